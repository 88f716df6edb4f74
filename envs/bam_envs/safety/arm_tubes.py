"""The links of an arm as tubes: their distances from each other and from the table.

Points of `ArmTubes`, for Universal Robots arms, are in the arm's vertical plane (radial, sideways, height), which turns
with joint 1: neither that joint nor the last one changes a distance. The tubes and pairs are those of the simulation
(`ArmContacts`); the last tube reaches to the end of the tool where there is one. `ChainTubes` are the capsules of any
other described arm, in ``base_link``.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.capsules import Outline
from bam_envs.arms.serial_chain import Arm, Capsule, SerialChain
from bam_envs.core.kinematics import ArmGeometry, ArmOutline

Array = NDArray[np.float64]
Point = tuple[float, float, float]
Tube = tuple[Point, Point, float]
"""The two ends and the radius [m]."""
_BASE, _SHOULDER, _UPPER, _FOREARM, _WRIST_1, _WRIST_2, _WRIST_3, _ELBOW = range(8)
_PAIRS = (
    *((first, other, 0) for first in (_BASE, _SHOULDER) for other in (_FOREARM, _WRIST_1, _WRIST_2, _WRIST_3)),
    *((_UPPER, other, 1) for other in (_WRIST_1, _WRIST_2, _WRIST_3)),
    (_FOREARM, _WRIST_3, 2),
)
"""Pairs of tubes that can touch and share no joint; 0, 1, 2: the joints from 2, 3, 4 on change their distance."""


class ArmTubes:
    """Distances of an arm's tubes; `tool` is whether the geometry's tool is mounted."""

    def __init__(self, geometry: ArmGeometry, outline: ArmOutline, *, tool: bool) -> None:
        self._arm, self._outline, self._tool = geometry, outline, geometry.tool if tool else 0.0
        self._radii = [outline.base, *[outline.upper_arm] * 2, outline.forearm, *[outline.wrist] * 3, outline.forearm]
        end = geometry.d6 + self._tool
        wrist = geometry.d5 + end
        self._levers = abs(geometry.a2) + abs(geometry.a3) + wrist, abs(geometry.a3) + wrist, wrist, end
        self._near = [0.0] * len(_PAIRS)
        self._at: Sequence[float] = [math.inf] * 6

    def lowest(self, q: Sequence[float]) -> float:
        """Height of the lowest point of the arm at the joints `q` (6,) [rad], up to its flange [m]."""
        arm, shape, low = self._arm, self._outline, q[1] + q[2] + q[3]
        elbow = arm.d1 + arm.a2 * math.sin(q[1])
        wrist_1 = elbow + arm.a3 * math.sin(q[1] + q[2])
        wrist_2 = wrist_1 - arm.d5 * math.cos(low)
        flange = wrist_2 - arm.d6 * math.sin(q[4]) * math.sin(low)
        thick = max(shape.upper_arm, shape.forearm)
        return min(elbow - thick, wrist_1 - shape.forearm, min(wrist_2, flange) - shape.wrist)

    def nearest(self, q: Sequence[float]) -> float:
        """Smallest distance of two tubes at the joints `q` (6,) [rad], in m; below 0 if they overlap."""
        tubes = self.tubes(q)
        return min(self._distance(tubes, first, other) for first, other, _ in _PAIRS)

    def change(self, here: Sequence[float], there: Sequence[float]) -> float:
        """Upper bound on the change of `lowest` and of any distance [m] between two sets of joints (6,) [rad]."""
        levers = self._levers
        return (
            levers[0] * abs(there[1] - here[1])
            + levers[1] * abs(there[2] - here[2])
            + levers[2] * abs(there[3] - here[3])
            + levers[3] * abs(there[4] - here[4])
        )

    def nearer_than(self, margin: float, q: Sequence[float]) -> bool:
        """Whether two tubes are nearer than `margin` [m] at the joints `q` (6,) [rad].

        A pair is computed again only when the joints between its tubes have turned far enough since the last time to
        bring it within the margin: a turn moves a tube by at most its angle times the length of the arm beyond.
        """
        moved, at, levers = [0.0] * 3, self._at, self._levers
        beyond = levers[3] * abs(q[4] - at[4])
        for group, joint in ((2, 3), (1, 2), (0, 1)):
            beyond += levers[joint - 1] * abs(q[joint] - at[joint])
            moved[group] = beyond
        self._at = list(q)
        tubes: list[Tube] = []
        for place, (first, other, group) in enumerate(_PAIRS):
            self._near[place] -= moved[group]
            if not self._near[place] >= margin:
                tubes = tubes or self.tubes(q)
                self._near[place] = self._distance(tubes, first, other)
        return self.least < margin

    @property
    def least(self) -> float:
        """Lower bound on the smallest distance of two tubes at the joints of `nearer_than` [m]."""
        return min(self._near)

    @staticmethod
    def _distance(tubes: list[Tube], first: int, other: int) -> float:
        (start, end, radius), (other_start, other_end, other_radius) = tubes[first], tubes[other]
        return math.sqrt(segment_distance2(start, end, other_start, other_end)) - radius - other_radius

    def tubes(self, q: Sequence[float]) -> list[Tube]:
        """Base, shoulder, upper arm, forearm, wrists 1 to 3 (up to the end of the tool), elbow, at `q` (6,) [rad]."""
        arm, shape, low = self._arm, self._outline, q[1] + q[2] + q[3]
        sine, cosine, s5, reach = math.sin(low), math.cos(low), math.sin(q[4]), arm.d6 + self._tool
        upper, fore, d1 = shape.upper_arm_offset, shape.forearm_offset, arm.d1
        elbow_x, elbow_z = arm.a2 * math.cos(q[1]), d1 + arm.a2 * math.sin(q[1])
        x, z = elbow_x + arm.a3 * math.cos(q[1] + q[2]), elbow_z + arm.a3 * math.sin(q[1] + q[2])
        wrist, wrist_1 = (x, fore, z), (x, arm.d4, z)
        x, z = x + arm.d5 * sine, z - arm.d5 * cosine
        wrist_2 = x, arm.d4, z
        tool = x - reach * s5 * cosine, arm.d4 + reach * math.cos(q[4]), z - reach * s5 * sine
        shoulder, beside = (0.0, 0.0, d1), (0.0, upper, d1)
        elbow, inside = (elbow_x, upper, elbow_z), (elbow_x, fore, elbow_z)
        starts = (0.0, 0.0, 0.0), shoulder, beside, inside, wrist, wrist_1, wrist_2, elbow
        ends = shoulder, beside, elbow, wrist, wrist_1, wrist_2, tool, inside
        return list(zip(starts, ends, self._radii, strict=True))


class ChainTubes:
    """Distances of the capsules of a described arm, with the methods of `ArmTubes`; `tool`: with its gripper."""

    def __init__(self, chain: SerialChain, *, tool: bool) -> None:
        size = chain.num_joints
        kept = tuple(one for one in chain.capsules if tool or one.link <= size)
        self._chain, self._outline = chain, Outline(replace(chain, capsules=kept))
        outline = self._outline
        ends = [[(*one.start, 1.0), (*one.end, 1.0)] for one in kept]
        self._links, self._ends = outline.links, np.array(ends).transpose(0, 2, 1)
        self._low = np.flatnonzero((self._links > 2) & (self._links <= size))
        one, other = outline.pairs.T
        self._beyond = np.minimum(self._links[one], size), np.minimum(self._links[other], size)
        self._kept = (outline.radius[one] + outline.radius[other] - outline.slack).tolist()
        self._levers = _levers(chain, kept)
        self._near, self._at = np.full(len(outline.pairs), -math.inf), np.zeros(size)
        self._mount = chain.mount[None]
        self._placed: tuple[list[float], Array] = [], np.empty(0)

    @property
    def least(self) -> float:
        """Lower bound on the smallest distance of two capsules at the joints of `nearer_than` [m]."""
        return float(self._near.min(initial=math.inf))

    def lowest(self, q: Sequence[float]) -> float:
        """Height of the lowest point of the links at the joints `q` (k,) [rad], from the third to the flange [m]."""
        places = self._places(q)[self._low]
        lows: Array = places[:, 2].min(axis=1) - self._outline.radius[self._low]
        return float(lows.min(initial=math.inf))

    def nearest(self, q: Sequence[float]) -> float:
        """Smallest distance of two capsules at the joints `q` (k,) [rad], in m; below 0 if their links overlap."""
        return float(self._outline.nearest(np.array([q]))[0])

    def change(self, here: Sequence[float], there: Sequence[float]) -> float:
        """Upper bound on the change of `lowest` and of any distance [m] between two sets of joints (k,) [rad]."""
        rows = zip(self._levers.tolist(), here, there, strict=True)
        return float(sum(lever * abs(one - other) for lever, one, other in rows))

    def nearer_than(self, margin: float, q: Sequence[float]) -> bool:
        """Whether two capsules are nearer than `margin` [m] at the joints `q` (k,) [rad].

        A pair is computed again only when the joints between its links have turned far enough since the last time to
        bring it within the margin.
        """
        moved = np.zeros(len(self._levers) + 1)
        np.cumsum(self._levers * np.abs(np.array(q) - self._at), out=moved[1:])
        self._near -= moved[self._beyond[1]] - moved[self._beyond[0]]
        self._at = np.array(q)
        due = np.flatnonzero(self._near < margin)
        if len(due):
            places = self._places(q).transpose(0, 2, 1).tolist()
            for pair in due.tolist():
                one, other = self._outline.pairs[pair].tolist()
                gap = math.sqrt(segment_distance2(*places[one], *places[other]))
                self._near[pair] = gap - self._kept[pair]
        return self.least < margin

    def _places(self, q: Sequence[float]) -> Array:
        """Ends of the capsules as columns [m]. Shape: (capsules, 3, 2)."""
        if self._placed[0] != q:
            frames = np.concatenate([self._mount, self._chain.link_frames(np.array([q]))[0]])
            self._placed = list(q), frames[self._links, :3] @ self._ends
        return self._placed[1]


def _levers(chain: SerialChain, capsules: Sequence[Capsule]) -> Array:
    """How far a turn of each joint moves what is beyond it at most [m/rad]. Shape: (k,)."""
    size = chain.num_joints
    extent = [0.0] * (size + 2)
    for one in capsules:
        extent[one.link] = max(extent[one.link], math.hypot(*one.start) + one.radius, math.hypot(*one.end) + one.radius)
    steps = [math.hypot(*place[:3, 3]) for place in (*chain.placements[1:], chain.tool_placement)]
    levers, beyond = np.zeros(size), extent[size + 1]
    for joint in reversed(range(size)):
        levers[joint] = beyond = max(extent[joint + 1], steps[joint] + beyond)
    return levers


Tubes = ArmTubes | ChainTubes


def tubes_of(arm: Arm, *, tool: bool) -> Tubes | None:
    """The tubes of an arm, with its gripper or without; None if its outline is not known."""
    if isinstance(arm, SerialChain):
        return ChainTubes(arm, tool=tool) if arm.capsules else None
    return ArmTubes(arm, arm.outline, tool=tool) if arm.outline is not None else None


def segment_distance2(start: Point, end: Point, other_start: Point, other_end: Point) -> float:
    """Squared distance of two segments [m^2]; Ericson, "Real-Time Collision Detection", 5.1.9."""
    wx, wy, wz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    ox, oy, oz = other_end[0] - other_start[0], other_end[1] - other_start[1], other_end[2] - other_start[2]
    gx, gy, gz = start[0] - other_start[0], start[1] - other_start[1], start[2] - other_start[2]
    a, e = max(wx * wx + wy * wy + wz * wz, 1e-12), max(ox * ox + oy * oy + oz * oz, 1e-12)
    b, c, f = wx * ox + wy * oy + wz * oz, wx * gx + wy * gy + wz * gz, ox * gx + oy * gy + oz * gz
    slant = a * e - b * b  # 0 for parallel segments: any first point will do
    share = min(max((b * f - c * e) / slant, 0.0), 1.0) if slant > 1e-9 * a * e else 0.0
    other = min(max((b * share + f) / e, 0.0), 1.0)
    share = min(max((b * other - c) / a, 0.0), 1.0)
    x, y, z = gx + share * wx - other * ox, gy + share * wy - other * oy, gz + share * wz - other * oz
    return x * x + y * y + z * z
