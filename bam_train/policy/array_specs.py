"""What a frozen policy knows of its spaces: their JSON form, read without Gymnasium; the check of an observation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bam_train.errors import PolicyError

_KINDS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")


@dataclass(frozen=True)
class ArraySpec:
    """One array of an observation, or the action."""

    name: str
    """Such as observation.camera; the graph's input of the same name takes it."""
    kind: str
    """Box, Discrete, MultiDiscrete or MultiBinary."""
    shape: tuple[int, ...]
    """Without a batch axis."""
    dtype: np.dtype[Any]
    """As the environment gives it."""
    low: np.ndarray | None
    """Lowest value; None for a MultiBinary."""
    high: np.ndarray | None
    """Highest value; None for a MultiBinary."""

    def checked(self, value: Any, batch: tuple[int, ...]) -> np.ndarray:
        """Return the value as an array that can be copied into this one.

        Args:
            value: (*batch, *shape).
            batch: Axes before the shape: () or (n,).

        Raises:
            PolicyError: The shape or the kind of number does not fit, or a Discrete is not in its range.
        """
        try:
            array = np.asarray(value)
        except ValueError as error:
            raise PolicyError(f"{self.name}: expected an array of shape {self._shape(batch)}, found {error}") from error
        if array.shape != (*batch, *self.shape):
            raise PolicyError(f"{self.name}: expected shape {self._shape(batch)}, found {array.shape}")
        if not np.can_cast(array.dtype, self.dtype, "same_kind"):
            raise PolicyError(f"{self.name}: expected numbers of type {self.dtype}, found {array.dtype}")
        if self.kind in ("Discrete", "MultiDiscrete") and not ((array >= self.low) & (array <= self.high)).all():
            raise PolicyError(f"{self.name}: expected {self.low} to {self.high}, found {array}")
        return array

    def _shape(self, batch: tuple[int, ...]) -> str:
        return f"{(*batch, *self.shape)} ({self.dtype})"


def observation_arrays(space: Mapping[str, Any]) -> list[ArraySpec]:
    """List the arrays of an observation space; that of a Dict are named observation.<key>.

    Args:
        space: As written by `bam_envs.core.spaces.space_to_json`.

    Raises:
        PolicyError: The space is of another kind than a policy takes.
    """
    if space.get("type") != "Dict":
        return [array_spec("observation", space)]
    return [array_spec(f"observation.{key}", inner) for key, inner in dict(space["spaces"]).items()]


def array_spec(name: str, space: Mapping[str, Any]) -> ArraySpec:
    """Read one space that is a single array."""
    kind = space.get("type")
    if kind not in _KINDS:
        raise PolicyError(
            f"{name}: a space of type {kind!r} cannot be used; expected {', '.join(_KINDS)} or a Dict of them"
        )
    try:
        return _array_spec(name, str(kind), space)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise PolicyError(f"{name}: its space cannot be read ({type(error).__name__}: {error}): {space}") from error


def _array_spec(name: str, kind: str, space: Mapping[str, Any]) -> ArraySpec:
    if kind == "MultiBinary":
        shape = tuple(np.atleast_1d(space["n"]).tolist())
        return ArraySpec(name, kind, shape, np.dtype(np.int8), None, None)
    dtype = np.dtype(space["dtype"])
    if kind == "Box":
        shape = tuple(space["shape"])
        return ArraySpec(name, kind, shape, dtype, _numbers(space["low"], shape), _numbers(space["high"], shape))
    counts = np.asarray(space["n"] if kind == "Discrete" else space["nvec"], np.int64)
    low = np.broadcast_to(np.asarray(space.get("start", 0), np.int64), counts.shape)
    return ArraySpec(name, kind, counts.shape, dtype, low, low + counts - 1)


def _numbers(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Read a number or nested lists of them, infinities as text."""
    flat = np.vectorize(float, otypes=[np.float64])(np.array(values, dtype=object))
    return np.broadcast_to(flat, shape)
