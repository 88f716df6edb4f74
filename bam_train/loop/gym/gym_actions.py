"""The action of one time: read from the workspace, checked against the action space, in the form environments take.

It is the variable "action", or, when there is none, the nested dict of all variables "action/<key>/<key>".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from bam_train.errors import UnknownVariable, ValueMismatch
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
        self._name, self._space, self._num_envs = name, space, num_envs
        self._parts = {name: _Part(name, space, num_envs)}

    def each(self, workspace: Any, t: int) -> Sequence[Any]:
        """One action for each environment: an int, an array (float64 or int64), or a nested dict of these.

        Raises:
            UnknownVariable: Nobody wrote an action.
            TimeNotWritten: Nobody wrote it at t.
            ValueMismatch: It does not fit the action space, or is not for n environments.
        """
        if self._name in workspace.variables:
            return self._parts[self._name].each(workspace.get(self._name, t), t)
        return _transpose(self._tree(workspace, t, _Part.each), self._num_envs)

    def batch(self, workspace: Any, t: int) -> Any:
        """The actions of all environments together: a new array of the space's dtype, or a nested dict of these.

        Raises:
            UnknownVariable: Nobody wrote an action.
            TimeNotWritten: Nobody wrote it at t.
            ValueMismatch: It does not fit the action space, or is not for n environments.
        """
        if self._name in workspace.variables:
            return self._parts[self._name].batch(workspace.get(self._name, t), t)
        return self._tree(workspace, t, _Part.batch)

    def _tree(self, workspace: Any, t: int, convert: Callable[[_Part, Any, int], Any]) -> dict[str, Any]:
        """The variables below the name as a nested dict of what `convert` makes of each."""
        tree: dict[str, Any] = {}
        prefix = self._name + "/"
        for variable in list(workspace.variables):
            if variable.startswith(prefix):
                *above, last = variable[len(prefix) :].split("/")
                branch = tree
                for key in above:
                    branch = branch.setdefault(key, {})
                branch[last] = convert(self._part(variable, (*above, last)), workspace.get(variable, t), t)
        if not tree:
            raise UnknownVariable(self._name, workspace.variables)
        _require_keys(self._name, self._space, tree, workspace)
        return tree

    def _part(self, variable: str, keys: Sequence[str]) -> _Part:
        if variable not in self._parts:
            space: Any = self._space
            for key in keys:
                space = space.spaces.get(key) if isinstance(space, spaces.Dict) else None
            self._parts[variable] = _Part(variable, space, self._num_envs)
        return self._parts[variable]


class _Part:
    """One variable of the action, and what is known of it."""

    def __init__(self, name: str, space: Space[Any] | None, num_envs: int) -> None:
        self._name, self._space, self._num_envs = name, space, num_envs
        self._shape = (num_envs, *(space.shape or ())) if isinstance(space, _SHAPED) else None
        self._whole = isinstance(space, _WHOLE)
        self._dtype = None if space is None or space.dtype is None else np.dtype(space.dtype)
        self._range = None
        if isinstance(space, spaces.Discrete):
            self._range = int(space.start), int(space.start + space.n - 1)

    def each(self, value: Any, t: int) -> Sequence[Any]:
        array = self._checked(value, t)
        kind = array.dtype.kind
        if array.ndim > 1:
            return list(array.astype(_GIVEN[kind]))
        plain: list[Any] = array.tolist()
        if self._range is not None:
            self._check_range(plain, min(plain), max(plain), t)
        return [np.asarray(one) for one in plain] if kind == "f" else plain

    def batch(self, value: Any, t: int) -> NDArray[Any]:
        array = self._checked(value, t)
        if self._range is not None:
            self._check_range(array, np.minimum.reduce(array), np.maximum.reduce(array), t)
        fits = array.dtype == self._dtype or (
            self._dtype is not None and np.can_cast(array.dtype, self._dtype, "same_kind")
        )
        cast: NDArray[Any] = array.astype(self._dtype if fits else array.dtype)
        return cast

    def _checked(self, value: Any, t: int) -> NDArray[Any]:
        array = _as_array(value)
        if self._shape is None:
            self._check_unshaped(array, t)
        elif array.shape != self._shape:
            raise mismatch(self._name, f"t={t}", "shape", self._shape, array.shape)
        elif self._whole and array.dtype.kind == "f":
            raise ValueMismatch(f"{self._name!r} at t={t}: {self._space} takes whole numbers, found {array.dtype}.")
        return array

    def _check_unshaped(self, array: NDArray[Any], t: int) -> None:
        if len(array) != self._num_envs:
            raise mismatch(self._name, f"t={t}", "batch size", self._num_envs, len(array))
        if isinstance(self._space, spaces.Dict):
            wanted = ", ".join(repr(f"{self._name}/{key}") for key in self._space.spaces)
            raise ValueMismatch(
                f"{self._name!r} at t={t}: expected the variables {wanted}, found {self._name!r} itself."
            )

    def _check_range(self, actions: Any, least: int, most: int, t: int) -> None:
        first, last = self._range or (0, 0)
        if least < first or most > last:
            k, found = next((k, int(one)) for k, one in enumerate(actions) if not first <= one <= last)
            raise ValueMismatch(
                f"{self._name!r} at t={t}: {self._space} takes {first} to {last}, found {found} for environment {k}."
            )


def _as_array(value: Any) -> NDArray[Any]:
    """A tensor or array as an array; shares its memory where it can."""
    if isinstance(value, np.ndarray):
        return value
    try:
        array: NDArray[Any] = value.numpy()
    except (RuntimeError, TypeError):  # with a gradient, on another device, or of a dtype that NumPy lacks
        value = value.detach().cpu()
        array = (value.float() if value.is_floating_point() and value.itemsize < 4 else value).numpy()
    return array


def _require_keys(name: str, space: Any, tree: Any, workspace: Any) -> None:
    if not isinstance(space, spaces.Dict):
        return
    for key, part in space.spaces.items():
        if not isinstance(tree, Mapping) or key not in tree:
            raise UnknownVariable(f"{name}/{key}", workspace.variables)
        _require_keys(f"{name}/{key}", part, tree[key], workspace)


def _transpose(tree: Mapping[str, Any], num_envs: int) -> list[dict[str, Any]]:
    """A nested dict of n values each as n nested dicts."""
    parts = {key: _transpose(one, num_envs) if isinstance(one, dict) else one for key, one in tree.items()}
    return [{key: one[k] for key, one in parts.items()} for k in range(num_envs)]
