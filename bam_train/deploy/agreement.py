"""Agreement of a policy with whoever drives the robot: its commands, not sent, compared with the robot's motion."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import RobotSpec, RobotState
from bam_envs.safety.guard import Limits, columns_in, is_base, measured_places
from bam_train.files.log_lines import counted

Array = NDArray[np.float64]
STILL = 0.02
"""Share of the speed limits below which a robot counts as still."""
BLOCK = 1.0
"""Length of the blocks whose means count as independent samples [s]; successive ticks are correlated."""
_MIN_BLOCKS = 10
"""Minimum number of blocks for an interval."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of a policy with whoever drives: 1 for the same motion, 0 for the opposite motion."""

    mean: float | None
    """Mean over the ticks in which policy or robot moves; None if the robot never moves."""
    interval: tuple[float, float] | None
    """95 % confidence interval of the mean; None for less than ten blocks of a second."""
    ticks: int
    """Number of ticks in which policy or robot moves."""
    still: int
    """Number of ticks in which neither does."""

    def to_json(self) -> dict[str, Any]:
        """The agreement as JSON values."""
        rounded = None if self.mean is None else round(self.mean, 4)
        interval = None if self.interval is None else [round(bound, 4) for bound in self.interval]
        return {"agreement": rounded, "interval": interval, "ticks": self.ticks, "still": self.still}

    @property
    def text(self) -> str:
        """One line: ``agreement with whoever drives: 0.83 (0.79 to 0.87) in 412 moving ticks``."""
        if self.mean is None and self.ticks:
            seen = f"nobody drove; the policy would have moved in {counted(self.ticks, 'tick')}"
            return f"agreement with whoever drives: {seen}"
        if self.mean is None:
            seen = f"nobody moved, nor would the policy, in {counted(self.still, 'tick')}"
            return f"agreement with whoever drives: {seen}"
        between = "too short for an interval"
        if self.interval is not None:
            between = f"{self.interval[0]:.2f} to {self.interval[1]:.2f}"
        return f"agreement with whoever drives: {self.mean:.2f} ({between}) in {self.ticks} moving ticks"


class Shadow:
    """Compares commands that are not sent with the motion of the robot; memory is bounded.

    In each tick, p is the velocity that the policy commands and d the measured one after the robot's lag, as shares of
    the speed limits. The agreement of the tick is 1 - |p - d| / (|p| + |d|). Grippers are ignored.

    Args:
        spec: The robot.
        limits: The speed limits, and the lag if it is set.
    """

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        base, command = is_base(spec), spec.command
        units = ("m/s", "rad/s") if base else ("rad",)
        self._columns = sorted(column for unit in units for column in columns_in(command, unit))
        fastest = {"rad": limits.joint_speed, "m/s": limits.base_speed, "rad/s": limits.turn_speed}
        self._fastest = np.array([fastest[command.units[column]] for column in self._columns])
        places = {place: (name, column) for place, name, column in measured_places(spec, command.units)}
        self._places = [places[column] for column in self._columns]
        self._base, self._period = base, spec.period
        lag = spec.lag if limits.lag is None else limits.lag
        self._commanded: deque[Array] = deque(maxlen=1 + round(lag / spec.period))
        self._size = max(1, round(BLOCK / spec.period))
        self._block: list[float] = []
        self._blocks, self._mean, self._squares = 0, 0.0, 0.0  # Welford's algorithm over the block means
        self._sum, self._ticks, self._still, self._driven = 0.0, 0, 0, False

    def __call__(self, command: Array, before: RobotState, after: RobotState) -> None:
        """Compare one tick; called as `bam_envs.live.shadow_robot.ShadowRobot.watch`."""
        here, there = self._values(before), self._values(after)
        wanted = command[0, self._columns]
        commanded = wanted if self._base else (wanted - here) / self._period
        moved = there if self._base else (there - here) / self._period
        self._commanded.append(commanded / self._fastest)
        p, d = self._commanded[0], moved / self._fastest
        size = float(np.linalg.norm(p)), float(np.linalg.norm(d))
        if max(size) < STILL:
            self._still += 1
            return
        self._driven = self._driven or size[1] >= STILL
        self._take(1.0 - float(np.linalg.norm(p - d)) / sum(size))

    def _take(self, agreement: float) -> None:
        self._sum, self._ticks = self._sum + agreement, self._ticks + 1
        self._block.append(agreement)
        if len(self._block) == self._size:
            value = math.fsum(self._block) / self._size
            self._block.clear()
            self._blocks += 1
            away = value - self._mean
            self._mean += away / self._blocks
            self._squares += away * (value - self._mean)

    def _values(self, state: RobotState) -> Array:
        return np.array([state.signals[name][0, column] for name, column in self._places])

    @property
    def agreement(self) -> Agreement:
        """The agreement so far."""
        mean = self._sum / self._ticks if self._driven else None
        interval = None
        if mean is not None and self._blocks >= _MIN_BLOCKS:
            half = _student(self._blocks - 1) * math.sqrt(self._squares / (self._blocks - 1) / self._blocks)
            interval = max(0.0, mean - half), min(1.0, mean + half)
        return Agreement(mean, interval, self._ticks, self._still)


def _student(freedom: int) -> float:
    """The 97.5 % quantile of Student's t, by Cornish and Fisher's expansion; within 0.001 from 9 degrees on."""
    z, n = 1.959964, freedom
    return z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
