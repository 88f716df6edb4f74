"""A robot without physics, for tests: the joints follow commands exactly, at most at the arm's maximum speed."""

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
    """Arms with the signals of a UR5e that follow commands exactly; the object, if there is one, does not move.

    A command is clipped to the limits and the `max_rate` of the spec, and reached within the period.
    """

    def __init__(self, num_robots: int = 1, *, with_object: bool = True) -> None:
        self.num_robots = num_robots
        self.spec = arm_spec("fake", with_object=with_object)
        self.sent: list[Array] = []
        """Every command since the robot was made, before clipping. Shape: (n, 7) each."""
        self.halts = 0
        """Number of calls of `halt`."""
        self._connected = False
        self._low, self._high = np.array(self.spec.command.low), np.array(self.spec.command.high)
        self._reach = np.array(self.spec.command.max_rate) * self.spec.period
        position = np.tile([0.0] * 6 + [GRIPPER_OPEN], (num_robots, 1))
        # Every array is replaced, never changed, so that returned states keep their numbers.
        self._now = {
            "position": position,
            "velocity": np.zeros((num_robots, 6)),
            "object": np.tile([0.5, 0.0, OBJECT_HEIGHT, 1.0, 0.0, 0.0, 0.0], (num_robots, 1)),
            "stamp": np.zeros(num_robots),
            "command": position,
        }

    def connect(self) -> None:
        """Accept commands from now on."""
        self._connected = True

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Set these environments to the initial joint positions and object pose, at rest, the gripper open."""
        self._require_link()
        self._now = now = self.state_dict()
        now["position"][env_ids, :6], now["position"][env_ids, 6] = initial.signals["joint_position"], GRIPPER_OPEN
        now["velocity"][env_ids], now["stamp"][env_ids] = 0.0, 0.0
        now["command"][env_ids] = now["position"][env_ids]
        return self.place_object(initial.signals.get("object_pose"), initial.seeds, env_ids)

    def place_object(
        self, pose: Array | None, seeds: NDArray[np.int64], env_ids: EnvIds | slice = slice(None)
    ) -> RobotState:
        """Put the objects at x, y [m] and yaw [rad] of `pose` (k, 3), or leave them; `seeds` are not used."""
        self._require_link()
        if pose is not None:
            self._now["object"] = placed = self._now["object"].copy()
            placed[env_ids, :2], placed[env_ids, 2] = pose[:, :2], OBJECT_HEIGHT
            placed[env_ids, 3], placed[env_ids, 6] = np.cos(pose[:, 2] / 2), np.sin(pose[:, 2] / 2)
        return self.measure()

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, 7): six joint positions [rad] and the gripper's width [m]; one period later, measure."""
        return next(self.slices(command, 1))

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """Send `command` (n, 7), and yield the state after each of `parts` equal parts of the period."""
        self._require_link()
        self._now["command"] = checked_command(command, (self.num_robots, 7))
        self.sent.append(self._now["command"].copy())
        return self._slices(np.clip(self._now["command"], self._low, self._high), parts)

    def _slices(self, target: Array, parts: int) -> Iterator[RobotState]:
        start, began, halts = self._now["position"], self._now["stamp"], self.halts
        near = np.abs(target - start) <= self._reach
        travel = np.clip(target - start, -self._reach, self._reach)
        for part in range(1, parts + 1):
            if self.halts == halts:
                self._now["position"] = np.where(near & (part == parts), target, start + travel * (part / parts))
                self._now["velocity"] = travel[:, :6] / self.spec.period
            else:
                self._now["velocity"] = np.zeros_like(self._now["velocity"])
            self._now["stamp"] = began + self.spec.period * part / parts
            yield self.measure()

    def measure(self) -> RobotState:
        """The current state."""
        self._require_link()
        position, place = self._now["position"], self._now["object"]
        values = [position[:, :6], self._now["velocity"], position[:, 6:], place[:, :3], place[:, 3:]]
        names = [signal.name for signal in self.spec.signals]  # without an object the last two are not measured
        return RobotState(dict(zip(names, values, strict=False)), self._now["stamp"], self._now["command"])

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
        """The complete state of the robots."""
        return {name: array.copy() for name, array in self._now.items()}

    def load_state_dict(self, state: dict[str, Any]) -> RobotState:
        """Restore the result of `state_dict`; returns the state."""
        self.connect()
        self._now = {name: np.array(state[name]) for name in self._now}
        return self.measure()
