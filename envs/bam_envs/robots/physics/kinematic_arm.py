"""Universal Robots arms without dynamics: in a period the joints reach their set points, within their speed limits.

The commands of a task (`bam_envs.tasks.ur_arm`) slow an arm down, so that a live arm is as slow. Contacts are detected
but do not stop the arm; ``state.truth["collision"]`` reports them until the next reset.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import EnvIds, Initial, RobotState, checked_command
from bam_envs.core.task import Memory
from bam_envs.robots.physics.drawn import Drawn
from bam_envs.robots.physics.obstacles import RADIUS, Obstacles
from bam_envs.robots.physics.shapes import BLUE, GREY, RED, WOOD, Shape, View
from bam_envs.robots.ur import DEFAULT_MODEL, START, UrModel, ur_spec
from bam_envs.robots.ur import ur_model as model_called
from bam_envs.robots.ur5e import TOOL_LENGTH

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
_LOW_LINKS = [_UPPER, _FOREARM, _WRIST_1, _WRIST_2, _WRIST_3, _ELBOW]  # links that can reach the table
_HALVINGS = 20
LEAST_SHARE = 0.7  # of randomised arms: the least share of the way to its set point that one moves in a period


class Capsules(NamedTuple):
    """The tubes of n arms, in ``base_link`` [m]. Shapes: (n, k, 3), (n, k, 3), (k,)."""

    start: Array
    end: Array
    radius: Array


class ArmContacts:
    """Contacts of arms of one model with themselves, the table they stand on, the ground, a ball.

    Each link is a tube, a segment with a radius. Links that share a joint cannot collide; of the others, pairs that are
    always apart are left out. Distances are exact: of two segments in closed form, of a segment and the table by
    bisection, since the distance from a box along a line is convex.
    """

    def __init__(self, model: UrModel) -> None:
        self._geometry, self._outline = model.geometry, (shape := model.outline)
        self._radius = np.array(
            [shape.base, shape.upper_arm, shape.upper_arm, shape.forearm, *[shape.wrist] * 3, shape.forearm]
        )
        self._one, self._other = (list(side) for side in zip(*_PAIRS, strict=True))
        self._near = (self._radius[self._one] + self._radius[self._other]) ** 2

    def capsules(self, q: Array) -> Capsules:
        """The tubes at joint positions `q` (n, 6) [rad]: base, shoulder, upper arm, forearm, wrists 1 to 3, elbow."""
        positions, rotations = self._geometry.link_poses(q)
        _, shoulder, elbow, wrist_1, wrist_2, flange = positions.swapaxes(0, 1)
        sideways = rotations[:, 1, :, 2]
        beside, inside = self._outline.upper_arm_offset * sideways, self._outline.forearm_offset * sideways
        wrist = wrist_1 + (self._outline.forearm_offset - self._geometry.d4) * sideways
        start = [np.zeros_like(shoulder), shoulder, shoulder + beside, elbow + inside]
        start += [wrist, wrist_1, wrist_2, elbow + beside]
        end = [shoulder, shoulder + beside, elbow + beside, wrist, wrist_1, wrist_2, flange, elbow + inside]
        return Capsules(np.stack(start, axis=1), np.stack(end, axis=1), self._radius)

    def touching(self, q: Array, obstacle: Array | None = None) -> Flags:
        """Whether arms at `q` [rad] touch anything, or a ball at `obstacle` [m]. Shapes: (n, 6), (n, 3) -> (n,)."""
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
        arm, link = np.nonzero(lowest < TABLE[1, 2])
        if len(arm):  # the others are above the table
            overlaps = box_distance2(start[arm, link], end[arm, link]) < radius[link] ** 2
            touching[arm[overlaps]] = True
        return touching

    def touching_ball(self, arms: Capsules, middle: Array) -> Flags:
        """Whether a link from the shoulder on overlaps the ball at `middle` (n, 3). Shape: (n,)."""
        start, way = arms.start[:, 1:], arms.end[:, 1:] - arms.start[:, 1:]
        offset = middle[:, None] - start
        share = np.clip(_dot(offset, way) / np.maximum(_dot(way, way), 1e-12), 0.0, 1.0)
        offset -= share[:, :, None] * way
        touching: Flags = np.logical_or.reduce(_dot(offset, offset) < (arms.radius[1:] + RADIUS) ** 2, axis=1)
        return touching


def segment_distance2(start: Array, end: Array, other_start: Array, other_end: Array) -> Array:
    """Squared distances of segments [m^2]; Ericson, "Real-Time Collision Detection", 5.1.9. Shapes: (..., 3) -> (...).

    The nearest points of the lines, each clamped to its segment in turn.
    """
    way, other_way, gap = end - start, other_end - other_start, start - other_start
    a, e = np.maximum(_dot(way, way), 1e-12), np.maximum(_dot(other_way, other_way), 1e-12)
    b, c, f = _dot(way, other_way), _dot(way, gap), _dot(other_way, gap)
    slant = a * e - b * b  # 0 if they are parallel: then any first point will do
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
    """Distances of points (n, 3) outside the table along each axis [m]. Shape: (n, 3)."""
    outside: Array = np.maximum(point - TABLE[1], 0.0) + np.minimum(point - TABLE[0], 0.0)
    return outside


def _dot(one: Array, other: Array) -> Array:
    """Dot products along the last axis, written out so that each is the same in a batch of any size."""
    return one[..., 0] * other[..., 0] + one[..., 1] * other[..., 1] + one[..., 2] * other[..., 2]


class KinematicArm(Memory, Drawn):
    """n arms of one model on a table, which follow commands exactly.

    Args:
        num_robots: Number of arms stepped together.
        ur_model: ur3, ur3e, ur5, ur5e, ur10, ur10e or ur16e.
        period: Time between two commands [s].
        obstacle: Whether there is a moving ball, measured by a tracker.
        randomize: Whether the arm lags behind its set points, by a share of the way from 0 to 0.3, drawn each episode.
    """

    floor, mark_radius = GROUND, 0.025
    memory: Mapping[str, str] = {
        name: f"_{name}" for name in ("position", "velocity", "share", "stamp", "collided", "command")
    }

    def __init__(
        self,
        num_robots: int = 1,
        *,
        ur_model: str = DEFAULT_MODEL,
        period: float,
        obstacle: bool = False,
        randomize: bool = False,
    ) -> None:
        model = model_called(ur_model)
        self.num_robots, self.model, self.randomize = num_robots, model, randomize
        self.spec = ur_spec(model, period, obstacle)
        self._tool = replace(model.geometry, tool=TOOL_LENGTH)
        self._contacts = ArmContacts(model)
        self._obstacles = Obstacles(num_robots) if obstacle else None
        self._halts = 0
        self._low, self._high = np.array(self.spec.command.low), np.array(self.spec.command.high)
        self._reach = np.array(self.spec.command.max_rate) * period
        self._position = np.tile(START, (num_robots, 1))
        self._velocity = np.zeros((num_robots, 6))
        self._share = np.ones((num_robots, 1))
        self._stamp = np.zeros(num_robots)
        self._collided = np.zeros(num_robots, dtype=bool)
        self._command = self._position

    @property
    def setpoint(self) -> Array:
        """Current set points of the joints [rad]. Shape: (n, 6)."""
        setpoint: Array = self._position.copy()
        return setpoint

    @property
    def tool_position(self) -> Callable[[Array], Array]:
        """Forward kinematics of the pads of an assumed gripper: (n, 6) [rad] to (n, 3) [m]."""
        return self._tool.tool_position

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Set these environments to the initial joint positions, at rest, and restart their obstacles."""
        self._require_link()
        self.own_memory()
        self._position[env_ids] = initial.signals["joint_position"]
        self._velocity[env_ids], self._stamp[env_ids] = 0.0, 0.0
        self._command[env_ids] = self._position[env_ids]
        if self.randomize:
            draws = [np.random.default_rng(int(seed)).random() for seed in initial.seeds]
            self._share[env_ids, 0] = 1.0 - (1.0 - LEAST_SHARE) * np.array(draws)
        if self._obstacles is not None:
            self._obstacles.begin(env_ids, initial.signals, initial.seeds)
        self._collided[env_ids] = self._touching()[env_ids]
        return self._measure()

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """See `Drawn`: `command` (n, 6) [rad]; a halt between two parts holds for the rest of the period."""
        self._require_link()
        self._command = checked_command(command, (self.num_robots, 6))
        return self._slices(np.clip(self._command, self._low, self._high), parts)

    def _slices(self, target: Array, parts: int) -> Iterator[RobotState]:
        start, began, halts, period = self._position, self._stamp, self._halts, self.spec.period
        travel = np.clip(target - start, -self._reach, self._reach)
        goal = np.where(np.abs(target - start) <= self._reach, target, start + travel)  # exact if it is in reach
        if self.randomize:
            travel = travel * self._share
            goal = start + travel
        for part in range(1, parts + 1):
            if self._halts == halts:
                self._position = goal if part == parts else start + travel * (part / parts)
                self._velocity = travel / period
            else:
                self._velocity = np.zeros_like(self._velocity)
            self._stamp = began + period * part / parts
            self._collided = self._collided | self._touching()
            yield self._measure()

    def _touching(self) -> NDArray[np.bool_]:
        obstacle = None if self._obstacles is None else self._obstacles.position(self._stamp)
        return self._contacts.touching(self._position, obstacle)

    def _measure(self) -> RobotState:
        signals = {"joint_position": self._position, "joint_velocity": self._velocity}
        if self._obstacles is not None:
            signals["object_position"] = self._obstacles.position(self._stamp)
            signals["object_quaternion"] = np.tile([1.0, 0.0, 0.0, 0.0], (self.num_robots, 1))
        return RobotState(signals, self._stamp, self._command, {"collision": self._collided})

    def halt(self) -> None:
        """Hold the current position."""
        self._halts += 1

    def show(self, state: RobotState) -> None:
        """Put the arm of the one environment where `state` measured it, to draw it."""
        self._position, self._stamp = state.signals["joint_position"], state.stamp

    def picture(self) -> tuple[list[Shape], View]:
        """The arm of environment 0, its table and its ball, from far enough to show the whole arm."""
        x, y, z = (TABLE[1] - TABLE[0]).tolist()
        shapes = [Shape("box", TABLE.mean(axis=0), (x, y, z), WOOD)]
        arms = self._contacts.capsules(self._position[:1])
        for link, (start, end, radius) in enumerate(zip(arms.start[0], arms.end[0], arms.radius, strict=True)):
            colour = GREY if link in (2, 3) else BLUE  # tubes around joints are blue
            shapes.append(Shape("capsule", start, (float(radius),), colour, to=end))
        if self._obstacles is not None:
            shapes.append(Shape("sphere", self._obstacles.position(self._stamp)[0], (RADIUS,), RED))
        reach = self.model.workspace_radius
        return shapes, View((0.0, 0.1 * reach, 0.35 * reach), max(1.6, 2.6 * reach), 140.0, -25.0)

    def state_dict(self) -> dict[str, Any]:
        """The complete state of the simulated robots."""
        return super().state_dict() | ({} if self._obstacles is None else {"obstacles": self._obstacles.state_dict()})

    def load_state_dict(self, state: dict[str, Any]) -> RobotState:
        """Restore the result of `state_dict`; returns the state."""
        self.connect()
        super().load_state_dict(state)
        if self._obstacles is not None:
            self._obstacles.load_state_dict(state["obstacles"])
        return self._measure()


reach_arm = partial(KinematicArm, period=0.1)
empty_arm = partial(KinematicArm, period=0.05)
obstacle_arm = partial(KinematicArm, period=0.05, obstacle=True)
isaac_arm = partial(KinematicArm, period=1 / 30, ur_model="ur10")
