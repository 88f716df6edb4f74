"""Tables of a TOML or YAML file as frozen dataclasses: every key known, every value of its type, errors with names."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, fields
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from bam_envs.core.errors import InvalidValue

T = TypeVar("T")
_MISFIT = object()


def read_table(kind: type[T], data: object, where: str) -> T:
    """A `kind` with the values of `data`; `where` names file and table in errors.

    Raises:
        InvalidValue: A key is unknown or missing, or a value has another type.
    """
    table = require_table(data, where)
    hints = get_type_hints(kind)
    known = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
    require_known(table, known, where)
    for name, field in known.items():
        if name not in table and field.default is MISSING and field.default_factory is MISSING:
            raise InvalidValue(f"{where}: the key {name!r} is missing.")
    return kind(**{name: _value(hints[name], value, f"{where}: {name}") for name, value in table.items()})


def require_table(data: object, where: str) -> Mapping[str, Any]:
    """`data`, which must be a table with text as keys."""
    if not isinstance(data, Mapping) or not all(isinstance(key, str) for key in data):
        raise InvalidValue(f"{where} must be a table of named values, not {data!r}.")
    return data


def require_tables(data: object, where: str) -> list[Any]:
    """`data`, which must be a list of tables; `read_table` looks at each."""
    if not isinstance(data, list):
        raise InvalidValue(f"{where} must be a list of tables, not {data!r}.")
    return data


def require_known(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    """Every key of `table` is one of `known`."""
    known = list(known)
    for key in table:
        if key not in known:
            close = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
            hint = f"Did you mean {close[0]!r}?" if close else f"Choose from: {', '.join(known)}."
            raise InvalidValue(f"{where}: unknown key {key!r}. {hint}")


def _value(hint: Any, value: Any, where: str) -> Any:
    """`value` as what `hint` says."""
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise InvalidValue(f"{where} must be one of {', '.join(get_args(hint))}, not {value!r}.")
        return value
    expected, read = _READERS[str(hint)]
    found = read(value)
    if found is _MISFIT:
        raise InvalidValue(f"{where} must be {expected}, not {value!r}.")
    return found


def _text(value: Any) -> Any:
    return value if isinstance(value, str) and value else _MISFIT


def _any_text(value: Any) -> Any:
    return value if isinstance(value, str) else _MISFIT


def _switch(value: Any) -> Any:
    return value if isinstance(value, bool) else _MISFIT


def _number(value: Any) -> Any:
    plain = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if plain else _MISFIT


def _plain(value: Any) -> Any:
    return value if isinstance(value, (bool, str)) else _number(value)


def _count(value: Any) -> Any:
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else _MISFIT


def _several(read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Reads a list of what `read` reads, or one of it."""

    def read_all(value: Any) -> Any:
        values = tuple(map(read, value if isinstance(value, list) else [value]))
        return _MISFIT if _MISFIT in values else values

    return read_all


def _pair(value: Any) -> Any:
    values = _several(_count)(value)
    return values if values is not _MISFIT and len(values) == 2 else _MISFIT


def _range(value: Any) -> Any:
    values = _several(_number)(value)
    return values if values is not _MISFIT and len(values) == 2 and values[0] <= values[1] else _MISFIT


def _named(read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Reads a table of what `read` reads."""

    def read_all(value: Any) -> Any:
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            return _MISFIT
        values = {key: read(one) for key, one in value.items()}
        return _MISFIT if _MISFIT in values.values() else values

    return read_all


_READERS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    str(str): ("text", _text),
    str(bool): ("true or false", _switch),
    str(float): ("a finite number", _number),
    str(float | None): ("a finite number", _number),
    str(tuple[str, ...]): ("a list of texts", _several(_text)),
    str(tuple[float, ...]): ("a list of finite numbers", _several(_number)),
    str(tuple[float | bool | str, ...]): ("a list of numbers, texts, true and false", _several(_plain)),
    str(tuple[int, int]): ("two counts", _pair),
    str(tuple[float, float] | None): ("two finite numbers, the least first", _range),
    str(Mapping[str, float]): ("a table of finite numbers", _named(_number)),
    str(Mapping[str, str]): ("a table of texts", _named(_any_text)),
}
