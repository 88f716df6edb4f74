"""A robot without physics, for tests: the joints go exactly where they are sent, at most at the arm's maximum speed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ResetNeeded
from bam_envs.core.robot import EnvIds, Initial, RobotState, checked_command
from bam_envs.robots.ur5e import GRIPPER_OPEN, arm_spec

Array = NDArray[np.float64]
OBJECT_HEIGHT = 0.02
"""Height of the object's middle above the table [m]."""


class FakeRobot:
    """Arms with the signals of a UR5e, moved exactly; the object, if there is one, stays where it is.

    A command is cut to the limits and the `max_rate` of the spec, and reached within the period.

    Args:
        num_robots: How many are stepped together.
        with_object: Whether there is an object, seen by a tracker.
    """

    def __init__(self, num_robots: int = 1, *, with_object: bool = True) -> None:
        self.num_robots = num_robots
        self.spec = arm_spec("fake", with_object=with_object)
        self.sent: list[Array] = []
        """Every command since the robot was made, as it was given. Shape: (n, 7) each."""
        self.halts = 0
        """How often `halt` was called."""
        self._with_object = with_object
        self._connected = False
        self._low, self._high = np.array(self.spec.command.low), np.array(self.spec.command.high)
        self._reach = np.array(self.spec.command.max_rate) * self.spec.period
        self._position = np.tile([0.0] * 6 + [GRIPPER_OPEN], (num_robots, 1))
        self._velocity = np.zeros((num_robots, 6))
        self._object = np.tile([0.5, 0.0, OBJECT_HEIGHT, 1.0, 0.0, 0.0, 0.0], (num_robots, 1))
        self._stamp = np.zeros(num_robots)
        self._command = self._position

    def connect(self) -> None:
        """Take commands from now on."""
        self._connected = True

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Set these environments to the initial joint positions and object pose, at rest, the gripper open."""
        self._require_link()
        self._position, self._object = self._position.copy(), self._object.copy()
        self._velocity, self._stamp = self._velocity.copy(), self._stamp.copy()
        self._position[env_ids, :6], self._position[env_ids, 6] = initial.signals["joint_position"], GRIPPER_OPEN
        self._velocity[env_ids], self._stamp[env_ids] = 0.0, 0.0
        self._command = self._command.copy()
        self._command[env_ids] = self._position[env_ids]
        if "object_pose" in initial.signals:
            self._place_object(env_ids, initial.signals["object_pose"])
        return self._measure()

    def _place_object(self, env_ids: EnvIds, pose: Array) -> None:
        """Put the object at x, y [m] and yaw [rad] of `pose` (k, 3)."""
        self._object[env_ids, :2], self._object[env_ids, 2] = pose[:, :2], OBJECT_HEIGHT
        self._object[env_ids, 3], self._object[env_ids, 6] = np.cos(pose[:, 2] / 2), np.sin(pose[:, 2] / 2)

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, 7): six joint positions [rad] and the gripper's width [m]; one period later, measure."""
        return next(self.slices(command, 1))

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """Send `command` (n, 7), and give the state after each of `parts` equal parts of the period."""
        self._require_link()
        self._command = checked_command(command, (self.num_robots, 7))
        self.sent.append(self._command.copy())
        return self._slices(np.clip(self._command, self._low, self._high), parts)

    def _slices(self, target: Array, parts: int) -> Iterator[RobotState]:
        start, began, halts = self._position, self._stamp, self.halts
        near = np.abs(target - start) <= self._reach
        travel = np.clip(target - start, -self._reach, self._reach)
        for part in range(1, parts + 1):
            if self.halts == halts:
                last = part == parts
                self._position = np.where(near & last, target, start + travel * (part / parts))
                self._velocity = travel[:, :6] / self.spec.period
            else:
                self._velocity = np.zeros_like(self._velocity)
            self._stamp = began + self.spec.period * part / parts
            yield self._measure()

    def place_object(self, pose: Array | None, seeds: NDArray[np.int64]) -> RobotState:
        """Put the object at x, y [m] and yaw [rad] of `pose` (n, 3), or leave it; nothing is drawn from `seeds`."""
        self._require_link()
        if pose is not None:
            self._object = self._object.copy()
            self._place_object(np.arange(self.num_robots), pose)
        return self._measure()

    def _measure(self) -> RobotState:
        signals = {
            "joint_position": self._position[:, :6],
            "joint_velocity": self._velocity,
            "gripper_width": self._position[:, 6:],
        }
        if self._with_object:
            signals |= {"object_position": self._object[:, :3], "object_quaternion": self._object[:, 3:]}
        return RobotState(signals, self._stamp, self._command)

    def _require_link(self) -> None:
        if not self._connected:
            raise ResetNeeded("The fake robot is not connected. Call connect() first.")

    def halt(self) -> None:
        """Count the call: the robot never moves between steps."""
        self.halts += 1

    def close(self) -> None:
        """Halt, and take no command until `connect`."""
        self.halt()
        self._connected = False

    def state_dict(self) -> dict[str, Any]:
        """Everything the future of the robots depends on."""
        arrays = (self._position, self._velocity, self._object, self._stamp, self._command)
        names = ("position", "velocity", "object", "stamp", "command")
        return {name: array.copy() for name, array in zip(names, arrays, strict=True)}

    def load_state_dict(self, state: dict[str, Any]) -> RobotState:
        """Go to what `state_dict` returned; the state there."""
        self.connect()
        self._position, self._velocity = np.array(state["position"]), np.array(state["velocity"])
        self._object, self._stamp = np.array(state["object"]), np.array(state["stamp"])
        self._command = np.array(state["command"])
        return self._measure()
