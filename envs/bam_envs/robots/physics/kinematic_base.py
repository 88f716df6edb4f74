"""MiR100 bases in NumPy, many stepped together: the drive and its limits, walls, boxes, contacts and lasers."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, Initial, RobotState, checked_command
from bam_envs.core.task import Memory
from bam_envs.robots.mir100 import (
    BACK_MASKED,
    BACK_MOUNT,
    BACK_RAYS,
    FOOTPRINT,
    FOOTPRINT_AHEAD,
    FRONT_MASKED,
    FRONT_MOUNT,
    FRONT_RAYS,
    SCAN_RANGE,
    SCAN_RAYS,
    SCAN_SPAN,
    base_spec,
)
from bam_envs.robots.physics.drawn import Drawn
from bam_envs.robots.physics.shapes import BLUE, DARK, GREY, RED, WOOD, Colour, Shape, View, turned
from bam_envs.robots.room import BOX_EDGE, LAB, NOWHERE, LaserScanner, Room, measured, mixed, noise, touches

Array = NDArray[np.float64]
_HEIGHT = 0.352  # of a MiR100 [m]
_BODY: tuple[tuple[float, tuple[float, float, float], float, Colour], ...] = (
    (FOOTPRINT_AHEAD, (*FOOTPRINT, _HEIGHT - 0.05), _HEIGHT, BLUE),
    (FOOTPRINT_AHEAD + FOOTPRINT[0] / 2 - 0.1, (0.08, FOOTPRINT[1] - 0.1, 0.02), _HEIGHT + 0.02, DARK),
)
"""Boxes that the base looks like: how far ahead [m], edges [m], height of the top [m], colour."""
_WALL = (0.15, 0.5)  # thickness and height [m]
_LASER_HEIGHT = 0.1914
_EVERY = 6  # every sixth ray is drawn
_STAYS = 2.5  # distance of the base from which the camera follows it [m]
GAIN_SPREAD = 0.05  # largest relative error of the speed of a randomised drive


class SimulatedBase(Memory, Drawn):
    """Bases with the signals of a MiR100, each in a separate room.

    Speeds change no faster than the `max_rate` of the spec, at the beginning of a period; then the base moves along an
    arc. A base that would touch a wall or a box stops instead, and ``truth["collision"]`` is set until `reset`.

    Args:
        num_robots: Number of bases stepped together.
        room: The walls; None for none.
        boxes: Number of boxes in each room.
        with_scans: Whether the laser scanners are on.
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
    ) -> None:
        self.num_robots, self.room, self.randomize = num_robots, room, randomize
        self.spec = base_spec(with_scans=with_scans)
        self.boxes: Array = np.tile(np.array(NOWHERE), (num_robots, boxes, 1))
        """x, y [m] and yaw [rad] of each box. Shape: (n, b, 3)."""
        self.pose: Array = np.zeros((num_robots, 3))
        """x, y [m] and yaw [rad]. Shape: (n, 3)."""
        self._low, self._high = np.array(self.spec.command.low), np.array(self.spec.command.high)
        self._change = np.array(self.spec.command.max_rate) * self.spec.period
        self._velocity, self._command = np.zeros((num_robots, 2)), np.zeros((num_robots, 2))
        self._gain = np.ones((num_robots, 2))
        self._stamp, self._collision = np.zeros(num_robots), np.zeros(num_robots, dtype=bool)
        self._seeds, self._scans = np.zeros(num_robots, np.uint64), np.zeros(num_robots, np.uint64)
        self._scanners = (LaserScanner(FRONT_MOUNT, FRONT_MASKED), LaserScanner(BACK_MOUNT, BACK_MASKED))
        self._seen = np.zeros((num_robots, FRONT_RAYS + BACK_RAYS if with_scans else 0))

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Put these environments at rest at ``base_pose`` (k, 3), and their boxes at ``obstacle_pose`` (k, b, 3).

        Poses are x, y [m] and yaw [rad]. Without them the base is at the origin, and the boxes are nowhere.

        Raises:
            InvalidValue: A base would touch a wall or a box there.
        """
        self._require_link()
        pose = initial.signals.get("base_pose", np.zeros((len(env_ids), 3)))
        boxes = initial.signals.get("obstacle_pose", np.tile(np.array(NOWHERE), (len(env_ids), self.boxes.shape[1], 1)))
        touching = np.flatnonzero(touches(pose, self.room, boxes))
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
            columns = [mixed(self._seeds[env_ids] ^ np.uint64(1 + column)) for column in range(2)]
            self._gain[env_ids] = 1.0 + GAIN_SPREAD * (np.stack(columns, axis=1) / 2.0**63 - 1.0)  # from -1 to 1
        self._scan(env_ids)
        return self._state()

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """See `Drawn`: `command` (n, 2) is the speed forward [m/s] and of turning [rad/s]."""
        self._require_link()
        self._command = checked_command(command, (self.num_robots, 2))
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
        v, w = np.ascontiguousarray(self._velocity.T)
        x, y, yaw = np.ascontiguousarray(self.pose.T)
        turn = w * seconds
        chord = v * seconds * np.sinc(turn / (2 * np.pi))  # sinc(x) is sin(pi x) / (pi x)
        middle = yaw + turn / 2
        yaw = np.mod(yaw + turn + np.pi, 2 * np.pi) - np.pi
        pose = np.stack([x + chord * np.cos(middle), y + chord * np.sin(middle), yaw], axis=1)
        stuck = touches(pose, self.room, self.boxes)
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
        self._seen[env_ids] = measured(true, noise(self._seeds[env_ids], self._scans[env_ids], true.shape[1]))

    def _state(self) -> RobotState:
        signals = {"base_pose": self.pose, "base_velocity": self._velocity}
        if self._seen.shape[1]:
            signals |= {"f_scan": self._seen[:, :FRONT_RAYS], "b_scan": self._seen[:, FRONT_RAYS:]}
        truth: dict[str, Any] = {"collision": self._collision, "obstacle_pose": self.boxes}
        return RobotState(signals, self._stamp, self._command, truth)

    def halt(self) -> None:
        """Stop at once."""
        self._velocity, self._command = np.zeros_like(self._velocity), np.zeros_like(self._command)

    def show(self, state: RobotState) -> None:
        """Put the base of the one environment where `state` measured it, with what its scanners saw, to draw it."""
        self.pose = state.signals["base_pose"]
        if self._seen.shape[1]:
            self._seen = np.concatenate([state.signals["f_scan"], state.signals["b_scan"]], axis=1)

    def picture(self) -> tuple[list[Shape], View]:
        """The base of environment 0, its room and boxes, and its laser ranges.

        From above: the whole room; without a room, the camera follows the base once it is far from the origin.
        """
        pose, seen, rotation = self.pose[0], self._seen[0], turned(float(self.pose[0, 2]))
        shapes = []
        for ahead, edges, top, colour in _BODY:  # a dark bar marks the front
            middle = np.array([pose[0], pose[1], top - edges[2] / 2]) + rotation @ [ahead, 0.0, 0.0]
            shapes.append(Shape("box", middle, edges, colour, rotation))
        shapes += [] if self.room is None else wall_shapes(self.room)
        for x, y, yaw in self.boxes[0]:
            shapes.append(Shape("box", np.array([x, y, BOX_EDGE / 2]), (BOX_EDGE,) * 3, WOOD, turned(yaw)))
        if len(seen):
            shapes += scan_shapes(pose, seen[:FRONT_RAYS], seen[FRONT_RAYS:])
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


def scan_shapes(pose: Array, front: Array, back: Array) -> list[Shape]:
    """Dots at the ends of some rays of the base at `pose` (3,), whose scanners measure `front` and `back` [m]."""
    dots = []
    for mount, masked, ranges in ((FRONT_MOUNT, FRONT_MASKED, front), (BACK_MOUNT, BACK_MASKED, back)):
        bearing = np.linspace(*SCAN_SPAN, SCAN_RAYS)[masked[0] : SCAN_RAYS - masked[1]][::_EVERY]
        ends = ranges[::_EVERY] < SCAN_RANGE[1]  # the others meet nothing
        eye = pose[:2] + turned(float(pose[2]))[:2, :2] @ np.array(mount[:2])
        heading, far = float(pose[2]) + mount[2] + bearing[ends], ranges[::_EVERY][ends, None]
        for x, y in eye + far * np.stack([np.cos(heading), np.sin(heading)], axis=1):
            dots.append(Shape("sphere", np.array([x, y, _LASER_HEIGHT]), (0.03,), RED))
    return dots


open_floor = partial(SimulatedBase, room=None, with_scans=False)
lab = partial(SimulatedBase, boxes=3)
