"""Ctrl-C and SIGTERM while a robot moves: the first stops the loop at once, the second may not interrupt the halt."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(BaseException):
    """A signal asked for the end.

    Attributes:
        signal: Its number.
    """

    def __init__(self, number: int) -> None:
        self.signal = number
        super().__init__(f"stopped by {signal.Signals(number).name}")


class StopSwitch:
    """What a signal does: `Stopped` while armed; else the first is ignored and the second raises KeyboardInterrupt.

    Ignored, because the robot is being halted then; raised the next time, for a halt that hangs.
    """

    def __init__(self) -> None:
        self.armed = False
        """Whether a signal may interrupt what runs now."""
        self._ignored = 0

    def __call__(self, number: int, _: FrameType | None) -> None:
        """Handle a signal, in the main thread, between two of its instructions."""
        if self.armed:
            self.armed = False
            raise Stopped(number)
        self._ignored += 1
        if self._ignored > 1:
            raise KeyboardInterrupt


@contextmanager
def stop_signals() -> Iterator[StopSwitch]:
    """Within this, SIGINT and SIGTERM go to the switch (not armed yet); afterwards to whom they went before."""
    switch = StopSwitch()
    before = [(number, signal.signal(number, switch)) for number in _SIGNALS]
    try:
        yield switch
    finally:
        for number, handler in before:
            signal.signal(number, handler)
