"""Where an arm's episode starts: as a command, whether it is there, and what is missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, StartNotReached
from bam_envs.core.robot import Initial, RobotSpec
from bam_envs.safety.guard import Limits, columns_in, position_range

Array = NDArray[np.float64]
GRIPPER_NEAR = 0.002
"""The gripper is open when it is as near as this to its widest [m]."""


class StartPose:
    """The start pose of one episode.

    Args:
        spec: Of the arm.
        limits: Tolerance, time and position margin.
        initial: Its ``joint_position`` is the pose; the gripper is open.

    Raises:
        InvalidValue: The pose is outside the position limits.
    """

    def __init__(self, spec: RobotSpec, limits: Limits, initial: Initial) -> None:
        self._limits = limits
        self._joints, self._grippers = columns_in(spec.command, "rad"), columns_in(spec.command, "m")
        self._names = [spec.command.labels[column] for column in self._joints]
        self.command: Array = np.array(spec.command.high)
        """Shape: (m,)."""
        self.command[self._joints] = np.asarray(initial.signals["joint_position"], dtype=np.float64)[0]
        self._require_inside(*position_range(spec, limits))

    def _require_inside(self, low: Array, high: Array) -> None:
        for name, column in zip(self._names, self._joints, strict=True):
            if not low[column] <= self.command[column] <= high[column]:
                raise InvalidValue(
                    f"The start pose has {name} at {self.command[column]:.3f} rad, outside the {low[column]:.3f} to "
                    f"{high[column]:.3f} rad that the guards allow. Choose another start, or a smaller position_margin."
                )

    def opened(self, here: Array) -> Array:
        """The command `here` (m,) with the gripper open."""
        command: Array = here.copy()
        command[self._grippers] = self.command[self._grippers]
        return command

    def is_open(self, measured: Array) -> bool:
        """Whether the gripper is measured open; one that is not measured (NaN) is not waited for."""
        return not (np.abs(self.command - measured)[self._grippers] > GRIPPER_NEAR).any()

    def joints_off(self, measured: Array) -> dict[str, float]:
        """The joints that are not there, with how far they have to go [rad]."""
        way = (self.command - measured)[self._joints]
        near = self._limits.reset_tolerance
        return {name: float(far) for name, far in zip(self._names, way, strict=True) if not abs(far) <= near}

    def is_near(self, measured: Array) -> bool:
        """Whether joints and gripper are measured there."""
        return self.is_open(measured) and not self.joints_off(measured)

    def is_reached(self, measured: Array, sent: Array) -> bool:
        """Whether all joints are measured there, and were told to be."""
        told = bool((sent == self.command)[self._joints].all())
        return told and not self.joints_off(measured)

    def failure(self, measured: Array, why: str | None = None) -> StartNotReached:
        """The error that names the joints, and `why` the robot cannot move, if it says so."""
        off = self.joints_off(measured)
        where = ", ".join(f"{name} is {far:+.3f} rad from it" for name, far in off.items()) or "it is on its way"
        said = "" if why is None else f"Not ready: {why}. "
        return StartNotReached(
            f"{said}The arm did not reach its start pose in {self._limits.reset_timeout:g} s: {where}. "
            "Look for what holds it, or raise the limit reset_timeout.",
            off,
        )
