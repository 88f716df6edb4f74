"""Ctrl-C, SIGTERM and SIGHUP while training: the first ends it in order, the second at once."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import time
from typing import TYPE_CHECKING, Any

from bam_train.cli.program import TOGETHER
from bam_train.trainers.at_quit import before_quitting

if TYPE_CHECKING:
    from bam_train.trainers.run import TrainingRun

SHOW_CURSOR = b"\x1b[?25h"
"""Undoes what a live panel did to the terminal."""


class StopSignals:
    """While entered, the first signal asks `run` to stop after its update, the second ends the process there and then.

    Signals that are ignored already stay so, as ``nohup`` and background jobs want it. Once one came, the next ends the
    process even after leaving: what is left to do then is not worth waiting for.

    Args:
        run: What is to stop; its newest checkpoint is named when it is quit.

    Attributes:
        status: Exit status of the program: 0, or 128 + the first signal.
    """

    SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

    def __init__(self, run: TrainingRun) -> None:
        self.run = run
        self.status = 0
        self._before: dict[int, Any] = {}
        self._first = -math.inf

    def __enter__(self) -> StopSignals:
        for number in self.SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        if not self.status:
            self.restore()

    def restore(self) -> None:
        """Handle signals as before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: object) -> None:
        if self._is_the_first_again(number):
            return
        if self.status:
            self._quit(number)
        self.status, self._first = 128 + number, time.monotonic()
        doing = "all is saved; ending" if self.run.done else "finishing the update and saving"
        self.run.stop()
        again = "Ctrl-C again" if number == signal.SIGINT else "another signal"
        _write(f"{doing}; {again} quits at once\n")

    def _is_the_first_again(self, number: int) -> bool:
        soon = time.monotonic() < self._first + TOGETHER
        return soon and number != signal.SIGINT and self.status == 128 + number

    def _quit(self, number: int) -> None:
        """End the process here, wherever it is: an exception might be caught, or wait for threads."""
        last = self.run.last
        kept = f"the last checkpoint on the disk is {last}" if last else "no checkpoint had been saved yet"
        _write(f"bam-train: quit at once; {kept}\n")
        self.run.folder.remove_unfinished()
        before_quitting()
        os._exit(128 + number)


def _write(line: str) -> None:
    """To standard error, not by print: the signal may have come in the middle of one."""
    with contextlib.suppress(OSError):  # nobody reads it any more
        os.write(2, (SHOW_CURSOR if sys.stderr.isatty() else b"") + line.encode())
