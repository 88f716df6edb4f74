"""Gymnasium spaces as plain JSON values and back: what a checkpoint's manifest says of observation and action.

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

Infinities are the strings ``"inf"`` and ``"-inf"``: JSON has none. Floats keep every bit. A space comes back equal to
what it was, except that ``MultiBinary([n])`` comes back as ``MultiBinary(n)``, which holds the same arrays.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, UnknownName

Json = dict[str, Any]
Make = Callable[[Mapping[str, Any]], Space[Any]]
_REFUSED = (AssertionError, AttributeError, OverflowError, TypeError, ValueError)
"""What Gymnasium and NumPy raise for fields that do not fit."""


def space_to_json(space: Space[Any]) -> Json:
    """Plain values that `space_from_json` makes the same space of.

    Raises:
        UnknownName: Graph, OneOf, or a kind of space that is not Gymnasium's.
        InvalidValue: A bound or key that JSON cannot say.
    """
    for kind, write in _WRITERS:
        if isinstance(space, kind):
            return {"type": kind.__name__, **write(space)}
    raise UnknownName("kind of space", type(space).__name__, _MAKERS)


def space_from_json(value: Mapping[str, Any]) -> Space[Any]:
    """The space that `space_to_json` was given.

    Raises:
        UnknownName: ``value["type"]`` is not in the table.
        InvalidValue: A field is missing or does not fit.
    """
    if not isinstance(value, Mapping):
        raise InvalidValue(f"A space is an object with a type, not {value!r}.")
    kind = value.get("type")
    if kind not in _MAKERS:
        raise UnknownName("kind of space", str(kind), _MAKERS)
    try:
        return _MAKERS[kind](value)
    except (InvalidValue, UnknownName):
        raise
    except KeyError as error:
        raise InvalidValue(f"The {kind} space has no field {error.args[0]!r}.") from error
    except _REFUSED as error:
        raise InvalidValue(f"The fields of the {kind} space do not make one: {error}") from error


def _write_box(space: spaces.Box) -> Json:
    bounds = {side: _bounds_to_json(getattr(space, side), side) for side in ("low", "high")}
    return {"shape": list(space.shape), "dtype": str(space.dtype), **bounds}


def _bounds_to_json(bounds: NDArray[Any], side: str) -> Any:
    """One number when all are the same bit for bit, else nested lists."""
    if np.isnan(bounds).any():
        raise InvalidValue(f"The {side} of a Box must be numbers, not NaN.")
    if bounds.size and bounds.tobytes() == np.full_like(bounds, bounds.flat[0]).tobytes():
        return _number_to_json(bounds.flat[0].item())
    return _nested(bounds.tolist(), _number_to_json)


def _number_to_json(value: float) -> float | str:
    return repr(value) if isinstance(value, float) and math.isinf(value) else value


def _make_box(value: Mapping[str, Any]) -> Space[Any]:
    dtype = np.dtype(value["dtype"])
    shape = tuple(int(length) for length in value["shape"])
    low, high = (_bounds(value[side], shape, dtype, side) for side in ("low", "high"))
    return spaces.Box(low, high, shape=shape, dtype=dtype.type)


def _bounds(value: Any, shape: tuple[int, ...], dtype: np.dtype[Any], side: str) -> NDArray[Any]:
    """Bounds as an array of `shape`; one number stands for all."""
    plain = _nested(value, lambda number: _number(number, side))
    array = np.asarray(plain, dtype=dtype)
    if isinstance(value, list) and array.shape != shape:
        raise InvalidValue(f"The {side} of the Box must have shape {shape}, not {array.shape}.")
    return np.array(np.broadcast_to(array, shape))


def _number(value: Any, side: str) -> float:
    if value in ("inf", "-inf"):
        return float(value)
    if not isinstance(value, (bool, int, float)) or math.isnan(value):
        raise InvalidValue(f'The {side} of a Box must be numbers, "inf" or "-inf", not {value!r}.')
    return value


def _nested(value: Any, change: Callable[[Any], Any]) -> Any:
    """`value` with `change` applied to everything that is not a list."""
    return [_nested(one, change) for one in value] if isinstance(value, list) else change(value)


def _write_discrete(space: spaces.Discrete[Any]) -> Json:
    return {"n": int(space.n), "start": int(space.start), "dtype": str(space.dtype)}


def _make_discrete(value: Mapping[str, Any]) -> Space[Any]:
    # Gymnasium 1.1 knows no other dtype than int64, and no argument for it.
    kind = {} if value["dtype"] == "int64" else {"dtype": np.dtype(value["dtype"])}
    return spaces.Discrete(_integer(value, "n"), start=_integer(value, "start"), **kind)


def _write_multi_discrete(space: spaces.MultiDiscrete) -> Json:
    return {"nvec": space.nvec.tolist(), "start": space.start.tolist(), "dtype": str(space.dtype)}


def _make_multi_discrete(value: Mapping[str, Any]) -> Space[Any]:
    dtype = np.dtype(value["dtype"])
    return spaces.MultiDiscrete(value["nvec"], dtype=dtype.type, start=value["start"])


def _write_multi_binary(space: spaces.MultiBinary) -> Json:
    return {"n": list(space.shape)}


def _make_multi_binary(value: Mapping[str, Any]) -> Space[Any]:
    shape = [int(length) for length in value["n"]]
    return spaces.MultiBinary(shape[0] if len(shape) == 1 else shape)


def _write_text(space: spaces.Text) -> Json:
    return {"min_length": space.min_length, "max_length": space.max_length, "charset": "".join(space.character_list)}


def _make_text(value: Mapping[str, Any]) -> Space[Any]:
    lengths = {name: _integer(value, name) for name in ("min_length", "max_length")}
    return spaces.Text(**lengths, charset=str(value["charset"]))


def _integer(value: Mapping[str, Any], name: str) -> int:
    number = value[name]
    if isinstance(number, bool) or not isinstance(number, int):
        raise InvalidValue(f"{name} of the {value['type']} space must be a whole number, not {number!r}.")
    return number


def _write_dict(space: spaces.Dict) -> Json:
    for key in space.spaces:
        if not isinstance(key, str):
            raise InvalidValue(f"The keys of a Dict space must be strings, not {key!r}.")
    return {"spaces": {key: space_to_json(one) for key, one in space.spaces.items()}}


def _make_dict(value: Mapping[str, Any]) -> Space[Any]:
    # An OrderedDict keeps its order in Gymnasium; a dict is sorted.
    return spaces.Dict(OrderedDict((key, space_from_json(one)) for key, one in value["spaces"].items()))


def _write_tuple(space: spaces.Tuple) -> Json:
    return {"spaces": [space_to_json(one) for one in space.spaces]}


def _make_tuple(value: Mapping[str, Any]) -> Space[Any]:
    return spaces.Tuple([space_from_json(one) for one in value["spaces"]])


def _write_sequence(space: spaces.Sequence) -> Json:
    return {"space": space_to_json(space.feature_space), "stack": bool(space.stack)}


def _make_sequence(value: Mapping[str, Any]) -> Space[Any]:
    if not isinstance(value["stack"], bool):
        raise InvalidValue(f"stack of the Sequence space must be true or false, not {value['stack']!r}.")
    return spaces.Sequence(space_from_json(value["space"]), stack=value["stack"])


_WRITERS: tuple[tuple[type[Space[Any]], Callable[[Any], Json]], ...] = (
    (spaces.Box, _write_box),
    (spaces.Discrete, _write_discrete),
    (spaces.MultiDiscrete, _write_multi_discrete),
    (spaces.MultiBinary, _write_multi_binary),
    (spaces.Text, _write_text),
    (spaces.Dict, _write_dict),
    (spaces.Tuple, _write_tuple),
    (spaces.Sequence, _write_sequence),
)
_MAKERS: dict[str, Make] = {
    "Box": _make_box,
    "Discrete": _make_discrete,
    "MultiDiscrete": _make_multi_discrete,
    "MultiBinary": _make_multi_binary,
    "Text": _make_text,
    "Dict": _make_dict,
    "Tuple": _make_tuple,
    "Sequence": _make_sequence,
}
