"""What n environments give, as one array (n, ...) for each variable: observations, and chosen entries of the infos.

An observation is one variable ``env_obs``, or, for a (nested) dict, one for each entry: ``env_obs/<key>/<key>``. As in
Gymnasium's vector environments, entry k of the infos is the variable ``info/k`` beside the mask ``info/_k``. It begins
with the first value that any environment gives, since its dtype and shape are not known earlier; from then on it is
written at every time, zero where the mask is False.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from bam_train.errors import ValueMismatch
from bam_train.loop.variables import kind_name

Array = NDArray[Any]
NAME = "env_obs"


class Entry(NamedTuple):
    """One variable of an observation."""

    name: str
    """``env_obs`` or ``env_obs/<key>/<key>``."""
    path: tuple[str, ...]
    """The keys to it; none for an observation that is no dict."""
    dtype: np.dtype[Any]
    """What it is written as."""
    shape: tuple[int, ...]
    """The shape for one environment; () for a number."""


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


def pack(entry: Entry, observations: Sequence[Any]) -> Array:
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
        k, shape = next((k, s) for k, s in enumerate(map(np.shape, values)) if s != entry.shape)
        raise ValueMismatch(f"{entry.name!r}: expected shape {entry.shape}, found {shape} from environment {k}.")
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


class InfoRecorder:
    """Takes the entries named `keys` out of infos.

    Args:
        keys: The entries.
        num_envs: The number of environments.
        for_torch: Floats become float32, else they become float64.
    """

    def __init__(self, keys: Sequence[str], num_envs: int, for_torch: bool) -> None:
        self.keys, self._num_envs = tuple(keys), num_envs
        self._floats = np.dtype(np.float32 if for_torch else np.float64)
        self._known: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def of_each(self, infos: Sequence[Mapping[str, Any]]) -> dict[str, Array]:
        """From one info for each environment."""
        found: dict[str, Array] = {}
        for key in self.keys:
            mask = np.array([key in info for info in infos])
            given = [(k, info[key]) for k, info in enumerate(infos) if mask[k]]
            if given:
                self._learn(key, np.asarray(given[0][1]))
            if key in self._known:
                self._write(found, key, mask, given)
        return found

    def of_vector(self, infos: Mapping[str, Any]) -> dict[str, Array]:
        """From the infos of a vector environment."""
        found: dict[str, Array] = {}
        for key in self.keys:
            mask = np.zeros(self._num_envs, dtype=bool)
            if key in infos:
                mask[:] = infos.get(f"_{key}", True)
                values = np.asarray(infos[key])
                self._learn(key, values[0])
            if key in self._known:
                self._write(found, key, mask, [(mask, values[mask])] if mask.any() else [])
        return found

    def replaced(self, new: dict[str, Array], old: Mapping[str, Array], chosen: Array) -> None:
        """In `new`, take the environments `chosen` (n,) bool from `old`; where `old` has nothing, nothing was given."""
        for name, array in old.items():
            if name.startswith("info/") and name not in new:
                new[name] = np.zeros_like(array)
        for name, array in new.items():
            array[chosen] = old[name][chosen] if name in old else 0

    def _learn(self, key: str, value: Any) -> None:
        array = np.asarray(value)
        kinds = {"b": np.dtype(bool), "i": np.dtype(np.int64), "u": np.dtype(np.int64), "f": self._floats}
        if array.dtype.kind not in kinds:
            raise ValueMismatch(f"info {key!r}: expected a number or an array of them, found a {kind_name(value)}.")
        self._known.setdefault(key, (kinds[array.dtype.kind], array.shape))

    def _write(self, found: dict[str, Array], key: str, mask: Array, given: Sequence[tuple[Any, Any]]) -> None:
        dtype, shape = self._known[key]
        found[f"info/{key}"] = values = np.zeros((self._num_envs, *shape), dtype)
        found[f"info/_{key}"] = mask
        for where, value in given:
            if np.shape(value)[np.ndim(where) :] != shape:
                raise ValueMismatch(f"info {key!r}: expected shape {shape}, found {np.shape(value)[np.ndim(where) :]}.")
            values[where] = value
