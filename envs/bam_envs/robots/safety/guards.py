"""The guards between whoever commands a live robot and the robot, in one list: `default_guards`.

Each has a number, a name, a limit and a unit, and says one of three things:

* `Guard.fault`: nothing of this tick may be executed, the robot holds;
* `Guard.limit`: the command goes so far and no farther;
* `Guard.trip`: what was measured is beyond what the robot may ever do, it is stopped.

All of them look at one robot, at the last command that was *sent*, and take a tick to last one period.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bam_envs.errors import InvalidValue
from bam_envs.robots.robot import RobotSpec, RobotState
from bam_envs.robots.safety.arm_guards import (
    GripperSpeed,
    JointAcceleration,
    JointSpeed,
    PositionLimits,
    RampIn,
    ToolPosition,
    ToolSpeed,
)
from bam_envs.robots.safety.guard import Guard, Limits, Tick, columns_in, default_age, is_base, joint_columns, max_rate
from bam_envs.robots.ur5e import GEOMETRY, JOINTS

__all__ = ["Guard", "Limits", "Tick", "ToolPosition", "default_guards"]

Array = NDArray[np.float64]
_SPEEDS = {"m/s", "rad/s"}


class Shape(Guard):
    """A command has one number for each label. Another shape is a mistake in the program, and an error at once."""

    number, name, unit = "G2", "shape", "numbers"

    def __init__(self, spec: RobotSpec) -> None:
        self.limit_value = len(spec.command.labels)

    def row(self, command: Array) -> Array:
        """`command` (1, m) as numbers (m,); a copy.

        Raises:
            InvalidValue: It has another shape, or is not made of numbers.
        """
        try:
            array = np.array(command, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InvalidValue(f"The command must be numbers: {error}.") from error
        expected = (1, int(self.limit_value))
        if array.shape != expected:
            raise InvalidValue(f"The command must have shape {expected}, not {array.shape}.")
        row: Array = array[0]
        return row


class Finite(Guard):
    """NaN and infinity are no places to go to."""

    number, name, unit = "G2", "finite", "bad ticks in a row"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value, self._labels = limits.bad_ticks, spec.command.labels

    def fault(self, tick: Tick) -> str | None:
        """Names the numbers that are not finite."""
        finite = np.isfinite(tick.goal)
        if finite.all():
            return None
        bad = [label for label, good in zip(self._labels, finite, strict=True) if not good]
        return f"the command for {', '.join(bad)} is not a finite number"


class Freshness(Guard):
    """While the newest state is old, nobody knows where the robot is: nothing new is commanded."""

    number, name, unit = "G3", "state age", "s"

    def __init__(self, max_age: float) -> None:
        self.limit_value = max_age

    def fault(self, tick: Tick) -> str | None:
        """Says how old the state is."""
        if tick.age <= self.limit_value:
            return None
        return f"the newest state is {tick.age:.3f} s old, and at most {self.limit_value:g} s are allowed"


class BaseSpeed(Guard):
    """The drive, or its turning, is never faster than the limit nor than its data sheet."""

    number = "G11"

    def __init__(self, name: str, unit: str, limit: float, spec: RobotSpec) -> None:
        self.name, self.unit = name, unit
        self._columns = columns_in(spec.command, unit)
        self._low = np.maximum(-limit, np.array(spec.command.low)[self._columns])
        self._high = np.minimum(limit, np.array(spec.command.high)[self._columns])
        self.limit_value = float(self._high.max())

    def limit(self, tick: Tick) -> bool:
        """Clip it, the other one is left alone."""
        wanted = tick.command[self._columns]
        tick.command[self._columns] = speed = np.clip(wanted, self._low, self._high)
        return bool((speed != wanted).any())


class BaseAcceleration(Guard):
    """The drive, or its turning, gains speed gradually; slowing down is never held back, turning round begins at 0."""

    number = "G11"

    def __init__(self, name: str, unit: str, limit: float, spec: RobotSpec) -> None:
        self.name, self.unit = name, f"{unit}^2"
        self._columns = columns_in(spec.command, unit)
        fastest = np.minimum(limit, max_rate(spec.command)[self._columns])
        self.limit_value, self._change = float(fastest.max()), fastest * spec.period

    def limit(self, tick: Tick) -> bool:
        """Clip it around the last."""
        wanted, last = tick.command[self._columns], tick.last[self._columns]
        low = np.where(last > 0, np.minimum(0.0, last - self._change), last - self._change)
        high = np.where(last < 0, np.maximum(0.0, last + self._change), last + self._change)
        tick.command[self._columns] = speed = np.clip(wanted, low, high)
        return bool((speed != wanted).any())


class MeasuredLimits(Guard):
    """A robot that is measured beyond its data sheet, in position or speed, is not under control."""

    number, name, unit, limit_value = "G7", "measured limits", "beyond the data sheet", 0.0
    SIGNALS = ("joint_position", "joint_velocity", "base_velocity")

    def __init__(self, spec: RobotSpec) -> None:
        self._watched = [signal for signal in spec.signals if signal.name in self.SIGNALS]
        self._ranges = {one.name: (np.array(one.low), np.array(one.high)) for one in self._watched}

    def trip(self, state: RobotState) -> str | None:
        """Names the first number that is outside."""
        for signal in self._watched:
            low, high = self._ranges[signal.name]
            values = state.signals[signal.name][0]
            inside = (values >= low) & (values <= high)  # NaN is not
            if not inside.all():
                at = int(np.flatnonzero(~inside)[0])
                return (
                    f"{signal.name} of {signal.labels[at]} was measured at {values[at]:.3f} {signal.units[at]}, "
                    f"outside {low[at]:.3f} to {high[at]:.3f}"
                )
        return None


def default_guards(
    spec: RobotSpec, limits: Limits | None = None, *, tool_position: ToolPosition | None = None
) -> list[Guard]:
    """Every guard that a robot of `spec` has, in the order in which they are asked.

    Args:
        spec: Of the robot; joints are what it is told in rad, a base is told m/s and rad/s.
        limits: How far they let it go.
        tool_position: Forward kinematics; a UR5e's is known.

    Raises:
        InvalidValue: A command with numbers that no guard knows, or an arm whose tool would have no speed limit.
    """
    limits = limits or Limits()
    _require_guarded(spec)
    first: list[Guard] = [Shape(spec), Finite(spec, limits), Freshness(limits.max_age or default_age(spec))]
    moving = _base_guards(spec, limits) if is_base(spec) else _arm_guards(spec, limits, tool_position)
    return [*first, *moving, MeasuredLimits(spec)]


def _require_guarded(spec: RobotSpec) -> None:
    """Every number of a command is one that the guards of a base, or those of an arm, limit."""
    units = set(spec.command.units)
    moving = _SPEEDS if is_base(spec) else {"rad"}
    other = sorted(units - _SPEEDS if is_base(spec) else units & _SPEEDS)
    if units >= moving and not other:
        return
    found = ", ".join(dict.fromkeys(spec.command.units))
    raise InvalidValue(
        f"The command of {spec.name} cannot be guarded: a base is told m/s and rad/s and nothing else, an arm rad and "
        f"no speeds; found {found}."
    )


def _arm_guards(spec: RobotSpec, limits: Limits, tool_position: ToolPosition | None) -> list[Guard]:
    # The tool's speed is looked at twice: joints that change their speed one by one can speed up the tool.
    tool = _tool_guard(spec, limits, tool_position)
    gripper: list[Guard] = [GripperSpeed(spec)] if "m" in spec.command.units else []
    acceleration = JointAcceleration(spec, limits)
    return [
        PositionLimits(spec, limits),
        *gripper,
        JointSpeed(spec, limits),
        RampIn(spec, limits),
        *tool,
        *([acceleration] if math.isfinite(limits.joint_acceleration) else []),
        *tool,
    ]


def _tool_guard(spec: RobotSpec, limits: Limits, tool_position: ToolPosition | None) -> list[Guard]:
    if math.isinf(limits.tool_speed):
        return []
    labels = tuple(np.array(spec.command.labels)[joint_columns(spec)])
    if tool_position is None and labels != JOINTS:
        raise InvalidValue(
            f"The tool speed of {spec.name} cannot be limited: its kinematics are not known. "
            "Give tool_position=, or the limit tool_speed = inf."
        )
    return [ToolSpeed(spec, limits, tool_position or GEOMETRY.tool_position)]


def _base_guards(spec: RobotSpec, limits: Limits) -> list[Guard]:
    return [
        BaseSpeed("base speed", "m/s", limits.base_speed, spec),
        BaseSpeed("turn speed", "rad/s", limits.turn_speed, spec),
        BaseAcceleration("base acceleration", "m/s", limits.base_acceleration, spec),
        BaseAcceleration("turn acceleration", "rad/s", limits.turn_acceleration, spec),
    ]
