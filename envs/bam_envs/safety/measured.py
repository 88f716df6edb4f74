"""The guards that watch what the robot does, whatever it was told: measured speeds, and measurements that cannot be."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import RobotSpec
from bam_envs.safety.arm_guards import ToolPosition
from bam_envs.safety.guard import Guard, Limits, Tick, columns_in, is_base, joint_columns, max_rate

Array = NDArray[np.float64]
MARGIN = 1.3
"""A measured speed may be so many times its limit: commands are no faster than it, and controllers swing a little."""
PATIENCE = 3
"""So many ticks: commands that a network bunches up are caught up with in one, and a robot that is held slows down."""
JUMP = 0.05
"""A joint may be measured so much farther than it can have turned [rad]."""
_MOMENT = 1e-3


class MeasuredSpeed(Guard):
    """What is measured is no faster than 1.3 times its limit, as the mean of two ticks; one that is held slows down."""

    patience = PATIENCE

    def __init__(self, number: str, name: str, unit: str, limit: float, speeds: Callable[[Tick], Array]) -> None:
        self.number, self.name, self.unit, self.limit_value = number, f"measured {name}", unit, MARGIN * limit
        self._speeds = speeds
        self._before: Array | None = None

    def restart(self) -> None:
        """One tick says nothing."""
        self._before = None

    def fault(self, tick: Tick) -> str | None:
        """Says how fast it is."""
        now = np.abs(self._speeds(tick))
        before, self._before = self._before, now
        if before is None:
            return None
        fastest = float(((before + now) / 2).max())
        if not fastest > self.limit_value:  # NaN: it is not measured
            return None
        return f"{fastest:.3f} {self.unit} were measured, and at most {self.limit_value:.3f} {self.unit} are allowed"


class MeasuredJump(Guard):
    """A joint that is measured where it cannot have turned to since the last tick is not measured."""

    number, name, unit = "G7", "measured jump", "rad"

    def __init__(self, spec: RobotSpec) -> None:
        self.limit_value = JUMP
        self._joints, self._fastest = joint_columns(spec), max_rate(spec.command)[joint_columns(spec)]
        self._labels = np.array(spec.command.labels)[self._joints]

    def fault(self, tick: Tick) -> str | None:
        """Names the joint."""
        way = np.abs(tick.measured - tick.before)[self._joints]
        can = self._fastest * (max(tick.period, tick.pause) + tick.age) + self.limit_value
        over = way > can  # NaN: there was no tick before
        if not over.any():
            return None
        at = int(np.argmax(way - can))
        return (
            f"{self._labels[at]} was measured {way[at]:.3f} rad from where it was a tick before, and it turns "
            f"{can[at]:.3f} rad at most in that time: look at what publishes its position"
        )


def measured_guards(spec: RobotSpec, limits: Limits, tool_position: ToolPosition | None) -> Sequence[Guard]:
    """Those of an arm, whose tool is watched where its kinematics are given, or of a base."""
    if is_base(spec):
        drive, turn = columns_in(spec.command, "m/s"), columns_in(spec.command, "rad/s")
        return [
            MeasuredSpeed("G11", "base speed", "m/s", limits.base_speed, lambda tick: tick.measured[drive]),
            MeasuredSpeed("G11", "turn speed", "rad/s", limits.turn_speed, lambda tick: tick.measured[turn]),
        ]
    joints = joint_columns(spec)
    guards: list[Guard] = [MeasuredJump(spec)]
    if math.isfinite(limits.joint_speed):
        guards.append(
            MeasuredSpeed("G8", "joint speed", "rad/s", limits.joint_speed, lambda tick: tick.velocity[joints])
        )
    if tool_position is not None:
        tool = tool_position

        def speed(tick: Tick) -> Array:
            here, way = tick.measured[joints], tick.velocity[joints] * _MOMENT
            begin, end = tool(np.stack([here, here + way]))
            return np.array([math.dist(begin, end) / _MOMENT])

        guards.append(MeasuredSpeed("G10", "tool speed", "m/s", limits.tool_speed, speed))
    return guards
