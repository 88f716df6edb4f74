"""Where an arm can work on a table before it: its home pose, and the largest box that it reaches with the tool down."""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.capsules import Outline
from bam_envs.arms.description import ArmDescription
from bam_envs.arms.serial_chain import SerialChain
from bam_envs.core.errors import InvalidValue

Array = NDArray[np.float64]
BOX = np.array([[-0.20, -0.25, 0.016], [0.20, 0.25, 0.35]])
"""Full work area about its middle: lowest and highest x, y, z [m]; a smaller arm has a smaller one."""
TABLE_END = 0.88
"""Farthest x of a work area: the table ends at 0.95 m."""
YAW = 1.2
"""Farthest turn of the gripper from straight ahead [rad]."""
_SCALES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.42, 0.35, 0.3, 0.25, 0.2)
_HEIGHTS = (1.0, 0.6)
_MARGIN = 0.05  # from the ends of a joint's travel [rad]
_CLEAR = 0.006  # of the table and of the arm itself, more than the guards keep [m]
_REACHED = 1e-4  # [m], and as far in rad
_TRIES = 240  # start poses of the search for a home pose
_STEPS = 12  # from the middle of the area to a point of it


def find_work_area(*arms: ArmDescription, tell: Callable[[str], None] = lambda _: None) -> ArmDescription:
    """The first of `arms` that has the largest work area straight before it, with that area and its home pose.

    They are one arm in several forms, such as with its gripper turned by half a turn. The home pose is the one farthest
    from all limits. `tell` takes a line before each size.

    Raises:
        InvalidValue: It reaches no such area with its tool pointing down.
    """
    if all(next(_areas(arm, _SCALES[-1]), None) is None for arm in arms):  # before the larger ones, which take long
        raise InvalidValue(
            f"{arms[0].name}: it cannot work in {_size(_SCALES[-1])} on the table before it: {_obstacle(arms)}. "
            "Look at the tool (--site, --gripper) and at the limits of the joints."
        )

    def areas(scale: float, arm: ArmDescription) -> list[ArmDescription]:
        if arm is arms[0]:
            tell(f"looking for a work area of {_size(scale)} before the arm")
        return list(_areas(arm, scale))

    return next(found[-1] for scale, arm in itertools.product(_SCALES, arms) if (found := areas(scale, arm)))


def _size(scale: float) -> str:
    width, length = 100 * scale * np.diff(BOX[:, :2], axis=0)[0]
    return f"{width:.0f} x {length:.0f} cm"


def _obstacle(arms: Sequence[ArmDescription]) -> str:
    """What keeps the tool from the smallest work area, where the arms come farthest."""
    (span, _), height = _span(arms[0].chain), float(arms[0].chain.placements[0, 2, 3])
    found = [(0.0, f"it reaches {span:.2f} m from its first joint, which is {height:.2f} m above the table")]
    for arm in arms:
        chain, outline = arm.chain, Outline(arm.chain)
        for box in _boxes(chain, _SCALES[-1]):
            homes = _homes(chain, outline, box)[:4]
            found += [uncovered(dataclasses.replace(chain, home=home), outline, box) for _, home in homes]
            found += [] if homes else [_no_home(chain, outline, _middle(box))]
    return max(found, key=itemgetter(0))[1]


def _no_home(chain: SerialChain, outline: Outline, middle: Array) -> tuple[float, str]:
    """How near the tool comes to pointing down at `middle`, and why it does not."""
    q, reached = _down(chain, middle)
    if reached.any():
        return 0.5, _contact(outline, q[reached])
    free = dataclasses.replace(chain, low=chain.low - 2 * np.pi, high=chain.high + 2 * np.pi)
    if not _down(free, middle)[1].any():
        return 0.0, ""
    return 0.4, f"limits of joints keep the tool from pointing down at x {middle[0]:.2f}, z {middle[2]:.2f} m"


def _contact(outline: Outline, q: Array) -> str:
    """What an arm touches in most of the postures `q`."""
    on_table = outline.lowest(q) < _CLEAR - 1e-3
    if on_table.mean() > 0.5 or not len(outline.pairs):
        return "the arm would touch the table"
    pairs = outline.links[outline.pairs[outline.distances(q).argmin(axis=1)]].tolist()
    one, other = Counter(map(tuple, pairs)).most_common(1)[0][0]
    return f"links {one} and {other} would touch"


def _areas(arm: ArmDescription, scale: float) -> Iterator[ArmDescription]:
    """The arm with areas of one size that it reaches, each with a better home pose than the ones before."""
    chain, outline, best = arm.chain, Outline(arm.chain), -np.inf
    for box in _boxes(chain, scale):
        for margin, home in _homes(chain, outline, box)[:4]:
            if margin <= best:
                break
            if not uncovered(dataclasses.replace(chain, home=home), outline, box)[1]:
                low, high = (tuple(round(float(one), 4) for one in corner) for corner in box)
                area: Any = {"home": tuple(map(float, home)), "workspace": (low, high)}
                yield dataclasses.replace(arm, **area)
                best = margin
                break


def _span(chain: SerialChain) -> tuple[float, float]:
    """Longest way from the first joint to the point `up` above the tool that points down, and `up` [m]."""
    place, out = chain.tool_placement[:3, 3], chain.tool_placement[:3, 2]
    up = float(place @ out)
    links = np.linalg.norm(chain.placements[1:, :3, 3], axis=1)
    return float(links.sum() + np.linalg.norm(place - up * out)), up


def _boxes(chain: SerialChain, scale: float) -> Iterator[Array]:
    """Boxes of one size before the first joint, at growing distances from the base."""
    (span, up), whole = _span(chain), np.concatenate([chain.placements[:, :3, 3], chain.tool_placement[None, :3, 3]])
    length = float(np.linalg.norm(whole, axis=1).sum())
    nearest = 0.5 * (BOX[1, 0] - BOX[0, 0]) * scale + 0.08
    for middle, height in itertools.product(np.arange(nearest, length, max(0.02, 0.05 * length)), _HEIGHTS):
        box = BOX * scale
        box[:, :2] += np.round([middle, chain.placements[0, 1, 3]], 3)
        box[:, 2] = BOX[0, 2], max(0.06, height * box[1, 2])
        corners = np.array(list(itertools.product(*box.T))) + (np.array([0.0, 0.0, up]) - chain.placements[0, :3, 3])
        if box[1, 0] <= TABLE_END and np.linalg.norm(corners, axis=1).max() < span:
            yield box


def _middle(box: Array) -> Array:
    x, y = box[:, :2].mean(axis=0)
    return np.array([x, y, box[0, 2] + 0.55 * (box[1, 2] - box[0, 2])])


def _homes(chain: SerialChain, outline: Outline, box: Array) -> list[tuple[float, Array]]:
    """Poses with the tool down over the middle of `box`, those farthest from limits, table and itself first."""
    q, reached = _down(chain, _middle(box))
    q = q[(np.minimum(outline.lowest(q), outline.nearest(q)) > _CLEAR) & reached]
    if not len(q):
        return []
    room = np.minimum(q - chain.low, chain.high - q).min(axis=1)
    _, jacobian = chain.jacobians(q)
    least = np.linalg.svd(jacobian[:, : 6 if chain.turns else 5], compute_uv=False)[:, -1]
    gap = np.minimum(np.minimum(outline.nearest(q), outline.lowest(q)), 0.1)
    low, high = _turns(chain)
    aside = np.sqrt(np.mean((q - 0.5 * (low + high)) ** 2, axis=1))
    scores = np.minimum(room, 1.0) + 4.0 * np.minimum(least, 0.25) + 5.0 * gap - 0.4 * aside
    order = np.argsort(-scores)
    picked: list[tuple[float, Array]] = []
    for at in order:
        if all(np.abs(q[at] - other).max() > 0.2 for _, other in picked):
            picked.append((float(scores[at]), np.round(q[at], 4)))
    return picked


def _turns(chain: SerialChain) -> tuple[Array, Array]:
    """Limits of the joints, within a turn [rad]. Shape: (k,) each."""
    return np.maximum(chain.low, -np.pi), np.minimum(chain.high, np.pi)


def _down(chain: SerialChain, point: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Joints that bring the tool to `point` pointing down, from random postures, and whether each does."""
    (low, high), wanted = _turns(chain), np.tile(point, (_TRIES, 1))
    q = low + np.random.default_rng(0).random((_TRIES, chain.num_joints)) * (high - low)
    for _ in range(40):  # each stays near its posture where the tool leaves joints free
        q = chain.reach_down(wanted, np.zeros(_TRIES), q)
    return q, _reaches(chain, q, wanted, np.zeros(_TRIES))


def uncovered(chain: SerialChain, outline: Outline, box: Array) -> tuple[float, str]:
    """Whether the arm follows straight lines from the middle of `box` to all sides of it, with the gripper turned.

    Returns:
        How far it comes, from 1 to 3, and what keeps it from the rest; "" if nothing does.
    """
    sides = [np.linspace(low, high, 3) for low, high in box.T]
    points = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    yaws = np.array([-YAW, 0.0, YAW] if chain.turns else [0.0])
    goals, turns = np.repeat(points, len(yaws), axis=0), np.tile(yaws, len(points))
    middle = _middle(box)
    q = np.tile(chain.home, (len(goals), 1))
    for step in range(1, _STEPS + 1):
        share = step / _STEPS
        wanted = middle + share * (goals - middle)
        q = chain.reach_down(wanted, share * turns, chain.reach_down(wanted, share * turns, q))
        touching = (outline.nearest(q) < _CLEAR) | (outline.lowest(q) < _CLEAR - 1e-3)
        if touching.any():
            return 1.0 + share, _contact(outline, q[touching])
    lost = ~_reaches(chain, q, goals, turns)
    if not lost.any():
        return 3.0, ""
    x, y, z = goals[lost][0]
    room = np.minimum(q - chain.low, chain.high - q)[lost]
    joint = Counter(room.argmin(axis=1).tolist()).most_common(1)[0][0] + 1
    ends = f": joint {joint} is at the end of its travel" if (room.min(axis=1) <= _MARGIN).mean() > 0.5 else ""
    turned = f" turned by {YAW} rad" if turns[lost].all() else ""
    return 3.0 - float(lost.mean()), f"the gripper does not come to x {x:.2f}, y {y:.2f}, z {z:.2f} m{turned}{ends}"


def _reaches(chain: SerialChain, q: Array, position: Array, yaw: Array) -> NDArray[np.bool_]:
    """Whether the tool is at `position` pointing down at `yaw`, with all joints clear of their limits. (n,) bool."""
    frames = chain.link_frames(q)[:, -1]
    off = np.linalg.norm(frames[:, :3, 3] - position, axis=1)
    down = np.linalg.norm(frames[:, :3, 2] - [0.0, 0.0, -1.0], axis=1)
    turned = np.abs(np.angle(np.exp(1j * (np.arctan2(frames[:, 1, 0], frames[:, 0, 0]) - yaw)))) if chain.turns else 0.0
    room = np.minimum(q - chain.low, chain.high - q).min(axis=1)
    reached: NDArray[np.bool_] = (off < _REACHED) & (down < _REACHED) & (turned < _REACHED) & (room > _MARGIN)
    return reached
