"""The guards between whoever commands a live robot and the robot, in one list: `default_guards`.

Each has a number, a name, a limit and a unit, and says one of three things:

* `Guard.fault`: nothing of this tick may be executed, the robot holds;
* `Guard.limit`: the command goes so far and no farther;
* `Guard.trip`: what was measured is beyond what the robot may ever do, it is stopped.

All of them look at one robot and at the last command that was *sent*; speeds and accelerations hold over the real time
since then.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import RobotSpec, RobotState
from bam_envs.robots.ur5e import GEOMETRY, JOINTS
from bam_envs.safety.arm_guards import (
    GripperSpeed,
    JointAcceleration,
    JointSpeed,
    PositionLimits,
    RampIn,
    ToolPosition,
    ToolSpeed,
)
from bam_envs.safety.following import BaseFollowing, JointFollowing
from bam_envs.safety.guard import (
    Guard,
    Limits,
    Tick,
    columns_in,
    default_age,
    is_base,
    joint_columns,
    max_rate,
    ticks_of,
)
from bam_envs.safety.measured import measured_guards

__all__ = ["Guard", "Limits", "Tick", "ToolPosition", "default_guards"]

Array = NDArray[np.float64]
_SPEEDS = {"m/s", "rad/s"}
LATE = 2.0
"""A live robot that was sent nothing for so many periods need not be where it was going to: its dead-man may have
stopped it."""
LATE_TICKS = 10
"""So many late commands, one after another, stop the robot."""


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
        self.limit_value = self.patience = limits.bad_ticks
        self._labels = spec.command.labels

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

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value = limits.max_age or default_age(spec)
        self.patience = ticks_of(limits.hold_time, spec)

    def fault(self, tick: Tick) -> str | None:
        """Says how old the state is."""
        if tick.age <= self.limit_value:
            return None
        return f"the newest state is {tick.age:.3f} s old, and at most {self.limit_value:g} s are allowed"


class Pace(Guard):
    """Commands come one period after the other: a late one is not executed, and a pause or many late ones stop."""

    number, name, unit = "G15", "command pace", "s"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value, self._period = limits.max_pause, spec.period

    def fault(self, tick: Tick) -> str | None:
        """Says how late the command is."""
        if tick.pause <= LATE * self._period:
            return None
        self.patience = 1 if tick.pause > self.limit_value else LATE_TICKS
        return (
            f"the command came {tick.pause:.3f} s after the one before, and one is expected every {self._period:g} s: "
            "the policy takes too long, or this process was paused or the computer is busy"
        )


class Answers(Guard):
    """A robot that says which command it has executed does so soon; else commands do not arrive, or late."""

    number, name, unit = "G4", "answer to a command", "s"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value, self.patience = limits.answer_time, ticks_of(limits.hold_time, spec)

    def fault(self, tick: Tick) -> str | None:
        """Says for how long it has been waited."""
        if tick.waiting <= self.limit_value:
            return None
        return (
            f"a command that was sent {tick.waiting:.3f} s ago is not answered, and at most {self.limit_value:g} s are "
            "allowed: commands do not arrive, or late; look at the network and at who else commands the robot"
        )


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
        self.limit_value, self._fastest = float(fastest.max()), fastest

    def limit(self, tick: Tick) -> bool:
        """Clip it around the last."""
        wanted, last = tick.command[self._columns], tick.last[self._columns]
        change = self._fastest * tick.period
        low = np.where(last > 0, np.minimum(0.0, last - change), last - change)
        high = np.where(last < 0, np.maximum(0.0, last + change), last + change)
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
    first: list[Guard] = [
        Shape(spec),
        Finite(spec, limits),
        Freshness(spec, limits),
        Pace(spec, limits),
        Answers(spec, limits),
    ]
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
    position = None if math.isinf(limits.tool_speed) else _kinematics(spec, tool_position)
    tool: list[Guard] = [] if position is None else [ToolSpeed(spec, limits, position)]
    gripper: list[Guard] = [GripperSpeed(spec)] if "m" in spec.command.units else []
    acceleration = JointAcceleration(spec, limits)
    return [
        *measured_guards(spec, limits, position),
        PositionLimits(spec, limits),
        *gripper,
        JointSpeed(spec, limits),
        RampIn(spec, limits),
        *tool,
        *([acceleration] if math.isfinite(limits.joint_acceleration) else []),
        *tool,
        JointFollowing(spec, limits, position),
    ]


def _kinematics(spec: RobotSpec, tool_position: ToolPosition | None) -> ToolPosition:
    """Forward kinematics.

    Raises:
        InvalidValue: They are not known, or the tool stays where it is when the joints turn.
    """
    joints = joint_columns(spec)
    if tool_position is None:
        if tuple(np.array(spec.command.labels)[joints]) == JOINTS:
            return GEOMETRY.tool_position
        raise InvalidValue(
            f"The tool speed of {spec.name} cannot be limited: its kinematics are not known. "
            "Give tool_position=; a simulated robot may do with the limit tool_speed = inf."
        )
    middle = (np.array(spec.command.low) + np.array(spec.command.high))[joints] / 2
    turned = tool_position(middle + 0.5 * np.vstack([np.zeros_like(middle), np.eye(len(middle))]))
    if not np.ptp(turned, axis=0).max() > 0.01:
        raise InvalidValue(
            f"tool_position of {spec.name} must give the position of the tool [m] for joints [rad], and the tool stays "
            "within 0.01 m when each joint is turned by 0.5 rad."
        )
    return tool_position


def _base_guards(spec: RobotSpec, limits: Limits) -> list[Guard]:
    return [
        *measured_guards(spec, limits, None),
        BaseSpeed("base speed", "m/s", limits.base_speed, spec),
        BaseSpeed("turn speed", "rad/s", limits.turn_speed, spec),
        BaseAcceleration("base acceleration", "m/s", limits.base_acceleration, spec),
        BaseAcceleration("turn acceleration", "rad/s", limits.turn_acceleration, spec),
        BaseFollowing("base following", "m/s", limits.base_acceleration, spec, limits),
        BaseFollowing("turn following", "rad/s", limits.turn_acceleration, spec, limits),
    ]
