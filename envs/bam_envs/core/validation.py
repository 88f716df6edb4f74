"""The check of all values that users give, by annotated types and msgspec.

::

    @dataclass(frozen=True)
    class Options:
        rate: Positive = 20.0
        port: Port = 9090

        def __post_init__(self) -> None:
            check_fields(self)      # rate: expected a number above 0, found -1

A range is ``Annotated[float, msgspec.Meta(gt=0, le=2)]``; the names below are the frequent ones, and every one of them
refuses NaN and infinity. ``Meta(description=...)`` replaces an error's description of the type and its range.
"""

import functools
import re
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from bam_envs.core.errors import InvalidValue
from bam_envs.core.wording import brief, did_you_mean

T = TypeVar("T")
_MOST = sys.float_info.max

Finite = Annotated[float, Meta(ge=-_MOST, le=_MOST, description="a finite number")]
Positive = Annotated[float, Meta(gt=0, le=_MOST)]
AboveZero = Annotated[float, Meta(gt=0, description="a number above 0")]  # infinity, too
NonNegative = Annotated[float, Meta(ge=0, le=_MOST)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
PositiveInt = Annotated[int, Meta(ge=1)]
NonNegativeInt = Annotated[int, Meta(ge=0)]
Port = Annotated[int, Meta(ge=0, le=65535)]
Metres = Annotated[float, Meta(ge=-10, le=10, description="a number of metres from -10 to 10")]
Length = Annotated[float, Meta(gt=0, le=10, description="a number of metres above 0 and of at most 10")]
Mass = Annotated[float, Meta(gt=0, le=1000, description="a number of kilograms above 0 and of at most 1000")]
MetresPerS = Annotated[float, Meta(gt=0, le=20, description="a data sheet's m/s, above 0 and at most 20")]
MetresPerS2 = Annotated[float, Meta(gt=0, le=100, description="a data sheet's m/s^2, above 0 and at most 100")]
RadPerS = Annotated[float, Meta(gt=0, le=50, description="a data sheet's rad/s, above 0 and at most 50")]
RadPerS2 = Annotated[float, Meta(gt=0, le=1e4, description="a data sheet's rad/s^2, above 0 and at most 10000")]
RadPerS3 = Annotated[float, Meta(gt=0, le=1e6, description="a data sheet's rad/s^3, above 0 and at most 1000000")]
Newtons = Annotated[float, Meta(gt=0, le=5000, description="a data sheet's N, above 0 and at most 5000")]
NewtonMetres = Annotated[float, Meta(gt=0, le=5000, description="a data sheet's N m, above 0 and at most 5000")]
DATA_SHEET = frozenset((MetresPerS, MetresPerS2, RadPerS, RadPerS2, RadPerS3, Newtons, NewtonMetres))
"""The limits of robots, none of which is greater."""
RobotName = Annotated[
    str,
    Meta(
        pattern=r"^(\w([\w .@-]{0,62}\w)?)?\Z",
        description="at most 64 letters, digits, blanks and . _ @ -, with a letter or digit at both ends",
    ),
]
"""What tells a robot from others: its serial number, or a name that its operator gave; empty if neither is known."""
NonEmpty = Annotated[str, Meta(min_length=1, description="non-empty text")]


def check(value: Any, kind: Any, name: str, error: type[Exception] = InvalidValue) -> Any:
    """`value` as a `kind`: an int becomes a float if one is expected, a whole float (1e6) an int, a list a tuple.

    Args:
        value: A number, text, list, table, a dataclass or an instance of any other class.
        kind: A type or annotation, such as ``Positive`` or ``list[int] | None``.
        name: Name of the value, with which the error begins.
        error: Exception to raise.

    Raises:
        error: ``name: expected ..., found ...``; in a list or table with the place, ``name[2]``, ``name.key``.
    """
    if type(value).__module__ == "numpy" and getattr(value, "ndim", None) == 0:  # a number as Python's
        value = value.item()
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError:
        if isinstance(value, float) and value.is_integer() and fits(int(value), kind):
            return int(value)
    place, part, wanted = _misfit(value, kind, name)
    raise error(f"{place}: expected {expected(wanted)}, found {brief(part)}")


def check_fields(instance: Any, name: Callable[[str], str] = str, error: type[Exception] = InvalidValue) -> None:
    """Check every field of a dataclass instance against its annotation; nothing is converted.

    Args:
        instance: The dataclass instance.
        name: Converts a field's name for errors, such as `bam_envs.core.wording.as_flag`.
        error: Exception to raise.

    Raises:
        error: As in `check`, for the first field that does not fit.
    """
    for field, hint in type_hints(type(instance)).items():
        check(getattr(instance, field), hint, name(field), error)


def read_table(
    kind: type[T],
    data: object,
    where: str,
    error: type[Exception] = InvalidValue,
    *,
    hints: Mapping[str, Any] | None = None,
) -> T:
    """The dataclass `kind` with the values of the table `data` from TOML, YAML or JSON.

    Args:
        kind: A dataclass; its fields are the keys.
        data: The table.
        where: File and table, with which the error begins.
        error: Exception to raise.
        hints: The annotation of each field, where those of `kind` do not count.

    Raises:
        error: `data` is not a table, a key is unknown (with the closest match) or missing, or a value does not fit.
    """
    table, hints = check(data, dict[str, Any], where, error), hints or type_hints(kind)
    check_keys(table, hints, where, error)
    for field in fields(kind):  # type: ignore[arg-type]
        if field.name not in table and field.default is MISSING and field.default_factory is MISSING:
            raise error(f"{where}: the key {field.name!r} is missing")
    return kind(**{key: check(value, hints[key], f"{where}: {key}", error) for key, value in table.items()})


def check_keys(
    table: Mapping[str, Any],
    known: Sequence[str] | Mapping[str, Any],
    where: str,
    error: type[Exception] = InvalidValue,
) -> None:
    """Refuse a key of `table` that is not `known`, with the closest match."""
    for key in table:
        if key not in known:
            raise error(f"{where}: unknown key {key!r}. {did_you_mean(key, known, cutoff=0.5)}")


def type_hints(kind: Any) -> Mapping[str, Any]:
    """The annotation of each field of a dataclass, with its ranges."""
    return _type_hints(kind)


@functools.cache
def _type_hints(kind: Any) -> Mapping[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return types.MappingProxyType({field.name: hints[field.name] for field in fields(kind)})


def expected(kind: Any) -> str:
    """What fits the annotation `kind`, but None, in words: ``a whole number from 0 to 65535``."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        metas = [one for one in arguments[1:] if isinstance(one, Meta)]
        description = next((meta.description for meta in metas if meta.description), None)
        return description or expected(arguments[0]) + "".join(map(_range, metas))
    if origin in (Union, types.UnionType):
        return " or ".join(expected(one) for one in arguments if one is not type(None))
    if origin is Literal:
        choices = [repr(one) for one in arguments]
        return " or ".join([", ".join(choices[:-1]), choices[-1]] if choices[1:] else choices)
    base = origin or kind
    if base in (list, tuple, Sequence) and arguments:
        if base is not tuple or arguments[-1] is ...:
            return f"a list of {_plural(expected(arguments[0]))}"
        if len(set(arguments)) == 1 < len(arguments):
            return f"a list of {len(arguments)} {_plural(expected(arguments[0]))}"
        return f"a list [{', '.join(map(expected, arguments))}]"
    if base in (dict, Mapping):
        rest = _plural(expected(arguments[1])) if arguments and arguments[1] is not Any else "named values"
        return f"a table of {rest}"
    return _WORDS.get(base) or f"a {base.__name__}"


_WORDS: dict[Any, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    list: "a list",
    tuple: "a list",
    Sequence: "a list",
}


def _range(meta: Meta) -> str:
    """The range of `meta`, as it follows a noun."""
    low, high = meta.ge, None if meta.le == _MOST else meta.le
    if low is not None and high is not None:
        return f" from {_number(low)} to {_number(high)}"
    limits = (("above", meta.gt), ("at least", low), ("below", meta.lt), ("at most", high))
    texts = [f"{word} {_number(limit)}" for word, limit in limits if limit is not None]
    return f"{' of' if texts[0].startswith('at') else ''} {' and '.join(texts)}" if texts else ""


def _number(limit: float) -> str:
    return str(limit) if isinstance(limit, int) else f"{limit:g}"


def _plural(text: str) -> str:
    """``numbers above 0`` of ``a number above 0``."""
    noun = re.search("number|text|table|list", text)
    if noun is None:
        return f"({text})"
    return f"{text[: noun.start()].removeprefix('a ')}{noun[0]}s{text[noun.end() :]}"


def fits(value: object, kind: Any) -> bool:
    """Whether `value` is a `kind`, a type or annotation."""
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return False
    return True


def _misfit(value: Any, kind: Any, name: str) -> tuple[str, Any, Any]:
    """The innermost part of `value` that does not fit `kind`: its place, itself, what it should be."""
    for place, part, wanted in _parts(value, kind, name):
        if not fits(part, wanted):
            return _misfit(part, wanted, place)
    return name, value, kind


def _parts(value: Any, kind: Any, name: str) -> list[tuple[str, Any, Any]]:
    """Items of a list, entries of a table and fields of a dataclass, each with its place and annotation."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _parts(value, arguments[0], name)
    if origin in (Union, types.UnionType):  # check the items of an optional list only
        rest = [one for one in arguments if one is not type(None)]
        return _parts(value, rest[0], name) if len(rest) == 1 else []
    if isinstance(value, Mapping) and origin in (dict, Mapping):
        return [(f"{name}.{key}", one, arguments[1]) for key, one in value.items()]
    if isinstance(value, (list, tuple)) and origin in (list, tuple, Sequence):
        each = arguments if origin is tuple and arguments[-1] is not ... else (arguments[0],) * len(value)
        return [(f"{name}[{i}]", one, wanted) for i, (one, wanted) in enumerate(zip(value, each, strict=False))]
    if isinstance(value, Mapping) and isinstance(kind, type) and is_dataclass(kind):
        return [(f"{name}.{key}", value[key], hint) for key, hint in type_hints(kind).items() if key in value]
    return []
