"""When each period of a live robot ends: an even grid that does not drift, and begins anew after a pause."""

from __future__ import annotations


class Grid:
    """Ends of periods, on a monotonic clock.

    Args:
        period: Time between two ends [s].
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self._end: float | None = None

    def restart(self) -> None:
        """The next period begins when it is asked for."""
        self._end = None

    def next(self, now: float) -> float:
        """When the period ends that begins at `now`, or began a little before [s].

        It ends one period after the last end, so that small delays do not add up; after a delay of more than half a
        period the grid begins anew, so that no period is ever shorter than half of one.
        """
        if self._end is None or abs(now - self._end) > self.period / 2:
            self._end = now
        self._end += self.period
        return self._end
