"""Spaces of a frozen policy, read from JSON without Gymnasium; the check of an observation."""

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
    """Name of the graph's input, such as observation.camera, or ``action``."""
    kind: str
    """Box, Discrete, MultiDiscrete or MultiBinary."""
    shape: tuple[int, ...]
    """Without a batch axis."""
    dtype: np.dtype[Any]
    """The dtype of the environment."""
    low: np.ndarray | None = None
    """Lowest value; None for a MultiBinary."""
    high: np.ndarray | None = None

    def checked(self, value: Any, batch: tuple[int, ...]) -> np.ndarray:
        """Return the value as an array (*batch, *shape) that can be cast to this dtype; the batch is () or (n,)."""
        shape = (*batch, *self.shape)
        try:
            array = np.asarray(value)
        except ValueError as error:
            raise PolicyError(
                f"{self.name}: expected an array of shape {shape} ({self.dtype}), found {error}"
            ) from error
        if array.shape != shape:
            raise PolicyError(f"{self.name}: expected shape {shape} ({self.dtype}), found {array.shape}")
        if not np.can_cast(array.dtype, self.dtype, "same_kind"):
            raise PolicyError(f"{self.name}: expected numbers of type {self.dtype}, found {array.dtype}")
        if self.kind in ("Discrete", "MultiDiscrete") and not ((array >= self.low) & (array <= self.high)).all():
            raise PolicyError(f"{self.name}: expected {self.low} to {self.high}, found {array}")
        return array


def observation_arrays(space: Mapping[str, Any]) -> list[ArraySpec]:
    """List the arrays of an observation space in JSON form; those of a Dict are named observation.<key>."""
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
        if kind == "MultiBinary":
            return ArraySpec(name, kind, tuple(np.atleast_1d(space["n"]).tolist()), np.dtype(np.int8))
        dtype = np.dtype(space["dtype"])
        if kind == "Box":
            shape = tuple(space["shape"])
            return ArraySpec(name, kind, shape, dtype, _bound(space["low"], shape), _bound(space["high"], shape))
        counts = np.asarray(space["n" if kind == "Discrete" else "nvec"], np.int64)
        low = np.broadcast_to(np.asarray(space.get("start", 0), np.int64), counts.shape)
        return ArraySpec(name, kind, counts.shape, dtype, low, low + counts - 1)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise PolicyError(f"{name}: its space cannot be read ({type(error).__name__}: {error}): {space}") from error


def _bound(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Read a number or nested lists of them, infinities as text."""
    flat = np.vectorize(float, otypes=[np.float64])(np.array(values, dtype=object))
    return np.broadcast_to(flat, shape)
