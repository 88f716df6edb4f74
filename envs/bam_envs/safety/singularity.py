"""Singularity (G13): an arm that moves its tool along straight lines slows down near singularities."""

import math
from collections.abc import Sequence
from functools import lru_cache
from operator import mul, sub

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.serial_chain import Arm, SerialChain
from bam_envs.core.robot import RobotSpec
from bam_envs.safety.guard import Guard, Limits, Tick, columns_in, picker

Array = NDArray[np.float64]
_SMALLEST, _LARGEST = (2.0, 1.1, 0.5, 1.1), (0.9, 1.2, 1.6, 1.6)
"""Joints 2 to 5 change the smallest and the largest singular value by no more than this [1/rad]; measured at 56,000
poses of all seven arms, with and without a tool: 1.56, 0.87, 0.41, 0.87 and 0.69, 0.93, 1.27, 1.27 at most."""


_SAFETY = 1.5  # on the changes that were measured in `_SAMPLES` postures
_SAMPLES = 300


@lru_cache(maxsize=8)
def _rates(chain: SerialChain, unit: float) -> tuple[list[float], list[float]]:
    """The most by which a turn of each joint changes the smallest and the largest singular value [1/rad], measured."""
    rng, size, step = np.random.default_rng(0), chain.num_joints, 1e-3
    q = chain.low + rng.random((_SAMPLES, size)) * (chain.high - chain.low)

    def values(joints: Array) -> Array:
        jacobians = chain.jacobians(joints)[1]
        jacobians[:, :3] /= unit
        found: Array = np.asarray(np.linalg.svd(jacobians, compute_uv=False), np.float64)
        return found

    here = values(q)
    rates = [_SAFETY * np.abs(values(q + step * one) - here).max(axis=0) / step for one in np.eye(size)]
    return [float(one[-1]) for one in rates], [float(one[0]) for one in rates]


class Singularity(Guard):
    """In a task with straight lines, an arm slows down towards a singularity and stops before it.

    The limit is the condition number of the Jacobian, with lengths in halves of the arm's length. It is computed again
    only when the joints have turned far enough since the last time to reach the limit. Away from the singularity the
    arm moves freely.
    """

    number, name, unit, setting = "G13", "singularity", "condition number", "singularity_stop"

    def __init__(self, spec: RobotSpec, limits: Limits, arm: Arm) -> None:
        self._slow, self.limit_value = limits.singularity_slow, limits.singularity_stop
        self._arm, self._joints = arm, columns_in(spec.command, "rad")
        self._pick, size = picker(self._joints), len(self._joints)
        if isinstance(arm, SerialChain):
            lengths = np.linalg.norm(arm.placements[1:, :3, 3], axis=1)
            self._unit = max(float(lengths.sum()), 0.1) / 2.0
            self._rates = [least + most / self._slow for least, most in zip(*_rates(arm, self._unit), strict=True)]
        else:
            self._unit = (abs(arm.a2) + abs(arm.a3)) / 2.0
            self._rates = [least + most / self._slow for least, most in zip(_SMALLEST, _LARGEST, strict=True)]
            self._rates = [0.0, *self._rates, 0.0]
        self._at: Sequence[float] = [0.0] * size
        self._room = 0.0  # smallest singular value minus the largest one divided by `singularity_slow`, at `_at`

    def limit(self, tick: Tick) -> bool:
        """Shorten the step of all joints, except on the way to a start pose, which is not a straight line."""
        wanted = self._pick(tick.command)
        if tick.approach or sum(map(mul, self._rates, map(abs, map(sub, wanted, self._at)))) < self._room:
            return False
        self._at, condition, last = wanted, self.condition(wanted), self._pick(tick.last)
        if condition <= self._slow or condition <= self.condition(last):
            return False
        span = self.limit_value - self._slow
        share = max(0.0, self.limit_value - condition) / span if span else 0.0
        for at, start, way in zip(self._joints, last, wanted, strict=True):
            tick.command[at] = start + min(share, 1.0) * (way - start)
        self._room = 0.0
        return True

    def condition(self, q: Sequence[float]) -> float:
        """Condition number of the Jacobian at the joints `q` (k,) [rad]."""
        if isinstance(self._arm, SerialChain):
            scaled = self._arm.tool_jacobian(q)
            scaled[:3] /= self._unit
        else:
            scaled = np.array([[value / self._unit for value in row[:3]] + row[3:] for row in self._arm.jacobian(q)])
        square = scaled @ scaled.T if len(scaled) <= scaled.shape[1] else scaled.T @ scaled
        squared = np.linalg.eigvalsh(square)  # in a third of the time of the singular values
        least, most = math.sqrt(max(squared[0], 0.0)), math.sqrt(squared[-1])
        self._room = least - most / self._slow
        return most / max(least, 1e-12)
