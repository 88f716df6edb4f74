"""Real time: steps end on a grid of the monotonic clock."""

from __future__ import annotations

from collections.abc import Callable


class Pace:
    """Makes steps last one period each, without adding up the lateness of any.

    Args:
        period: Time between the ends of two steps [s].
        clock: A monotonic clock [s].
        sleep: Waits [s].
    """

    def __init__(self, period: float, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        self.period = period
        self._clock, self._sleep = clock, sleep
        self._end = 0.0

    def restart(self) -> None:
        """An episode begins now."""
        self._end = self._clock()

    def wait(self) -> None:
        """Wait for the end of the period. Later than half a period, the grid begins anew: nothing is caught up."""
        now = self._clock()
        self._end = self._end + self.period if now < self._end + 1.5 * self.period else now
        if self._end > now:
            self._sleep(self._end - now)
