"""Cubic splines through points in d dimensions, batched; the ends are "not-a-knot", as SciPy's are.

The parameter runs from 0 to 1 along the polyline of the points (chord length). With three neighbouring intervals and
more, the first two share one cubic and so do the last two, so a spline through points of one cubic is that cubic.
Source: C. de Boor, A Practical Guide to Splines, chapter IV.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Splines:
    """k splines through p points each."""

    knots: Array
    """Parameter at each point, from 0 to 1. Shape: (k, p)."""
    coefficients: Array
    """Coefficients of the cubic in (u - knot) of each interval, constant first. Shape: (k, p - 1, 4, d)."""

    def at(self, u: Array) -> Array:
        """Points at the parameters `u` of each spline. Shape: (k, m) -> (k, m, d)."""
        knots = self.knots
        interval = (u[:, :, None] >= knots[:, None, 1:-1]).sum(axis=2)
        row = np.arange(len(knots))[:, None]
        a, b, c, d = np.moveaxis(self.coefficients[row, interval], 2, 0)
        s = (u - knots[row, interval])[:, :, None]
        points: Array = a + s * (b + s * (c + s * d))
        return points


def splines_through(points: Array) -> Splines:
    """The splines through `points`, four or more a row, no two neighbours equal. Shape: (k, p, d)."""
    steps = np.diff(points, axis=1)
    chords = np.sqrt(np.einsum("kij,kij->ki", steps, steps))
    knots = np.concatenate([np.zeros((len(points), 1)), np.cumsum(chords, axis=1)], axis=1)
    knots /= knots[:, -1:]
    width = np.diff(knots, axis=1)[:, :, None]
    slope = steps / width
    second = _second_derivatives(width[:, :, 0], slope)
    coefficients = np.stack(
        [
            points[:, :-1],
            slope - width * (2 * second[:, :-1] + second[:, 1:]) / 6,
            second[:, :-1] / 2,
            np.diff(second, axis=1) / (6 * width),
        ],
        axis=2,
    )
    return Splines(knots, coefficients)


def _second_derivatives(width: Array, slope: Array) -> Array:
    """Second derivatives at the knots. Shapes: (k, p - 1), (k, p - 1, d) -> (k, p, d)."""
    k, p = len(width), width.shape[1] + 1
    matrix, right = np.zeros((k, p, p)), np.zeros((k, p, slope.shape[2]))
    inner = np.arange(1, p - 1)
    # First derivatives agree: h0 M0 + 2 (h0 + h1) M1 + h1 M2 = 6 (slope1 - slope0).
    matrix[:, inner, inner - 1] = width[:, :-1]
    matrix[:, inner, inner] = 2 * (width[:, :-1] + width[:, 1:])
    matrix[:, inner, inner + 1] = width[:, 1:]
    right[:, 1:-1] = 6 * np.diff(slope, axis=1)
    # Third derivatives agree at the second knot and at the last but one: (M1 - M0) / h0 = (M2 - M1) / h1.
    for row, (first, near, far) in ((0, (0, 0, 1)), (p - 1, (p - 3, p - 3, p - 2))):
        h0, h1 = width[:, near], width[:, far]
        matrix[:, row, first] = h1
        matrix[:, row, first + 1] = -(h0 + h1)
        matrix[:, row, first + 2] = h0
    second: Array = np.linalg.solve(matrix, right)
    return second


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
