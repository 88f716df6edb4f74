"""Values that people type: parsed from text, fitted to a type annotation, described in errors.

Everything here stays within JSON (None, bool, int, float, str, list, dict): settings can be written and read back.
"""

from __future__ import annotations

import difflib
import json
import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from bam_train.errors import SettingsError

_WORDS = {"true": True, "True": True, "false": False, "False": False, "null": None, "None": None, "none": None}
_SCHEDULE = re.compile(r"lin_(?P<start>\d.*)")


def parse_value(text: str) -> Any:
    """Read one typed value: JSON, Python's True/False/None, else the text itself.

    ``64`` is an int, ``3e-4`` a float, ``[64,64]`` a list, ``true`` a bool, ``lin_3e-4`` text.
    """
    if text in _WORDS:
        return _WORDS[text]
    try:
        return json.loads(text)
    except ValueError:
        return text


def parse_assignment(text: str, example: str = "learning_rate=3e-4") -> tuple[list[str], Any]:
    """Split ``name.of.it=value`` into the parts of its name and its typed value.

    Args:
        text: What was typed after ``--set``.
        example: What may be typed there, for the error.

    Raises:
        SettingsError: There is no ``=``, or no name before it.
    """
    name, equals, value = text.partition("=")
    path = name.strip().split(".")
    if not equals or not all(path):
        raise SettingsError(f"--set {text}: expected name=value, such as --set {example}, found {text!r}")
    return path, parse_value(value.strip())


def linear_start(text: str) -> float | None:
    """The first value of a linear schedule such as ``lin_3e-4``, which ends at 0; None if `text` is not one."""
    match = _SCHEDULE.fullmatch(text)
    try:
        return float(match["start"]) if match else None
    except ValueError:
        return None


def describe(value: Any) -> str:
    """A value and its type, as errors show it."""
    kinds = {bool: "a bool", int: "an int", float: "a float", str: "text", list: "a list", dict: "a table"}
    kind = kinds.get(type(value))
    return f"{value!r} ({kind})" if kind else repr(value)


def closest(name: str, choices: Iterable[str]) -> str:
    """A hint that follows an unknown name: the most similar choice, or all of them."""
    ordered = sorted(choices)
    same = [choice for choice in ordered if choice.lower() == name.lower()]
    matches = same or difflib.get_close_matches(name, ordered, n=1, cutoff=0.65)
    return f"Did you mean {matches[0]!r}?" if matches else f"Choose from: {', '.join(ordered)}."


def fit(name: str, value: Any, hint: Any) -> Any:
    """Return `value` as `hint` wants it.

    A whole float becomes an int where an int is wanted (``1e6``); everything else must already fit.

    Args:
        name: What the value is for, as errors name it.
        value: A JSON value.
        hint: A type annotation; a ``Callable`` stands for a schedule and takes ``"lin_3e-4"``.

    Raises:
        SettingsError: It does not fit; names the thing, the expected and the found.
    """
    for convert in (_exact, _whole):
        fitted = convert(value, hint)
        if fitted is not _NO:
            return fitted
    raise SettingsError(f"{name}: expected {expected(hint)}, found {describe(value)}")


_NO = object()


def _exact(value: Any, hint: Any) -> Any:
    return value if fits(value, hint) else _NO


def _whole(value: Any, hint: Any) -> Any:
    """`value` as an int where the hint takes one and nothing else fits."""
    if isinstance(value, float) and value.is_integer() and fits(int(value), hint):
        return int(value)
    return _NO


def fits(value: Any, hint: Any) -> bool:
    """Whether a JSON value is an instance of a type annotation."""
    if hint is Any:
        return True
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, argument) for argument in arguments)
    check = _CHECKS.get(origin or hint)
    return check is not None and check(value, arguments)


def _fits_list(value: Any, arguments: tuple[Any, ...]) -> bool:
    return isinstance(value, list) and (not arguments or all(fits(item, arguments[0]) for item in value))


def _fits_tuple(value: Any, arguments: tuple[Any, ...]) -> bool:
    """A tuple is written as a list of the same length."""
    return isinstance(value, list) and len(value) == len(arguments) and all(map(fits, value, arguments))


def _fits_dict(value: Any, arguments: tuple[Any, ...]) -> bool:
    return isinstance(value, Mapping) and (not arguments or all(fits(item, arguments[1]) for item in value.values()))


def _is_int(value: Any, _: tuple[Any, ...] = ()) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


_CHECKS: dict[Any, Callable[[Any, tuple[Any, ...]], bool]] = {
    type(None): lambda value, _: value is None,
    bool: lambda value, _: isinstance(value, bool),
    int: _is_int,
    float: lambda value, _: isinstance(value, float) or _is_int(value),
    str: lambda value, _: isinstance(value, str),
    list: _fits_list,
    tuple: _fits_tuple,
    dict: _fits_dict,
    Mapping: _fits_dict,
    Callable: lambda value, _: isinstance(value, str) and linear_start(value) is not None,
}

_NAMES = {type(None): "none", bool: "true or false", int: "an int", float: "a number", str: "text"}


def expected(hint: Any) -> str:
    """A type annotation in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(expected(argument) for argument in arguments)
    if origin is list:
        return f"a list of {expected(arguments[0]).removeprefix('an ').removeprefix('a ')}s"
    if origin is tuple:
        return f"a list [{', '.join(expected(argument) for argument in arguments)}]"
    if Callable in (hint, origin):
        return 'a schedule such as "lin_3e-4"'
    if origin is dict or hint is dict:
        return "a table"
    return _NAMES.get(hint, getattr(hint, "__name__", str(hint)))
