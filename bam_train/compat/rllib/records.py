"""What RLlib's files say of spaces and classes, whether it was read as a `pickles.Record` or as the object itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_train.compat.rllib.pickles import Record, dtype_of, unpacked_array
from bam_train.errors import FormatError
from bam_train.trainers.rllib.freezing.parts import AnySpace

_FAULTS = (
    AssertionError,
    AttributeError,
    IndexError,
    KeyError,
    OverflowError,
    TypeError,
    ValueError,
    RecursionError,
)
"""What Gymnasium and NumPy raise for fields that do not fit."""


def class_name(value: Any) -> str:
    """Dotted name of a class that was read as a record, or of a class."""
    if isinstance(value, Record):  # a class that was pickled with its code has its name among the arguments
        made = value.name.endswith("._make_skeleton_class") and value.args is not None
        return str(value.args[1]) if made and value.args and len(value.args) > 1 else value.name
    if isinstance(value, type):
        return value.name if issubclass(value, Record) else f"{value.__module__}.{value.__qualname__}"
    return ""


def last_name(value: Any) -> str:
    """A class's name without its module."""
    return class_name(value).rpartition(".")[2]


def attributes(value: Any) -> dict[str, Any]:
    """The attributes of an object that was read as a record, or of an object."""
    if isinstance(value, Mapping):
        return dict(value)
    return value.attributes if isinstance(value, Record) else dict(getattr(value, "__dict__", {}))


def constructor(value: Any) -> tuple[Any, tuple[Any, ...], dict[str, Any]]:
    """Class, arguments and keyword arguments in a ``class_and_ctor_args.pkl``.

    Raises:
        FormatError: It holds something else.
    """
    try:
        args, kwargs = value["ctor_args_and_kwargs"]
        return value["class"], tuple(args), dict(kwargs)
    except _FAULTS as error:
        raise FormatError("does not hold a class and its arguments") from error


def space_of(value: Any) -> AnySpace:
    """The space that a record of one of Gymnasium's describes.

    Raises:
        FormatError: It is of another kind, or its fields do not make a space.
    """
    if isinstance(value, spaces.Space):
        return value
    make = _SPACES.get(last_name(value))
    if make is None or not class_name(value).startswith("gymnasium.spaces."):
        raise FormatError(f"a space of kind {class_name(value) or type(value).__name__} is not known")
    try:
        return make(attributes(value))
    except _FAULTS as error:
        raise FormatError(f"the fields of a {last_name(value)} space do not make one: {error}") from error


def _box(fields: dict[str, Any]) -> AnySpace:
    return _bounded(fields["low"], fields["high"], fields["_shape"], dtype_of(fields["dtype"]))


def _bounded(low: Any, high: Any, shape: Any, dtype: np.dtype[Any]) -> AnySpace:
    low, high, shape = np.asarray(low), np.asarray(high), tuple(shape)
    if not low.shape == high.shape == shape:  # a number would be spread over a shape of any size
        raise FormatError(f"bounds of shapes {low.shape} and {high.shape} for shape {shape}")
    return spaces.Box(low, high, shape=shape, dtype=dtype.type)


def _discrete(fields: dict[str, Any]) -> AnySpace:
    return spaces.Discrete(int(fields["n"]), start=int(fields.get("start", 0)))


def _multi_discrete(fields: dict[str, Any]) -> AnySpace:
    dtype = dtype_of(fields["dtype"]).type
    return spaces.MultiDiscrete(np.asarray(fields["nvec"]), dtype=dtype, start=fields.get("start"))


def _multi_binary(fields: dict[str, Any]) -> AnySpace:
    return spaces.MultiBinary(fields["n"] if isinstance(fields["n"], int) else [int(n) for n in fields["n"]])


def _dict(fields: dict[str, Any]) -> AnySpace:
    return spaces.Dict({str(key): space_of(space) for key, space in dict(fields["spaces"]).items()})


_SPACES: dict[str, Callable[[dict[str, Any]], AnySpace]] = {
    "Box": _box,
    "Dict": _dict,
    "Discrete": _discrete,
    "MultiBinary": _multi_binary,
    "MultiDiscrete": _multi_discrete,
}


def old_space(value: Any) -> AnySpace:
    """The space before any preprocessor that `space_to_dict` of the old stack describes.

    Raises:
        FormatError: It is of another kind, or its fields do not make a space.
    """
    try:
        return _old_space(value.get("original_space", value))
    except FormatError:
        raise
    except _FAULTS as error:
        raise FormatError(f"a space cannot be read: {type(error).__name__} {error}") from error


def _old_space(value: Any) -> AnySpace:
    fields = value["space"] if isinstance(value["space"], Mapping) else value
    kind = fields["space"]
    if kind == "box":
        low, high = unpacked_array(fields["low"]), unpacked_array(fields["high"])
        return _bounded(low, high, fields["shape"], np.dtype(fields["dtype"]))
    if kind == "discrete":
        return spaces.Discrete(int(fields["n"]), start=int(fields.get("start", 0)))
    if kind == "multi-discrete":
        dtype: Any = np.dtype(fields["dtype"]).type
        return spaces.MultiDiscrete(unpacked_array(fields["nvec"]), dtype=dtype)
    if kind == "multi-binary":
        return spaces.MultiBinary(fields["n"])
    if kind == "dict":
        return spaces.Dict({str(key): _old_space(space) for key, space in fields["spaces"].items()})
    raise FormatError(f"a space of kind {kind!r} is not known")
