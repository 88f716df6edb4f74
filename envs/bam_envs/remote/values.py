"""Values of Gymnasium spaces as plain trees and back, bit for bit; every transport checks and sends these.

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

`tree_to_json` writes any tree as strict JSON, which has no arrays, no NaN and no infinities.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, ProtocolError, UnknownName
from bam_envs.core.wording import brief

Tree = Any
_INT64 = range(-(2**63), 2**63)
_DTYPE = re.compile("[<>|=]?[biuf][0-9]{1,2}")


def pack(space: Space[Any], value: Any, name: str = "value") -> Tree:
    """Check `value` and return its tree.

    Args:
        space: What the value must be one of.
        value: As the space has it, or its tree.
        name: What errors call it.

    Raises:
        InvalidValue: It does not fit; the text names the place, such as ``action['arm'][2]``.
    """
    for kind, pack_one in _PACKERS:
        if isinstance(space, kind):
            return pack_one(space, value, name)
    raise UnknownName("kind of space", type(space).__name__, [kind.__name__ for kind, _ in _PACKERS])


def exact(space: Space[Any], value: Any, name: str = "value") -> Any:
    """Check `value`, which may be a tree, and return it with the types and dtypes of its space. Raises as `pack`."""
    return _unpacked(space, pack(space, value, name))


def _unpacked(space: Space[Any], tree: Tree) -> Any:
    """The value of a checked tree; arrays are those of the tree."""
    if isinstance(space, spaces.Discrete):
        return np.dtype(space.dtype).type(tree)
    if isinstance(space, spaces.Dict):
        return {key: _unpacked(part, tree[key]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_unpacked(part, one) for part, one in zip(space.spaces, tree, strict=True))
    if not isinstance(space, spaces.Sequence):
        return tree
    items = tuple(_unpacked(space.feature_space, one) for one in tree)
    if not space.stack:
        return items
    empty = create_empty_array(space.feature_space, len(items))
    return concatenate(space.feature_space, items, empty) if items else empty


def _pack_box(space: spaces.Box, value: Any, name: str) -> NDArray[Any]:
    array = _array(space, value, name)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        _refuse_not_finite(space, array, name)
    return array


def _array(space: Space[Any], value: Any, name: str) -> NDArray[Any]:
    """`value` with the dtype and shape of `space`."""
    if not isinstance(value, np.ndarray):
        try:
            value = np.asarray(value)
        except ValueError as error:  # rows of different lengths
            raise InvalidValue(f"{name} must be an array, not {brief(value)}.") from error
        if value.dtype.kind not in "biuf":
            raise InvalidValue(f"{name} must be numbers, not {brief(value.tolist())}.")
    if value.shape != space.shape:
        raise InvalidValue(f"{name} must have shape {space.shape}, not {value.shape}.")
    if value.dtype != space.dtype:
        return _cast(value, np.dtype(space.dtype), name)
    return value if value.flags.c_contiguous else np.array(value, order="C")


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


def _pack_integers(space: Space[Any], value: Any, name: str) -> NDArray[Any]:
    array = _array(space, value, name)
    if not space.contains(array):
        raise InvalidValue(f"{name} must be one of {space}, not {brief(value)}.")
    return array


def _pack_discrete(space: spaces.Discrete[Any], value: Any, name: str) -> int:
    plain = value.item() if isinstance(value, (np.generic, np.ndarray)) and value.size == 1 else value
    if isinstance(plain, bool) or not isinstance(plain, int) or not 0 <= plain - int(space.start) < int(space.n):
        last = int(space.start) + int(space.n) - 1
        raise InvalidValue(f"{name} must be a whole number from {space.start} to {last}, not {brief(value)}.")
    return plain


def _pack_text(space: spaces.Text, value: Any, name: str) -> str:
    if not isinstance(value, str) or not space.contains(value):
        raise InvalidValue(
            f"{name} must be {space.min_length} to {space.max_length} of the characters "
            f"{brief(''.join(space.character_list))}, not {brief(value)}."
        )
    return str(value)


def _pack_tuple(space: spaces.Tuple, value: Any, name: str) -> list[Tree]:
    parts = _parts(space, value, name)
    return [pack(one, part, f"{name}[{i}]") for i, (one, part) in enumerate(zip(space.spaces, parts, strict=True))]


def _parts(space: spaces.Tuple, value: Any, name: str) -> Any:
    if not isinstance(value, (tuple, list, np.ndarray)) or len(value) != len(space.spaces):
        raise InvalidValue(f"{name} must be {len(space.spaces)} values, not {brief(value)}.")
    return value


def _pack_dict(space: spaces.Dict, value: Any, name: str) -> dict[str, Tree]:
    _require_keys(space, value, name)
    return {key: pack(one, value[key], f"{name}[{key!r}]") for key, one in space.spaces.items()}


def _require_keys(space: spaces.Dict, value: Any, name: str) -> None:
    found = list(value) if isinstance(value, Mapping) else brief(value)
    if not isinstance(value, Mapping) or value.keys() != space.spaces.keys():
        raise InvalidValue(f"{name} must have the keys {list(space.spaces)}, not {found}.")


def _pack_sequence(space: spaces.Sequence, value: Any, name: str) -> list[Tree]:
    feature = space.feature_space
    # Gymnasium stacks arrays, dicts and tuples; a list is the list of items of a tree.
    items = _unstacked(feature, value, name) if space.stack and not isinstance(value, list) else value
    if not isinstance(items, (tuple, list)):
        raise InvalidValue(f"{name} must be a tuple of any length, not {brief(value)}.")
    return [pack(feature, one, f"{name}[{i}]") for i, one in enumerate(items)]


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
        raise InvalidValue(f"{name} must be an array of any length, not {brief(value)}.")
    return list(value)


def _zipped(columns: list[list[Any]], name: str) -> list[Any]:
    if len({len(column) for column in columns}) > 1:
        raise InvalidValue(f"The parts of {name} must have one length, not {[len(one) for one in columns]}.")
    return list(zip(*columns, strict=True))


_PACKERS: tuple[tuple[type[Space[Any]], Callable[..., Tree]], ...] = (
    (spaces.Box, _pack_box),
    (spaces.Discrete, _pack_discrete),
    (spaces.Dict, _pack_dict),
    (spaces.MultiDiscrete, _pack_integers),
    (spaces.MultiBinary, _pack_integers),
    (spaces.Text, _pack_text),
    (spaces.Tuple, _pack_tuple),
    (spaces.Sequence, _pack_sequence),
)


def plain_info(value: Any) -> Tree:
    """An info as a tree: tuples and sets become lists, keys and other objects their text.

    Numbers keep their values, and those of NumPy their dtypes. NaN is let through: an info is for people.
    """
    if isinstance(value, str):  # first: NumPy's texts would be taken for numbers
        return value.encode(errors="replace").decode()  # halves of surrogate pairs cannot be sent
    if value is None or isinstance(value, (bool, float, np.bool_, np.number)):
        return value
    if isinstance(value, int):
        return value if value in _INT64 else str(value)
    if isinstance(value, Mapping):
        return {str(key): plain_info(one) for key, one in value.items()}
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return np.ascontiguousarray(value).reshape(value.shape)
    if isinstance(value, np.ndarray):
        return plain_info(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain_info(one) for one in value]
    return plain_info(str(value))


def tree_to_json(tree: Tree) -> Any:
    """`tree` as strict JSON values.

    Arrays are ``{"array": [dtype, shape, base64]}``, NumPy's scalars ``{"scalar": [dtype, base64]}``, NaN and
    infinities ``{"float": "nan"}``. A dict with one of these keys alone is ``{"dict": …}``.
    """
    if isinstance(tree, np.ndarray):
        return {"array": [tree.dtype.str, list(tree.shape), _base64(tree)]}
    if isinstance(tree, np.generic):
        return {"scalar": [tree.dtype.str, _base64(tree)]}
    if isinstance(tree, float):
        return tree if math.isfinite(tree) else {"float": repr(tree)}
    if isinstance(tree, Mapping):
        plain = {key: tree_to_json(one) for key, one in tree.items()}
        return {"dict": plain} if len(plain) == 1 and plain.keys() <= _MARKS.keys() | {"dict"} else plain
    if isinstance(tree, (list, tuple)):
        return [tree_to_json(one) for one in tree]
    return tree


def tree_from_json(value: Any) -> Tree:
    """The tree that `tree_to_json` was given.

    Raises:
        ProtocolError: An array in it is not one.
    """
    if isinstance(value, list):
        return [tree_from_json(one) for one in value]
    if not isinstance(value, Mapping):
        return value
    if len(value) == 1:
        [(mark, content)] = value.items()
        if mark == "dict" and isinstance(content, Mapping):
            return {key: tree_from_json(one) for key, one in content.items()}
        if mark in _MARKS:
            try:
                return _MARKS[mark](content)
            except (AttributeError, IndexError, TypeError, ValueError) as error:
                raise ProtocolError(f"Expected the {mark} of a value, found {brief(content)}: {error}.") from error
    return {key: tree_from_json(one) for key, one in value.items()}


def _base64(array: NDArray[Any] | np.generic) -> str:
    return base64.b64encode(array.tobytes()).decode()


def _array_of(content: Any) -> NDArray[Any]:
    dtype, shape, data = content
    flat = np.frombuffer(bytearray(base64.b64decode(data, validate=True)), number_dtype(dtype))
    return flat.reshape([int(length) for length in shape])


_MARKS: dict[str, Callable[[Any], Any]] = {
    "array": _array_of,
    "scalar": lambda content: _array_of([content[0], [1], content[1]])[0],
    "float": float,
}


def number_dtype(text: Any) -> np.dtype[Any]:
    """The dtype in a message, which must be of numbers: no objects, no records.

    Raises:
        ValueError: It is not.
    """
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise ValueError(f"{brief(text)} is no dtype of numbers")
    return np.dtype(text)
