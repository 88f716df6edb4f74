"""Values of Gymnasium spaces as plain trees and back, bit for bit; what every transport checks and sends.

A tree is made of dicts, lists, numbers, text and NumPy arrays, and nothing else:

=====================================  ============================================================
space                                  in the tree
=====================================  ============================================================
Box, MultiDiscrete, MultiBinary        an array of the space's shape and dtype
Discrete                               an int
Text                                   a str
Tuple, Sequence                        a list
Dict                                   a dict, in the order of the space
=====================================  ============================================================

NaN is refused everywhere, infinity where a Box has a finite bound on that side. Finite numbers beyond the bounds of a
Box are let through: environments clip their actions, and observations overshoot.

Longer than most files here: the two ways of each kind stand side by side because they must agree.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, UnknownName

Tree = Any


def check(space: Space[Any], value: Any, name: str = "value") -> None:
    """Prove that `value` can be sent as one of `space`.

    Raises:
        InvalidValue: It does not fit; the text names the place, such as ``action['arm'][2]``.
    """
    pack(space, value, name)


def pack(space: Space[Any], value: Any, name: str = "value") -> Tree:
    """The tree of `value`. Raises as `check` does."""
    for kind, pack_one, _ in _KINDS:
        if isinstance(space, kind):
            return pack_one(space, value, name)
    raise UnknownName("kind of space", type(space).__name__, [kind.__name__ for kind, *_ in _KINDS])


def unpack(space: Space[Any], tree: Tree, name: str = "value") -> Any:
    """The value of `space` that `pack` was given; arrays are those of the tree.

    Raises:
        InvalidValue: The tree is not of a value of this space.
    """
    for kind, _, unpack_one in _KINDS:
        if isinstance(space, kind):
            return unpack_one(space, tree, name)
    raise UnknownName("kind of space", type(space).__name__, [kind.__name__ for kind, *_ in _KINDS])


def exact(space: Space[Any], value: Any, name: str = "value") -> Any:
    """`value` as it is after a journey: checked, and with the dtypes of its space."""
    if isinstance(space, (spaces.Box, spaces.MultiDiscrete, spaces.MultiBinary)):
        return pack(space, value, name)  # arrays are their own trees
    return unpack(space, pack(space, value, name), name)


def _pack_box(space: spaces.Box, value: Any, name: str) -> NDArray[Any]:
    array = _array(space, value, name)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        _refuse_not_finite(space, array, name)
    return array


def _array(space: Space[Any], value: Any, name: str) -> NDArray[Any]:
    """`value` with the dtype and shape of `space`."""
    if not isinstance(value, np.ndarray):
        value = _as_array(value, name)
    if value.shape != space.shape:
        raise InvalidValue(f"{name} must have shape {space.shape}, not {value.shape}.")
    if value.dtype != space.dtype:
        return _cast(value, np.dtype(space.dtype), name)
    return value if value.flags.c_contiguous else np.array(value, order="C")


def _as_array(value: Any, name: str) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except ValueError as error:  # rows of different lengths
        raise InvalidValue(f"{name} must be an array, not {shown(value)}.") from error
    if array.dtype.kind not in "biuf":
        raise InvalidValue(f"{name} must be numbers, not {shown(value)}.")
    return array


def _cast(array: NDArray[Any], dtype: np.dtype[Any], name: str) -> NDArray[Any]:
    """To `dtype`: rounding floats is allowed, changing anything else is not."""
    if array.dtype.kind not in "biuf" or (array.dtype.kind == "f" and dtype.kind != "f"):
        raise InvalidValue(f"{name} must be of dtype {dtype}, not {array.dtype}.")
    with np.errstate(over="ignore"):
        cast: NDArray[Any] = np.ascontiguousarray(array, dtype=dtype).reshape(array.shape)
    changed = np.isinf(cast) & np.isfinite(array) if dtype.kind == "f" else cast != array
    if changed.any():
        place, found = _first(changed, array, name)
        raise InvalidValue(f"{place} is {found}, which {dtype} cannot hold.")
    return cast


def _refuse_not_finite(space: spaces.Box, array: NDArray[Any], name: str) -> None:
    """Refuse NaN, and infinity beyond a finite bound."""
    bad = np.isnan(array)
    if bad.any():
        raise InvalidValue(f"{_first(bad, array, name)[0]} is NaN; only numbers are sent.")
    bad = (np.isposinf(array) & space.bounded_above) | (np.isneginf(array) & space.bounded_below)
    if bad.any():
        place, found = _first(bad, array, name)
        raise InvalidValue(f"{place} is {found}, where the space has a finite bound.")


def _first(bad: NDArray[np.bool_], array: NDArray[Any], name: str) -> tuple[str, Any]:
    """Name and value of the first element that is `bad`."""
    index = tuple(int(one) for one in np.argwhere(bad)[0])
    place = f"{name}[{', '.join(map(str, index))}]" if index else name
    return place, array[index]


def _unpack_box(space: Space[Any], tree: Tree, name: str) -> NDArray[Any]:
    if not isinstance(tree, np.ndarray) or tree.dtype != space.dtype or tree.shape != space.shape:
        found = f"{tree.dtype} {tree.shape}" if isinstance(tree, np.ndarray) else shown(tree)
        raise InvalidValue(f"{name} must be an array of {space.dtype} {space.shape}, not {found}.")
    return _pack_box(space, tree, name) if isinstance(space, spaces.Box) else _pack_integers(space, tree, name)


def _pack_integers(space: Space[Any], value: Any, name: str) -> NDArray[Any]:
    array = _array(space, value, name)
    if not space.contains(array):
        raise InvalidValue(f"{name} must be one of {space}, not {shown(value)}.")
    return array


def _pack_discrete(space: spaces.Discrete[Any], value: Any, name: str) -> int:
    plain = value.item() if isinstance(value, (np.generic, np.ndarray)) and value.size == 1 else value
    if isinstance(plain, bool) or not isinstance(plain, int) or not 0 <= plain - int(space.start) < int(space.n):
        last = int(space.start) + int(space.n) - 1
        raise InvalidValue(f"{name} must be a whole number from {space.start} to {last}, not {shown(value)}.")
    return plain


def _unpack_discrete(space: spaces.Discrete[Any], tree: Tree, name: str) -> np.integer[Any]:
    number: np.integer[Any] = np.dtype(space.dtype).type(_pack_discrete(space, tree, name))
    return number


def _pack_text(space: spaces.Text, value: Any, name: str) -> str:
    if not isinstance(value, str) or not space.contains(value):
        raise InvalidValue(
            f"{name} must be {space.min_length} to {space.max_length} of the characters "
            f"{shown(''.join(space.character_list))}, not {shown(value)}."
        )
    return str(value)


def _pack_tuple(space: spaces.Tuple, value: Any, name: str) -> list[Tree]:
    parts = _parts(space, value, name)
    return [pack(one, part, f"{name}[{i}]") for i, (one, part) in enumerate(zip(space.spaces, parts, strict=True))]


def _unpack_tuple(space: spaces.Tuple, tree: Tree, name: str) -> tuple[Any, ...]:
    parts = _parts(space, tree, name)
    return tuple(unpack(one, p, f"{name}[{i}]") for i, (one, p) in enumerate(zip(space.spaces, parts, strict=True)))


def _parts(space: spaces.Tuple, value: Any, name: str) -> Any:
    if not isinstance(value, (tuple, list, np.ndarray)) or len(value) != len(space.spaces):
        raise InvalidValue(f"{name} must be {len(space.spaces)} values, not {shown(value)}.")
    return value


def _pack_dict(space: spaces.Dict, value: Any, name: str) -> dict[str, Tree]:
    _require_keys(space, value, name)
    return {key: pack(one, value[key], f"{name}[{key!r}]") for key, one in space.spaces.items()}


def _unpack_dict(space: spaces.Dict, tree: Tree, name: str) -> dict[str, Any]:
    _require_keys(space, tree, name)
    return {key: unpack(one, tree[key], f"{name}[{key!r}]") for key, one in space.spaces.items()}


def _require_keys(space: spaces.Dict, value: Any, name: str) -> None:
    found = list(value) if isinstance(value, Mapping) else shown(value)
    if not isinstance(value, Mapping) or value.keys() != space.spaces.keys():
        raise InvalidValue(f"{name} must have the keys {list(space.spaces)}, not {found}.")


def _pack_sequence(space: spaces.Sequence, value: Any, name: str) -> list[Tree]:
    feature = space.feature_space
    items = _unstacked(feature, value, name) if space.stack else value
    if not isinstance(items, (tuple, list)):
        raise InvalidValue(f"{name} must be a tuple of any length, not {shown(value)}.")
    return [pack(feature, one, f"{name}[{i}]") for i, one in enumerate(items)]


def _unpack_sequence(space: spaces.Sequence, tree: Tree, name: str) -> Any:
    if not isinstance(tree, list):
        raise InvalidValue(f"{name} must be a list, not {shown(tree)}.")
    items = tuple(unpack(space.feature_space, one, f"{name}[{i}]") for i, one in enumerate(tree))
    if not space.stack:
        return items
    empty = create_empty_array(space.feature_space, len(items))
    return concatenate(space.feature_space, items, empty) if items else empty


def _unstacked(feature: Space[Any], value: Any, name: str) -> list[Any]:
    """The items of a stacked sequence, which has its items in the leaves."""
    if isinstance(feature, spaces.Dict):
        _require_keys(feature, value, name)
        columns = [_unstacked(one, value[key], f"{name}[{key!r}]") for key, one in feature.spaces.items()]
        return [dict(zip(feature.spaces, row, strict=True)) for row in _zipped(columns, name)]
    if isinstance(feature, spaces.Tuple):
        parts = _parts(feature, value, name)
        return _zipped([_unstacked(one, part, name) for one, part in zip(feature.spaces, parts, strict=True)], name)
    if not isinstance(value, (np.ndarray, tuple, list)):
        raise InvalidValue(f"{name} must be an array of any length, not {shown(value)}.")
    return list(value)


def _zipped(columns: list[list[Any]], name: str) -> list[Any]:
    if len({len(column) for column in columns}) > 1:
        raise InvalidValue(f"The parts of {name} must have one length, not {[len(one) for one in columns]}.")
    return list(zip(*columns, strict=True))


def shown(value: Any) -> str:
    """`value` in one short line, for an error."""
    return " ".join(_SHORT.repr(value).split())


def _short() -> reprlib.Repr:
    short = reprlib.Repr()
    short.maxstring = short.maxother = 60
    return short


_SHORT = _short()
_KINDS: tuple[tuple[type[Space[Any]], Callable[..., Tree], Callable[..., Any]], ...] = (
    (spaces.Box, _pack_box, _unpack_box),
    (spaces.Discrete, _pack_discrete, _unpack_discrete),
    (spaces.Dict, _pack_dict, _unpack_dict),
    (spaces.MultiDiscrete, _pack_integers, _unpack_box),
    (spaces.MultiBinary, _pack_integers, _unpack_box),
    (spaces.Text, _pack_text, _pack_text),
    (spaces.Tuple, _pack_tuple, _unpack_tuple),
    (spaces.Sequence, _pack_sequence, _unpack_sequence),
)
