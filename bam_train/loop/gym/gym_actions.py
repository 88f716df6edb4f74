"""The action of one time: read from the workspace, checked against the action space, in the form environments take.

It is the variable "action", or, where the space is a (nested) dict, the variables "action/<key>/<key>".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from gymnasium import Space, spaces

from bam_train.errors import ValueMismatch
from bam_train.loop.gym.gym_observations import Array
from bam_train.loop.variables import mismatch

_SHAPED = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_WHOLE = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_GIVEN = {"f": np.float64, "i": np.int64, "u": np.int64, "b": np.bool_}
"""What single environments are given, by kind of action."""


class ActionReader:
    """Reads the actions of n environments.

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
        """One action for each environment: an int, an array (float64 or int64), or a nested dict of these.

        Raises:
            UnknownVariable: Nobody wrote an action.
            TimeNotWritten: Nobody wrote it at t.
            ValueMismatch: It does not fit the action space, or is not for n environments.
        """
        if not self._is_nested:
            return self._parts[0].each(workspace, t)
        columns = [(part.path, part.each(workspace, t)) for part in self._parts]
        return [_nested((path, values[k]) for path, values in columns) for k in range(self._num_envs)]

    def batch(self, workspace: Any, t: int) -> Any:
        """The actions of all environments together: a new array of the space's dtype, or a nested dict of these.

        Raises:
            UnknownVariable: Nobody wrote an action.
            TimeNotWritten: Nobody wrote it at t.
            ValueMismatch: It does not fit the action space, or is not for n environments.
        """
        if not self._is_nested:
            return self._parts[0].batch(workspace, t)
        return _nested((part.path, part.batch(workspace, t)) for part in self._parts)


class _Part:
    """One variable of the action, and what is known of it."""

    def __init__(self, name: str, path: tuple[str, ...], space: Space[Any], num_envs: int) -> None:
        self.path = path
        self._name, self._space, self._num_envs = name, space, num_envs
        self._shape = (num_envs, *(space.shape or ())) if isinstance(space, _SHAPED) else None
        self._whole = isinstance(space, _WHOLE)
        self._dtype = None if space.dtype is None else np.dtype(space.dtype)
        self._range = None
        if isinstance(space, spaces.Discrete):
            self._range = int(space.start), int(space.start + space.n - 1)

    def each(self, workspace: Any, t: int) -> Sequence[Any]:
        array = self._read(workspace, t)
        kind = array.dtype.kind
        if array.ndim > 1:
            return list(array.astype(_GIVEN[kind]))
        plain: list[Any] = array.tolist()
        if self._range is not None:
            self._check_range(plain, min(plain), max(plain), t)
        return [np.asarray(one) for one in plain] if kind == "f" else plain

    def batch(self, workspace: Any, t: int) -> Array:
        array = self._read(workspace, t)
        if self._range is not None:
            self._check_range(array, np.minimum.reduce(array), np.maximum.reduce(array), t)
        fits = array.dtype == self._dtype or (
            self._dtype is not None and np.can_cast(array.dtype, self._dtype, "same_kind")
        )
        cast: Array = array.astype(self._dtype if fits else array.dtype)
        return cast

    def _read(self, workspace: Any, t: int) -> Array:
        array = _as_array(workspace.get(self._name, t))
        if self._shape is None:
            if len(array) != self._num_envs:
                raise mismatch(self._name, f"t={t}", "batch size", self._num_envs, len(array))
        elif array.shape != self._shape:
            raise mismatch(self._name, f"t={t}", "shape", self._shape, array.shape)
        elif self._whole and array.dtype.kind == "f":
            raise ValueMismatch(f"{self._name!r} at t={t}: {self._space} takes whole numbers, found {array.dtype}.")
        return array

    def _check_range(self, actions: Any, least: int, most: int, t: int) -> None:
        first, last = self._range or (0, 0)
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


def _as_array(value: Any) -> Array:
    """A tensor or array as an array; shares its memory where it can."""
    if isinstance(value, np.ndarray):
        return value
    try:
        array: Array = value.numpy()
    except (RuntimeError, TypeError):  # with a gradient, on another device, or of a dtype that NumPy lacks
        value = value.detach().cpu()
        array = (value.float() if value.is_floating_point() and value.itemsize < 4 else value).numpy()
    return array
