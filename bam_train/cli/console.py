"""What the programs print, on standard output, standard error or a rich console.

What is printed may come from a file or from the network: every text passes `shown`, so that nothing in it acts on a
terminal.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import traceback
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text


def shown(text: str) -> str:
    r"""One line of text with ``\x1b``, ``\n`` and the like instead of the characters.

    Control characters (C0, C1), those that turn the direction of writing, line separators and halves of surrogate pairs
    are shown as in Python's string literals.
    """
    return text if text.isprintable() else "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


def say(text: str = "") -> None:
    """Print one plain line on standard error."""
    print(shown(text), file=sys.stderr, flush=True)


def tell(*lines: str) -> None:
    """Print the results of a program on standard output, line by line."""
    print("\n".join(map(shown, lines)), flush=True)


def drop(stream: TextIO) -> None:
    """From now on what is written to the stream is dropped, and what its buffer still holds."""
    with contextlib.suppress(OSError):  # a stream that is no file
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def make_console() -> Console:
    """A rich console on standard error; standard output is kept for results that programs read."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, markup=False, emoji=False)


def rich_text(text: str, style: str = "", **arguments: Any) -> Text:
    """Text for a rich console, without markup."""
    from rich.text import Text

    return Text(shown(text), style, **arguments)


class ShownFormatter(logging.Formatter):
    """Formats what is logged."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: D102, N802 - logging's name
        return shown(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: D102, N802
        return "\n".join(map(shown, super().formatException(ei).split("\n")))


def show_logs_and_tracebacks() -> None:
    """Pass what Python itself prints through `shown`: unhandled logs, and the traceback of an error in our code."""

    def say_traceback(*error: Any) -> None:
        for line in "".join(traceback.format_exception(*error)).rstrip("\n").split("\n"):
            say(line)

    if logging.lastResort is not None:
        logging.lastResort.setFormatter(ShownFormatter())
    sys.excepthook = say_traceback


# Numbers to read


def count(number: float) -> str:
    """A count in short: 950, 12.3k, 1.25M."""
    if number < 10_000:
        return f"{number:.0f}"
    return f"{number / 1e3:.4g}k" if number < 1e6 else f"{number / 1e6:.4g}M"


def duration(seconds: float | None) -> str:
    """A duration in short: 4.2 s, 3 min 05 s, 2 h 04 min; a dash if it is not known."""
    if seconds is None or seconds != seconds or seconds == float("inf"):
        return "-"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def percent(share: float | None) -> str:
    """A share: 98.5 %; a dash if it is not known."""
    return "-" if share is None else f"{100 * share:.1f} %".replace(".0 %", " %")


def number(value: float | None) -> str:
    """A measured value to four digits; a dash if it is not known."""
    return "-" if value is None else f"{value:.4g}"
