"""Checks of values that come from elsewhere: kinds, ranges, finite numbers, whole texts, bounded depth.

One check for each kind of value, which makes the file a little long.
"""

from __future__ import annotations

import base64
import binascii
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

from bam_envs.core.errors import InvalidValue

MAX_DEPTH = 32
"""How deep lists and objects may be nested in one another."""
INTEGERS = {
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
    "byte": (0, 255),
    "char": (0, 255),
}
"""Least and largest value of each integer type."""
FLOATS = {"float32": 3.4028234663852886e38, "float64": sys.float_info.max}
"""Largest value of each floating-point type."""
OBJECT = (dict, Mapping)
"""What has names. dict first: asking whether something is a Mapping takes ten times as long."""
BYTES = ("uint8", "byte", "char")
"""The types whose arrays are `bytes`."""


class Misfit(Exception):  # noqa: N818 - becomes an InvalidValue, with the whole path in its text
    """A value that does not fit; collects the path to it on the way out."""

    def __init__(self, expected: str, found: object) -> None:
        self.expected, self.found, self.path = expected, describe(found), ""

    def under(self, step: str) -> Misfit:
        """The same, seen from one level further out."""
        self.path = step + self.path
        return self


Check = Callable[[Any, int], Any]
"""Takes a value and how deep it is nested, returns it in its normal form or raises Misfit."""


class Missing:
    """Stands for a field that a message leaves out."""


MISSING = Missing()


def zeros(value: Any, size: int | None) -> Any:
    """An array that is left out: empty, or of the fixed `size`, with every item left out."""
    return [MISSING] * (size or 0) if value is MISSING else value


def require_plain(value: object, place: str = "value") -> None:
    """Refuse what JSON cannot carry unharmed.

    Raises:
        InvalidValue: There is a NaN, an infinity, a huge integer, a broken text, or too deep a nesting in it; null is
            allowed here.
    """
    try:
        _plain(value, 0, null=True)
    except Misfit as misfit:
        raise InvalidValue(f"{place}{misfit.path}: expected {misfit.expected}, found {misfit.found}.") from None


def describe(value: object) -> str:
    """A value in a few words, for an error message."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float):
        return {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}.get(repr(value), repr(float(value)))
    if isinstance(value, int):
        return str(int(value)) if abs(value) < 10**20 else "a huge integer"
    if isinstance(value, str):
        return repr(value) if len(value) <= 40 else f"{value[:37]!r}..."
    if isinstance(value, (list, tuple)):
        return f"a list of {len(value)}"
    return "an object" if isinstance(value, Mapping) else f"a {type(value).__name__}"


def require_object(value: Any) -> Mapping[str, Any]:
    """Anything with names, or Misfit."""
    if not isinstance(value, OBJECT):
        raise Misfit("an object", value)
    return value


def float_check(limit: float, first: float) -> Check:
    """Check of a number up to `limit` either way; `first` where it is left out."""

    def check(value: Any, depth: int) -> float:
        if type(value) is float and -limit <= value <= limit:  # what it is nearly always
            return value
        if value is MISSING:
            return first
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise Misfit("a number", value)
        if not -limit <= value <= limit:
            raise Misfit("a finite number" if limit == FLOATS["float64"] else "a finite number of 32 bits", value)
        return float(value)

    return check


def integer_check(kind: str, low: int, high: int) -> Check:
    """Check of an integer in [`low`, `high`]; 0 where it is left out."""

    def check(value: Any, depth: int) -> int:
        if type(value) is int and low <= value <= high:
            return value
        if value is MISSING:
            return 0
        if isinstance(value, bool) or not isinstance(value, int):
            raise Misfit(f"an integer ({kind})", value)
        if not low <= value <= high:
            raise Misfit(f"an integer in [{low}, {high}]", value)
        return int(value)

    return check


def bool_check(value: Any, depth: int) -> bool:
    """Check of true or false; false where it is left out."""
    if value is MISSING:
        return False
    if not isinstance(value, bool):
        raise Misfit("true or false", value)
    return value


def string_check(value: Any, depth: int) -> str:
    """Check of a text that can be written as UTF-8; empty where it is left out."""
    if type(value) is str and value.isascii():
        return value
    if value is MISSING:
        return ""
    if not isinstance(value, str):
        raise Misfit("a text", value)
    if not value.isascii():
        _require_unicode(value)
    return value


def _require_unicode(value: str) -> None:
    try:
        value.encode()
    except UnicodeEncodeError:
        raise Misfit("a text of whole characters", value) from None


def number_array_check(kind: str, one: Check, size: int | None) -> Check:
    """Check of a list of numbers of the type `kind`; `one` checks an item, `size` is the length if it is fixed."""
    low, high = INTEGERS.get(kind) or (-FLOATS[kind], FLOATS[kind])
    any_fits = kind == "float64"
    usual = _integers if kind in INTEGERS else _floats

    def check(value: Any, depth: int) -> list[Any]:
        values = zeros(value, size)
        # A few passes in C instead of one in Python, which would hold up everybody for the time of a large list.
        numbers = usual(values) if isinstance(values, list) and size in (None, len(values)) else None
        if numbers and (any_fits or (low <= min(numbers) and max(numbers) <= high)):
            return numbers
        return array_check(values, depth, one, size)

    return check


def _integers(values: list[Any]) -> list[int] | None:
    """A copy of `values` if all of them are integers."""
    return values[:] if set(map(type, values)) == {int} else None


def _floats(values: list[Any]) -> list[float] | None:
    """`values` as floats if all of them are finite floats or integers."""
    kinds = set(map(type, values))
    if not kinds <= {float, int}:
        return None
    try:
        floats = values[:] if int not in kinds else list(map(float, values))
    except OverflowError:
        return None
    return floats if math.isfinite(sum(floats)) else None  # a finite sum has finite terms


def string_array_check(size: int | None) -> Check:
    """Check of a list of texts; `size` is the length if it is fixed."""

    def check(value: Any, depth: int) -> list[Any]:
        values = zeros(value, size)
        usual = type(values) is list and set(map(type, values)) == {str} and size in (None, len(values))
        return list(values) if usual and "".join(values).isascii() else array_check(values, depth, string_check, size)

    return check


def array_check(value: Any, depth: int, one: Check, size: int | None) -> list[Any]:
    """Check of a list, item by item."""
    if not isinstance(value, (list, tuple)):
        raise Misfit("a list", value)
    if size is not None and len(value) != size:
        raise Misfit(f"a list of {size}", value)
    checked: list[Any] = []
    try:
        checked.extend(one(item, depth + 1) for item in value)
    except Misfit as misfit:
        raise misfit.under(f"[{len(checked)}]") from None
    return checked


def byte_array_check(value: Any, size: int | None) -> bytes:
    """Check of bytes: as they are, as base64, or as a list of integers; zeros where they are left out."""
    if value is MISSING:
        return bytes(size or 0)
    data = _bytes(value)
    if size is not None and len(data) != size:
        raise Misfit(f"{size} bytes", f"{len(data)} bytes")
    return data


def _bytes(value: Any) -> bytes:
    if isinstance(value, (bytes, bytearray, memoryview)):
        return bytes(value)
    try:
        if isinstance(value, str):
            return base64.b64decode(value, validate=True)
        if isinstance(value, (list, tuple)) and set(map(type, value)) <= {int}:
            return bytes(value)
    except (binascii.Error, ValueError):
        pass
    raise Misfit("bytes as base64 or a list of integers in [0, 255]", value)


def any_check(value: Any, depth: int) -> Any:
    """Check of any plain value without null; an empty object where it is left out."""
    if value is MISSING:
        return {}
    _plain(value, depth, null=False)
    return value


def _plain(value: Any, depth: int, *, null: bool) -> None:
    if depth > MAX_DEPTH:
        raise Misfit(f"at most {MAX_DEPTH} lists and objects in one another", value)
    kind = type(value)
    if kind is dict:
        for name, item in value.items():
            _plain_item(f".{_plain_name(name)}", item, depth, null=null)
    elif kind is list or kind is tuple:
        _plain_list(value, depth, null=null)
    elif isinstance(value, str):
        string_check(value, depth)
    elif not isinstance(value, (bool, bytes)) and not (null and value is None):
        _plain_number(value)


def _plain_number(value: Any) -> None:
    if not isinstance(value, (int, float)):
        raise Misfit("a plain value", value)
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        raise Misfit("a number of 64 bits", value)
    if isinstance(value, float) and not math.isfinite(value):
        raise Misfit("a finite number", value)


def _plain_name(name: Any) -> str:
    if not isinstance(name, str):
        raise Misfit("texts as names", name)
    return string_check(name, 0)


def _plain_item(step: str, item: Any, depth: int, *, null: bool) -> None:
    try:
        _plain(item, depth + 1, null=null)
    except Misfit as misfit:
        raise misfit.under(step) from None


def _plain_list(values: Any, depth: int, *, null: bool) -> None:
    kinds = set(map(type, values))
    if kinds <= {float} and math.isfinite(sum(values)):
        return
    if kinds == {int} and min(values) >= -(2**63) and max(values) < 2**64:
        return
    for place, item in enumerate(values):
        _plain_item(f"[{place}]", item, depth, null=null)
