"""Ctrl-C and SIGTERM while training: the first ends it in order, the second at once."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bam_train.trainers.run import TrainingRun


class StopSignals:
    """While entered, the first signal asks `run` to stop after its update, the second raises `KeyboardInterrupt`.

    Args:
        run: What is to stop; its newest checkpoint is named when it is quit.

    Attributes:
        status: Exit status of the program: 0, or 128 + the first signal.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, run: TrainingRun) -> None:
        self.run = run
        self.status = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        self._before = {number: signal.signal(number, self._handle) for number in self.SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: object) -> None:
        if self.status:
            last = self.run.last
            kept = f"the last checkpoint on the disk is {last}" if last else "no checkpoint had been saved yet"
            raise KeyboardInterrupt(f"quit at once; {kept}")
        self.status = 128 + number
        self.run.stop()
        # Not print: the signal may have come in the middle of one.
        os.write(2, b"finishing the update and saving; Ctrl-C again quits at once\n")
