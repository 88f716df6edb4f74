"""The output of the programs, on standard output, standard error or a rich console.

Text may come from a file or from the network, so all of it passes `shown`, which makes control characters harmless.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TextIO

from bam_train.files.log_lines import ShownFormatter, counted, shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

_BETWEEN = 5.0
"""Time between two lines about a long work [s]."""


def say(text: str = "") -> None:
    """Print one plain line on standard error."""
    print(shown(text), file=sys.stderr, flush=True)


def say_in_handler(text: str) -> None:
    """Write a line to standard error in a signal handler, which may have interrupted the printing of another line."""
    show_cursor = "\x1b[?25h" if can_draw() else ""  # a live panel has hidden it
    with contextlib.suppress(OSError):  # the reader has closed it
        os.write(2, f"{show_cursor}{shown(text)}\n".encode())


def tell(*lines: str) -> None:
    """Print the results of a program on standard output, line by line."""
    print("\n".join(map(shown, lines)), flush=True)


def can_ask() -> bool:
    """Whether standard input is a terminal, at which somebody may answer; it is None where it is closed."""
    return sys.stdin is not None and sys.stdin.isatty()


def ask(question: str, write: Callable[[str], None]) -> str:
    """Write `question` to the terminal that is standard input; returns the line typed from then on, in lower case.

    What was typed ahead of the question, in lines or in part of one, is thrown away: it answers something else. The
    answer is empty at the end of input, and if the terminal is gone.
    """
    try:
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    except ImportError:  # Windows
        pass
    except termios.error:  # the terminal is gone
        return ""
    write(question)
    with open(sys.stdin.fileno(), errors="replace", closefd=False) as typed:  # without what sys.stdin has read ahead
        return typed.readline().strip().lower()


def drop(stream: TextIO) -> None:
    """Discard the content of the stream's buffer, and all later writes to the stream."""
    with contextlib.suppress(OSError):  # a stream without a file
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def can_draw() -> bool:
    """Whether standard error is a terminal that moves its cursor."""
    return sys.stderr.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")


def make_console() -> Console:
    """A rich console on standard error; standard output is kept for results that programs read."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, markup=False, emoji=False)


def rich_text(text: str, style: str = "", **arguments: Any) -> Text:
    """Text for a rich console, without markup."""
    from rich.text import Text

    return Text(shown(text), style, **arguments)


def show_logs_and_tracebacks() -> None:
    """Pass the output of Python itself through `shown`: unhandled logs, and tracebacks."""

    def say_traceback(*error: Any) -> None:
        for line in "".join(traceback.format_exception(*error)).rstrip("\n").split("\n"):
            say(line)

    if logging.lastResort is not None:
        logging.lastResort.setFormatter(ShownFormatter())
    sys.excepthook = say_traceback


def progress(prog: str, what: str, total: int | None = None) -> Callable[[int], None]:
    """What says how many pieces of a long work are done, every 5 s: ``bam-data: 12 of 40 episodes``.

    Args:
        prog: The program.
        what: One of the pieces.
        total: Their number, if it is known.
    """
    last = time.monotonic()

    def say_done(done: int) -> None:
        nonlocal last
        if done != total and time.monotonic() - last > _BETWEEN:
            last = time.monotonic()
            say(f"{prog}: {counted(done, what) if total is None else f'{done} of {counted(total, what)}'}")

    return say_done


# Numbers for people


def count(number: float) -> str:
    """Format a count: 950, 12.3k, 1.25M."""
    if number < 10_000:
        return f"{number:.0f}"
    return f"{number / 1e3:.4g}k" if number < 1e6 else f"{number / 1e6:.4g}M"


def duration(seconds: float | None) -> str:
    """Format a duration [s]: 4.2 s, 3 min 05 s, 2 h 04 min; a dash if it is not known."""
    if seconds is None or seconds != seconds or seconds == float("inf"):
        return "-"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def percent(share: float | None) -> str:
    """Format a share: 98.5 %; a dash if it is not known."""
    return "-" if share is None else f"{100 * share:.1f} %".replace(".0 %", " %")


def number(value: float | None) -> str:
    """Format a measured value with four digits; a dash if it is not known."""
    return "-" if value is None else f"{value:.4g}"
