"""A clock that ticks at absolute deadlines: lateness does not add up, and missed ticks are skipped, not caught up."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable


class Deadlines:
    """The ticks at start + k * period.

    Args:
        period: Time between two ticks [s].
        now: The clock [s]; monotonic.
    """

    def __init__(self, period: float, now: Callable[[], float] = time.monotonic) -> None:
        self.period = period
        self.missed = 0
        """Ticks that were skipped, because one before them took too long."""
        self._now, self._start, self._next = now, now(), 0

    def left(self) -> float:
        """Time to the next tick [s]; 0 if it is due."""
        return max(0.0, self._start + self._next * self.period - self._now())

    def advance(self) -> None:
        """If a tick is due it begins: the next one is the first that is at least half a period from now."""
        if self.left() > 0:
            return
        following = self._next + 1
        # Rounding must not turn a deadline that is exactly half a period away into a missed one.
        self._next = max(following, math.ceil((self._now() - self._start) / self.period + 0.5 - 1e-9))
        self.missed += self._next - following


class Clock:
    """A thread that calls `tick` every `period`, and when it is woken, until it is stopped.

    Args:
        tick: What to do. An error of its own ends the clock, and goes to `threading.excepthook` as of any thread.
        period: Time between two ticks [s].
    """

    def __init__(self, tick: Callable[[], None], period: float) -> None:
        self.period = period
        self._tick, self._wake, self._stopped = tick, threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="bam-clock", daemon=True)

    @property
    def running(self) -> bool:
        """Whether it ticks."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Tick from now on."""
        self._thread.start()

    def wake(self) -> None:
        """Tick now, out of turn."""
        self._wake.set()

    def _run(self) -> None:
        deadlines = Deadlines(self.period)
        while True:
            self._wake.wait(deadlines.left())
            self._wake.clear()
            if self._stopped:
                return
            deadlines.advance()
            self._tick()

    def stop(self) -> None:
        """No tick begins any more, and the last one has ended. As often as one likes."""
        self._stopped = True
        self._wake.set()
        if self.running and self._thread is not threading.current_thread():
            self._thread.join()
