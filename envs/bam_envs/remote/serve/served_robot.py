"""One robot that an environment, topics and a clock share: its time and its command timeout.

Time passes in one of two modes. Fast: each step takes a period at once, and no time passes between steps. In real time:
a clock calls `ServedRobot.tick`, a command is executed over the period that follows it, and without fresh commands the
robot rests.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import RemoteError, ResetNeeded, RobotFault
from bam_envs.core.robot import EnvIds, Initial, Robot, RobotState, checked_command

Array = NDArray[np.float64]

CATCH_UP = 1.2
"""Speed at which a robot whose clock stood still catches up with its commands, as a multiple of theirs."""
LONGEST_LOST = 0.5
"""Longest time that a robot catches up [s]."""
_STEP = 1e-4
"""Least change between two commands that tells their speed [rad, m]."""
PARTS = 5
"""Ticks per period of robots that can be stepped in parts (`slices`); others are stepped a period at a time."""


class ServedRobot:
    """A Robot around a Robot, for several threads.

    Args:
        robot: The robot that moves.
        command_timeout: Longest time for which a command is executed [s].
        zero_rests: Whether a command of zeros is rest, as for speeds; else the robot rests at its position.
        realtime: Whether time passes in real time; see the module.
        patience: In real time, longest wait of a step for a stopped clock [s].
        now: Monotonic clock [s].
    """

    def __init__(
        self,
        robot: Robot,
        *,
        command_timeout: float,
        zero_rests: bool = False,
        realtime: bool = False,
        patience: float = 10.0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.spec, self.num_robots = robot.spec, robot.num_robots
        self.command_timeout, self.realtime = command_timeout, realtime
        self.tick_period = robot.spec.period / (PARTS if hasattr(robot, "slices") else 1)
        """Time between two ticks [s]."""
        self.state: RobotState | None = None
        """The newest state; None before the first `reset`."""
        self.fault: RobotFault | None = None
        """The fault of the robot, if any; cleared by `reset`."""
        self._robot, self._zero_rests, self._patience, self._now = robot, zero_rests, patience, now
        self._changed = threading.Condition(threading.RLock())
        self._target: Array = np.zeros((self.num_robots, len(robot.spec.command.labels)))
        self._expires = -math.inf  # when the command times out; never while a step is waited for
        self.resting = True
        """Whether the robot executes no command."""
        self._parts: Iterator[RobotState] = iter(())
        self._left = 0  # parts of this period still to come
        self._midway = False  # whether the last period was not executed to its end
        self._orders = self._begun = self._done = 0  # commands given, begun, executed over a whole period
        self._ticked = self._followed = math.inf  # when the last tick was, and the last command came
        self._lost, self._lost_until = 0.0, -math.inf  # time that `follow` may catch up, and until when it counts
        self._behind = 0.0  # time by which the robot is behind its commands

    def __getattr__(self, name: str) -> Any:
        """Other attributes of the robot, such as `connect`, `render` and `state_dict`."""
        if name.startswith("_"):
            raise AttributeError(name)
        value = getattr(self._robot, name)

        def call(*arguments: Any, **options: Any) -> Any:
            with self._changed:
                return value(*arguments, **options)

        return call if callable(value) else value

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Bring the robot to `initial`; ends a running command, and clears a fault."""
        with self._changed:
            self._drop_parts()
            self.fault = None
            self.state = self._robot.reset(env_ids, initial)
            self._target, self.resting, self._expires = self.state.command.copy(), True, -math.inf
            self._behind = 0.0
            return self.state

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, m); returns the state one period later. After a RobotFault a `reset` is needed."""
        with self._changed:
            command = checked_command(command, self._target.shape)
            if not self.realtime:
                try:
                    self.state = self._robot.step(command)
                except RobotFault as fault:
                    self.fault = fault
                    raise
                self._target, self.resting = command, False
                return self.state
            self.follow(command)
            self._expires, order = math.inf, self._orders
            if not self._changed.wait_for(
                lambda: self._done >= order or self.fault is not None or self.state is None, self._patience
            ):
                raise RemoteError(f"The clock of {self.spec.name} has stood still for {self._patience:g} s.")
            self._expires = self._now() + self.command_timeout
            if self.fault is not None:
                raise self.fault
            if self.state is None:
                raise ResetNeeded("The served robot was closed.")
            return self.state

    def follow(self, command: Array, *, at_once: bool = True, count: int = 1) -> None:
        """Execute the finite `command` (n, m) from the next tick on, at most for the command timeout.

        With `at_once` it does not wait for the end of the current period. It is the last of `count` commands that came
        since the last tick. After the clock has stood still, as on a busy computer, the commands of that time come all
        at once: a real robot, whose clock does not stop, has executed them one after the other. A command that came
        late is followed sooner by the next one: the robot has the rest of its way to go, too.
        """
        with self._changed:
            now, period = self._pass_time(), self.spec.period
            if count:
                since = period if self.resting else now - self._followed
                if since > period:
                    self._lose(since - period, now)
                early = count - 1 + max(0.0, 1.0 - since / period)
                caught = min(early * period, self._lost) if now <= self._lost_until else 0.0
                self._lost, self._behind, self._followed = self._lost - caught, self._behind + caught, now
                if self._behind and not early:
                    self._behind = min(self._behind, self._time_to(command) - period)
            self._target = command
            self._expires, self.resting = now + self.command_timeout, False
            self._orders += 1
            # A command that came slightly early must not drop the last part of a period.
            if at_once and self._left != 1:
                self._drop_parts()

    def target(self) -> Array:
        """A copy of the command that the robot executes now. Shape: (n, m)."""
        with self._changed:
            return self._target + 0.0

    def tick(self) -> None:
        """In real time: one part of a period passes. Stores a fault of the robot in `fault` instead of raising it."""
        with self._changed:
            if self.state is None or self.fault is not None:
                return
            now = self._pass_time()
            self._behind = max(0.0, self._behind - (CATCH_UP - 1) * self.tick_period)
            if not self.resting and now > self._expires:
                self.halt()
            try:
                if not self._left:
                    slices, command = getattr(self._robot, "slices", None), self._reachable()
                    if slices is None:
                        self._parts, self._left = (self._robot.step(command) for _ in range(1)), 1
                    else:
                        self._parts, self._left = iter(slices(command, PARTS)), PARTS
                    self._begun, self._midway = self._orders, False
                self._left -= 1
                self.state = next(self._parts)
            except RobotFault as fault:
                self.fault, self._left = fault, 0
            if not self._left:
                self._done = self._begun
                self._changed.notify_all()

    def _pass_time(self) -> float:
        """Note for how long the clock stood still; returns the time [s]."""
        now = self._now()
        lost = now - self._ticked - self.tick_period
        if lost > self.tick_period:
            self._lose(lost, now)
        self._ticked = now
        return now

    def _lose(self, seconds: float, now: float) -> None:
        """Note a time for which the clock stood still, or for which a command was late."""
        before = self._lost if now <= self._lost_until else 0.0
        self._lost, self._lost_until = min(max(seconds, before), LONGEST_LOST), now + LONGEST_LOST

    def _time_to(self, command: Array) -> float:
        """Time to a `command` (n, m) at the speed of the commands [s]; infinite if it is the command before again."""
        step, setpoint = np.abs(command - self._target), getattr(self._robot, "setpoint", command)
        moving = step > _STEP
        if not moving.any():
            return math.inf
        return self.spec.period * max(1.0, float((np.abs(command - setpoint)[moving] / step[moving]).max()))

    def _reachable(self) -> Array:
        """The target, limited to the distance that the robot may move in a period. Shape: (n, m)."""
        rate, setpoint = self.spec.command.max_rate, getattr(self._robot, "setpoint", None)
        target = self._target
        if setpoint is None:
            return target
        # The robot limits the change from its last command, of which an early command finds only a part executed.
        if self._midway and rate is not None:
            reach = np.array(rate) * self.spec.period
            target = np.clip(target, setpoint - reach, setpoint + reach)
        share = CATCH_UP / (1 + self._behind / self.spec.period)
        return target if share >= 1 else setpoint + share * (target - setpoint)

    def _drop_parts(self) -> None:
        """Drop the rest of this period; a step that waits for it ends with the next one."""
        self._midway = self._left > 0
        self._parts, self._left = iter(()), 0

    def place_object(self, pose: Array | None, seeds: NDArray[np.int64]) -> None:
        """Set the scene of a simulated robot, which stays as it is. Raises RemoteError if it has none.

        Args:
            pose: Pose of its object: x, y [m], yaw [rad]; None leaves it in place. Shape: (n, 3).
            seeds: Seeds of the robot's own random numbers. Shape: (n,).
        """
        with self._changed:
            place = getattr(self._robot, "place_object", None)
            if self.state is None or (place is None and pose is not None):
                raise RemoteError(f"{self.spec.name} has no object that could be placed.")
            self.state = self.state if place is None else self._stood(place(pose, seeds))

    def halt(self) -> None:
        """Rest at the current position, or at speed zero. Time continues, and a waiting step ends in time."""
        with self._changed:
            if self.resting:
                return  # a repeated halt would hold the arm lower each time, as gravity has pulled it
            self._robot.halt()
            if self.state is None:
                return
            self._drop_parts()
            self._target, self.resting, self._behind = self._rest(self.state), True, 0.0
            self.state = self._stood(self.state)

    def _stood(self, state: RobotState) -> RobotState:
        """The state with speed zero where the robot rests and its time stands still, so that no speed would end."""
        if self.realtime or not self.resting:
            return state
        speeds = {
            one.name: state.signals[one.name] * [not unit.endswith("/s") for unit in one.units]
            for one in self.spec.signals
            if any(unit.endswith("/s") for unit in one.units)
        }
        return replace(state, signals={**state.signals, **speeds})

    def _rest(self, state: RobotState) -> Array:
        """The command that keeps a halted robot at rest. Shape: (n, m)."""
        if self._zero_rests:
            return np.zeros_like(self._target)
        setpoint: Array | None = getattr(self._robot, "setpoint", None)  # of its controllers
        if setpoint is not None:  # it includes the force of a gripper
            return setpoint
        # The measured values, or the commanded ones if not measured.
        measured = {
            (label, unit): state.signals[signal.name][:, place]
            for signal in self.spec.signals
            for place, (label, unit) in enumerate(zip(signal.labels, signal.units, strict=True))
        }
        wanted = zip(self.spec.command.labels, self.spec.command.units, strict=True)
        return np.stack([measured.get(one, self._target[:, i]) for i, one in enumerate(wanted)], axis=1)

    def close(self) -> None:
        """Halt, and close the robot."""
        with self._changed:
            self._drop_parts()
            self.state = None
            self._robot.close()
            self._changed.notify_all()
