"""Lines that programs print: without characters that a terminal executes, and with the time in a log."""

import logging
from collections.abc import Callable, Sequence
from typing import Any

from bam_train.files.place import with_addresses


def shown(text: str) -> str:
    r"""One line of text with ``\x1b``, ``\n`` and the like instead of the characters.

    Control characters (C0, C1), those that turn the direction of writing, line separators and halves of surrogate pairs
    are shown as in Python's string literals.
    """
    text = with_addresses(text)
    return text if text.isprintable() else "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


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


def begin_log(who: str, level: int = logging.WARNING) -> Callable[[str], None]:
    """Log to standard error from now on: local time, name of the program, message; returns what adds a line.

    Args:
        who: The program.
        level: Least level of the records of other modules.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(ShownFormatter(f"%(asctime)s {who}: %(message)s", "%Y-%m-%d %H:%M:%S"))
    logging.basicConfig(level=level, handlers=[handler])
    log = logging.getLogger(who)
    log.setLevel(logging.INFO)
    return lambda line: log.info("%s", line)
