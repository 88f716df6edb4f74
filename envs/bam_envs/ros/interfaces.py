"""Check messages against their types before use: fields, types, ranges, finite numbers.

A message of a known type (`definitions`) is completed: missing fields get the type's defaults. A message of an unknown
type may hold only plain values. Values that are not finite and nulls are refused in both cases.
"""

import base64
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from bam_envs.core.errors import InvalidValue
from bam_envs.core.wording import brief
from bam_envs.ros.definitions import DEFINITIONS

MAX_DEPTH = 32  # how deep lists and objects may be nested in one another
INTEGERS = {
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
    "byte": (0, 255),
    "char": (0, 255),
}  # least and largest value of each integer type
FLOATS = {"float32": 3.4028234663852886e38, "float64": sys.float_info.max}  # largest value of each floating-point type
_BYTES = ("uint8", "byte", "char")  # the types whose arrays are `bytes`
_OBJECT = (dict, Mapping)  # dict first: a check for Mapping takes ten times as long
_MISSING: Any = object()  # stands for a field that a message leaves out
_SHORT = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration"}
_PLAIN_NAME = re.compile(r"[A-Za-z]\w*/(?:msg/|srv/|action/)?[A-Za-z]\w*", re.ASCII)

Check = Callable[[Any, int], Any]
"""Takes a value and how deep it is nested, returns it in its normal form or raises _Misfit."""


class _Misfit(Exception):  # noqa: N818 - becomes an InvalidValue
    """A value that does not fit, described by `text` if given; collects the path to it while it is raised."""

    def __init__(self, expected: str, found: object, text: str = "") -> None:
        self.expected, self.found, self.path = expected, text or brief(found), ""

    def under(self, step: str) -> "_Misfit":
        self.path = step + self.path
        return self

    def error(self, place: str) -> InvalidValue:
        return InvalidValue(f"{place}{self.path}: expected {self.expected}, found {self.found}.")


@dataclass(frozen=True)
class Field:
    """One field of a message type."""

    name: str  # as on the wire
    type: str  # a primitive, or the normal name of a message type
    array: str | None = None
    """None for one value, ``""`` for a list of any length, a number for a fixed one, ``"?"`` for one or a list."""
    default: float = 0  # of a number


def normal_name(kind: str) -> str:
    """``pkg/Type`` of that, ``pkg/msg/Type``, ``pkg/srv/Type`` or ``pkg/action/Type``; else `InvalidValue`."""
    if not isinstance(kind, str) or len(kind) > 256 or not _PLAIN_NAME.fullmatch(kind):
        raise InvalidValue(f"Type: expected a name such as 'std_msgs/String', found {brief(kind)}.")
    return re.sub("/(msg|srv|action)/", "/", kind)


def request_type(kind: str) -> str:
    """Name of the request message of a service of type `kind`."""
    return normal_name(kind) + "Request"


def response_type(kind: str) -> str:
    """Name of the response message of a service of type `kind`."""
    return normal_name(kind) + "Response"


def variants(kind: str) -> tuple[tuple[Field, ...], ...]:
    """The fields of the type with the normal name `kind`, in each of its spellings; empty for an unknown type."""
    return _table().get(kind, ())


def complete(kind: str, message: object, *, lenient: bool = False) -> dict[str, Any]:
    """A message of type `kind` with every field: a new dict, byte arrays as `bytes`. It must not be changed.

    Byte arrays of `message` may be base64, as in JSON, `bytes`, or lists of integers. A `lenient` check ignores unknown
    fields, which may be of a newer version. `InvalidValue` if the message does not fit.
    """
    name = kind if kind in _table() else normal_name(kind)
    try:
        # Unknown types are not cached: a client could name any number of them.
        check = _check(name, None, 0, lenient) if name in _table() else _any
        checked: dict[str, Any] = check(_object(message), 0)
    except _Misfit as misfit:
        raise misfit.error(name) from None
    return checked


def require_plain(value: object, place: str = "value") -> None:
    """Raise `InvalidValue` for NaN, infinity, a huge integer, a broken text, too deep a nesting; null is allowed."""
    try:
        _plain(value, 0, null=True)
    except _Misfit as misfit:
        raise misfit.error(place) from None


# ---- the table of types


@cache
def _table() -> dict[str, tuple[tuple[Field, ...], ...]]:
    def field(text: str, package: str) -> Field:
        kind, name = text.split()
        name, _, value = name.partition("=")
        kind, bracket, size = kind.partition("[")
        kind = _SHORT.get(kind, kind)
        primitive = kind in INTEGERS or kind in FLOATS or kind in ("bool", "string", "any")
        full = kind if primitive or "/" in kind else f"{package}/{kind}"
        return Field(name, full, size.removesuffix("]") if bracket else None, float(value or 0))

    table = {}
    for line in filter(None, DEFINITIONS.splitlines()):
        name, body = line.split(":", 1)
        package = name.split("/")[0]
        request, arrow, response = body.partition("->")
        parts = {name + "Request": request, name + "Response": response} if arrow else {name: body}
        for part, text in parts.items():
            spellings = [[one for one in spelling.split(";") if one.strip()] for spelling in text.split("|")]
            table[part] = tuple(tuple(field(one, package) for one in fields) for fields in spellings)
    return table


# ---- the check of each type, made once


@cache
def _check(kind: str, array: str | None, first: float, lenient: bool) -> Check:
    """The check of a value of type `kind`, or of an array of it; `first` is the default of a number."""
    others: dict[str, Check] = {"bool": _bool, "string": _string, "any": _any}
    numeric = kind in FLOATS or kind in INTEGERS
    one = _number(kind, first) if numeric else others.get(kind) or _message(kind, lenient)
    if array is None:
        return one
    if array == "?":
        many = _check(kind, "", first, lenient)
        return lambda value, depth: (many if isinstance(value, (list, tuple)) else one)(value, depth)
    size = int(array) if array else None
    return (lambda value, depth: _byte_array(value, size)) if kind in _BYTES else _array(kind, one, size)


def _message(kind: str, lenient: bool) -> Check:
    plans = [
        {one.name: _check(one.type, one.array, one.default, lenient) for one in fields} for fields in _table()[kind]
    ]
    usual = plans[0]
    left_out = {name: one(_MISSING, 0) for name, one in usual.items()}

    def check(value: Any, depth: int) -> dict[str, Any]:
        if value is _MISSING:
            return left_out
        given = _object(value)
        plan = next((one for one in plans if given.keys() <= one.keys()), None)
        if plan is None and lenient:
            plan = max(plans, key=lambda one: len(given.keys() & one.keys()))
        if plan is None:
            extra = next(name for name in given if name not in usual)
            raise _Misfit(f"only the fields {', '.join(usual)}" if usual else "no fields", extra)
        checked, name = {}, ""
        try:  # one for all fields, without a function for each: this runs for every part of every message
            for name, one in plan.items():
                checked[name] = one(given.get(name, _MISSING), depth + 1)
        except _Misfit as misfit:
            raise misfit.under(f".{name}") from None
        return checked

    return check


def _number(kind: str, first: float) -> Check:
    whole = kind in INTEGERS
    make, kinds = (int, int) if whole else (float, (int, float))
    low, high = INTEGERS[kind] if whole else (-FLOATS[kind], FLOATS[kind])
    expected = f"an integer ({kind})" if whole else "a number"
    inside = f"an integer in [{low}, {high}]" if whole else "a finite number"
    inside += " of 32 bits" if kind == "float32" else ""
    first = make(first)

    def check(value: Any, depth: int) -> float:
        if type(value) is make and low <= value <= high:  # the usual case
            return value
        if value is _MISSING:
            return first
        if isinstance(value, bool) or not isinstance(value, kinds):
            raise _Misfit(expected, value)
        if not low <= value <= high:
            raise _Misfit(inside, value)
        return make(value)

    return check


def _array(kind: str, one: Check, size: int | None) -> Check:
    def check(value: Any, depth: int) -> list[Any]:
        values = [_MISSING] * (size or 0) if value is _MISSING else value
        if not isinstance(values, (list, tuple)):
            raise _Misfit("a list", values)
        if size is not None and len(values) != size:
            raise _Misfit(f"a list of {size}", values, f"a list of {len(values)}")
        usual = _usual(kind, values)
        if usual is not None:
            return usual
        checked: list[Any] = []
        try:
            checked.extend(one(item, depth + 1) for item in values)
        except _Misfit as misfit:
            raise misfit.under(f"[{len(checked)}]") from None
        return checked

    return check


def _usual(kind: str, values: Sequence[Any]) -> list[Any] | None:
    """A checked copy of many numbers or texts, by a few passes in C; None where items need a closer look."""
    kinds = set(map(type, values))
    if kinds == {float} and kind in FLOATS and math.isfinite(sum(values)):  # a finite sum has finite terms
        return list(values) if max(map(abs, values)) <= FLOATS[kind] else None
    if kinds == {int} and kind in INTEGERS:
        low, high = INTEGERS[kind]
        return list(values) if low <= min(values) and max(values) <= high else None
    if kinds == {str} and kind == "string":
        return list(values) if "".join(values).isascii() else None
    return None


def _bool(value: Any, depth: int) -> bool:
    if value is _MISSING:
        return False
    if not isinstance(value, bool):
        raise _Misfit("true or false", value)
    return value


def _string(value: Any, depth: int) -> str:
    if value is _MISSING:
        return ""
    if not isinstance(value, str):
        raise _Misfit("a text", value)
    if not value.isascii():
        try:
            value.encode()
        except UnicodeEncodeError:
            raise _Misfit("a text of whole characters", value) from None
    return value


def _byte_array(value: Any, size: int | None) -> bytes:
    """Bytes as they are, as base64, or as a list of integers; zeros where they are left out."""
    if value is _MISSING:
        return bytes(size or 0)
    data: bytes | None = None
    try:
        if isinstance(value, (bytes, bytearray, memoryview)):
            data = bytes(value)
        elif isinstance(value, str):
            data = base64.b64decode(value, validate=True)
        elif isinstance(value, (list, tuple)) and set(map(type, value)) <= {int}:
            data = bytes(value)
    except ValueError:  # binascii.Error is one
        pass
    if data is None:
        raise _Misfit("bytes as base64 or a list of integers in [0, 255]", value)
    if size is not None and len(data) != size:
        raise _Misfit(f"{size} bytes", data, f"{len(data)} bytes")
    return data


# ---- plain values of any type


def _object(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, _OBJECT):
        raise _Misfit("an object", value)
    return value


def _any(value: Any, depth: int) -> Any:
    if value is _MISSING:
        return {}
    _plain(value, depth, null=False)
    return value


def _plain(value: Any, depth: int, *, null: bool) -> None:
    if depth > MAX_DEPTH:
        raise _Misfit(f"at most {MAX_DEPTH} lists and objects in one another", value)
    parts: list[tuple[str, Any]] = []
    if type(value) is dict:
        for name in value:
            if not isinstance(name, str):
                raise _Misfit("texts as names", name)
            parts.append((f".{_string(name, 0)}", value[name]))
    elif type(value) in (list, tuple):
        if _usual("float64", value) or _usual("int64", value):  # an image or a scan, which a few passes in C check
            return
        parts = [(f"[{place}]", item) for place, item in enumerate(value)]
    elif isinstance(value, str):
        _string(value, depth)
    elif not isinstance(value, (bool, bytes)) and not (null and value is None):
        if not isinstance(value, (int, float)):
            raise _Misfit("a plain value", value)
        if isinstance(value, int) and not -(2**63) <= value < 2**64:
            raise _Misfit("a number of 64 bits", value)
        if isinstance(value, float) and not math.isfinite(value):
            raise _Misfit("a finite number", value)
    for step, item in parts:
        try:
            _plain(item, depth + 1, null=null)
        except _Misfit as misfit:  # noqa: PERF203
            raise misfit.under(step) from None
