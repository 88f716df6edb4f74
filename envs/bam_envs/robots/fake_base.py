"""A MiR100 without physics, for tests and to be served: it drives exactly as it is told, in a room of four walls."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.errors import ResetNeeded
from bam_envs.robots.mir100 import (
    BACK_MASKED,
    BACK_MOUNT,
    FOOTPRINT,
    FRONT_MASKED,
    FRONT_MOUNT,
    SCAN_RANGE,
    SCAN_RAYS,
    SCAN_SPAN,
    base_spec,
)
from bam_envs.robots.robot import Initial, RobotState, Rows, checked_command

Array = NDArray[np.float64]
ROOM = (10.0, 8.0)
"""Length and width of the room, whose middle is the origin [m]."""
_TOUCH = math.hypot(*FOOTPRINT) / 2
_REACH = np.array(ROOM) / 2 - _TOUCH


class FakeBase:
    """Bases with the signals of a MiR100 and a room each.

    Speeds change no faster than the `max_rate` of the spec. A base that would touch a wall stands still instead.

    Args:
        num_robots: How many are stepped together.
        with_scans: Whether they have laser scanners.
    """

    def __init__(self, num_robots: int = 1, *, with_scans: bool = True) -> None:
        self.num_robots = num_robots
        self.spec = base_spec("fake base", with_scans=with_scans)
        self.halts = 0
        """How often `halt` was called."""
        self._with_scans, self._connected = with_scans, False
        self._low, self._high = np.array(self.spec.command.low), np.array(self.spec.command.high)
        self._change = np.array(self.spec.command.max_rate) * self.spec.period
        self._pose, self._velocity = np.zeros((num_robots, 3)), np.zeros((num_robots, 2))
        self._stamp, self._command = np.zeros(num_robots), np.zeros((num_robots, 2))

    def connect(self) -> None:
        """There is nothing to connect to; commands are taken from now on."""
        self._connected = True

    def reset(self, rows: Rows, initial: Initial) -> RobotState:
        """Put `rows` at rest at ``base_pose`` (k, 3): x, y [m], yaw [rad]; or where none is given, in the middle."""
        self._require_link()
        self._pose, self._velocity = self._pose.copy(), self._velocity.copy()
        self._stamp, self._command = self._stamp.copy(), self._command.copy()
        self._pose[rows] = initial.signals.get("base_pose", np.zeros((len(rows), 3)))
        self._velocity[rows], self._stamp[rows], self._command[rows] = 0.0, 0.0, 0.0
        return self._measure()

    def step(self, command: Array) -> RobotState:
        """Drive with `command` (n, 2), forward [m/s] and turning anticlockwise [rad/s]; one period later, measure."""
        return next(self.slices(command, 1))

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """Send `command` (n, 2), and give the state after each of `parts` equal parts of the period."""
        self._require_link()
        self._command = checked_command(command, (self.num_robots, 2))
        target = np.clip(self._command, self._low, self._high)
        self._velocity = self._velocity + np.clip(target - self._velocity, -self._change, self._change)
        return self._slices(parts)

    def _slices(self, parts: int) -> Iterator[RobotState]:
        began = self._stamp
        for part in range(1, parts + 1):
            self._drive(self.spec.period / parts)
            self._stamp = began + self.spec.period * part / parts
            yield self._measure()

    def _drive(self, seconds: float) -> None:
        """Go along the arc of the present speeds."""
        (v, w), yaw = self._velocity.T, self._pose[:, 2]
        chord = v * seconds * np.sinc(w * seconds / (2 * np.pi))  # sinc(x) is sin(pi x) / (pi x)
        middle = yaw + w * seconds / 2
        pose = self._pose + np.stack([chord * np.cos(middle), chord * np.sin(middle), w * seconds], axis=1)
        pose[:, 2] = np.mod(pose[:, 2] + np.pi, 2 * np.pi) - np.pi
        free = (np.abs(pose[:, :2]) <= _REACH).all(axis=1)[:, None]
        self._pose, self._velocity = np.where(free, pose, self._pose), np.where(free, self._velocity, 0.0)

    def _measure(self) -> RobotState:
        signals = {"base_pose": self._pose, "base_velocity": self._velocity}
        if self._with_scans:
            signals |= {"f_scan": self._scan(FRONT_MOUNT, FRONT_MASKED), "b_scan": self._scan(BACK_MOUNT, BACK_MASKED)}
        return RobotState(signals, self._stamp, self._command)

    def _scan(self, mount: tuple[float, float, float], masked: tuple[int, int]) -> Array:
        """How far each ray of a scanner goes to a wall [m]. Shape: (n, rays)."""
        x, y, yaw = self._pose.T
        bearing = yaw[:, None] + mount[2] + np.linspace(*SCAN_SPAN, SCAN_RAYS)[masked[0] : SCAN_RAYS - masked[1]]
        eye = np.stack(
            [x + mount[0] * np.cos(yaw) - mount[1] * np.sin(yaw), y + mount[0] * np.sin(yaw) + mount[1] * np.cos(yaw)],
            axis=1,
        )
        return np.clip(_to_walls(eye, bearing), *SCAN_RANGE)

    def _require_link(self) -> None:
        if not self._connected:
            raise ResetNeeded("The fake base is not connected. Call connect() first.")

    def halt(self) -> None:
        """Stand still, and count the call."""
        self.halts += 1
        self._velocity, self._command = np.zeros_like(self._velocity), np.zeros_like(self._command)

    def close(self) -> None:
        """Halt; no command is taken until `connect`."""
        self.halt()
        self._connected = False

    def state_dict(self) -> dict[str, Any]:
        """Everything the future of the bases depends on."""
        arrays = (self._pose, self._velocity, self._stamp, self._command)
        return {name: array.copy() for name, array in zip(_MEMORY, arrays, strict=True)}

    def load_state_dict(self, state: dict[str, Any]) -> RobotState:
        """Go to what `state_dict` returned; the state there."""
        self.connect()
        self._pose, self._velocity, self._stamp, self._command = (np.array(state[name]) for name in _MEMORY)
        return self._measure()


_MEMORY = ("pose", "velocity", "stamp", "command")


def _to_walls(eye: Array, bearing: Array) -> Array:
    """Distance from `eye` (n, 2), inside the room, to its walls in each direction `bearing` (n, k) [rad]."""
    direction = np.stack([np.cos(bearing), np.sin(bearing)], axis=2)
    wall = np.copysign(np.array(ROOM) / 2, direction)
    with np.errstate(divide="ignore"):
        distance: Array = ((wall - eye[:, None]) / direction).min(axis=2)
    return distance
