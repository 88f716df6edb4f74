"""Simulated robots that move and are measured as live ones are: behind guards, a link and a busy computer.

They are no model of one robot: what differs between live robots, and between usual runs of one, is drawn for each
episode from its seed, over a wide range. For `SafeRobot` and `LinkedRobot`, which are exact, one robot or whole periods
are too coarse or too slow here.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import EnvIds, Initial, Robot, RobotState, checked_command
from bam_envs.robots.room import mixed
from bam_envs.safety.guard import Limits, is_base, max_rate

Array = NDArray[np.float64]
SLOWEST = 0.15
"""Smallest share of the speed; a robot on trial has `guard.TRIAL_SPEED`."""
_ACCELERATION = 0.5, 2.0  # least and greatest factor on the default limit
_LATE = 1.0  # greatest time by which all states of an episode are old [periods]
_JITTER = 0.5  # greatest deviation of this time from tick to tick [periods]
_HOLD, _LONGEST_HOLD = 0.01, 5  # probability that commands begin to be late; for how many periods at most
_DRAWS = 3  # random numbers of a step


class LiveLike:
    """A `Robot` around a `Robot`, which sends limited commands and returns late states.

    Each episode has a share of the speed (1 for half of them), limits of the acceleration, and a part of a period by
    which states are old, which also changes from step to step. Now and then commands are late for some periods, so that
    the robot is held: an arm at its last command, a base at rest. A state is interpolated between the newest two.

    Args:
        robot: The robots.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot, self.spec, self.num_robots = robot, robot.spec, robot.num_robots
        n, command, limits = robot.num_robots, robot.spec.command, Limits()
        self._is_base, self._env_ids = is_base(robot.spec), np.arange(n)
        self._rate, period = np.array(max_rate(command)), robot.spec.period
        self._is_joint = np.array([unit == "rad" for unit in command.units])
        speeds = {"rad": limits.joint_speed, "m/s": limits.base_speed, "rad/s": limits.turn_speed}
        gains = {"m/s": limits.base_acceleration, "rad/s": limits.turn_acceleration}
        self._speed = np.array([speeds.get(unit, math.inf) for unit in command.units])
        self._gain = period * np.array([gains.get(unit, limits.joint_acceleration) for unit in command.units])
        self.pace: Array = np.ones(n)
        """Share of the speed in this episode. Shape: (n,)."""
        self._agility, self._late, self._jitter = np.ones((n, 1)), np.zeros(n), np.zeros(n)
        self._held, self._count = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self._seeds = np.zeros(n, np.uint64)
        self._sent, self._velocity = np.zeros((2, n, len(command.labels)))
        self._before: dict[str, NDArray[Any]] = {}
        self._shown: dict[str, NDArray[Any]] = {}

    def connect(self) -> None:
        """Make the robots ready."""
        self.robot.connect()

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Bring these robots to `initial`, and draw what differs."""
        state = self.robot.reset(env_ids, initial)
        self._seeds[env_ids] = mixed(np.asarray(initial.seeds).astype(np.uint64) + np.uint64(0x11FE))
        self._count[env_ids] = self._held[env_ids] = 0
        draws = self._draws(5)[:, env_ids]
        slow = np.exp(math.log(SLOWEST) * (2 * draws[0] - 1))
        self.pace = self.pace.copy()
        self.pace[env_ids] = np.where(draws[0] < 0.5, 1.0, slow)
        least, most = _ACCELERATION
        self._agility[env_ids, 0] = least + (most - least) * draws[1]
        self._late[env_ids], self._jitter[env_ids] = _LATE * draws[2], _JITTER * draws[3]
        self._sent, self._velocity = self._sent.copy(), self._velocity.copy()
        self._sent[env_ids], self._velocity[env_ids] = state.command[env_ids], 0.0
        for kept in (self._before, self._shown):
            for name, array in state.signals.items():
                kept[name] = kept[name].copy() if name in kept else array.copy()
                kept[name][env_ids] = array[env_ids]
        return replace(state, signals=dict(self._shown), command=self._sent)

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, m), SI units, as far as the limits allow; returns the state about one period later.

        Raises:
            InvalidValue: The command has another shape, or is not finite.
        """
        command = checked_command(command, self._sent.shape)
        self._count = self._count + 1
        draws = self._draws(_DRAWS)
        begins = (self._held == 0) & (draws[0] < _HOLD)
        held = np.where(begins, 1 + (draws[1] * _LONGEST_HOLD).astype(np.int64), self._held)
        self._held = np.maximum(held - 1, 0)
        sent = self._limited(command)
        rest = np.zeros_like(sent) if self._is_base else self._sent
        sent = np.where(held[:, None] > 0, rest, sent)
        self._velocity, self._sent = (sent - self._sent) / self.spec.period, sent
        state = self.robot.step(sent)
        late = np.clip(self._late + self._jitter * (2 * draws[2] - 1), 0.0, 1.0)
        self._shown = {name: self._aged(name, array, late) for name, array in state.signals.items()}
        self._before = {name: array.copy() for name, array in state.signals.items()}
        return replace(state, signals=dict(self._shown), command=sent)

    def _limited(self, command: Array) -> Array:
        """The command with the speed and the acceleration of this episode. Shape: (n, m)."""
        pace, period, gain = self.pace[:, None], self.spec.period, self._gain * self._agility
        if self._is_base:
            high = self._speed * pace
            base: Array = np.clip(np.clip(command, -high, high), self._sent - gain, self._sent + gain)
            return base
        wanted = (command - self._sent) / period
        fastest = np.abs(wanted / self._speed).max(axis=1, keepdims=True)  # the joints slow down together
        speed = np.clip(wanted * (pace / np.maximum(1.0, fastest)), self._velocity - gain, self._velocity + gain)
        gripper = np.clip(wanted, -self._rate, self._rate)
        arm: Array = self._sent + period * np.where(self._is_joint, speed, gripper)
        return arm

    def _aged(self, name: str, array: NDArray[Any], late: Array) -> NDArray[Any]:
        """A signal `late` periods (n,) ago; what jumps, as an angle at pi or an image does, is the newest."""
        aged: Array = array.copy()
        if array.dtype.kind == "f":
            change = self._before[name] - array
            aged += np.where(np.abs(change) < math.pi, late.reshape(-1, *[1] * (array.ndim - 1)) * change, 0.0)
        return aged

    def _draws(self, number: int) -> Array:
        """Random numbers in [0, 1) of this step. Shape: (number, n)."""
        keys = self._count.astype(np.uint64) * np.uint64(8) + np.arange(number, dtype=np.uint64)[:, None]
        draws: Array = (mixed(self._seeds + mixed(keys)) >> np.uint64(11)).astype(np.float64) / 2**53
        return draws

    def rest(self, resting: NDArray[np.bool_]) -> None:
        """See `RobotVectorEnv.rest`."""
        if hasattr(self.robot, "rest"):
            self.robot.rest(resting)

    def halt(self) -> None:
        """Stop moving."""
        self.robot.halt()

    def close(self) -> None:
        """Halt, and let go of the robots."""
        self.robot.close()
