"""Observations, infos and actions of n Gymnasium environments, as one array (n, ...) for each variable.

An observation is one variable ``env_obs``, or, for a (nested) dict, one for each entry: ``env_obs/<key>/<key>``. An
action is the variable ``action``, or ``action/<key>/<key>``. As in Gymnasium's vector environments, entry k of the
infos is the variable ``info/k`` beside the mask ``info/_k``. It begins with the first value that any environment gives,
since its dtype and shape are not known earlier; from then on it is written at every time, zero where the mask is False.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from bam_train.errors import ValueMismatch
from bam_train.loop.variables import kind_name, mismatch, to_array

Array = NDArray[Any]
NAME = "env_obs"
_WHOLE = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_GIVEN = {"f": np.float64, "i": np.int64, "u": np.int64, "b": np.bool_}
"""What single environments are given, by kind of action."""


# -- observations ------------------------------------------------------------------------------------------------------


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


def entries(
    value: Any, space: Space[Any] | None, for_torch: bool, name: str = NAME, path: tuple[str, ...] = ()
) -> list[Entry]:
    """The variables of the observation `value` of one environment.

    Args:
        value: An array, a number or a dict of them; anything else raises `ValueMismatch`.
        space: Where the dtype comes from unless `for_torch`; None for the observation's own.
        for_torch: Floats become float32 and integers int64, whatever they are.
        name: The variable; of a dict, the first part of its entries'.
        path: The keys to it.
    """
    if isinstance(value, Mapping):
        found = []
        for key, one in value.items():
            part = space.spaces.get(key) if isinstance(space, spaces.Dict) else None
            found += entries(one, part, for_torch, f"{name}/{key}", (*path, key))
        return found
    dtype = None if isinstance(value, (tuple, str)) else np.asarray(_plain(value)).dtype
    if dtype is None or dtype.kind not in "fiub":
        raise ValueMismatch(
            f"{name!r}: expected an array, a number or a dict of them, found a {kind_name(value)}; "
            "wrap the environment, for example in gymnasium.wrappers.FlattenObservation."
        )
    if for_torch:
        whole = bool if isinstance(value, (bool, np.bool_)) else np.int64
        dtype = np.dtype(np.float32 if dtype.kind == "f" else whole)
    elif space is not None and space.dtype is not None:
        dtype = np.dtype(space.dtype)
    return [Entry(name, path, dtype, np.shape(_plain(value)))]


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
    """The part of an observation that `entry` is about."""
    try:
        for key in entry.path:
            observation = observation[key]
    except (KeyError, TypeError, IndexError):
        raise ValueMismatch(f"{entry.name!r}: the environment gave an observation without it.") from None
    return observation


# -- infos -------------------------------------------------------------------------------------------------------------


class InfoRecorder:
    """Takes the entries named `keys` out of infos; floats become `floats`, float32 or float64."""

    def __init__(self, keys: Sequence[str], num_envs: int, floats: np.dtype[Any]) -> None:
        self._keys, self._num_envs = tuple(keys), num_envs
        whole = np.dtype(np.int64)
        self._dtypes = {"b": np.dtype(bool), "i": whole, "u": whole, "f": floats}
        self._known: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def of_each(self, infos: Sequence[Mapping[str, Any]]) -> dict[str, Array]:
        """From one info for each environment."""
        found: dict[str, Array] = {}
        for key in self._keys:
            mask = np.array([key in info for info in infos])
            self._record(found, key, mask, [(k, info[key]) for k, info in enumerate(infos) if mask[k]])
        return found

    def of_vector(self, infos: Mapping[str, Any]) -> dict[str, Array]:
        """From the infos of a vector environment."""
        found: dict[str, Array] = {}
        for key in self._keys:
            mask = np.zeros(self._num_envs, dtype=bool)
            if key in infos:
                mask[:] = infos.get(f"_{key}", True)
            self._record(found, key, mask, [(mask, np.asarray(infos[key])[mask])] if mask.any() else [])
        return found

    def _record(self, found: dict[str, Array], key: str, mask: Array, given: Sequence[tuple[Any, Any]]) -> None:
        """Add one entry to `found`; `given` has indices of environments, and their values."""
        for index, value in given:
            one = value[0] if np.ndim(index) else value
            array = np.asarray(one)
            if array.dtype.kind not in self._dtypes:  # at every time: NumPy writes None as NaN and "2" as 2
                raise ValueMismatch(f"info {key!r}: expected a number or an array of them, found a {kind_name(one)}.")
            self._known.setdefault(key, (self._dtypes[array.dtype.kind], array.shape))
        if key not in self._known:
            return
        dtype, shape = self._known[key]
        found[f"info/{key}"] = values = np.zeros((self._num_envs, *shape), dtype)
        found[f"info/_{key}"] = mask
        for index, value in given:
            if np.shape(value)[np.ndim(index) :] != shape:
                raise ValueMismatch(f"info {key!r}: expected shape {shape}, found {np.shape(value)[np.ndim(index) :]}.")
            values[index] = value


# -- actions -----------------------------------------------------------------------------------------------------------


class ActionReader:
    """Reads the actions of n environments, and checks them against the action space.

    Its methods raise `UnknownVariable` or `TimeNotWritten` where nobody wrote an action, and `ValueMismatch` where it
    does not fit the space or is not for n environments.

    Args:
        name: The variable, or the first part of the variables' names.
        space: Of one environment. Spaces of other kinds than Box, Discrete, MultiDiscrete, MultiBinary and Dict are
            not checked.
        num_envs: n.
    """

    def __init__(self, name: str, space: Space[Any], num_envs: int) -> None:
        self._num_envs, self._is_nested = num_envs, isinstance(space, spaces.Dict)
        self._parts = list(_parts(name, (), space, num_envs))

    def each(self, workspace: Any, t: int) -> Sequence[Any]:
        """One action for each environment: an int, an array (float64 or int64), or a nested dict of these."""
        if not self._is_nested:
            return self._parts[0].each(workspace, t)
        columns = [(part.path, part.each(workspace, t)) for part in self._parts]
        return [_nested((path, values[k]) for path, values in columns) for k in range(self._num_envs)]

    def batch(self, workspace: Any, t: int) -> Any:
        """The actions of all environments together: a new array of the space's dtype, or a nested dict of these."""
        if not self._is_nested:
            return self._parts[0].batch(workspace, t)
        return _nested((part.path, part.batch(workspace, t)) for part in self._parts)


class _Part:
    """One variable of the action, and what is known of it."""

    def __init__(self, name: str, path: tuple[str, ...], space: Space[Any], num_envs: int) -> None:
        self.path = path
        self._name, self._space, self._num_envs = name, space, num_envs
        self._shape = (num_envs, *(space.shape or ())) if isinstance(space, (spaces.Box, *_WHOLE)) else None
        self._dtype = None if space.dtype is None else np.dtype(space.dtype)

    def each(self, workspace: Any, t: int) -> Sequence[Any]:
        array = self._read(workspace, t)
        if array.ndim > 1:
            return list(array.astype(_GIVEN[array.dtype.kind]))
        plain: list[Any] = array.tolist()
        if isinstance(self._space, spaces.Discrete):
            self._check_range(plain, min(plain), max(plain), t)
        return [np.asarray(one) for one in plain] if array.dtype.kind == "f" else plain

    def batch(self, workspace: Any, t: int) -> Array:
        array = self._read(workspace, t)
        if isinstance(self._space, spaces.Discrete):
            self._check_range(array, np.minimum.reduce(array), np.maximum.reduce(array), t)
        fits = self._dtype is not None and np.can_cast(array.dtype, self._dtype, "same_kind")
        return np.array(array, dtype=self._dtype if fits else None)

    def _read(self, workspace: Any, t: int) -> Array:
        array = to_array(workspace.get(self._name, t))
        if self._shape is None:
            if len(array) != self._num_envs:
                raise mismatch(self._name, f"t={t}", "batch size", self._num_envs, len(array))
        elif array.shape != self._shape:
            raise mismatch(self._name, f"t={t}", "shape", self._shape, array.shape)
        elif array.dtype.kind == "f" and isinstance(self._space, _WHOLE):
            raise ValueMismatch(f"{self._name!r} at t={t}: {self._space} takes whole numbers, found {array.dtype}.")
        return array

    def _check_range(self, actions: Any, least: int, most: int, t: int) -> None:
        first, last = int(self._space.start), int(self._space.start + self._space.n - 1)  # type: ignore[attr-defined]
        if least < first or most > last:
            k, found = next((k, int(one)) for k, one in enumerate(actions) if not first <= one <= last)
            raise ValueMismatch(
                f"{self._name!r} at t={t}: {self._space} takes {first} to {last}, found {found} for environment {k}."
            )


def _parts(name: str, path: tuple[str, ...], space: Space[Any], num_envs: int) -> Iterator[_Part]:
    """The variables of an action of this space."""
    if not isinstance(space, spaces.Dict):
        yield _Part(name, path, space, num_envs)
        return
    for key, part in space.spaces.items():
        yield from _parts(f"{name}/{key}", (*path, key), part, num_envs)


def _nested(pairs: Iterable[tuple[tuple[str, ...], Any]]) -> dict[str, Any]:
    """Values by their paths of keys as a nested dict."""
    tree: dict[str, Any] = {}
    for (*above, last), value in pairs:
        branch = tree
        for key in above:
            branch = branch.setdefault(key, {})
        branch[last] = value
    return tree
