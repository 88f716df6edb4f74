"""Absolute deadlines on the monotonic clock.

Tick k of an episode is due at t0 + k * period, so that lateness does not add up. A tick that is late starts at
once, and no burst makes up for it: deadlines that lie before half a period after its start are missed, counted, and
never run. Two ticks are therefore always at least half a period apart, and a tick that is in time is on the grid
again.
"""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

KEPT = 65536
"""Ticks whose lateness is kept, so that memory stays flat: 55 minutes at 20 Hz."""


@dataclass(frozen=True)
class Lateness:
    """How long after their deadlines the ticks started [s]."""

    p50: float
    p99: float
    max: float


class Pacer:
    """Waits for deadlines and keeps account of how they were kept.

    Args:
        period: Time between two ticks [s]; None runs as fast as it goes, with nothing to be late for.
        now: The clock [s]; monotonic.
        sleep: Waits for so many seconds.
    """

    def __init__(
        self,
        period: float | None,
        *,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.period, self._now, self._sleep = period, now, sleep
        self.ticks = 0
        """Ticks started, over all episodes."""
        self.missed = 0
        """Deadlines that were never run."""
        self._late = array("d")  # of the last KEPT ticks, in no order
        self._latest = 0.0
        self._seconds = 0.0  # between the first and the last tick of each episode
        self._start = self._previous = 0.0
        self._next = 0
        self._intervals = 0

    def start(self) -> None:
        """Begin an episode: its first tick is due now."""
        self._start = self._previous = self._now()
        self._next = 0

    def wait(self) -> float:
        """Return when the next tick is due; how late it is [s], 0 when running free."""
        late = 0.0 if self.period is None else self._wait_for(self._start + self._next * self.period)
        now = self._now()
        if self._next > 0:
            self._seconds += now - self._previous
            self._intervals += 1
        self._previous = now
        self._plan_next(now)
        self.ticks += 1
        return late

    def _wait_for(self, deadline: float) -> float:
        while (left := deadline - self._now()) > 0:
            self._sleep(left)
        late = max(0.0, -left)  # not -0.0, which would be printed
        self._latest = max(self._latest, late)
        if len(self._late) < KEPT:
            self._late.append(late)
        else:
            self._late[self.ticks % KEPT] = late
        return late

    def _plan_next(self, now: float) -> None:
        following = self._next + 1
        if self.period is None:
            self._next = following
            return
        # Rounding in the division must not turn a tick that is exactly half a period late into a missed one.
        earliest = math.ceil((now - self._start) / self.period + 0.5 - 1e-9)
        self._next = max(following, earliest)
        self.missed += self._next - following

    @property
    def slack(self) -> float:
        """Time left to the next deadline [s]; infinite when running free."""
        if self.period is None:
            return math.inf
        return self._start + self._next * self.period - self._now()

    @property
    def rate(self) -> float | None:
        """Ticks per second within episodes; None before the second tick."""
        return self._intervals / self._seconds if self._seconds > 0 else None

    @property
    def lateness(self) -> Lateness | None:
        """Percentiles over the last `KEPT` ticks, the worst of all; None when running free or before the first."""
        if not self._late:
            return None
        p50, p99 = np.percentile(np.frombuffer(self._late), [50, 99])
        return Lateness(float(p50), float(p99), self._latest)
