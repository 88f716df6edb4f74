"""An episode as arrays, and what all episodes of a data set have in common."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.spaces import Path, joined, leaves_by_path, part_at, place_of, space_from_json, space_to_json
from bam_envs.core.wording import brief
from bam_train.errors import BadDataSet

Array = NDArray[Any]
Values = Any
"""An array, or nested dicts and tuples of arrays, as the space is."""


@dataclass(frozen=True)
class DataSetInfo:
    """What is equal for all episodes of a data set."""

    env: str
    """Gymnasium id, such as bam/pick-v0."""
    env_kwargs: dict[str, Any]
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    period: float
    """Time of a step [s]."""
    robot: str = ""
    """Name of the robot; "" for none."""
    contract: dict[str, Any] = field(default_factory=dict)
    """Names and units of the numbers, as the ``signals`` of a checkpoint's manifest; {} if unknown."""

    @property
    def fps(self) -> int:
        """Steps per second as LeRobot has them: a whole number from 1 on."""
        return max(1, round(1 / self.period))

    @property
    def observation_leaves(self) -> list[Leaf]:
        """The arrays of an observation; BadDataSet as `leaves_of`."""
        return leaves_of(self.observation_space, "observation")

    @property
    def action_leaves(self) -> list[Leaf]:
        """The arrays of an action; BadDataSet as `leaves_of`."""
        return leaves_of(self.action_space, "action")

    def to_json(self) -> dict[str, Any]:
        """Plain values for `from_json`."""
        spaces = {name: space_to_json(getattr(self, name)) for name in ("observation_space", "action_space")}
        plain: dict[str, Any] = json.loads(json.dumps({**vars(self), **spaces}))
        return plain

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> DataSetInfo:
        """The info that `to_json` gave as plain values."""
        spaces: Any = {name: space_from_json(value[name]) for name in ("observation_space", "action_space")}
        known = {name: value[name] for name in ("env", "env_kwargs", "period", "robot", "contract")}
        return cls(**known, **spaces)


@dataclass
class Episode:
    """One episode of T steps."""

    observations: Values
    """Of the space's own dtype, the final one included; a dict for Dict spaces. Shape: (T + 1, ...)."""
    actions: Values
    """Of the space's own dtype. Shape: (T, ...)."""
    rewards: NDArray[np.float64]
    """Shape: (T,)."""
    terminated: bool
    """Whether the task ended with the last step."""
    truncated: bool
    """Whether the time limit, or a person, ended the episode."""
    success: bool | None = None
    """None if unknown."""
    columns: dict[str, Array] = field(default_factory=dict)
    """Further numbers or texts of each step, shape (T, ...): ``time`` (wall clock [s] of the observation),
    ``raw_action``, ``command``, ``guard``, ``intervention``, ``info.NAME``, ``propensity``."""
    facts: dict[str, Any] = field(default_factory=dict)
    """JSON values of the episode: ``seed``, ``policy`` (digest), ``task``, ``date``, ``group``."""
    digest: str = ""
    """SHA-256 of observations, actions, rewards and end; filled by reader and writer."""

    def __len__(self) -> int:
        return len(self.rewards)


@dataclass
class Transitions:
    """All steps of several episodes; n steps in all."""

    observations: Values
    """Shape: (n, ...)."""
    actions: Values
    """Shape: (n, ...)."""
    rewards: NDArray[np.float64]
    """Shape: (n,)."""
    next_observations: Values
    """Shape: (n, ...)."""
    terminals: NDArray[np.bool_]
    """Whether the task ended with this step; False for truncation. Shape: (n,)."""
    episode: NDArray[np.int64]
    """Index of the step's episode in the data set. Shape: (n,)."""


@dataclass(frozen=True)
class Leaf:
    """A part of a space that is one array, and the column of its numbers."""

    path: Path
    """Keys of Dict spaces and places in Tuple spaces from the root to it; () for the root."""
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    column: str
    is_image: bool = False

    def of(self, values: Values) -> Any:
        """Its part of nested `values`."""
        return part_at(values, self.path)


def leaves_of(space: gym.Space[Any], kind: str) -> list[Leaf]:
    """The leaves of an observation or action space; `kind` is ``observation`` or ``action``.

    Raises:
        BadDataSet: A space without a fixed number of values, such as Text.
    """
    leaves = [_leaf(path, part, kind) for path, part in leaves_by_path(space)]
    names = [leaf.column for leaf in leaves]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise BadDataSet(f"the {kind} space has two parts that would be the column {twice!r}; rename one")
    return leaves


def _leaf(path: Path, space: gym.Space[Any], kind: str) -> Leaf:
    if not isinstance(space, gym.spaces.Box | gym.spaces.Discrete | gym.spaces.MultiDiscrete | gym.spaces.MultiBinary):
        raise BadDataSet(
            f"the {place_of(f'{kind} space', path)} is {brief(space)}; a data set holds Box, Discrete, MultiDiscrete, "
            "MultiBinary, and Dict and Tuple of them"
        )
    shape, dtype = tuple(space.shape or ()), np.dtype(space.dtype)
    is_image = kind == "observation" and dtype == np.uint8 and len(shape) == 3 and shape[2] in (1, 3, 4)
    name = ".".join(str(part).replace("/", "_") for part in path)
    if kind == "action":
        column = f"action.{name}" if name else "action"
    else:
        column = f"observation.images.{name or 'camera'}" if is_image else f"observation.{name or 'state'}"
    return Leaf(path, shape, dtype, column, is_image)


def nested(space: gym.Space[Any], arrays: Mapping[str, Array], leaves: list[Leaf]) -> Values:
    """Nested values of `space` from the arrays of its leaves by column."""
    return joined(space, {leaf.path: arrays[leaf.column] for leaf in leaves})


def digest_of(arrays: Mapping[str, Array], *end: bool | None) -> str:
    """SHA-256 of an episode's arrays by column, and of how it ended: terminated, truncated, success; hexadecimal."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        if array.dtype.kind in "UO":
            digest.update(json.dumps([name, [str(one) for one in array]]).encode())
            continue
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name}:{array.dtype.str}:{array.shape};".encode())
        digest.update(array.reshape(-1).view(np.uint8).data)
    digest.update(json.dumps(end).encode())
    return digest.hexdigest()
