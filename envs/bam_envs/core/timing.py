"""Time: deadlines on the monotonic clock, the pacer of every loop that runs at a fixed rate, and a ticking thread."""

import math
import threading
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

KEPT = 65536
"""Ticks whose lateness is kept, to limit the memory: 55 minutes at 20 Hz."""


class Deadline:
    """A time limit.

    Args:
        timeout: Time until it passes [s].
        now: The clock [s]; monotonic.
    """

    def __init__(self, timeout: float, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._at = now, now() + timeout

    @property
    def left(self) -> float:
        """Time left [s]; 0 once it has passed."""
        return max(0.0, self._at - self._now())

    @property
    def passed(self) -> bool:
        """Whether no time is left."""
        return self._now() >= self._at


@dataclass(frozen=True)
class Lateness:
    """Delays of the ticks after their deadlines [s]."""

    p50: float
    p99: float
    max: float


class Pacer:
    """Deadlines one period apart, so that lateness does not add up, with statistics of the lateness.

    A late tick starts at once, and later deadlines do not move. A tick that is late by more than half a period begins
    a new grid: the deadlines that passed are counted as missed and are not caught up. Two deadlines are therefore never
    less than half a period apart.

    Args:
        period: Time between two ticks [s]; None runs as fast as possible, without deadlines.
        now: The clock [s]; monotonic.
        sleep: Waits for a time [s]; if it returns True, the tick starts now.
    """

    def __init__(
        self,
        period: float | None,
        *,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], bool | None] = time.sleep,
    ) -> None:
        self.period, self._now, self._sleep = period, now, sleep
        self.ticks = 0
        """Ticks started, over all episodes."""
        self.missed = 0
        """Deadlines that passed without a tick."""
        self._late = array("d")  # of the last KEPT ticks, in no order
        self._latest = 0.0
        self._seconds, self._intervals = 0.0, 0  # between the ticks of an episode
        self._previous: float | None = None
        self._due: float | None = None  # None: the first tick is due when it starts

    def start(self) -> None:
        """Begin an episode: its first tick is due now."""
        self._due, self._previous = self._now(), None

    def hasten(self) -> None:
        """Let the next tick be due half a period after the last one, if it would be due later."""
        if self._due is not None and self._previous is not None and self.period is not None:
            self._due = min(self._due, self._previous + self.period / 2)

    def wait(self) -> float:
        """Wait until the next tick is due and start it; returns its lateness [s], 0 without a period."""
        while self.period is not None and (slack := self.slack) > 0:
            if self._sleep(slack):
                break
        return self.tick()

    def tick(self) -> float:
        """Start the next tick now, and set the deadline after it; returns its lateness [s], 0 without a period."""
        now = self._now()
        if self._previous is not None:
            self._seconds += now - self._previous
            self._intervals += 1
        self._previous = now
        self.ticks += 1
        if self.period is None:
            return 0.0
        due = now if self._due is None else self._due
        late = max(0.0, now - due)
        # Rounding must not make a tick that is late by exactly half a period begin a new grid.
        missed = math.ceil(late / self.period - 0.5 - 1e-9)
        self.missed += missed
        self._due = (now if missed or due - now > self.period / 2 else due) + self.period
        self._latest = max(self._latest, late)
        if len(self._late) < KEPT:
            self._late.append(late)
        else:
            self._late[self.ticks % KEPT] = late
        return late

    @property
    def slack(self) -> float:
        """Time left to the next deadline [s]; negative once it has passed, infinite without a period."""
        if self.period is None:
            return math.inf
        return 0.0 if self._due is None else self._due - self._now()

    @property
    def rate(self) -> float | None:
        """Ticks per second within episodes [Hz]; None before the second tick."""
        return self._intervals / self._seconds if self._seconds > 0 else None

    @property
    def lateness(self) -> Lateness | None:
        """Percentiles over the last `KEPT` ticks, the maximum over all; None without a period or before a tick."""
        if not self._late:
            return None
        p50, p99 = np.percentile(np.frombuffer(self._late), [50, 99])
        return Lateness(float(p50), float(p99), self._latest)


class Ticker:
    """A thread that calls `tick` every `period`, and whenever it is woken, until it is stopped.

    Args:
        tick: The function to call. An exception in it ends the thread, and goes to `threading.excepthook`.
        period: Time between two calls [s].
    """

    def __init__(self, tick: Callable[[], None], period: float) -> None:
        self.period = period
        self._tick, self._wake, self._stopped = tick, threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="bam-ticker", daemon=True)

    @property
    def running(self) -> bool:
        """Whether the thread is alive."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread; the first call is immediate."""
        self._thread.start()

    def wake(self) -> None:
        """Call `tick` now, before its next time."""
        self._wake.set()

    def _run(self) -> None:
        pacer = Pacer(self.period)
        pacer.start()
        while True:
            self._wake.wait(max(0.0, pacer.slack))
            self._wake.clear()
            if self._stopped:
                return
            if pacer.slack <= 0:  # else it was woken
                pacer.tick()
            self._tick()

    def stop(self) -> None:
        """End the thread; waits for a running call. Idempotent."""
        self._stopped = True
        self._wake.set()
        if self.running and self._thread is not threading.current_thread():
            self._thread.join()
