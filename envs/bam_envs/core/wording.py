"""Words of error messages: the closest match to a misspelt name, a short value, a short list."""

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any

_LONGEST = 100
"""Characters of a value in a message; a file or the network may bring millions."""


def _short_repr() -> reprlib.Repr:
    short = reprlib.Repr()
    short.maxstring = short.maxother = 60
    return short


_SHORT = _short_repr()


def brief(value: Any) -> str:
    """`value` in one short line, as Python writes it: ``'text'``, ``[1, 2, 3, 4, 5, 6, ...]``."""
    try:
        text = " ".join(_SHORT.repr(value).split())
    except ValueError:  # Python refuses to print integers of more than 4300 digits
        return "a huge integer"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def listed(names: Iterable[object], most: int = 8) -> str:
    """``a, b, c``; the first `most` and the total of a longer list; ``none`` of an empty one."""
    texts = [str(name) for name in names]
    if len(texts) > most:
        return f"{', '.join(texts[:most])}, ... ({len(texts)} in all)"
    return ", ".join(texts) or "none"


def as_flag(field: str) -> str:
    """The flag of a command line that sets `field`: ``--num-envs`` of ``num_envs``."""
    return "--" + field.replace("_", "-")


def closest(name: object, known: Iterable[str], cutoff: float = 0.65) -> str | None:
    """The most similar of the `known` names, ignoring case, or one with these initials; None if none is similar.

    Args:
        name: The misspelt name.
        known: The names to choose from.
        cutoff: Least similarity of a match, from 0 to 1.
    """
    names = sorted(known)
    initials = {"".join(part[:1] for part in one.split("_")): one for one in names if "_" in one}
    lower = str(name).lower()
    same = [one for one in names if one.lower() == lower] or [initials[one] for one in initials if one == lower]
    matches = same or difflib.get_close_matches(str(name), names, n=1, cutoff=cutoff)
    return matches[0] if matches else None


def did_you_mean(
    name: object, known: Iterable[str], cutoff: float = 0.65, examples: Iterable[str] | None = None
) -> str:
    """The sentence that follows an unknown name: ``Did you mean 'pick'?``, or the names to choose from.

    Args:
        name: The misspelt name.
        known: The names to choose from.
        cutoff: Least similarity of a match, from 0 to 1.
        examples: Names to list if none is similar; by default all of `known`.
    """
    names = sorted(known)
    match = closest(name, names, cutoff)
    if match is not None:
        return f"Did you mean {match!r}?"
    choices = names if examples is None else list(examples)
    return f"Choose from: {', '.join(choices)}." if choices else "There are none."
