"""A simulated robot that replaces a live one, in this process and in simulated time; its driver can misbehave."""

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, Initial, Robot, RobotState
from bam_envs.safety.gate import ClearedCommand
from bam_envs.safety.guard import is_base

Array = NDArray[np.float64]
FAULTS = ("ignore", "slow", "delay")
_PARTS = 5
_ROUNDING = 1e-9


class DrivenRobot:
    """One simulated `robot` with the interface of a live one: it takes cleared commands, and `reset` moves nothing.

    ``SafeRobot(driven, clock=driven.clock)`` is its gate; `place` it before the first `reset`.
    """

    needs_clearance = True
    num_robots = 1
    info = None

    def __init__(self, robot: Robot) -> None:
        self.robot, self.spec = robot, robot.spec
        self.now = 0.0  # see `clock`
        self.fastest = 0.0
        """Fastest joint [rad/s], or drive [m/s] or turn [rad/s], measured since this was set to 0."""
        self._state: RobotState | None = None
        self._fault, self._begins, self._ends, self._number = "", math.inf, -math.inf, 0.0
        self._followed: Array = np.zeros((1, len(robot.spec.command.labels)))  # what the driver follows
        self._late: deque[tuple[float, Array]] = deque()
        self._is_base = is_base(robot.spec)

    def clock(self) -> float:
        """Simulated time [s]."""
        return self.now

    def misbehave(self, fault: str, seconds: float, number: float = 0.0, after: float = 0.0) -> None:
        """Stop following commands in `after` [s], for `seconds` [s]; then follow the newest one at once.

        The `fault` is ``"ignore"``: the robot holds its position; ``"slow"``: it is no faster than `number`, a joint
        [rad/s], a base [m/s, rad/s]; or ``"delay"``: commands arrive `number` [s] late.
        """
        if fault not in FAULTS:
            raise InvalidValue(f"A driver can {', '.join(FAULTS)}, not {fault!r}.")
        self._fault, self._number, self._begins = fault, number, self.now + after
        self._ends = self._begins + seconds
        self._late.clear()

    def connect(self) -> None:
        """Connect the simulated robot."""
        self.robot.connect()

    def place(self, initial: Initial) -> None:
        """Put the simulated robot at `initial`, at rest."""
        self._state = self.robot.reset(np.zeros(1, np.int64), initial)
        self._followed = self._state.command.copy()

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Measure; only the object moves, to its pose in `initial`."""
        place: Any = getattr(self.robot, "place_object", None)
        if place is not None:
            self._state = place(initial.signals.get("object_pose"), initial.seeds)
        return self.measure()

    def measure(self) -> RobotState:
        """The newest state."""
        if self._state is None:
            raise InvalidValue("The robot has no position yet. Call place(initial) first.")
        return self._state

    def age(self) -> float:
        """Always 0: a simulation measures at once."""
        return 0.0

    def step(self, command: ClearedCommand) -> RobotState:
        """Step one period, with `command` as the driver follows it."""
        self._followed = self._driven(command.for_robot(self).copy())
        slices: Any = getattr(self.robot, "slices", None)
        for state in [self.robot.step(self._followed)] if slices is None else slices(self._followed, _PARTS):
            speed = state.signals["base_velocity" if self._is_base else "joint_velocity"]
            self.fastest = max(self.fastest, float(np.abs(speed).max()))
            self._state = state
        self.now += self.spec.period
        return self.measure()

    def _driven(self, command: Array) -> Array:
        """The driver's command to the robot for `command`. Shape: (1, m) both."""
        if not self._begins - _ROUNDING <= self.now < self._ends - _ROUNDING:
            return command
        if self._fault == "delay":
            self._late.append((self.now + self._number, command))
            followed = self._followed
            while self._late and self._late[0][0] <= self.now + _ROUNDING:
                followed = self._late.popleft()[1]
            return followed
        if self._fault == "slow":
            reach, about = (self._number, 0.0) if self._is_base else (self._number * self.spec.period, self._followed)
            return np.clip(command, about - reach, about + reach)
        if self.now < self._begins + self.spec.period - _ROUNDING:
            self._stand()
        return self._followed

    def _stand(self) -> None:
        self.robot.halt()
        if self._is_base:
            self._followed = np.zeros_like(self._followed)
        elif self._state is not None:
            self._followed = np.concatenate([self._state.signals["joint_position"], self._followed[:, 6:]], axis=1)

    def halt(self) -> None:
        """Hold the current position; delayed commands are dropped."""
        self._late.clear()
        self._stand()

    def close(self) -> None:
        """Halt and close the simulated robot."""
        self.robot.close()
