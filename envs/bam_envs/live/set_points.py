"""Set points on cubic splines, as a controller of trajectories makes them, for one that holds what it gets."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class SetPoints:
    """Set points from `position` (k,) on; each goal is approached from where they are, and reached at rest."""

    def __init__(self, position: Array, now: float) -> None:
        self._from = self._goal = position.copy()
        self._speed, self._begun, self._within = np.zeros(len(position)), now, 0.0

    def aim(self, goal: Array, now: float, within: float) -> None:
        """Be at `goal` (k,) `within` [s] from `now`."""
        self._from, self._speed = self.at(now)
        self._goal, self._begun, self._within = goal.copy(), now, within

    def at(self, now: float) -> tuple[Array, Array]:
        """Set point (k,), and its speed [1/s]."""
        share = (now - self._begun) / self._within if self._within else 1.0
        if share >= 1.0:
            return self._goal, np.zeros(len(self._goal))
        way, first = self._goal - self._from, self._speed * self._within
        square, cube = 3 * way - 2 * first, first - 2 * way
        point = self._from + share * (first + share * (square + share * cube))
        return point, (first + share * (2 * square + share * 3 * cube)) / self._within
