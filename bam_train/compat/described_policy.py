"""A policy of others as an ONNX file, with a TOML file that says what its inputs and outputs mean.

::

    network = "act.onnx"                        # beside this file
    rate = 20.0                                 # actions a second
    chunk = { size = 50, steps = 25 }           # where it gives several actions at once

    [[inputs]]
    name = "state"                              # of the graph
    names = ["shoulder_pan.pos", "gripper.pos"] # each number, in its order
    units = "degrees"                           # or range, -100 to 100; or si
    mean = [0.0, 50.0]                          # where the network takes (x - mean) / std
    std = [30.0, 20.0]

    [[inputs]]
    name = "image"
    part = "front"                              # the camera
    size = [3, 480, 640]                        # channels first; mean 0 and std 255 by default, for each channel

    [output]
    name = "action"
    names = ["shoulder_pan.pos", "gripper.pos"]
    units = "degrees"
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct

from bam_envs.core.wording import did_you_mean
from bam_train.checkpoint.manifest import Chunk
from bam_train.compat.foreign_policy import Affine, ForeignPolicy, Port, Units
from bam_train.errors import CheckpointError
from bam_train.settings import tomllib

_PIXEL = 255.0
_Positive = Annotated[float, Meta(gt=0)]


class _Port(Struct, forbid_unknown_fields=True):
    name: str
    part: str = ""
    size: list[int] = []
    names: list[str] = []
    units: Units | None = None
    mean: list[float] = []
    std: list[_Positive] = []

    def port(self, *, is_output: bool) -> Port:
        """What it is; raises ValueError where it does not say enough."""
        size = tuple(self.size) or (len(self.names),)
        if len(size) not in (1, 3) or size[0] < 1:
            raise ValueError(f"{self.name}: give names, or size: [numbers], or [channels, height, width] of an image")
        if self.names and self.units is None:
            raise ValueError(f'{self.name}: units: expected "degrees", "range" or "si"')
        is_image = len(size) == 3
        mean = np.array(self.mean or [0.0] * size[0])
        std = np.array(self.std or [_PIXEL if is_image else 1.0] * size[0])
        for name, array in (("mean", mean), ("std", std)):
            if array.shape != size[:1]:
                raise ValueError(f"{self.name}: {name}: expected {size[0]} numbers, found {len(array)}")
        to_data = Affine(std, mean)
        norm = to_data if is_output else to_data.inverse
        return Port(self.name, self.part, size, norm, tuple(self.names), self.units or "si")


class _Described(Struct, forbid_unknown_fields=True):
    network: str
    inputs: Annotated[list[_Port], Meta(min_length=1)]
    output: _Port
    rate: _Positive
    chunk: Chunk = Chunk(1, 1)
    algorithm: str = "policy"


def _read(text: str) -> _Described:
    """The content of a TOML file; raises ValueError or msgspec.MsgspecError."""
    table = tomllib.loads(text)
    chunk = table.get("chunk")
    for name in chunk if isinstance(chunk, dict) else ():
        if name not in Chunk.__dataclass_fields__:
            raise ValueError(f"chunk: there is no {name!r}. {did_you_mean(name, Chunk.__dataclass_fields__)}")
    described = msgspec.convert(table, type=_Described)
    if described.chunk.steps > described.chunk.size:
        raise ValueError(f"chunk: steps is {described.chunk.steps}, expected at most its size, {described.chunk.size}")
    return described


def described_policy(path: Path) -> ForeignPolicy:
    """The policy that a TOML file describes.

    Raises:
        CheckpointError: The file, or the network beside it, cannot be read or says too little.
    """
    path = path.expanduser()
    try:
        if path.suffix == ".onnx":
            raise ValueError("it is the network alone. Give a TOML file that says what its inputs and outputs mean")
        described = _read(path.read_text())
        network = path.parent / described.network
        inputs = tuple(one.port(is_output=False) for one in described.inputs)
        output = described.output.port(is_output=True)
        graph = network.read_bytes()
    except OSError as error:
        which = "it" if error.filename == str(path) else f"its network, {error.filename},"
        raise CheckpointError(path, f"{which} cannot be read: {error.strerror or error}. Check the name") from error
    except (ValueError, msgspec.MsgspecError) as error:  # ValueError: also of TOML
        raise CheckpointError(path, f"does not describe a policy: {error}") from error
    source: dict[str, Any] = {"description": str(path.absolute()), "network": str(network.absolute())}
    return ForeignPolicy(
        str(path),
        graph,
        inputs,
        output,
        described.chunk,
        described.algorithm,
        "onnx",
        1.0 / described.rate,
        source=source,
    )
