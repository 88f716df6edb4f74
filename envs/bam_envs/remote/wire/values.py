"""Values of Gymnasium spaces as plain trees and back, bit for bit; every transport checks and sends these.

A tree consists only of dicts, lists, numbers, text and NumPy arrays:

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
Box are accepted: environments clip their actions, and observations overshoot.

`tree_to_json` encodes any tree as strict JSON, which has no arrays, no NaN and no infinities.
"""

import base64
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, ProtocolError, UnknownName
from bam_envs.core.wording import brief

Tree = Any
_KINDS = ("Box", "Dict", "Discrete", "MultiBinary", "MultiDiscrete", "Sequence", "Text", "Tuple")
_INT64 = range(-(2**63), 2**63)
_DTYPE = re.compile("[<>|=]?[biuf][0-9]{1,2}")


def pack(space: Space[Any], value: Any, name: str = "value", *, typed: bool = False) -> Tree:
    """The tree of `value`, which may be a tree already; with `typed`, the result of `exact`.

    Raises:
        InvalidValue: It does not fit; the text names the place, such as ``action['arm'][2]``.
        UnknownName: Values of such a space cannot be sent.
    """
    if isinstance(space, spaces.Box):
        return _finite(space, _array(space, value, name), name)
    if isinstance(space, spaces.Discrete):
        plain = value.item() if isinstance(value, (np.generic, np.ndarray)) and value.size == 1 else value
        if isinstance(plain, bool) or not isinstance(plain, int) or not 0 <= plain - int(space.start) < int(space.n):
            last = int(space.start) + int(space.n) - 1
            raise InvalidValue(f"{name} must be a whole number from {space.start} to {last}, not {brief(value)}.")
        return np.dtype(space.dtype).type(plain) if typed else plain
    if isinstance(space, spaces.Dict):
        _require_keys(space, value, name)
        return {key: pack(one, value[key], f"{name}[{key!r}]", typed=typed) for key, one in space.spaces.items()}
    if isinstance(space, (spaces.MultiDiscrete, spaces.MultiBinary)):
        array = _array(space, value, name)
        if not space.contains(array):
            raise InvalidValue(f"{name} must be one of {space}, not {brief(value)}.")
        return array
    if isinstance(space, spaces.Text):
        if not isinstance(value, str) or not space.contains(value):
            raise InvalidValue(
                f"{name} must be {space.min_length} to {space.max_length} of the characters "
                f"{brief(''.join(space.character_list))}, not {brief(value)}."
            )
        return str(value)
    if isinstance(space, spaces.Tuple):
        _require_length(space, value, name)
        parts = enumerate(zip(space.spaces, value, strict=True))
        packed = [pack(one, part, f"{name}[{i}]", typed=typed) for i, (one, part) in parts]
        return tuple(packed) if typed else packed
    if isinstance(space, spaces.Sequence):
        # Gymnasium stacks arrays, dicts and tuples; a list is the list of items of a tree.
        stacked = space.stack and not isinstance(value, list)
        items = _unstacked(space.feature_space, value, name) if stacked else value
        if not isinstance(items, (tuple, list)):
            raise InvalidValue(f"{name} must be a tuple of any length, not {brief(value)}.")
        packed = [pack(space.feature_space, one, f"{name}[{i}]", typed=typed) for i, one in enumerate(items)]
        if typed:
            return stack(space.feature_space, packed) if space.stack else tuple(packed)
        return packed
    raise UnknownName("kind of space", type(space).__name__, _KINDS)


def exact(space: Space[Any], value: Any, name: str = "value") -> Any:
    """Check `value`, which may be a tree, and return it with the types and dtypes of its space. See `pack`."""
    return pack(space, value, name, typed=True)


def stack(space: Space[Any], each: Sequence[Any]) -> Any:
    """One batch of several values of `space`, in new arrays."""
    empty = create_empty_array(space, len(each))
    return concatenate(space, each, empty) if each else empty


def _array(space: Space[Any], value: Any, name: str) -> NDArray[Any]:
    """`value` with the dtype and shape of `space`; floats may be rounded, other numbers must not change."""
    if not isinstance(value, np.ndarray):
        try:
            value = np.asarray(value)
        except ValueError as error:  # lists of different lengths
            raise InvalidValue(f"{name} must be an array, not {brief(value)}.") from error
        if value.dtype.kind not in "biuf":
            raise InvalidValue(f"{name} must be numbers, not {brief(value.tolist())}.")
    if value.shape != space.shape:
        raise InvalidValue(f"{name} must have shape {space.shape}, not {value.shape}.")
    dtype = np.dtype(space.dtype)
    if value.dtype == dtype:
        return value if value.flags.c_contiguous else np.array(value, order="C")
    if value.dtype.kind not in "biuf" or (value.dtype.kind == "f" and dtype.kind != "f"):
        raise InvalidValue(f"{name} must be of dtype {dtype}, not {value.dtype}.")
    with np.errstate(over="ignore"):
        cast: NDArray[Any] = np.ascontiguousarray(value, dtype=dtype).reshape(value.shape)
    changed = np.isinf(cast) & np.isfinite(value) if dtype.kind == "f" else cast != value
    if changed.any():
        place, found = _first(changed, value, name)
        raise InvalidValue(f"{place} is {found}, which {dtype} cannot hold.")
    return cast


def _finite(space: spaces.Box, array: NDArray[Any], name: str) -> NDArray[Any]:
    """`array`, checked for NaN, and for infinity beyond a finite bound."""
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return array
    bad = np.isnan(array)
    if bad.any():
        raise InvalidValue(f"{_first(bad, array, name)[0]} is NaN; only numbers are sent.")
    bad = (np.isposinf(array) & space.bounded_above) | (np.isneginf(array) & space.bounded_below)
    if bad.any():
        place, found = _first(bad, array, name)
        raise InvalidValue(f"{place} is {found}, where the space has a finite bound.")
    return array


def _first(bad: NDArray[np.bool_], array: NDArray[Any], name: str) -> tuple[str, Any]:
    """Name and value of the first element that is `bad`."""
    index = tuple(int(one) for one in np.argwhere(bad)[0])
    return f"{name}[{', '.join(map(str, index))}]" if index else name, array[index]


def _require_length(space: spaces.Tuple, value: Any, name: str) -> None:
    if not isinstance(value, (tuple, list, np.ndarray)) or len(value) != len(space.spaces):
        raise InvalidValue(f"{name} must be {len(space.spaces)} values, not {brief(value)}.")


def _require_keys(space: spaces.Dict, value: Any, name: str) -> None:
    if not isinstance(value, Mapping) or value.keys() != space.spaces.keys():
        found = list(value) if isinstance(value, Mapping) else brief(value)
        raise InvalidValue(f"{name} must have the keys {list(space.spaces)}, not {found}.")


def _unstacked(feature: Space[Any], value: Any, name: str) -> list[Any]:
    """The items of a stacked sequence, which has its items in the leaves."""
    if isinstance(feature, spaces.Dict):
        _require_keys(feature, value, name)
        columns = [_unstacked(one, value[key], f"{name}[{key!r}]") for key, one in feature.spaces.items()]
    elif isinstance(feature, spaces.Tuple):
        _require_length(feature, value, name)
        columns = [_unstacked(one, part, name) for one, part in zip(feature.spaces, value, strict=True)]
    elif isinstance(value, (np.ndarray, tuple, list)):
        return list(value)
    else:
        raise InvalidValue(f"{name} must be an array of any length, not {brief(value)}.")
    if len({len(column) for column in columns}) > 1:
        raise InvalidValue(f"The parts of {name} must have one length, not {[len(one) for one in columns]}.")
    items = list(zip(*columns, strict=True))
    return (
        [dict(zip(feature.spaces, item, strict=True)) for item in items] if isinstance(feature, spaces.Dict) else items
    )


def plain_info(value: Any) -> Tree:
    """An info as a tree: tuples and sets become lists, keys and other objects text; NumPy numbers are unchanged.

    NaN is accepted, because no policy learns from an info.
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
        return {"array": [tree.dtype.str, list(tree.shape), base64.b64encode(tree.tobytes()).decode()]}
    if isinstance(tree, np.generic):
        return {"scalar": [tree.dtype.str, base64.b64encode(tree.tobytes()).decode()]}
    if isinstance(tree, float):
        return tree if math.isfinite(tree) else {"float": repr(tree)}
    if isinstance(tree, Mapping):
        plain = {key: tree_to_json(one) for key, one in tree.items()}
        return {"dict": plain} if len(plain) == 1 and plain.keys() <= _MARKS.keys() | {"dict"} else plain
    if isinstance(tree, (list, tuple)):
        return [tree_to_json(one) for one in tree]
    return tree


def tree_from_json(value: Any) -> Tree:
    """The tree that `tree_to_json` encoded. Raises ProtocolError for an invalid array in it."""
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
    """The dtype in a message. Raises ValueError unless it is numeric: no objects, no records."""
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise ValueError(f"{brief(text)} is no dtype of numbers")
    return np.dtype(text)
