"""The links of an arm as tubes: their distances from each other and from the table.

Points of `ArmTubes`, for Universal Robots arms, are in the arm's vertical plane (radial, sideways, height), which turns
with joint 1: neither that joint nor the last one changes a distance. The tubes and pairs are those of the simulation
(`ArmContacts`), with the ends of the wrists; the last tube reaches to the end of the tool where there is one.
`ChainTubes` are the capsules of any other described arm, in ``base_link``.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from operator import mul, sub
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.capsules import Outline
from bam_envs.arms.serial_chain import Arm, Capsule, Pose, SerialChain, chain_of
from bam_envs.core.kinematics import ArmGeometry, ArmOutline

Array = NDArray[np.float64]
Point = tuple[float, float, float]
Segment = tuple[Point, Point]
"""The two ends of a tube [m]."""
Pair = tuple[int, int, float]
"""Two tubes, and the distance of their segments at which their links touch [m]."""
_ENOUGH = 0.03
"""A distance of tubes around all tubes of two links that is this much above a margin [m] needs no closer look."""
_SOON = 4.0
"""A distance that would be computed again within so many more ticks is computed with the first."""
_CAP = 0.03
"""How far tubes of wrists 2 and 3 begin before the axis of the joint between: flat housings of UR3 to UR10 end 4.8 to
5.7 cm before it [m]."""
_BASE, _SHOULDER, _UPPER, _FOREARM, _WRIST_1, _WRIST_2, _WRIST_3, _ELBOW = range(8)
_PAIRS = (
    *((first, other) for first in (_BASE, _SHOULDER) for other in (_FOREARM, _WRIST_1, _WRIST_2, _WRIST_3)),
    *((_UPPER, other) for other in (_WRIST_1, _WRIST_2, _WRIST_3)),
    (_FOREARM, _WRIST_3),
)
"""Pairs of tubes that can touch and share no joint."""


class LinkPair(NamedTuple):
    """Pairs of tubes on two links that can touch."""

    levers: Sequence[float]
    """How far a turn of each joint changes their distance at most [m/rad]. Shape: (k,)."""
    pairs: Sequence[Pair]
    around: Pair
    """A tube around all of these tubes of the one link and one around those of the other, which are computed first."""

    def nearest(self, segments: Mapping[int, Segment]) -> float:
        """Smallest distance of a pair [m]."""
        return min(_distance(segments, pair) for pair in self.pairs)


class Tubes:
    """Tubes around the links of an arm; subclasses say where they are in a posture.

    Args:
        groups: The tubes that can touch.
        levers: How far a turn of each joint moves the lowest point up or down at most [m/rad]. Shape: (k,).
    """

    def __init__(self, groups: Sequence[LinkPair], levers: Sequence[float]) -> None:
        self._groups, self._levers = groups, np.array([*[group.levers for group in groups], levers])
        self._in = [{tube for pair in group.pairs for tube in pair[:2]} for group in groups]
        # How far the distances of all groups, and of the lowest point, are above the margin at the joints `_at`, at
        # least [m], the least of them; and what was asked for.
        self._room, self._at, self._asked = np.zeros(len(self._levers)), [0.0] * len(levers), (math.nan, math.nan)
        self._least, self._longest = 0.0, self._levers.max(axis=0).tolist()
        self._posed: tuple[list[float], Any] = [], None

    def posture(self, q: Sequence[float]) -> Any:
        """What `segments` and `lowest` need at the joints `q` (k,) [rad]."""
        raise NotImplementedError

    def posed(self, q: Sequence[float]) -> Any:
        """`posture`, computed once for all that is asked of it."""
        if (here := [*q]) != self._posed[0]:
            self._posed = here, self.posture(q)
        return self._posed[1]

    def segments(self, q: Sequence[float], tubes: Iterable[int]) -> Mapping[int, Segment]:
        """The segments of some `tubes` at the joints `q` (k,) [rad]."""
        raise NotImplementedError

    def lowest(self, q: Sequence[float]) -> float:
        """Height of the lowest point of the links that move at the joints `q` (k,) [rad], up to the flange [m]."""
        raise NotImplementedError

    def nearest(self, q: Sequence[float]) -> float:
        """Smallest distance of two tubes at the joints `q` (k,) [rad], in m; below 0 if their links overlap."""
        segments = self.segments(q, set().union(*self._in))
        return min((group.nearest(segments) for group in self._groups), default=math.inf)

    def nearer_than(self, margin: float, q: Sequence[float], table: float = -math.inf) -> bool:
        """Whether two tubes, or the lowest point and the `table`, are nearer than `margin` [m] at the joints `q` (k,).

        A distance is computed again only when the joints that change it have turned far enough since the last time to
        bring it within the margin; see `LinkPair.levers`. Since `_at` no distance has changed by more than the turns
        times the longest levers; where that is less than the least room, no other number is needed.
        """
        asked = margin, table
        if self._asked == asked and sum(map(mul, self._longest, map(abs, map(sub, q, self._at)))) < self._least:
            return False
        here = [*q]
        lost = self._levers @ np.abs(np.subtract(here, self._at))
        self._room -= lost
        self._at = here
        if self._asked != asked:
            self._room[:], self._asked = -math.inf, asked
        self._least = float(self._room[self._room.argmin()])
        if self._least > 0.0:
            return False
        for row in np.flatnonzero(~(self._room > _SOON * lost)).tolist():  # of one posture, it costs less
            apart = self._apart(row, margin, q) if row < len(self._groups) else self.lowest(q) - table
            self._room[row] = apart - margin
        self._least = float(self._room[self._room.argmin()])
        return self._least < 0.0

    def _apart(self, row: int, margin: float, q: Sequence[float]) -> float:
        """Distance of two links, at most; of the tubes around them if that is far above the margin [m]."""
        group = self._groups[row]
        apart = _distance(self.segments(q, group.around[:2]), group.around)
        if apart >= margin + _ENOUGH or len(group.pairs) == 1:
            return apart
        return group.nearest(self.segments(q, self._in[row]))


class ArmTubes(Tubes):
    """The tubes of a Universal Robots arm; `tool` is whether the geometry's tool is mounted."""

    def __init__(self, geometry: ArmGeometry, outline: ArmOutline, *, tool: bool) -> None:
        self._arm, self._outline, self._tool = geometry, outline, geometry.tool if tool else 0.0
        self._radii = [outline.base, *[outline.upper_arm] * 2, outline.forearm, *[outline.wrist] * 3, outline.forearm]
        end, upper, fore = max(geometry.d6 + self._tool, _CAP), abs(geometry.a2), abs(geometry.a3)
        wrist = math.hypot(geometry.d5, end)
        # How far tubes beyond joints 4 and 5, and those before joints 2 and 3, reach from the axes of these joints.
        beyond = {_WRIST_2: (max(geometry.d5, _CAP), 0.0), _WRIST_3: (wrist, end)}
        before = {_BASE: (geometry.d1, geometry.d1 + upper), **dict.fromkeys((_SHOULDER, _UPPER), (0.0, upper))}
        groups = []
        for one, other in _PAIRS:
            (turn_2, turn_3), (turn_4, turn_5) = before.get(one, (0.0, 0.0)), beyond.get(other, (0.0, 0.0))
            pair = one, other, self._radii[one] + self._radii[other]
            levers = [0.0, min(turn_2, upper + fore + turn_4), min(turn_3, fore + turn_4), turn_4, turn_5, 0.0]
            groups.append(LinkPair(levers, [pair], pair))
        super().__init__(groups, [0.0, upper + fore + wrist, fore + wrist, wrist, end, 0.0])

    def lowest(self, q: Sequence[float]) -> float:
        """Height of the lowest point of the arm at the joints `q` (6,) [rad], up to its flange [m]."""
        arm, shape, low = self._arm, self._outline, q[1] + q[2] + q[3]
        elbow = arm.d1 + arm.a2 * math.sin(q[1])
        wrist_1 = elbow + arm.a3 * math.sin(q[1] + q[2])
        wrist_2 = wrist_1 - arm.d5 * math.cos(low)
        flange = wrist_2 - arm.d6 * math.sin(q[4]) * math.sin(low)
        thick = max(shape.upper_arm, shape.forearm)
        return min(elbow - thick, wrist_1 - shape.forearm, min(wrist_2, flange) - shape.wrist)

    def segments(self, q: Sequence[float], tubes: Iterable[int]) -> Mapping[int, Segment]:
        """All of them at the joints `q` (6,) [rad]."""
        segments: dict[int, Segment] = self.posed(q)
        return segments

    def posture(self, q: Sequence[float]) -> dict[int, Segment]:
        """Base, shoulder, upper arm, forearm, wrists 1 to 3 (up to the end of the tool), elbow, at `q` (6,) [rad]."""
        arm, shape, low = self._arm, self._outline, q[1] + q[2] + q[3]
        sine, cosine, reach = math.sin(low), math.cos(low), arm.d6 + self._tool
        s5, c5 = math.sin(q[4]), math.cos(q[4])
        upper, fore, d1 = shape.upper_arm_offset, shape.forearm_offset, arm.d1
        elbow_x, elbow_z = arm.a2 * math.cos(q[1]), d1 + arm.a2 * math.sin(q[1])
        x, z = elbow_x + arm.a3 * math.cos(q[1] + q[2]), elbow_z + arm.a3 * math.sin(q[1] + q[2])
        wrist, wrist_1 = (x, fore, z), (x, arm.d4, z)
        x, z = x + arm.d5 * sine, z - arm.d5 * cosine
        wrist_2 = x, arm.d4, z
        tool = x - reach * s5 * cosine, arm.d4 + reach * c5, z - reach * s5 * sine
        cap_1 = wrist_1[0] - _CAP * sine, wrist_1[1], wrist_1[2] + _CAP * cosine
        cap_2 = wrist_2[0] + _CAP * s5 * cosine, arm.d4 - _CAP * c5, wrist_2[2] + _CAP * s5 * sine
        shoulder, beside = (0.0, 0.0, d1), (0.0, upper, d1)
        elbow, inside = (elbow_x, upper, elbow_z), (elbow_x, fore, elbow_z)
        starts = (0.0, 0.0, 0.0), shoulder, beside, inside, wrist, cap_1, cap_2, elbow
        ends = shoulder, beside, elbow, wrist, wrist_1, wrist_2, tool, inside
        return dict(enumerate(zip(starts, ends, strict=True)))


class ChainTubes(Tubes):
    """The capsules of a described arm; `tool`: with its gripper."""

    def __init__(self, chain: SerialChain, *, tool: bool) -> None:
        size = chain.num_joints
        kept = tuple(one for one in chain.capsules if tool or one.link <= size)
        outline = Outline(replace(chain, capsules=kept))
        self._chain, self._radii = chain, [one.radius for one in kept]
        self._moving = [
            (one.link, *ends, one.radius) for one in kept if 2 < one.link <= size for ends in (one.start, one.end)
        ]
        pairs: dict[tuple[int, int], list[Pair]] = {}
        for (one, other), slack in zip(outline.pairs.tolist(), outline.slack.tolist(), strict=True):
            spare = self._radii[one] + self._radii[other] - slack
            pairs.setdefault((kept[one].link, kept[other].link), []).append((one, other, spare))
        hulls, groups = list[Capsule](), list[LinkPair]()
        for members in pairs.values():
            sides = [[kept[tube] for tube in {*tubes}] for tubes in list(zip(*members, strict=True))[:2]]
            around = members[0]
            if len(members) > 1:
                ends = [_around(side) for side in sides]
                slack = max(self._radii[one] + self._radii[other] - spare for one, other, spare in members)
                place = len(kept) + len(hulls)
                around = place, place + 1, ends[0].radius + ends[1].radius - slack
                hulls += ends
            groups.append(LinkPair(_levers(chain, *sorted(sides, key=lambda side: side[0].link)), members, around))
        self._shapes = [(one.link, *one.start, *one.end) for one in (*kept, *hulls)]
        levers = [_levers(chain, [], [one]) for one in kept if 2 < one.link <= size]
        lowest = [max(column) for column in zip([0.0] * size, *levers, strict=True)]
        lowest[0] *= math.hypot(*(chain.placements[0, :2, :3] @ chain.axes[0]))  # a turn about a vertical axis: nothing
        super().__init__(groups, lowest)

    def posture(self, q: Sequence[float]) -> Sequence[Pose]:
        """Poses of the links."""
        return self._chain.poses(q)

    def lowest(self, q: Sequence[float]) -> float:
        """Height of the lowest point of the links at the joints `q` (k,) [rad], from the third to the flange [m]."""
        poses, lowest = self.posed(q), math.inf
        for link, x, y, z, radius in self._moving:
            _, _, _, _, _, _, _, _, g, h, i, height = poses[link]
            lowest = min(lowest, g * x + h * y + i * z + height - radius)
        return lowest

    def segments(self, q: Sequence[float], tubes: Iterable[int]) -> dict[int, Segment]:
        """The segments of some of the capsules at the joints `q` (k,) [rad]."""
        poses, found = self.posed(q), dict[int, Segment]()
        for tube in tubes:
            link, x, y, z, u, v, w = self._shapes[tube]
            a, b, c, px, d, e, f, py, g, h, i, pz = poses[link]
            start = a * x + b * y + c * z + px, d * x + e * y + f * z + py, g * x + h * y + i * z + pz
            found[tube] = start, (a * u + b * v + c * w + px, d * u + e * v + f * w + py, g * u + h * v + i * w + pz)
        return found


def _levers(chain: SerialChain, near: Sequence[Capsule], far: Sequence[Capsule]) -> list[float]:
    """How far a turn of each joint changes the distance of `near` capsules, or the base, from `far` ones. Shape: (k,).

    A turn moves the one relative to the other by at most its angle times how far either of them reaches from its axis;
    a joint that is not between them moves neither. [m/rad]
    """
    levers, steps = [0.0] * chain.num_joints, chain.placements[:, :3, 3]
    (low, behind), (high, points) = (_ends(chain, capsules) for capsules in (near, far))
    rest = 0.0
    for joint in reversed(range(low, high)):  # from the frame of the far link to that of the joint
        levers[joint] = _reach(points, chain.axes[joint]) + rest
        rest, points = rest + float(np.linalg.norm(points, axis=1).max()), steps[joint, None]
    rest = 0.0
    for joint in range(low, high if near else low):  # from the frame of the near link to that before the joint
        apart = behind - steps[joint]
        levers[joint] = min(levers[joint], _reach(apart, chain.placements[joint, :3, :3] @ chain.axes[joint]) + rest)
        rest, behind = rest + float(np.linalg.norm(apart, axis=1).max()), np.zeros((1, 3))
    return levers


def tool_levers(arm: Arm | None) -> list[float]:
    """How far a turn of each joint of `arm` moves its tool at most [m/rad]. Shape: (k,); empty if it is not known."""
    if arm is None:
        return []
    chain = chain_of(arm)
    return _levers(chain, [], [Capsule(link=chain.num_joints + 1, radius=1.0)])


def _ends(chain: SerialChain, capsules: Sequence[Capsule]) -> tuple[int, Array]:
    """The link of `capsules`, for a gripper the last one, and their ends in its frame (n, 3) [m]."""
    size, link = chain.num_joints, capsules[0].link if capsules else 0
    place = chain.mount if link == 0 else chain.tool_placement if link > size else np.eye(4)
    ends = np.array([end for one in capsules for end in (one.start, one.end)]).reshape(-1, 3)
    return min(link, size), ends @ place[:3, :3].T + place[:3, 3]


def _reach(points: Array, axis: Array) -> float:
    """Greatest distance of `points` (n, 3) from a line along `axis` through the origin, in their unit."""
    return float(np.linalg.norm(np.cross(points, axis), axis=1).max())


def tubes_of(arm: Arm, *, tool: bool) -> Tubes | None:
    """The tubes of an arm, with its gripper or without; None if its outline is not known."""
    if isinstance(arm, SerialChain):
        return ChainTubes(arm, tool=tool) if arm.capsules else None
    return ArmTubes(arm, arm.outline, tool=tool) if arm.outline is not None else None


def _around(capsules: Sequence[Capsule]) -> Capsule:
    """One capsule around all `capsules` of a link, about the two ends that are farthest apart."""
    balls = [(end, one.radius) for one in capsules for end in (one.start, one.end)]
    start, end = max(combinations((place for place, _ in balls), 2), key=lambda two: math.dist(*two))
    apart = [math.sqrt(segment_distance2(place, place, start, end)) + radius for place, radius in balls]
    return Capsule(link=capsules[0].link, start=start, end=end, radius=max(apart))


def _distance(segments: Mapping[int, Segment], pair: Pair) -> float:
    """Distance of two tubes [m]."""
    first, other, kept = pair
    return math.sqrt(segment_distance2(*segments[first], *segments[other])) - kept


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
