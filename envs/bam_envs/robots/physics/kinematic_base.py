"""Wheeled bases in NumPy, many stepped together: the drive and its limits, walls, boxes, contacts and lasers."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, Initial, RobotState, Scanner, checked_command
from bam_envs.core.robot_models import DEFAULT_BASE
from bam_envs.core.task import Memory
from bam_envs.robots.base_description import BaseDescription, base_model
from bam_envs.robots.physics.drawn import Drawn
from bam_envs.robots.physics.shapes import BLUE, DARK, GREY, RED, WOOD, Shape, View, turned
from bam_envs.robots.room import BOX_EDGE, LAB, NOWHERE, LaserScanner, Room, measured, mixed, noise, room_for, touches

Array = NDArray[np.float64]
_WALL = (0.15, 0.5)  # thickness and height [m]
_EVERY = 6  # every sixth ray is drawn
_STAYS = 2.5  # distance of the base from which the camera follows it [m]
GAIN_SPREAD = 0.05  # largest relative error of the speed of a randomised drive


class SimulatedBase(Memory, Drawn):
    """Bases of one description, each in a separate room.

    Speeds change no faster than the `max_rate` of the spec, at the beginning of a period; then the base moves along an
    arc. A base that would touch a wall or a box stops instead, and ``truth["collision"]`` is set until `reset`.

    Args:
        num_robots: Number of bases stepped together.
        room: The walls; None for none.
        boxes: Number of boxes in each room.
        with_scans: Whether the laser scanners are on.
        robot_model: The base; see `bam_envs.core.robot_models.find_model`.
        randomize: Whether the drive has a speed error, drawn for each episode.
    """

    mark_radius = 0.2
    memory: Mapping[str, str] = {
        "pose": "pose",
        "boxes": "boxes",
        **{name: f"_{name}" for name in ("velocity", "command", "stamp", "collision", "gain", "seeds", "scans")},
    }

    def __init__(
        self,
        num_robots: int = 1,
        *,
        room: Room | None = LAB,
        boxes: int = 0,
        with_scans: bool = True,
        randomize: bool = False,
        robot_model: Any = DEFAULT_BASE,
    ) -> None:
        self.num_robots, self.room, self.randomize = num_robots, room, randomize
        self.description = base_model(robot_model)
        self.body, self.spec = self.description.body, self.description.spec(with_scans=with_scans)
        self._lasers = self.body.scanners if with_scans else ()
        self.boxes: Array = np.tile(np.array(NOWHERE), (num_robots, boxes, 1))
        """x, y [m] and yaw [rad] of each box. Shape: (n, b, 3)."""
        self.pose: Array = np.zeros((num_robots, 3))
        """x, y [m] and yaw [rad]. Shape: (n, 3)."""
        self._low, self._high = np.array(self.spec.command.low), np.array(self.spec.command.high)
        self._change = np.array(self.spec.command.max_rate) * self.spec.period
        axes = len(self._change)
        self._velocity, self._command = np.zeros((num_robots, axes)), np.zeros((num_robots, axes))
        self._gain = np.ones((num_robots, axes))
        self._stamp, self._collision = np.zeros(num_robots), np.zeros(num_robots, dtype=bool)
        self._seeds, self._scans = np.zeros(num_robots, np.uint64), np.zeros(num_robots, np.uint64)
        self._scanners = [LaserScanner(scanner) for scanner in self._lasers]
        self._seen = np.zeros((num_robots, sum(len(scanner.bearings) for scanner in self._lasers)))

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Put these environments at rest at ``base_pose`` (k, 3), and their boxes at ``obstacle_pose`` (k, b, 3).

        Poses are x, y [m] and yaw [rad]. Without them the base is at the origin, and the boxes are nowhere.

        Raises:
            InvalidValue: A base would touch a wall or a box there.
        """
        self._require_link()
        pose = initial.signals.get("base_pose", np.zeros((len(env_ids), 3)))
        boxes = initial.signals.get("obstacle_pose", np.tile(np.array(NOWHERE), (len(env_ids), self.boxes.shape[1], 1)))
        touching = np.flatnonzero(touches(self.body, pose, self.room, boxes))
        if len(touching):
            where, walls = np.round(pose[touching[0]], 3).tolist(), ""
            if self.room is not None:
                (left, bottom), (right, top) = self.room.low, self.room.high
                walls = f" The walls are at x {left:g} and {right:g} m, y {bottom:g} and {top:g} m."
            raise InvalidValue(
                f"The base cannot start at {where} (x, y [m], yaw [rad]): it touches a wall or a box there.{walls}"
            )
        self.own_memory()
        self._seen = self._seen.copy()  # states that were returned keep theirs
        self.pose[env_ids], self.boxes[env_ids] = pose, boxes
        self._velocity[env_ids], self._stamp[env_ids], self._command[env_ids] = 0.0, 0.0, 0.0
        self._collision[env_ids], self._scans[env_ids] = False, 0
        self._seeds[env_ids] = mixed(initial.seeds.astype(np.uint64))
        if self.randomize:
            columns = [mixed(self._seeds[env_ids] ^ np.uint64(1 + column)) for column in range(len(self._change))]
            self._gain[env_ids] = 1.0 + GAIN_SPREAD * (np.stack(columns, axis=1) / 2.0**63 - 1.0)  # from -1 to 1
        self._scan(env_ids)
        return self._state()

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """See `Drawn`: `command` (n, m) has the speeds of the spec [m/s, rad/s]."""
        self._require_link()
        self._command = checked_command(command, self._command.shape)
        target = np.clip(self._command, self._low, self._high) * self._gain
        self._velocity = self._velocity + np.clip(target - self._velocity, -self._change, self._change)
        return self._slices(parts)

    def _slices(self, parts: int) -> Iterator[RobotState]:
        began = self._stamp
        for part in range(1, parts + 1):
            self._drive(self.spec.period / parts)
            self._stamp = began + self.spec.period * part / parts
            self._scans = self._scans + np.uint64(1)
            self._seen = np.empty_like(self._seen)
            self._scan(np.arange(self.num_robots))
            yield self._state()

    def _drive(self, seconds: float) -> None:
        """Move along the arc of the current speeds; a base that would touch something stops."""
        v, *aside, w = np.ascontiguousarray(self._velocity.T)
        x, y, yaw = np.ascontiguousarray(self.pose.T)
        turn = w * seconds
        shorter = np.sinc(turn / (2 * np.pi))  # sinc(x) is sin(pi x) / (pi x)
        middle = yaw + turn / 2
        for speed, way in ((v, middle), *((one, middle + np.pi / 2) for one in aside)):
            chord = speed * seconds * shorter
            x, y = x + chord * np.cos(way), y + chord * np.sin(way)
        yaw = np.mod(yaw + turn + np.pi, 2 * np.pi) - np.pi
        pose = np.stack([x, y, yaw], axis=1)
        stuck = touches(self.body, pose, self.room, self.boxes)
        if stuck.any():
            pose[stuck] = self.pose[stuck]
            self._velocity = np.where(stuck[:, None], 0.0, self._velocity)
            self._collision = self._collision | stuck
        self.pose = pose

    def _scan(self, env_ids: EnvIds) -> None:
        """Measure the ranges of the scanners of these environments."""
        if not self._seen.shape[1]:
            return
        pose, boxes = self.pose[env_ids], self.boxes[env_ids]
        true = np.concatenate([scanner.cast(pose, self.room, boxes) for scanner in self._scanners], axis=1)
        self._seen[env_ids] = measured(
            true, noise(self._seeds[env_ids], self._scans[env_ids], true.shape[1]), self._lasers
        )

    def _scans_of(self, seen: Array) -> Iterator[tuple[Scanner, Array]]:
        """Each scanner, and its part of the ranges `seen` (..., rays)."""
        begin = 0
        for scanner in self._lasers:
            end = begin + len(scanner.bearings)
            yield scanner, seen[..., begin:end]
            begin = end

    def _state(self) -> RobotState:
        signals = {"base_pose": self.pose, "base_velocity": self._velocity}
        signals |= {scanner.signal: seen for scanner, seen in self._scans_of(self._seen)}
        truth: dict[str, Any] = {"collision": self._collision, "obstacle_pose": self.boxes}
        return RobotState(signals, self._stamp, self._command, truth)

    def halt(self) -> None:
        """Stop at once."""
        self._velocity, self._command = np.zeros_like(self._velocity), np.zeros_like(self._command)

    def show(self, state: RobotState) -> None:
        """Put the base of the one environment where `state` measured it, with what its scanners saw, to draw it."""
        self.pose = state.signals["base_pose"]
        if self._seen.shape[1]:
            self._seen = np.concatenate([state.signals[scanner.signal] for scanner in self._lasers], axis=1)

    def picture(self) -> tuple[list[Shape], View]:
        """The base of environment 0, its room and boxes, and its laser ranges.

        From above: the whole room; without a room, the camera follows the base once it is far from the origin.
        """
        pose, seen, rotation = self.pose[0], self._seen[0], turned(float(self.pose[0, 2]))
        shapes = base_shapes(self.description, pose, rotation)
        shapes += [] if self.room is None else wall_shapes(self.room)
        for x, y, yaw in self.boxes[0]:
            shapes.append(Shape("box", np.array([x, y, BOX_EDGE / 2]), (BOX_EDGE,) * 3, WOOD, turned(yaw)))
        for scanner, ranges in self._scans_of(seen):
            shapes += scan_shapes(pose, scanner, ranges)
        x, y = pose[:2] - np.clip(pose[:2], -_STAYS, _STAYS) if self.room is None else (0.0, 0.0)
        return shapes, View((round(float(x), 3), round(float(y), 3), 0.0), 11.0, 90.0, -65.0)

    def load_state_dict(self, state: dict[str, Any]) -> RobotState:
        """Restore the result of `state_dict`; returns the state."""
        self.connect()
        super().load_state_dict(state)
        self._seen = np.empty_like(self._seen)
        self._scan(np.arange(self.num_robots))
        return self._state()


def wall_shapes(room: Room) -> list[Shape]:
    """The four walls around `room`."""
    low, high, (thick, height) = np.array(room.low), np.array(room.high), _WALL
    middle, edges = (low + high) / 2, high - low + 2 * thick
    walls = []
    for side, out in ((low, -thick / 2), (high, thick / 2)):
        x, y = side + out
        walls.append(Shape("box", np.array([x, middle[1], height / 2]), (thick, float(edges[1]), height), GREY))
        walls.append(Shape("box", np.array([middle[0], y, height / 2]), (float(edges[0]), thick, height), GREY))
    return walls


def base_shapes(description: BaseDescription, pose: Array, rotation: Array) -> list[Shape]:
    """The body of a base at `pose` (3,): a disc, or the box around its footprint; a dark bar marks the front."""
    body, height = description.body, description.height
    length, left, right = body.front + body.back, body.reach(0.0, 1.0), body.reach(0.0, -1.0)
    ahead, across = (body.front - body.back) / 2, (left - right) / 2
    thick = height - 0.05
    middle = np.array([pose[0], pose[1], height - thick / 2]) + rotation @ [ahead, across, 0.0]
    shapes = [Shape("box", middle, (length, left + right, thick), BLUE, rotation)]
    if body.radius:
        shapes = [Shape("cylinder", middle, (body.radius, thick / 2), BLUE)]
    middle = np.array([pose[0], pose[1], height + 0.01]) + rotation @ [body.front - 0.1, across, 0.0]
    return [*shapes, Shape("box", middle, (0.08, max(0.02, left + right - 0.1), 0.02), DARK, rotation)]


def scan_shapes(pose: Array, scanner: Scanner, ranges: Array) -> list[Shape]:
    """Dots at the ends of some rays of a scanner of the base at `pose` (3,), which measures `ranges` [m]."""
    ranges, bearing = ranges[::_EVERY], np.array(scanner.bearings)[::_EVERY]
    ends = ranges < scanner.range[1]  # the others meet nothing
    eye = pose[:2] + turned(float(pose[2]))[:2, :2] @ np.array(scanner.pose[:2])
    heading, far = float(pose[2]) + scanner.pose[2] + bearing[ends], ranges[ends, None]
    places = eye + far * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return [Shape("sphere", np.array([x, y, scanner.height]), (0.03,), RED) for x, y in places]


def lab(num_robots: int = 1, *, robot_model: Any = DEFAULT_BASE, **options: Any) -> SimulatedBase:
    """Bases in a room with three boxes, as large as `room_for` says."""
    description = base_model(robot_model)
    scale = room_for(description.body)
    low, high = ((scale * x, scale * y) for x, y in (LAB.low, LAB.high))
    return SimulatedBase(num_robots, room=Room(low, high), boxes=3, robot_model=description, **options)


open_floor = partial(SimulatedBase, room=None, with_scans=False)
