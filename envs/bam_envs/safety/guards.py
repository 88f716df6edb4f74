"""The guards between a live robot and its commands, in one list: `default_guards`.

Each guard checks one robot against the last command that was *sent*; speeds and accelerations are over the real time
since then.
"""

import math
from collections.abc import Callable
from operator import le

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.serial_chain import arm_of
from bam_envs.core.errors import InvalidValue
from bam_envs.core.kinematics import UR5E_GRIPPER, UR_JOINTS
from bam_envs.core.robot import RobotSpec, RobotState, SignalSpec
from bam_envs.safety import arm_guards as arm
from bam_envs.safety.arm_tubes import tubes_of
from bam_envs.safety.base_guards import LaserZones
from bam_envs.safety.first_motion import FirstMotion
from bam_envs.safety.following import BaseFollowing, JointFollowing
from bam_envs.safety.guard import (
    Guard,
    Limits,
    Numbers,
    Tick,
    ToolPosition,
    clip,
    columns_in,
    is_base,
    max_rate,
    picker,
    ticks_of,
    tool_point_of,
)
from bam_envs.safety.link_guards import (
    LATE_TICKS,
    ActionAge,
    ChangedCommands,
    LateTicks,
    LinkQuality,
    RampAfterStop,
    Watchdog,
)
from bam_envs.safety.region_guards import Collision, WorkspaceBox
from bam_envs.safety.singularity import Singularity
from bam_envs.safety.trial_box import TrialBox
from bam_envs.safety.unusual import UnusualObservations

Array = NDArray[np.float64]
LATE = 2.0
"""After this many periods without a command a live robot may be short of its last command: its watchdog may have
stopped it."""
MEASURED_MARGIN = 1.3
"""A measured speed may be this many times its limit: controllers overshoot commands slightly."""
MEASURED_PATIENCE = 3
"""Faults in a row before a stop: a robot may execute bunched commands within one tick, and slows down when held."""


class CommandShape(Guard):
    """A command has one number for each label. Any other shape is a bug in the program, and raises at once."""

    number, name, unit = "G2", "shape", "numbers"

    def __init__(self, spec: RobotSpec) -> None:
        self.limit_value = len(spec.command.labels)

    def numbers(self, command: Array) -> Numbers:
        """`command` (1, m) as m numbers; `InvalidValue` if it has another shape or is not numeric."""
        try:
            array = np.asarray(command, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InvalidValue(f"The command must be numbers: {error}.") from error
        expected = (1, int(self.limit_value))
        if array.shape != expected:
            raise InvalidValue(f"The command must have shape {expected}, not {array.shape}.")
        numbers: Numbers = array[0].tolist()
        return numbers


class Finite(Guard):
    """A command with NaN or infinity is not executed."""

    number, name, unit, setting = "G2", "finite", "bad ticks in a row", "bad_ticks"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value = self.patience = limits.bad_ticks
        self._labels = spec.command.labels

    def fault(self, tick: Tick) -> str | None:
        """Report the numbers that are not finite."""
        if all(map(math.isfinite, tick.goal)):
            return None
        bad = [label for label, value in zip(self._labels, tick.goal, strict=True) if not math.isfinite(value)]
        return f"the command for {', '.join(bad)} is not a finite number"


class Freshness(Guard):
    """While the newest state is too old, the robot's position is unknown, and no new command is sent."""

    number, name, unit, setting = "G3", "state age", "s", "max_age"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value = limits.max_age or (0.5 if is_base(spec) else 0.1)
        self.patience = ticks_of(limits.hold_time, spec)

    def fault(self, tick: Tick) -> str | None:
        """Report the age of the state."""
        if tick.age <= self.limit_value:
            return None
        return f"the newest state is {tick.age:.3f} s old, and at most {self.limit_value:g} s are allowed"


class Pace(Guard):
    """Commands come one period apart: a late one is not executed, and a pause or many late ones stop the robot."""

    number, name, unit, setting = "G15", "command pace", "s", "max_pause"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value, self._period = limits.max_pause, spec.period

    def fault(self, tick: Tick) -> str | None:
        """Report the delay of the command."""
        if tick.pause <= LATE * self._period:
            return None
        self.patience = 1 if tick.pause > self.limit_value else LATE_TICKS
        return (
            f"the command came {tick.pause:.3f} s after the one before, and one is expected every {self._period:g} s: "
            "the policy takes too long, or this process was paused or the computer is busy"
        )


class Answers(Guard):
    """A robot that answers commands does so in time; otherwise commands arrive too late or not at all."""

    number, name, unit, setting = "G4", "answer to a command", "s", "answer_time"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value, self.patience = limits.answer_time, ticks_of(limits.hold_time, spec)

    def fault(self, tick: Tick) -> str | None:
        """Report the age of the unanswered command."""
        if tick.waiting <= self.limit_value:
            return None
        return (
            f"a command that was sent {tick.waiting:.3f} s ago is not answered, and at most {self.limit_value:g} s are "
            "allowed: commands arrive late or not at all; check the network, and other clients that command the robot"
        )


class BaseSpeed(Guard):
    """A base drives, or turns, no faster than the limit or its data sheet."""

    number = "G11"

    def __init__(self, name: str, unit: str, limit: float, spec: RobotSpec) -> None:
        self.name, self.unit, self.setting = name, unit, name.replace(" ", "_")
        self._columns, command = columns_in(spec.command, unit), spec.command
        self._low = [max(-limit, command.low[at]) for at in self._columns]
        self._high = [min(limit, command.high[at]) for at in self._columns]
        self.limit_value = max(self._high)

    def limit(self, tick: Tick) -> bool:
        """Clip this speed, in its direction if the base drives sideways too; others are unchanged."""
        changed = clip(tick, self._columns, self._low, self._high)
        speed = math.hypot(*(tick.command[at] for at in self._columns))
        if len(self._columns) == 1 or speed <= self.limit_value:
            return changed
        for at in self._columns:
            tick.command[at] *= self.limit_value / speed
        return True


class BaseAcceleration(Guard):
    """A base gains speed gradually, driving or turning. It may always slow down, and reverses only from 0."""

    number = "G11"

    def __init__(self, name: str, unit: str, limit: float, spec: RobotSpec) -> None:
        self.name, self.unit, self.setting = name, f"{unit}^2", name.replace(" ", "_")
        self._columns, rates = columns_in(spec.command, unit), max_rate(spec.command)
        self._fastest = [min(limit, rates[at]) for at in self._columns]
        self.limit_value = max(self._fastest)

    def limit(self, tick: Tick) -> bool:
        """Clip the speed to the range around the last one."""
        low, high = [], []
        for at, fastest in zip(self._columns, self._fastest, strict=True):
            last, change = tick.last[at], fastest * tick.period
            low.append(min(0.0, last - change) if last > 0 else last - change)
            high.append(max(0.0, last + change) if last < 0 else last + change)
        return clip(tick, self._columns, low, high)


class MeasuredSpeed(Guard):
    """A robot measured at more than 1.3 times the limit of this speed, as the mean of two ticks, is held.

    Controllers overshoot commands slightly, so that the limit itself is too little.
    """

    patience = MEASURED_PATIENCE

    def __init__(self, number: str, name: str, unit: str, limit: float, speeds: Callable[[Tick], Numbers]) -> None:
        self.number, self.name, self.unit = number, f"measured {name}", unit
        self.setting = name.replace(" ", "_")
        self.limit_value, self._speeds = MEASURED_MARGIN * limit, speeds
        self._before: Numbers | None = None
        self._fastest = 0.0  # highest speed of the last tick

    def restart(self) -> None:
        """Forget the last tick: the mean needs two."""
        self._before = None

    def fault(self, tick: Tick) -> str | None:
        """Report the measured speed."""
        now = list(map(abs, self._speeds(tick)))
        before, self._before = self._before, now
        fastest_before, self._fastest = self._fastest, max(now)
        if before is None or fastest_before + self._fastest <= 2 * self.limit_value:
            return None
        fastest = 0.0
        for first, second in zip(before, now, strict=True):
            if (first + second) / 2 > fastest:  # NaN: it is not measured
                fastest = (first + second) / 2
        if not fastest > self.limit_value:
            return None
        return f"{fastest:.3f} {self.unit} were measured, and at most {self.limit_value:.3f} {self.unit} are allowed"


class MeasuredLimits(Guard):
    """A robot whose measured position or speed is beyond its data sheet is out of control, and is stopped."""

    number, name, unit, limit_value = "G7", "measured limits", "beyond the data sheet", 0.0
    SIGNALS = ("joint_position", "joint_velocity", "base_velocity")

    def __init__(self, spec: RobotSpec) -> None:
        self._watched = [signal for signal in spec.signals if signal.name in self.SIGNALS]

    def trip(self, state: RobotState) -> str | None:
        """The first number of `state` that is outside its range, as the reason for a stop; or None."""
        for signal in self._watched:
            values = state.signals[signal.name][0].tolist()
            if not (all(map(le, signal.low, values)) and all(map(le, values, signal.high))):  # NaN is not
                return self._outside(signal, values)
        return None

    @staticmethod
    def _outside(signal: SignalSpec, values: Numbers) -> str:
        """The first of `values` that is outside the range of `signal`."""
        rows = zip(values, signal.low, signal.high, strict=True)
        at = next(place for place, (value, low, high) in enumerate(rows) if not low <= value <= high)
        return (
            f"{signal.name} of {signal.labels[at]} was measured at {values[at]:.3f} {signal.units[at]}, "
            f"outside {signal.low[at]:.3f} to {signal.high[at]:.3f}"
        )


def default_guards(
    spec: RobotSpec,
    limits: Limits | None = None,
    *,
    tool_position: ToolPosition | None = None,
    straight: bool = False,
) -> list[Guard]:
    """The guards of a robot of `spec`, in the order in which they are applied.

    Args:
        spec: An arm is commanded in rad, a base in m/s and rad/s.
        limits: The limits of the guards.
        tool_position: Forward kinematics, (n, k) [rad] to (n, 3) [m]; None only for a UR5e. If it is that of an
            `ArmGeometry` or a `SerialChain` with an outline, collisions are guarded too.
        straight: Whether the commands move the tool along straight lines; then singularities are guarded too.

    Raises:
        InvalidValue: The command has numbers that no guard limits, or the tool of an arm would have no speed limit.
    """
    limits = limits or Limits()
    units, speeds = set(spec.command.units), {"m/s", "rad/s"}
    if not (units == speeds if is_base(spec) else "rad" in units and not units & speeds):
        found = ", ".join(dict.fromkeys(spec.command.units))
        raise InvalidValue(
            f"The command of {spec.name} cannot be guarded: a base takes m/s and rad/s only, an arm takes rad and no "
            f"speeds; found {found}."
        )
    moving = _base_guards(spec, limits) if is_base(spec) else _arm_guards(spec, limits, tool_position, straight)
    # Guards that count ticks come first: they count every tick, also one that another guard does not execute.
    counting = [LateTicks(spec, limits), LinkQuality(spec, limits), ChangedCommands(limits)]
    first = [Finite(spec, limits), Freshness(spec, limits), Pace(spec, limits), ActionAge(limits)]
    watched = [Answers(spec, limits), Watchdog(spec, limits)]
    last = [UnusualObservations(), FirstMotion(spec), MeasuredLimits(spec)]
    return [CommandShape(spec), *counting, *first, *watched, *moving, *last]


def _arm_guards(spec: RobotSpec, limits: Limits, tool_position: ToolPosition | None, straight: bool) -> list[Guard]:
    position = None if math.isinf(limits.tool_speed) else _kinematics(spec, tool_position)
    joints = columns_in(spec.command, "rad")
    pick = picker(joints)
    measured: list[Guard] = [arm.MeasuredJump(spec)]
    if math.isfinite(limits.joint_speed):
        limit = max(arm.fastest_joints(spec, limits))
        measured.append(MeasuredSpeed("G8", "joint speed", "rad/s", limit, lambda tick: pick(tick.velocity)))
    tool: list[Guard] = []
    if position is not None:
        tool_point = tool_point_of(position)

        def tool_speed(tick: Tick) -> Numbers:
            here, moment = pick(tick.measured), 1e-3
            there = [at + speed * moment for at, speed in zip(here, pick(tick.velocity), strict=True)]
            return [math.dist(tool_point(here), tool_point(there)) / moment]

        measured.append(MeasuredSpeed("G10", "tool speed", "m/s", limits.tool_speed, tool_speed))
        tool.append(arm.ToolSpeed(spec, limits, position))
    gripper = [arm.GripperSpeed(spec)] if "m" in spec.command.units else []
    smooth: list[Guard] = []
    if math.isfinite(limits.joint_acceleration):
        smooth = [arm.JointAcceleration(spec, limits), arm.JointJerk(spec, limits)]
    speed = [arm.JointSpeed(spec, limits), arm.RampIn(spec, limits), RampAfterStop(spec, limits), *tool]
    singular, kept_out = _region_guards(spec, limits, position, straight)
    # The tool's speed is limited twice: joints that change their speed one by one can speed the tool up.
    last = [*smooth, *tool, JointFollowing(spec, limits, position), *singular, *kept_out]
    return [*measured, arm.PositionLimits(spec, limits), *gripper, *speed, *last]


def _region_guards(
    spec: RobotSpec, limits: Limits, position: ToolPosition | None, straight: bool
) -> tuple[list[Guard], list[Guard]]:
    """The guards of an arm against singularities, and against forbidden regions; none if its geometry is unknown."""
    if position is None:
        return [], []
    has_gripper, least = "m" in spec.command.units, limits.box_z_min
    if least is None:  # without a gripper the length of the tool is an assumption
        least = limits.table_height if has_gripper else -math.inf
    low, high = (limits.box_x_min, limits.box_y_min, least), (limits.box_x_max, limits.box_y_max, limits.box_z_max)
    kept_out: list[Guard] = [WorkspaceBox(spec, limits, low, high, position)]
    if limits.trial_box is not None:
        kept_out.append(TrialBox(spec, limits, limits.trial_box, position))
    known = arm_of(position)
    tubes = None if known is None else tubes_of(known, tool=has_gripper)
    if tubes is not None:
        kept_out.append(Collision(spec, limits, tubes))
    return [Singularity(spec, limits, known)] if straight and known is not None else [], kept_out


def _kinematics(spec: RobotSpec, tool_position: ToolPosition | None) -> ToolPosition:
    """Forward kinematics; `InvalidValue` if they are not known, or the tool stays in place when the joints turn."""
    joints = columns_in(spec.command, "rad")
    if tool_position is None:
        if tuple(spec.command.labels[at] for at in joints) == UR_JOINTS:
            return UR5E_GRIPPER.tool_position
        raise InvalidValue(
            f"The tool speed of {spec.name} cannot be limited: its kinematics are not known. "
            "Give tool_position=; a simulated robot may have the limit tool_speed = inf."
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
    drive, turn = picker(columns_in(spec.command, "m/s")), picker(columns_in(spec.command, "rad/s"))
    return [
        MeasuredSpeed("G11", "base speed", "m/s", limits.base_speed, lambda tick: [math.hypot(*drive(tick.measured))]),
        MeasuredSpeed("G11", "turn speed", "rad/s", limits.turn_speed, lambda tick: turn(tick.measured)),
        BaseSpeed("base speed", "m/s", limits.base_speed, spec),
        BaseSpeed("turn speed", "rad/s", limits.turn_speed, spec),
        BaseAcceleration("base acceleration", "m/s", limits.base_acceleration, spec),
        BaseAcceleration("turn acceleration", "rad/s", limits.turn_acceleration, spec),
        RampAfterStop(spec, limits),
        BaseFollowing("base following", "m/s", limits.base_acceleration, spec, limits),
        BaseFollowing("turn following", "rad/s", limits.turn_acceleration, spec, limits),
        *([] if spec.body is None else [LaserZones(spec, limits, spec.body)]),
        *([] if limits.trial_box is None else [TrialBox(spec, limits, limits.trial_box, None)]),
    ]
