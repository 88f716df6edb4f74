"""Messages are checked against their types before anything else sees them: fields, types, ranges, finite numbers.

A message of a known type (`definitions`) comes out complete: what it leaves out is filled with the type's default. Of
an unknown type only plain values are taken. Nothing that is not finite, and no null, gets through either way.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from bam_envs.core.errors import InvalidValue
from bam_envs.ros.checks import (
    BYTES,
    FLOATS,
    INTEGERS,
    MISSING,
    Check,
    Misfit,
    any_check,
    array_check,
    bool_check,
    byte_array_check,
    describe,
    float_check,
    integer_check,
    number_array_check,
    require_object,
    require_plain,
    string_array_check,
    string_check,
    zeros,
)
from bam_envs.ros.definitions import DEFINITIONS

__all__ = [
    "Field",
    "complete",
    "complete_known",
    "default",
    "describe",
    "is_known",
    "normal_name",
    "request_type",
    "require_plain",
    "response_type",
    "variants",
]

_SHORT = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration"}
_PLAIN_NAME = re.compile(r"[A-Za-z]\w*/(?:msg/|srv/)?[A-Za-z]\w*", re.ASCII)


@dataclass(frozen=True)
class Field:
    """One field of a message type."""

    name: str
    """As on the wire."""
    type: str
    """A primitive, or the normal name of a message type."""
    array: str | None = None
    """None for one value, ``""`` for a list of any length, a number for a fixed one, ``"?"`` for one or a list."""
    default: float = 0
    """Of a number."""


def normal_name(kind: str) -> str:
    """``pkg/msg/Type`` and ``pkg/srv/Type`` as ``pkg/Type``, which is left as it is.

    Raises:
        InvalidValue: It is not the name of a type.
    """
    if not isinstance(kind, str) or len(kind) > 256 or not _PLAIN_NAME.fullmatch(kind):
        raise InvalidValue(f"Type: expected a name such as 'std_msgs/String', found {describe(kind)}.")
    return kind.replace("/msg/", "/").replace("/srv/", "/")


def is_known(kind: str) -> bool:
    """Whether messages or services of the type `kind` are checked field by field."""
    return normal_name(kind) in _table() or request_type(kind) in _table()


def request_type(kind: str) -> str:
    """Name of the message that a service of type `kind` is asked with."""
    return normal_name(kind) + "Request"


def response_type(kind: str) -> str:
    """Name of the message that a service of type `kind` answers with."""
    return normal_name(kind) + "Response"


def variants(kind: str) -> tuple[tuple[Field, ...], ...]:
    """The fields of the type with the normal name `kind`, in each of its spellings; empty for an unknown type."""
    return _table().get(kind, ())


def complete(kind: str, message: object) -> dict[str, Any]:
    """A message of type `kind` with every field there: a new dict, byte arrays as `bytes`. Read it, do not change it.

    Args:
        kind: Name of the type, with or without ``/msg/``.
        message: A dict in the JSON form of rosbridge: byte arrays as base64, or as `bytes`, or as a list of integers.

    Raises:
        InvalidValue: It does not fit: the text names type, field, expected and found.
    """
    name = kind if isinstance(kind, str) and kind in _table() else normal_name(kind)
    try:
        # Unknown types are not kept: a client could name any number of them.
        check = _checker(name, None) if name in _table() else any_check
        checked: dict[str, Any] = check(require_object(message), 0)
    except Misfit as misfit:
        place = f"{name}.{misfit.path.removeprefix('.')}" if misfit.path else name
        raise InvalidValue(f"{place}: expected {misfit.expected}, found {misfit.found}.") from None
    return checked


def complete_known(kind: str, message: object) -> dict[str, Any]:
    """The same, and fields that the type does not have are ignored: they may be of a newer version of it.

    Raises:
        InvalidValue: A field that the type has does not fit.
    """
    try:
        return complete(kind, message)
    except InvalidValue:  # perhaps only because of a field too many
        return complete(kind, _known_fields(kind, message))


def _known_fields(kind: str, value: Any) -> Any:
    """A message, or a list of them, without the fields that `kind` does not have."""
    if isinstance(value, (list, tuple)):
        return [_known_fields(kind, one) for one in value]
    spellings = variants(kind)
    if not spellings or not isinstance(value, Mapping):
        return value
    fields = max(spellings, key=lambda one: len({field.name for field in one} & value.keys()))
    return {field.name: _known_fields(field.type, value[field.name]) for field in fields if field.name in value}


def default(kind: str) -> dict[str, Any]:
    """A message of a known type with every field at its default. Read it, do not change it."""
    return complete(kind, {})


@cache
def _table() -> dict[str, tuple[tuple[Field, ...], ...]]:
    table = {}
    for line in filter(None, DEFINITIONS.splitlines()):
        name, body = line.split(":", 1)
        package = name.split("/")[0]
        request, arrow, response = body.partition("->")
        parts = {name + "Request": request, name + "Response": response} if arrow else {name: body}
        table.update({part: _variants(text, package) for part, text in parts.items()})
    return table


def _variants(text: str, package: str) -> tuple[tuple[Field, ...], ...]:
    return tuple(
        tuple(_field(part, package) for part in spelling.split(";") if part.strip()) for spelling in text.split("|")
    )


def _field(text: str, package: str) -> Field:
    kind, name = text.split()
    name, _, value = name.partition("=")
    kind, bracket, size = kind.partition("[")
    kind = _SHORT.get(kind, kind)
    primitive = kind in INTEGERS or kind in FLOATS or kind in ("bool", "string", "any")
    full = kind if primitive or "/" in kind else f"{package}/{kind}"
    return Field(name, full, size.removesuffix("]") if bracket else None, float(value or 0))


@cache
def _checker(kind: str, array: str | None, first: float = 0) -> Check:
    if array is None:
        return _single(kind, first)
    one = _single(kind, first)
    if array == "?":
        many = _checker(kind, "")
        return lambda value, depth: (many if isinstance(value, (list, tuple)) else one)(value, depth)
    size = int(array) if array else None
    if kind in BYTES:
        return lambda value, depth: byte_array_check(value, size)
    if kind == "string":
        return string_array_check(size)
    if kind in FLOATS or kind in INTEGERS:
        return number_array_check(kind, one, size)
    return lambda value, depth: array_check(zeros(value, size), depth, one, size)


def _single(kind: str, first: float) -> Check:
    if kind in FLOATS:
        return float_check(FLOATS[kind], float(first))
    if kind in INTEGERS:
        return integer_check(kind, *INTEGERS[kind])
    others: dict[str, Check] = {"bool": bool_check, "string": string_check, "any": any_check}
    return others.get(kind) or _message_check(kind)


def _message_check(kind: str) -> Check:
    plans = [{one.name: _checker(one.type, one.array, one.default) for one in fields} for fields in _table()[kind]]
    usual = plans[0]
    left_out = {name: one(MISSING, 0) for name, one in plans[0].items()}

    def check(value: Any, depth: int) -> dict[str, Any]:
        if value is MISSING:
            return left_out
        given = require_object(value)
        plan = usual if given.keys() <= usual.keys() else _fitting(plans, given)
        checked, name = {}, ""
        try:  # one for all fields, and no function for each: this runs for every part of every message
            for name, one in plan.items():
                checked[name] = one(given.get(name, MISSING), depth + 1)
        except Misfit as misfit:
            raise misfit.under(f".{name}") from None
        return checked

    return check


def _fitting(plans: Sequence[Mapping[str, Check]], given: Mapping[str, Any]) -> Mapping[str, Check]:
    """The first spelling that has all the fields of `given`."""
    for plan in plans:
        if given.keys() <= plan.keys():
            return plan
    raise _unknown_field(given, plans[0])


def _unknown_field(given: Mapping[str, Any], plan: Mapping[str, Check]) -> Misfit:
    extra = next(name for name in given if name not in plan)
    return Misfit(f"only the fields {', '.join(plan)}" if plan else "no fields", f"{extra}")
