"""Observations, infos and actions of n Gymnasium environments, as one array (n, ...) for each variable.

An observation is one variable ``env_obs``, or, for a (nested) dict, one for each entry: ``env_obs/<key>/<key>``. An
action is the variable ``action``, or ``action/<key>/<key>``. As in Gymnasium's vector environments, entry k of the
infos is the variable ``info/k`` with the mask ``info/_k``. It is written from the first value that any environment
returns, since its dtype and shape are not known earlier, at every time, and is zero where the mask is False.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from bam_train.errors import LoopError
from bam_train.loop.workspace.variables import kind_name, mismatch, to_array

Array = NDArray[Any]
Arrays = dict[str, Array]
NAME = "env_obs"
_WHOLE = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_GIVEN = {"f": np.float64, "i": np.int64, "u": np.int64, "b": np.bool_}
"""Dtype of the actions that single environments get, by kind of dtype."""


# -- observations ------------------------------------------------------------------------------------------------------


class Kind(NamedTuple):
    """Dtype and shape in which one variable of an observation is written."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    """The shape for one environment; () for a number."""


def names(space: Space[Any]) -> tuple[str, ...]:
    """Names of the variables for observations of `space`."""
    return tuple(flat(space))


def flat(value: Any, name: str = NAME) -> dict[str, Any]:
    """The parts of an observation, or of its space, by variable; tensors become arrays."""
    if isinstance(value, np.ndarray):  # the usual case
        return {name: value}
    if isinstance(value, Mapping):
        return {path: leaf for key, part in value.items() for path, leaf in flat(part, f"{name}/{key}").items()}
    return {name: value.detach().cpu().numpy() if hasattr(value, "detach") else value}


def kinds(parts: Mapping[str, Any], space: Space[Any] | None, for_torch: bool) -> dict[str, Kind]:
    """Dtypes and shapes of the variables of an observation.

    Args:
        parts: `flat` of the observation of one environment: arrays or numbers; anything else raises `LoopError`.
        space: Determines the dtypes unless `for_torch`; None for those of the observation.
        for_torch: Whether all floats become float32 and all integers int64.
    """
    by_name, of_space = {}, flat(space)
    for name, value in parts.items():
        dtype = None if isinstance(value, (tuple, str)) else np.asarray(value).dtype
        if dtype is None or dtype.kind not in "fiub":
            raise LoopError(
                f"{name!r}: expected an array, a number or a dict of them, found a {kind_name(value)}; "
                "wrap the environment, for example in gymnasium.wrappers.FlattenObservation."
            )
        if for_torch:
            whole = bool if isinstance(value, (bool, np.bool_)) else np.int64
            dtype = np.dtype(np.float32 if dtype.kind == "f" else whole)
        elif (wanted := getattr(of_space.get(name), "dtype", None)) is not None:
            dtype = np.dtype(wanted)
        by_name[name] = Kind(dtype, np.shape(value))
    return by_name


def pack(kinds: Mapping[str, Kind], observations: Sequence[Any]) -> Arrays:
    """New arrays (n, ...) by variable from the observations of n environments; raises LoopError if they differ."""
    rows, packed = [flat(observation) for observation in observations], {}
    for name, (dtype, shape) in kinds.items():
        values = [pick(row, name) for row in rows]
        try:
            array = np.array(values, dtype=dtype)
        except ValueError:  # the shapes differ among the environments
            array = np.empty(0)
        if array.shape != (len(rows), *shape):
            k, other = next((k, s) for k, s in enumerate(map(np.shape, values)) if s != shape)
            raise LoopError(f"{name!r}: expected shape {shape}, found {other} from environment {k}.")
        packed[name] = array
    return packed


def pick(parts: Mapping[str, Any], name: str) -> Any:
    """The part of an observation for one variable."""
    if name not in parts:
        raise LoopError(f"{name!r}: the environment gave an observation without it.")
    return parts[name]


# -- infos -------------------------------------------------------------------------------------------------------------


class InfoRecorder:
    """Reads the entries `keys` of infos; floats are converted to `floats`, float32 or float64."""

    def __init__(self, keys: Sequence[str], num_envs: int, floats: np.dtype[Any]) -> None:
        self._keys, self._num_envs = tuple(keys), num_envs
        whole = np.dtype(np.int64)
        self._dtypes = {"b": np.dtype(bool), "i": whole, "u": whole, "f": floats}
        self._known: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def of_each(self, infos: Sequence[Mapping[str, Any]]) -> Arrays:
        """The entries' variables, (n, ...) each, from a list of n infos."""
        found: Arrays = {}
        for key in self._keys:
            mask = np.array([key in info for info in infos])
            self._record(found, key, mask, [(k, info[key]) for k, info in enumerate(infos) if mask[k]])
        return found

    def of_vector(self, infos: Mapping[str, Any]) -> Arrays:
        """The entries' variables, (n, ...) each, from the infos of a vector environment."""
        found: Arrays = {}
        for key in self._keys:
            mask = np.zeros(self._num_envs, dtype=bool)
            if key in infos:
                mask[:] = infos.get(f"_{key}", True)
            self._record(found, key, mask, [(mask, np.asarray(infos[key])[mask])] if mask.any() else [])
        return found

    def _record(self, found: Arrays, key: str, mask: Array, given: Sequence[tuple[Any, Any]]) -> None:
        """Add one entry to `found`; `given` has indices of environments, and their values."""
        for index, value in given:
            first = value[0] if np.ndim(index) else value
            array = np.asarray(first)
            if array.dtype.kind not in self._dtypes:  # at every time: NumPy converts None to NaN and "2" to 2
                raise LoopError(f"info {key!r}: expected a number or an array of them, found a {kind_name(first)}.")
            self._known.setdefault(key, (self._dtypes[array.dtype.kind], array.shape))
        if key not in self._known:
            return
        dtype, shape = self._known[key]
        found[f"info/{key}"] = values = np.zeros((self._num_envs, *shape), dtype)
        found[f"info/_{key}"] = mask
        for index, value in given:
            if np.shape(value)[np.ndim(index) :] != shape:
                raise LoopError(f"info {key!r}: expected shape {shape}, found {np.shape(value)[np.ndim(index) :]}.")
            values[index] = value


# -- actions -----------------------------------------------------------------------------------------------------------


def each_action(workspace: Any, t: int, name: str, space: Space[Any], num_envs: int) -> Sequence[Any]:
    """One action for each environment: an int, an array (float64 or int64), or a nested dict of these.

    Actions of other spaces than Box, Discrete, MultiDiscrete, MultiBinary and Dict are not checked.

    Args:
        workspace: The workspace; raises `LoopError` or `LoopError` if no action was written.
        t: The time.
        name: The variable; for dict actions, the prefix of the variables' names.
        space: Action space of one environment; an action that does not fit raises `LoopError`.
        num_envs: The number of environments.
    """
    if isinstance(space, spaces.Dict):
        columns = {key: each_action(workspace, t, f"{name}/{key}", part, num_envs) for key, part in space.items()}
        return [{key: column[k] for key, column in columns.items()} for k in range(num_envs)]
    array = _read(workspace, t, name, space, num_envs)
    if array.ndim > 1:
        return list(array.astype(_GIVEN[array.dtype.kind]))
    plain: list[Any] = array.tolist()
    return [np.asarray(number) for number in plain] if array.dtype.kind == "f" else plain


def batch_action(workspace: Any, t: int, name: str, space: Space[Any], num_envs: int) -> Any:
    """The actions of `each_action` as one new array (n, ...) of the space's dtype, or a nested dict of these."""
    if isinstance(space, spaces.Dict):
        return {key: batch_action(workspace, t, f"{name}/{key}", part, num_envs) for key, part in space.items()}
    array = _read(workspace, t, name, space, num_envs)
    fits = space.dtype is not None and np.can_cast(array.dtype, space.dtype, "same_kind")
    return np.array(array, dtype=space.dtype if fits else None)


def _read(workspace: Any, t: int, name: str, space: Space[Any], num_envs: int) -> Array:
    """Read one variable of the actions, (n, ...), and check it against its space."""
    array = to_array(workspace.get(name, t))
    if not isinstance(space, (spaces.Box, *_WHOLE)):
        if len(array) != num_envs:
            raise mismatch(name, f"t={t}", "batch size", num_envs, len(array))
        return array
    shape = (num_envs, *(space.shape or ()))
    if array.shape != shape:
        raise mismatch(name, f"t={t}", "shape", shape, array.shape)
    if array.dtype.kind == "f" and isinstance(space, _WHOLE):
        raise LoopError(f"{name!r} at t={t}: {space} takes whole numbers, found {array.dtype}.")
    if isinstance(space, spaces.Discrete):
        first = int(space.start)
        last = first + int(space.n) - 1
        plain = array.tolist()  # faster than NumPy for few environments; the set is, for many
        different = set(plain)
        if min(different) < first or max(different) > last:
            k, found = next((k, number) for k, number in enumerate(plain) if not first <= number <= last)
            raise LoopError(f"{name!r} at t={t}: {space} takes {first} to {last}, found {found} for environment {k}.")
    return array
