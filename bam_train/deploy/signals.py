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
    """What a signal does: `Stopped` while armed; else the first waits and the second raises KeyboardInterrupt.

    It waits, because the robot may be being halted then; raised the next time, for a halt that hangs.
    """

    def __init__(self) -> None:
        self.armed = False
        """Whether a signal may interrupt what runs now."""
        self.waiting: list[int] = []
        """Signals that came while not armed."""
        self._raised: int | None = None

    def arm(self) -> None:
        """From now on a signal interrupts.

        Raises:
            Stopped: One came before.
        """
        self.armed = True
        if self.waiting:
            self.armed, number = False, self.waiting[0]
            self.waiting.clear()
            raise Stopped(number)

    def raise_again(self) -> None:
        """To be called in every tick: Python discards an exception in a callback of its own, such as a ``__del__``.

        Raises:
            Stopped: One was raised, and nobody caught it.
        """
        if self._raised is not None:
            raise Stopped(self._raised)

    def __call__(self, number: int, _: FrameType | None) -> None:
        """Handle a signal, in the main thread, between two of its instructions."""
        if self.armed:
            self.armed, self._raised = False, number
            raise Stopped(number)
        self.waiting.append(number)
        if len(self.waiting) > 1:
            raise KeyboardInterrupt


@contextmanager
def stop_signals() -> Iterator[StopSwitch]:
    """Within this, SIGINT and SIGTERM go to the switch (not armed yet); afterwards to whom they went before.

    What waits in a switch around it waits in this one too.
    """
    switch = StopSwitch()
    before = [(number, signal.signal(number, switch)) for number in _SIGNALS]
    switch.waiting += [n for _, around in before[:1] if isinstance(around, StopSwitch) for n in around.waiting]
    try:
        yield switch
    finally:
        for number, handler in before:
            signal.signal(number, handler)
