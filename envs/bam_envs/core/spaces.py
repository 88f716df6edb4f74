"""Gymnasium spaces as plain JSON values and back; and the one walk over nested spaces and their values.

A value of a Dict or Tuple space is nested: dicts and tuples, with leaves that are neither, such as arrays and numbers.
The path of a leaf has the keys and places that lead to it; () is the path of a leaf alone.

=============  ==========================================================================
type           fields
=============  ==========================================================================
Box            shape, dtype, low, high: one number, or nested lists where bounds differ
Discrete       n, start, dtype
MultiDiscrete  nvec, start, dtype
MultiBinary    n: the shape, always a list
Text           min_length, max_length, charset
Dict           spaces: by key, in the order of the space
Tuple          spaces: a list
Sequence       space, stack
=============  ==========================================================================

Infinities are the strings ``"inf"`` and ``"-inf"``: JSON has none. Floats keep every bit. A decoded space equals the
encoded one, except that ``MultiBinary([n])`` becomes ``MultiBinary(n)``, which holds the same arrays.
"""

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.validation import check
from bam_envs.core.wording import brief

Json = dict[str, Any]
Path = tuple[Any, ...]
"""Keys and places that lead to a part of a nested value; see the top of the module."""
_KINDS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary", "Text", "Dict", "Tuple", "Sequence")
_REFUSED = (AssertionError, AttributeError, OverflowError, TypeError, ValueError)
"""Errors of Gymnasium and NumPy for fields that do not fit."""


def space_to_json(space: Space[Any]) -> Json:
    """Encode a space as plain values for `space_from_json`.

    Raises:
        UnknownName: Graph, OneOf, or a kind of space that is not Gymnasium's.
        InvalidValue: A bound or key that JSON cannot represent.
    """
    if isinstance(space, spaces.Box):
        bounds = {side: _bounds_to_json(getattr(space, side), side) for side in ("low", "high")}
        return {"type": "Box", "shape": list(space.shape), "dtype": str(space.dtype), **bounds}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start), "dtype": str(space.dtype)}
    if isinstance(space, spaces.MultiDiscrete):
        numbers = {"nvec": space.nvec.tolist(), "start": space.start.tolist()}
        return {"type": "MultiDiscrete", **numbers, "dtype": str(space.dtype)}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": list(space.shape)}
    if isinstance(space, spaces.Text):
        lengths = {"min_length": space.min_length, "max_length": space.max_length}
        return {"type": "Text", **lengths, "charset": "".join(space.character_list)}
    if isinstance(space, spaces.Dict):
        for key in space.spaces:
            if not isinstance(key, str):
                raise InvalidValue(f"The keys of a Dict space must be strings, not {key!r}.")
        return {"type": "Dict", "spaces": {key: space_to_json(one) for key, one in space.spaces.items()}}
    if isinstance(space, spaces.Tuple):
        return {"type": "Tuple", "spaces": [space_to_json(one) for one in space.spaces]}
    if isinstance(space, spaces.Sequence):
        return {"type": "Sequence", "space": space_to_json(space.feature_space), "stack": bool(space.stack)}
    raise UnknownName("kind of space", type(space).__name__, _KINDS)


def space_text(space: Space[Any]) -> str:
    """A space in a few words, such as ``float32 (18,)``, ``Discrete(4)``, or for a Dict ``agent: int64 (2,), ...``."""
    if isinstance(space, spaces.Dict):
        return ", ".join(f"{key}: {space_text(one)}" for key, one in space.spaces.items())
    return f"{space.dtype} {space.shape}" if isinstance(space, spaces.Box) else str(space)


def leaves(space: Space[Any]) -> dict[str, Any]:
    """The spaces of a Dict by key, in alphabetical order; any other space by ``""``."""
    return {key: space[key] for key in sorted(space.spaces)} if isinstance(space, spaces.Dict) else {"": space}


def parts_of(tree: Any) -> Mapping[Any, Any] | None:
    """The parts of a mapping, tuple, or Dict or Tuple space, by key or place; None for a leaf."""
    if isinstance(tree, np.ndarray):  # the usual case
        return None
    if isinstance(tree, Mapping):  # a Dict space too
        return tree
    return dict(enumerate(tree)) if isinstance(tree, (tuple, spaces.Tuple)) else None


def leaves_by_path(
    tree: Any, is_leaf: Callable[[Any], bool] = lambda part: False, path: Path = ()
) -> Iterator[tuple[Path, Any]]:
    """Path and leaf, for each leaf in order; a part for which `is_leaf` holds is one too."""
    parts = None if is_leaf(tree) else parts_of(tree)
    if parts is None:
        yield path, tree
    else:
        for key, part in parts.items():
            yield from leaves_by_path(part, is_leaf, (*path, key))


def part_at(tree: Any, path: Path) -> Any:
    """The part at `path`."""
    for key in path:
        tree = tree[key]
    return tree


def joined(tree: Any, values: Mapping[Path, Any], path: Path = ()) -> Any:
    """Nested as in `tree`, from the part at each path of `values`; KeyError for a leaf without one."""
    parts = parts_of(tree)
    if parts is None or path in values:
        return values[path]
    each = {key: joined(part, values, (*path, key)) for key, part in parts.items()}
    return each if isinstance(tree, Mapping) else tuple(each.values())


def mapped(change: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """The results of `change` for each leaf of `tree`, and the leaves of `others` at its path, nested as in `tree`."""
    parts = parts_of(tree)
    if parts is None:
        return change(tree, *others)
    each = {key: mapped(change, part, *(other[key] for other in others)) for key, part in parts.items()}
    return each if isinstance(tree, Mapping) else tuple(each.values())


def indexed(tree: Any, index: Any) -> Any:
    """Each leaf at `index`: a number, a slice or a mask."""
    return mapped(lambda leaf: leaf[index], tree)


def place_of(name: str, path: Path) -> str:
    """The part at `path` of what is called `name`, such as ``observation['arm'][0]``."""
    return name + "".join(f"[{key!r}]" for key in path)


def space_from_json(value: Mapping[str, Any]) -> Space[Any]:
    """Decode a space that `space_to_json` encoded.

    Raises:
        UnknownName: ``value["type"]`` is not in the table.
        InvalidValue: A field is missing or does not fit.
    """
    if not isinstance(value, Mapping):
        raise InvalidValue(f"A space is an object with a type, not {brief(value)}.")
    kind = value.get("type")
    if kind not in _KINDS:
        raise UnknownName("kind of space", str(kind), _KINDS)
    try:
        return _make(kind, value)
    except (InvalidValue, UnknownName):
        raise
    except KeyError as error:
        raise InvalidValue(f"The {kind} space has no field {error.args[0]!r}.") from error
    except _REFUSED as error:
        raise InvalidValue(f"The fields of the {kind} space do not make one: {error}") from error


def _make(kind: str, value: Mapping[str, Any]) -> Space[Any]:
    if kind == "Box":
        dtype, shape = np.dtype(value["dtype"]), tuple(int(length) for length in value["shape"])
        low, high = (_bounds(value[side], shape, dtype, side) for side in ("low", "high"))
        return spaces.Box(low, high, shape=shape, dtype=dtype.type)
    if kind == "Discrete":
        # Gymnasium 1.1 supports only int64, and has no argument for it.
        other = {} if value["dtype"] == "int64" else {"dtype": np.dtype(value["dtype"])}
        return spaces.Discrete(_integer(value, "n"), start=_integer(value, "start"), **other)
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete(value["nvec"], dtype=np.dtype(value["dtype"]).type, start=value["start"])
    if kind == "MultiBinary":
        sizes = [int(length) for length in value["n"]]
        return spaces.MultiBinary(sizes[0] if len(sizes) == 1 else sizes)
    if kind == "Text":
        lengths = {name: _integer(value, name) for name in ("min_length", "max_length")}
        return spaces.Text(**lengths, charset=str(value["charset"]))
    if kind == "Dict":  # an OrderedDict keeps its order in Gymnasium; a dict is sorted
        return spaces.Dict(OrderedDict((key, space_from_json(one)) for key, one in value["spaces"].items()))
    if kind == "Tuple":
        return spaces.Tuple([space_from_json(one) for one in value["spaces"]])
    return spaces.Sequence(space_from_json(value["space"]), stack=check(value["stack"], bool, "Sequence space: stack"))


def _integer(value: Mapping[str, Any], name: str) -> int:
    number: int = check(value[name], int, f"{value['type']} space: {name}")
    return number


def _bounds_to_json(bounds: NDArray[Any], side: str) -> Any:
    """One number when all are the same bit for bit, else nested lists."""
    if np.isnan(bounds).any():
        raise InvalidValue(f"The {side} of a Box must be numbers, not NaN.")
    if bounds.size and bounds.tobytes() == np.full_like(bounds, bounds.flat[0]).tobytes():
        return _number_to_json(bounds.flat[0].item())
    return _nested(bounds.tolist(), _number_to_json)


def _number_to_json(value: float) -> float | str:
    return repr(value) if isinstance(value, float) and math.isinf(value) else value


def _bounds(value: Any, shape: tuple[int, ...], dtype: np.dtype[Any], side: str) -> NDArray[Any]:
    """Bounds as an array of `shape`; one number stands for all."""
    array = np.asarray(_nested(value, lambda number: _number(number, side)), dtype=dtype)
    if isinstance(value, list) and array.shape != shape:
        raise InvalidValue(f"The {side} of the Box must have shape {shape}, not {array.shape}.")
    return np.array(np.broadcast_to(array, shape))


def _number(value: Any, side: str) -> float:
    if value in ("inf", "-inf"):
        return float(value)
    if not isinstance(value, (bool, int, float)) or math.isnan(value):
        raise InvalidValue(f'The {side} of a Box must be numbers, "inf" or "-inf", not {brief(value)}.')
    return value


def _nested(value: Any, change: Callable[[Any], Any]) -> Any:
    """`value` with `change` applied to everything that is not a list."""
    return [_nested(one, change) for one in value] if isinstance(value, list) else change(value)
