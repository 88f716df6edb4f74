"""What an arm touches: itself, the table it stands on, the ground, a ball. Its links are capsules, n arms at once.

Each tube is a segment with a radius. Links that share a joint cannot collide; of the others, pairs that are always
apart are left out. Distances are exact: of two segments in closed form, of a segment and the table by bisection, since
the distance from a box along a line is convex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bam_envs.robots.physics.obstacles import RADIUS as BALL_RADIUS
from bam_envs.robots.ur import UrModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

TABLE = np.array([[-0.55, -0.30, -0.10], [0.45, 0.70, 0.0]])
"""Lowest and highest corner of the table in ``base_link`` [m]; the arm stands on it."""
GROUND = -0.10
"""Height of the ground in ``base_link`` [m]."""

_BASE, _SHOULDER, _UPPER, _FOREARM, _WRIST_1, _WRIST_2, _WRIST_3, _ELBOW = range(8)
_PAIRS = (
    *((one, other) for one in (_BASE, _SHOULDER) for other in (_FOREARM, _WRIST_1, _WRIST_2, _WRIST_3)),
    *((_UPPER, other) for other in (_WRIST_1, _WRIST_2, _WRIST_3)),
    (_FOREARM, _WRIST_3),
)
_LOW_LINKS = [_UPPER, _FOREARM, _WRIST_1, _WRIST_2, _WRIST_3, _ELBOW]
"""Links that can get at the table."""
_HALVINGS = 20


@dataclass(frozen=True)
class Capsules:
    """The tubes of n arms, in ``base_link``."""

    start: Array
    """Shape: (n, k, 3) [m]."""
    end: Array
    """Shape: (n, k, 3) [m]."""
    radius: Array
    """Shape: (k,) [m]."""


class ArmContacts:
    """Finds contacts of arms of one model."""

    def __init__(self, model: UrModel) -> None:
        self._geometry, self._outline = model.geometry, model.outline
        shape = model.outline
        self._radius = np.array(
            [shape.base, shape.upper_arm, shape.upper_arm, shape.forearm, *[shape.wrist] * 3, shape.forearm]
        )
        self._one, self._other = (list(side) for side in zip(*_PAIRS, strict=True))
        self._near = (self._radius[self._one] + self._radius[self._other]) ** 2

    def capsules(self, q: Array) -> Capsules:
        """The tubes at joint positions `q` (n, 6) [rad]: base, shoulder, upper arm, forearm, wrists 1 to 3, elbow."""
        positions, rotations = self._geometry.link_poses(q)
        shoulder, elbow, flange = positions[:, 1], positions[:, 2], positions[:, 5]
        sideways = rotations[:, 1, :, 2]
        beside = self._outline.upper_arm_offset * sideways
        inside = self._outline.forearm_offset * sideways
        wrist = positions[:, 3] + (self._outline.forearm_offset - self._geometry.d4) * sideways
        start = [np.zeros_like(shoulder), shoulder, shoulder + beside, elbow + inside, wrist]
        start += [positions[:, 3], positions[:, 4], elbow + beside]
        end = [shoulder, shoulder + beside, elbow + beside, wrist, positions[:, 3]]
        end += [positions[:, 4], flange, elbow + inside]
        return Capsules(np.stack(start, axis=1), np.stack(end, axis=1), self._radius)

    def touching(self, q: Array, obstacle: Array | None = None) -> Flags:
        """Whether each arm touches anything.

        Args:
            q: Joint positions [rad]. Shape: (n, 6).
            obstacle: Middle of a ball [m]. Shape: (n, 3).

        Returns:
            Shape: (n,).
        """
        arms = self.capsules(q)
        touching = self.touching_itself(arms) | self.touching_table(arms)
        return touching if obstacle is None else touching | self.touching_ball(arms, obstacle)

    def touching_itself(self, arms: Capsules) -> Flags:
        """Whether two links that share no joint overlap. Shape: (n,)."""
        one, other = self._one, self._other
        distance = segment_distance2(arms.start[:, one], arms.end[:, one], arms.start[:, other], arms.end[:, other])
        touching: Flags = np.logical_or.reduce(distance < self._near, axis=1)
        return touching

    def touching_table(self, arms: Capsules) -> Flags:
        """Whether a link is lower than the ground or overlaps the table. Shape: (n,)."""
        start, end, radius = arms.start[:, _LOW_LINKS], arms.end[:, _LOW_LINKS], arms.radius[_LOW_LINKS]
        lowest = np.minimum(start[:, :, 2], end[:, :, 2]) - radius
        touching: Flags = np.logical_or.reduce(lowest < GROUND, axis=1)
        row, link = np.nonzero(lowest < TABLE[1, 2])
        if len(row):  # the others are above the table
            overlaps = box_distance2(start[row, link], end[row, link]) < radius[link] ** 2
            touching[row[overlaps]] = True
        return touching

    def touching_ball(self, arms: Capsules, middle: Array) -> Flags:
        """Whether a link from the shoulder on overlaps the ball at `middle` (n, 3). Shape: (n,)."""
        start, way = arms.start[:, 1:], arms.end[:, 1:] - arms.start[:, 1:]
        offset = middle[:, None] - start
        share = np.clip(_dot(offset, way) / np.maximum(_dot(way, way), 1e-12), 0.0, 1.0)
        offset -= share[:, :, None] * way
        touching: Flags = np.logical_or.reduce(_dot(offset, offset) < (arms.radius[1:] + BALL_RADIUS) ** 2, axis=1)
        return touching


def segment_distance2(start: Array, end: Array, other_start: Array, other_end: Array) -> Array:
    """Squared distances of segments [m^2]. Shapes: (..., 3) each -> (...).

    The nearest points of the lines, the one on the first clamped to its segment; then the nearest to it on the second,
    clamped; then again the nearest to that on the first (Ericson, "Real-Time Collision Detection", 5.1.9).
    """
    way, other_way, gap = end - start, other_end - other_start, start - other_start
    a, e = np.maximum(_dot(way, way), 1e-12), np.maximum(_dot(other_way, other_way), 1e-12)
    b, c, f = _dot(way, other_way), _dot(way, gap), _dot(other_way, gap)
    slant = a * e - b * b  # 0 where they are parallel: then any point will do to begin with
    share = np.where(slant > 1e-9 * a * e, np.clip((b * f - c * e) / np.maximum(slant, 1e-18), 0.0, 1.0), 0.0)
    other_share = np.clip((b * share + f) / e, 0.0, 1.0)
    share = np.clip((b * other_share - c) / a, 0.0, 1.0)
    nearest = gap + share[..., None] * way - other_share[..., None] * other_way
    return _dot(nearest, nearest)


def box_distance2(start: Array, end: Array) -> Array:
    """Squared distances of segments from the table [m^2]. Shapes: (n, 3) each -> (n,)."""
    way = end - start
    low, high = np.zeros(len(way)), np.ones(len(way))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        rising = _dot(_outside(start + middle[:, None] * way), way) > 0  # half the slope of the squared distance
        low, high = np.where(rising, low, middle), np.where(rising, middle, high)
    outside = _outside(start + ((low + high) / 2)[:, None] * way)
    return _dot(outside, outside)


def _outside(point: Array) -> Array:
    """How far points (n, 3) are outside the table, along each axis."""
    outside: Array = np.maximum(point - TABLE[1], 0.0) + np.minimum(point - TABLE[0], 0.0)
    return outside


def _dot(one: Array, other: Array) -> Array:
    """Products along the last axis, written out: a row's sum does not depend on how many rows there are."""
    product: Array = one[..., 0] * other[..., 0] + one[..., 1] * other[..., 1] + one[..., 2] * other[..., 2]
    return product
