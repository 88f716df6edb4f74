"""Observations of n environments as one array for each variable.

What a space gives is one variable ``env_obs``, or, for a (nested) dict, one for each entry: ``env_obs/<key>/<key>``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from bam_train.errors import ValueMismatch
from bam_train.loop.arrays import kind_name

NAME = "env_obs"


class Entry(NamedTuple):
    """One variable of an observation.

    Attributes:
        name: ``env_obs`` or ``env_obs/<key>/<key>``.
        path: The keys to it; none for an observation that is no dict.
        dtype: What it is written as.
        shape: Shape for one environment; () for a number.
    """

    name: str
    path: tuple[str, ...]
    dtype: np.dtype[Any]
    shape: tuple[int, ...]


def names(space: Space[Any], name: str = NAME) -> tuple[str, ...]:
    """The variables that observations of `space` are written to."""
    if isinstance(space, spaces.Dict):
        return tuple(one for key, part in space.spaces.items() for one in names(part, f"{name}/{key}"))
    return (name,)


def entries(observation: Any, space: Space[Any] | None, for_torch: bool) -> list[Entry]:
    """What an observation consists of.

    Args:
        observation: Of one environment.
        space: Where the dtype comes from unless `for_torch`; None for the observation's own.
        for_torch: Floats become float32 and integers int64, whatever they are.

    Raises:
        ValueMismatch: It is neither an array, nor a number, nor a dict of them.
    """
    return [
        Entry(name, path, _dtype(name, value, part, for_torch), np.shape(_plain(value)))
        for name, path, value, part in _walk(NAME, (), observation, space)
    ]


def _walk(
    name: str, path: tuple[str, ...], value: Any, space: Space[Any] | None
) -> Iterator[tuple[str, tuple[str, ...], Any, Space[Any] | None]]:
    if not isinstance(value, Mapping):
        yield name, path, value, space
        return
    for key, one in value.items():
        part = space.spaces.get(key) if isinstance(space, spaces.Dict) else None
        yield from _walk(f"{name}/{key}", (*path, key), one, part)


def _dtype(name: str, value: Any, space: Space[Any] | None, for_torch: bool) -> np.dtype[Any]:
    found = None if isinstance(value, (tuple, str)) else np.asarray(_plain(value)).dtype
    if found is None or found.kind not in "fiub":
        raise ValueMismatch(
            f"{name!r}: expected an array, a number or a dict of them, found a {kind_name(value)}; "
            "wrap the environment, for example in gymnasium.wrappers.FlattenObservation."
        )
    if not for_torch:
        return found if space is None or space.dtype is None else np.dtype(space.dtype)
    if found.kind == "f":
        return np.dtype(np.float32)
    return np.dtype(bool if isinstance(value, (bool, np.bool_)) else np.int64)


def _plain(value: Any) -> Any:
    """The value itself; of a tensor, its NumPy array."""
    return value.detach().cpu().numpy() if hasattr(value, "detach") else value


def pack(entry: Entry, observations: Sequence[Any]) -> NDArray[Any]:
    """One new array (n, ...) from the observations of n environments.

    Raises:
        ValueMismatch: One has another shape than the first observation of all had, or lacks a key.
    """
    values = [pick(entry, one) for one in observations] if entry.path else observations
    if hasattr(values[0], "detach"):
        values = [_plain(one) for one in values]
    try:
        array = np.array(values, dtype=entry.dtype)
    except ValueError:  # they differ among each other
        array = np.empty(0)
    if array.shape[1:] != entry.shape or len(array) != len(observations):
        row, shape = next((k, s) for k, s in enumerate(map(np.shape, values)) if s != entry.shape)
        raise ValueMismatch(f"{entry.name!r}: expected shape {entry.shape}, found {shape} from environment {row}.")
    return array


def pick(entry: Entry, observation: Any) -> Any:
    """The part of an observation that `entry` is about.

    Raises:
        ValueMismatch: It lacks a key.
    """
    try:
        for key in entry.path:
            observation = observation[key]
    except (KeyError, TypeError, IndexError):
        raise ValueMismatch(f"{entry.name!r}: the environment gave an observation without it.") from None
    return observation
