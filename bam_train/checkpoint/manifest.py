"""`bam/manifest.json` describes a checkpoint; it is checked against one schema, as a checkpoint may be untrusted."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from bam_train.errors import CheckpointError, CheckpointMismatch

FORMAT = 1
MANIFEST = "bam/manifest.json"
AGAIN = "Copy it again from its source, or train again"
MOST_MANIFEST = 8 * 2**20
"""Maximum bytes of a manifest, which is read before anything is verified."""
MOST_NUMBERS = 2**26
"""Maximum numbers of an observation or action; a colour picture of 3840 x 2160 pixels has 25 million."""
WHERE = frozenset(
    {"robot", "robot_name", "transport", "profile", "guards", "trial", "shadow", "ca_file", "token_file", "rs_address"}
)
"""Arguments of an environment that determine where it runs, `bam_envs.core.location.WHERE`, and robo-gym's name of a
robot's address. Spelt here, because a policy runs where nothing of `bam_envs` is imported."""

_Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Digest = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


@dataclass(frozen=True)
class Chunk:
    """How a policy answers that gives several actions at once, a chunk, one for each of the next steps."""

    size: Annotated[int, Meta(ge=1, le=1000)]
    """Actions of a chunk; none is sent more than so many steps after its observation."""
    steps: Annotated[int, Meta(ge=1, le=1000)]
    """Steps after which the next chunk is due; at most `size`."""
    history: Annotated[int, Meta(ge=1, le=16)] = 1
    """Number of the last observations that it sees, the newest last."""
    ensemble: float | None = None
    """The actions of all chunks for a step are averaged, the i-th oldest with the weight exp(-ensemble i), and a chunk
    is due in every step (temporal ensembling: Zhao et al. 2023); None: the newest chunk counts."""
    overlap: Annotated[int, Meta(ge=1, le=1000)] | None = None
    """Steps in which a chunk continues what is left of the one before, by a policy that makes it so (real-time
    chunking: Black et al. 2025; LeRobot's execution_horizon); None: it is made without that."""
    when_lost: Literal["finish", "halt"] = "finish"
    """If the server that computes the chunks is lost: the actions that wait are executed, and the robot halts if no
    chunk comes until then; or it halts at once."""

    def __post_init__(self) -> None:
        if self.steps > self.size:
            raise ValueError(f"chunk: steps is {self.steps}, expected at most its size, {self.size}")


@dataclass(frozen=True)
class Manifest:
    """`bam/manifest.json`."""

    format: Literal[1]
    """Version of the file's layout."""
    env: str
    """Versioned environment id, e.g. bam/pick-v0."""
    env_kwargs: dict[str, Any]
    """Keyword arguments that the environment was made with."""
    observation_space: dict[str, Any]
    """The environment's observation space, as written by `bam_envs.core.spaces.space_to_json`."""
    action_space: dict[str, Any]
    """The environment's action space, in the same form."""
    signals: dict[str, list[dict[str, Any]]]
    """Name, unit, low and high of every entry of observation, action, command and state; {} if unknown."""
    period: Annotated[float, Meta(gt=0)] | None
    """Time between two actions [s]; None if the environment has no period."""
    algorithm: str
    """Such as ppo."""
    trainer: str
    """Such as sb3."""
    settings: dict[str, Any]
    """All settings of the run."""
    steps: _Count
    """Environment steps trained."""
    seed: _Count
    """Seed of the run."""
    scores: dict[str, Any]
    """The last evaluation before it was saved."""
    versions: dict[str, Any]
    """Versions of Python and of the packages that made it."""
    git_commit: str | None
    """Commit of the source tree; None if it was installed."""
    created: str
    """UTC, ISO 8601."""
    sha256: dict[str, _Digest]
    """Hex digest of every other member."""
    data: dict[str, Any] = field(default_factory=dict)
    """What it learnt from a data set: the ``digest`` of the set, those of its training ``episodes``, and the number of
    their ``steps``; {} if it learnt from none."""
    chunk: Chunk | None = None
    """If the policy gives several actions at once."""


_Number = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
_Bound = float | Literal["inf", "-inf"] | list[Any]
_Shape = Annotated[list[_Count], Meta(max_length=32)]
_DType = Literal[
    "bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float16", "float32", "float64"
]


class _Box(Struct, tag_field="type", tag="Box"):
    shape: _Shape
    dtype: _DType
    low: _Bound
    high: _Bound


class _Discrete(Struct, tag_field="type", tag="Discrete"):
    n: Annotated[int, Meta(ge=1, le=2**63 - 1)]
    start: _Number
    dtype: _DType


class _MultiDiscrete(Struct, tag_field="type", tag="MultiDiscrete"):
    nvec: list[Any]
    start: list[Any]
    dtype: _DType


class _MultiBinary(Struct, tag_field="type", tag="MultiBinary"):
    n: _Shape


class _Dict(Struct, tag_field="type", tag="Dict"):
    spaces: Annotated[dict[str, _Box | _Discrete | _MultiDiscrete | _MultiBinary], Meta(max_length=1000)]


_Space = _Box | _Discrete | _MultiDiscrete | _MultiBinary | _Dict


class _Scores(Struct):
    success_rate: float | None = None
    success_interval: tuple[float, float] | None = None
    return_mean: float | None = None
    episodes: _Count | None = None


class _Data(Struct):
    digest: _Digest | None = None
    episodes: list[_Digest] = []
    steps: _Count = 0


class _Contents(Struct):
    """Fields whose content is checked besides the types of `Manifest`."""

    observation_space: _Space
    action_space: _Space
    scores: _Scores
    data: _Data = msgspec.field(default_factory=_Data)


class _Head(Struct):
    format: Any


def parse_manifest(path: Path, data: bytes) -> Manifest:
    """Read the manifest of the checkpoint at `path`; fields that this version does not know are ignored.

    Raises:
        CheckpointMismatch: Written by a newer bam-train.
        CheckpointError: A field is missing, of the wrong type or not allowed in a file.
    """
    try:
        manifest = _parse(path, data)
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        raise CheckpointError(path, f"{MANIFEST}: {error}. {AGAIN}", member=MANIFEST) from error
    try:
        require_no_place(manifest.env_kwargs)
    except ValueError as error:  # another copy would be the same
        remedy = "Ask whoever made it, or train again"
        raise CheckpointError(path, f"{MANIFEST}: {error}. {remedy}", member=MANIFEST) from error
    return manifest


def manifest_bytes(path: Path, values: Mapping[str, Any]) -> bytes:
    """Write the manifest of the checkpoint at `path` from every field of `Manifest` but for ``format``."""
    known = [field.name for field in fields(Manifest)]
    values = {"format": FORMAT, **values}
    try:
        if unknown := sorted(set(values) - set(known)):
            raise ValueError(f"there is no field {unknown[0]!r}")
        ordered = {name: values[name] for name in known if name in values}
        data = json.dumps(ordered, indent=2, allow_nan=False).encode()
        require_no_place(_parse(path, data).env_kwargs)
    except (msgspec.MsgspecError, TypeError, RecursionError, ValueError) as error:
        raise CheckpointError(path, f"cannot be written: {MANIFEST}: {error}") from error
    return data


def require_no_place(env_kwargs: Mapping[str, Any]) -> None:
    """Raise ValueError for arguments that determine where an environment runs or which one it is, or name a file."""
    for name in sorted(env_kwargs.keys() & (WHERE | {"env_id", "id"})):
        what = "where the environment runs" if name in WHERE else "which environment it is"
        raise ValueError(f"env_kwargs.{name} says {what}: flags such as --robot say that, never a file")
    arm = env_kwargs.get("robot_model")
    if isinstance(arm, str) and arm.endswith(".toml"):
        raise ValueError(f"env_kwargs.robot_model names the file {arm}; a checkpoint holds the content instead")
    link = env_kwargs.get("link")
    if isinstance(link, str) and link.endswith(".json"):
        raise ValueError(f"env_kwargs.link names the file {link}, of which a checkpoint holds the content instead")


def _parse(path: Path, data: bytes) -> Manifest:
    if len(data) > MOST_MANIFEST:
        raise ValueError(f"{len(data)} bytes, expected at most {MOST_MANIFEST}")
    found = msgspec.json.decode(data, type=_Head).format
    if type(found) is int and found > FORMAT:
        text = f"has format {found}; this bam-train reads up to {FORMAT}. Run: pip install --upgrade bam-train"
        raise CheckpointMismatch(path, text)
    manifest = msgspec.json.decode(data, type=Manifest)
    contents = msgspec.json.decode(data, type=_Contents)
    if not re.fullmatch(r"([\w.]+:)?[^:]+", manifest.env):
        raise ValueError(f"env {manifest.env!r} is no environment id, such as bam/pick-v0 or module:Env-v0")
    for name in ("observation_space", "action_space"):
        _require_reasonable(name, getattr(contents, name))
    return manifest


def _require_reasonable(name: str, space: _Space) -> None:
    """Refuse a space of more numbers than a policy can take."""
    if isinstance(space, _Dict):
        for key, inner in space.spaces.items():
            _require_reasonable(f"{name}.{key}", inner)
        return
    shape = space.n if isinstance(space, _MultiBinary) else space.shape if isinstance(space, _Box) else []
    if math.prod(shape) > MOST_NUMBERS:
        raise ValueError(f"{name} has shape {shape}, {math.prod(shape)} numbers; expected at most {MOST_NUMBERS}")
