"""Policies of others: what the numbers of their inputs and outputs mean, as an environment has them.

Each number of theirs is one of ours, in another order and unit: ``ours = scale * theirs + offset``; and a network may
take and give it normalised, which is of the same kind. Both are composed, and become a few nodes around the network.

A policy in an ONNX file has a TOML file that says what its inputs and outputs mean::

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

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium as gym
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.validation import Positive, read_table
from bam_envs.core.wording import did_you_mean
from bam_envs.live.robot_checks import Check
from bam_train.checkpoint.manifest import Chunk
from bam_train.errors import CheckpointError
from bam_train.files.log_lines import counted
from bam_train.settings import tomllib

Array = NDArray[Any]
Units = Literal["degrees", "range", "si"]
PIXEL = 255.0
"""Brightest value of a pixel."""
PERCENT = 100.0
"""What LeRobot's robots call the end of a joint's range, and the open gripper."""
_GRIPPER = ("gripper", "gripper_width")


@dataclass(frozen=True)
class Affine:
    """``scale * x + offset``, number by number, or for each channel of an image."""

    scale: Array
    offset: Array

    def __call__(self, x: Array) -> Array:
        """Apply it in float64."""
        result: Array = self.scale * np.asarray(x, np.float64) + self.offset
        return result

    def after(self, other: Affine) -> Affine:
        """First `other`, then this."""
        return Affine(self.scale * other.scale, self.scale * other.offset + self.offset)

    @property
    def inverse(self) -> Affine:
        """The way back."""
        return Affine(1 / self.scale, -self.offset / self.scale)


@dataclass(frozen=True)
class Port:
    """An input or the output of a network; the fields are those of a description, see `described_policy`.

    Raises:
        InvalidValue: They do not say enough, or contradict each other.
    """

    name: str
    """As the graph calls it."""
    part: str = ""
    """The camera, or the vector of the observation: its key, or "" where the observation is one array."""
    size: tuple[int, ...] = ()
    """Its shape in one step, without batch and chunk: (k,), or (channels, height, width) of an image."""
    names: tuple[str, ...] = ()
    """What each number is, such as shoulder_pan.pos; () for the environment's own numbers in its order."""
    units: Units | None = None
    """Of the numbers with names."""
    mean: tuple[float, ...] = ()
    """The network takes and gives (x - mean) / std, number by number, or for each channel of an image."""
    std: tuple[Positive, ...] = ()
    """By default 1, and 255 of an image."""
    low: tuple[float, ...] = ()
    """Lowest value of each number in the data, in their units, for the detector of unusual observations."""
    high: tuple[float, ...] = ()
    """Highest value."""

    def __post_init__(self) -> None:
        size = self.size or (len(self.names),)
        if len(size) not in (1, 3) or size[0] < 1:
            raise InvalidValue(f"{self.name}: give names, or size: [numbers], or [channels, height, width] of an image")
        if self.names and self.units is None:
            raise InvalidValue(f"{self.name}: give units: 'degrees', 'range' or 'si'")
        scale = PIXEL if len(size) == 3 else 1.0
        whole = {"size": size, "mean": self.mean or (0.0,) * size[0], "std": self.std or (scale,) * size[0]}
        for name, value in {**whole, "units": self.units or "si", "low": self.low, "high": self.high}.items():
            if name not in ("size", "units") and len(value) not in (size[0], 0):
                raise InvalidValue(f"{self.name}: {name}: expected {counted(size[0], 'number')}, found {len(value)}")
            object.__setattr__(self, name, value)

    @property
    def data(self) -> Affine:
        """From the network's numbers to those of the data."""
        return Affine(np.array(self.std), np.array(self.mean))

    @property
    def is_image(self) -> bool:
        """Whether it is an image, with its channels first."""
        return len(self.size) == 3


@dataclass(frozen=True)
class ForeignPolicy:
    """A network as an ONNX graph, and what it takes and gives."""

    place: str
    """Where it was found, for messages."""
    network: bytes
    inputs: tuple[Port, ...]
    output: Port
    chunk: Chunk
    algorithm: str
    trainer: str
    period: float | None = None
    """Time between two actions [s]; None if unknown."""
    by: str = "onnxruntime"
    """What computes `answer`."""
    answer: Callable[[Mapping[str, Array]], Array] | None = None
    """The chunk for one observation, arrays (1, ...) by names of inputs, by its own library; None: by the graph."""
    steps: int = 0
    source: Mapping[str, Any] = field(default_factory=dict)
    """Where it comes from, for the manifest."""
    env: str | None = None
    """The environment that it was trained on, if it is one of ours."""
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of that."""

    @property
    def rate(self) -> float | None:
        """Actions in a second."""
        return None if self.period is None else round(1 / self.period, 6)


@dataclass(frozen=True)
class Meaning:
    """The numbers of a port as those of an environment."""

    order: NDArray[np.int64]
    """Which of ours each of theirs is."""
    si: Affine
    """From theirs to ours."""


def meaning(port: Port, labels: Sequence[Mapping[str, Any]], ranges: Mapping[str, tuple[float, float]]) -> Meaning:
    """What the numbers of a vector are; its names were checked by `number_checks`.

    Args:
        port: The input, or the output.
        labels: ``name`` of each number that the environment has.
        ranges: Range of each joint [rad] and of the gripper [m], by name.
    """
    ours = [str(label["name"]) for label in labels]
    if not port.names:
        return Meaning(np.arange(len(ours)), Affine(np.ones(len(ours)), np.zeros(len(ours))))
    names = [plain_name(name) for name in port.names]
    pairs = [_si(name, port.units, ranges.get(name, (-math.inf, math.inf))) for name in names]
    scale, offset = np.array(pairs).T
    return Meaning(np.array([ours.index(name) for name in names]), Affine(scale, offset))


def plain_name(name: str) -> str:
    """The name of a joint without LeRobot's ``.pos``; the gripper is the width between its pads."""
    name = name.removesuffix(".pos")
    return "gripper_width" if name in _GRIPPER else name


def _si(name: str, units: Units | None, limits: tuple[float, float]) -> tuple[float, float]:
    """Scale and offset from a number of theirs to SI units."""
    low, high = limits
    if units == "si":
        return 1.0, 0.0
    if name in _GRIPPER:  # 0 is closed, and 100 open
        return (high - low) / PERCENT, low
    if units == "degrees":
        return math.pi / 180, 0.0
    return (high - low) / (2 * PERCENT), (low + high) / 2  # -100 to 100


def fit_rows(policy: ForeignPolicy, env: gym.Env[Any, Any], period: float | None) -> Iterator[Check]:
    """The lines of a contract between the policy and an environment: rate, images, and each number of each vector."""
    signals: Mapping[str, Any] = getattr(env.unwrapped, "describe", lambda: {"observation": [], "action": []})()
    if policy.period is not None and period is not None:
        same = math.isclose(policy.period, period, rel_tol=1e-3)
        found = f"{1 / period:g} Hz" if same else f"{1 / period:g} Hz. Leave --env and --set rate= out"
        yield Check("rate", f"{policy.rate:g} Hz", found, fits=same)
    box: Any = env.action_space
    yield from _vector_rows("action", policy.output, signals["action"], math.prod(box.shape or ()), whole=True)
    for port in policy.inputs:
        space: Any = part_of(env.observation_space, port)
        what = f"input {port.name}"
        if space is None:
            found = f"the observation has {', '.join(filter(None, _parts(env.observation_space))) or 'one array'}"
            found += ". Choose its images with --set camera= and --set image_size=" if port.is_image else ""
            yield Check(what, port.part or "a vector", found, fits=False)
        elif port.is_image:
            channels, height, width = port.size
            found = (
                f"{space.shape[1]} x {space.shape[0]}, {space.shape[2]} channels"
                if len(space.shape) == 3
                else "numbers"
            )
            wanted = f"{width} x {height}, {channels} channels"
            yield Check(f"image {port.part}", wanted, found, fits=wanted == found and space.dtype == np.uint8)
        else:
            images = {key for key, leaf in _parts(env.observation_space).items() if len(leaf.shape or ()) == 3}
            labels = [one for one in signals["observation"] if one["name"] not in images]
            yield from _vector_rows(what, port, labels, math.prod(space.shape or ()), whole=False)


def _vector_rows(
    what: str, port: Port, labels: Sequence[Mapping[str, Any]], count: int, *, whole: bool
) -> Iterator[Check]:
    """With `whole`, each of the environment's numbers has to be among the policy's, and all of these once."""
    if not port.names:
        yield Check(what, counted(math.prod(port.size), "number"), counted(count, "number"), fits=(count,) == port.size)
        return
    if (len(port.names),) != port.size:
        yield Check(what, counted(port.size[0], "number"), counted(len(port.names), "name"), fits=False)
        return
    ours, theirs = [str(label["name"]) for label in labels], [plain_name(name) for name in port.names]
    for name, theirs_name in zip(theirs, port.names, strict=True):
        if name not in ours:
            yield Check(
                f"{what}: {theirs_name}", "a joint of the robot", f"none. {did_you_mean(name, ours)}", fits=False
            )
    for name in ours:
        found = theirs.count(name)
        if whole or found:
            yield Check(
                f"{what}: {name}", "once", {0: "missing", 1: "once"}.get(found, f"{found} times"), fits=found == 1
            )


def _parts(space: gym.Space[Any]) -> dict[str, gym.Space[Any]]:
    return dict(space.spaces) if isinstance(space, gym.spaces.Dict) else {"": space}


def part_of(space: gym.Space[Any], port: Port) -> gym.Space[Any] | None:
    """The space of the array that a port takes; a vector without a key is the only vector."""
    parts = _parts(space)
    return parts.get(part_key(space, port))


def part_key(space: gym.Space[Any], port: Port) -> str:
    """The key of the array that a port takes; "" where the observation is one array."""
    vectors = [key for key, leaf in _parts(space).items() if len(leaf.shape or ()) == 1]
    if port.is_image or port.part in _parts(space) or len(vectors) != 1:
        return port.part
    return vectors[0] if port.part in ("", "state", "environment_state") else port.part


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
