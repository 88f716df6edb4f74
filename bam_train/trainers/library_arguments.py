"""Hyperparameters as JSON values, checked against the annotations of a learning library's functions.

All values are JSON, so that settings can be written and read. A schedule is ``"lin_3e-4"``, linear to 0.
"""

import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Annotated, Any

import msgspec

from bam_envs.core.validation import expected
from bam_envs.core.wording import brief, did_you_mean
from bam_train.errors import SettingsError

Schedule = Annotated[
    str, msgspec.Meta(pattern=r"^lin_\d+\.?\d*([eE][-+]?\d+)?$", description='a schedule such as "lin_3e-4"')
]
"""The text of a linear schedule; the library's annotation is a ``Callable``."""

_UNIONS = (typing.Union, types.UnionType)


def linear_start(text: str) -> float | None:
    """The first value of a linear schedule such as ``lin_3e-4``; None if `text` is not one."""
    return float(text.removeprefix("lin_")) if fits(text, Schedule) else None


def fit(name: str, value: Any, hint: Any) -> Any:
    """Return the JSON `value` if it fits the library's annotation; a whole float (``1e6``) becomes an int if needed."""
    if fits(value, hint):
        return value
    if isinstance(value, float) and value.is_integer() and fits(int(value), hint):
        return int(value)
    raise SettingsError(f"{name}: expected {expected(as_written(hint))}, found {brief(value)}")


def fits(value: Any, hint: Any) -> bool:
    """Whether a JSON value fits a library's annotation."""
    if typing.get_origin(hint) in _UNIONS:  # msgspec refuses unions of several kinds of lists
        return any(fits(value, kind) for kind in typing.get_args(hint))
    try:
        msgspec.convert(value, as_written(hint))
    except (msgspec.ValidationError, TypeError):  # TypeError: a class that is not written as JSON
        return False
    return True


def as_written(hint: Any) -> Any:
    """The annotation of a value in settings, where a schedule and a class are text."""
    origin = typing.get_origin(hint)
    if origin in _UNIONS:
        return typing.Union[tuple(map(as_written, typing.get_args(hint)))]  # noqa: UP007 - built at run time
    if Callable in (hint, origin):
        return Schedule
    return str if origin is type else hint


def require_known(
    given: Iterable[str],
    known: Collection[str],
    what: str,
    elsewhere: Mapping[str, str],
    others: Iterable[str] = (),
) -> None:
    """Refuse names that are not known, with the closest match among `known` and `others`.

    `elsewhere` has the library's names that are not used here, with the reason; `what` is the kind of name.
    """
    for name in given:
        if name in known:
            continue
        if name not in elsewhere:
            raise SettingsError(
                f"Unknown {what} {name!r}. {did_you_mean(name, [*known, *others], examples=sorted(known))}"
            )
        raise SettingsError(f"{name} is not a hyperparameter here: {elsewhere[name]}")
