"""Where the programs print: lines on standard output and error, a rich console on a terminal; and numbers to read.

What is printed may come from a file or from the network. So every text passes `shown`, here and nowhere else.
"""

from __future__ import annotations

import logging
import sys
import traceback
from types import TracebackType
from typing import TYPE_CHECKING, Any

from bam_train.terminal_text import shown

if TYPE_CHECKING:
    from rich.console import Console


def is_terminal() -> bool:
    """Whether somebody watches standard error on a terminal."""
    return sys.stderr.isatty()


def make_console() -> Console:
    """A rich console on standard error; standard output is kept for results that programs read."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, markup=False, emoji=False)


def say(text: str = "") -> None:
    """Print one plain line on standard error."""
    print(shown(text), file=sys.stderr, flush=True)


def tell(*lines: str) -> None:
    """Print the results of a program on standard output, line by line."""
    print("\n".join(map(shown, lines)), flush=True)


class ShownFormatter(logging.Formatter):
    """Shows what is logged as everything else."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        """One line."""
        return shown(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        """The lines of a traceback."""
        return "\n".join(map(shown, super().formatException(ei).split("\n")))


def show_logs_and_tracebacks() -> None:
    """Show what Python itself prints of a program: logs that nobody handles, and the traceback of a mistake of ours."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(ShownFormatter())
    sys.excepthook = _say_traceback


def _say_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    for line in "".join(traceback.format_exception(kind, error, trace)).rstrip("\n").split("\n"):
        say(line)


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
