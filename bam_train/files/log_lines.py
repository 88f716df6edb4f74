"""Lines that programs print: without characters that a terminal executes, and with the time in a log."""

import logging
import os
import queue
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from bam_train.files.place import with_addresses

_STDERR = 2
_MOST_LINES, _LAST_LINES = 1000, 1.0
"""Lines that wait for a terminal that is stopped, the oldest; and how long the last ones wait at the end [s]."""


def shown(text: str) -> str:
    r"""One line of text with ``\x1b``, ``\n`` and the like instead of the characters.

    Control characters (C0, C1), those that turn the direction of writing, line separators and halves of surrogate pairs
    are shown as in Python's string literals.
    """
    text = with_addresses(text)
    return text if text.isprintable() else "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


def counted(number: int, what: str) -> str:
    """``1 episode`` or ``2 episodes``: a number of things, `what` being one of them."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Each row as one line, in aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


class ShownFormatter(logging.Formatter):
    """Formats log records with `shown`."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: D102, N802 - logging's name
        return shown(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: D102, N802
        return "\n".join(map(shown, super().formatException(ei).split("\n")))


class _BesideHandler(logging.Handler):
    """Another thread writes the lines: nobody else waits for a terminal that is stopped, or for a full pipe."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._left_out = 0
        self._thread = threading.Thread(target=self._write, name="bam-log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        if self._lines.qsize() >= _MOST_LINES:
            self._left_out += 1
            return
        more, self._left_out = self._left_out, 0
        self._lines.put(f"{self.format(record)}{f' ({more} lines before it were left out)' if more else ''}\n")

    def close(self) -> None:
        self._lines.put(None)
        self._thread.join(_LAST_LINES)
        super().close()

    def _write(self) -> None:
        while (line := self._lines.get()) is not None:
            data = line.encode(errors="backslashreplace")
            with suppress(OSError):  # nobody reads it any more
                while data:
                    data = data[os.write(_STDERR, data) :]


def begin_log(who: str, level: int = logging.WARNING) -> Callable[[str], None]:
    """Log to standard error from now on: local time, name of the program, message; returns what adds a line.

    No thread waits for whoever reads it; see `_BesideHandler`.

    Args:
        who: The program.
        level: Least level of the records of other modules.
    """
    handler = _BesideHandler()
    handler.setFormatter(ShownFormatter(f"%(asctime)s {who}: %(message)s", "%Y-%m-%d %H:%M:%S"))
    logging.basicConfig(level=level, handlers=[handler])
    log = logging.getLogger(who)
    log.setLevel(logging.INFO)
    return lambda line: log.info("%s", line)
