"""A policy of others as an ONNX file, with a TOML file that says what its inputs and outputs mean.

::

    network = "act.onnx"                        # beside this file
    rate = 20.0                                 # actions a second
    chunk = { size = 50, steps = 25 }           # where it gives several actions at once; see `Chunk`

    [[inputs]]                                  # see `Port`
    name = "state"                              # of the graph
    names = ["shoulder_pan.pos", ..., "gripper.pos"]  # each number, in its order
    units = "degrees"                           # or range, -100 to 100; or si
    mean = [0.0, ..., 50.0]                     # where the network takes (x - mean) / std
    std = [30.0, ..., 20.0]
    low = [-80.0, ..., 0.0]                     # the range in the data
    high = [80.0, ..., 100.0]

    [[inputs]]
    name = "image"
    part = "front"                              # the camera
    size = [3, 480, 640]                        # channels first; mean 0 and std 255 by default, for each channel

    [output]
    name = "action"
    names = ["shoulder_pan.pos", ..., "gripper.pos"]
    units = "degrees"
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from bam_envs.core.validation import Positive, read_table
from bam_train.checkpoint.manifest import Chunk
from bam_train.compat.foreign_policy import ForeignPolicy, Port
from bam_train.errors import CheckpointError
from bam_train.settings import tomllib


@dataclass(frozen=True)
class _Description:
    network: str
    inputs: Annotated[list[dict[str, Any]], Meta(min_length=1, description="a list of tables, [[inputs]]")]
    output: dict[str, Any]
    rate: Positive
    chunk: dict[str, Any] | None = None
    algorithm: str = "policy"


def described_policy(path: Path) -> ForeignPolicy:
    """The policy that a TOML file describes.

    Raises:
        CheckpointError: The file, or the network beside it, cannot be read or says too little.
    """
    path = path.expanduser()
    try:
        if path.suffix == ".onnx":
            raise ValueError("it is the network alone. Give a TOML file that says what its inputs and outputs mean")
        described = read_table(_Description, tomllib.loads(path.read_text()), "the file")
        chunk = Chunk(1, 1) if described.chunk is None else read_table(Chunk, described.chunk, "chunk")
        inputs = tuple(_port(one, f"inputs[{i}]") for i, one in enumerate(described.inputs))
        output, network = _port(described.output, "output"), path.parent / described.network
        graph = network.read_bytes()
    except OSError as error:
        which = "it" if error.filename == str(path) else f"its network, {error.filename},"
        raise CheckpointError(path, f"{which} cannot be read: {error.strerror or error}. Check the name") from error
    except tomllib.TOMLDecodeError as error:
        raise CheckpointError(path, f"is not TOML: {error}. Correct it there") from error
    except ValueError as error:
        raise CheckpointError(path, f"does not describe a policy: {error}") from error
    source: dict[str, Any] = {"description": str(path.absolute()), "network": str(network.absolute())}
    return ForeignPolicy(
        str(path),
        graph,
        inputs,
        output,
        chunk,
        described.algorithm,
        "onnx",
        1.0 / described.rate,
        source=source,
    )


def _port(table: dict[str, Any], place: str) -> Port:
    return read_table(Port, table, str(table.get("name", place)))
