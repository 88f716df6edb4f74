"""The base class of guards, the tick that a guard checks, and the limits of a robot.

Longer than most files: each of the limits stands here with its default, its bounds and what it means.
"""

from __future__ import annotations

import math
import operator
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.arms.serial_chain import arm_of
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.core.validation import AboveZero, check
from bam_envs.core.wording import brief

Array = NDArray[np.float64]
Numbers = list[float]
"""A value for each entry of a command, or for some of them; lists are several times faster than short arrays."""
ToolPosition = Callable[[Array], Array]
"""Forward kinematics: joints (n, k) [rad] to tool positions (n, 3) [m]."""
ToolPoint = Callable[[Sequence[float]], tuple[float, float, float]]
"""Forward kinematics of one pose: joints (k,) [rad] to the tool's x, y, z [m]."""
LONGEST_PERIOD = 1.0
"""Longest time between two commands to a live robot [s]: a robot may move for that long before the next check."""


SPEEDS = ("joint_speed", "tool_speed", "base_speed", "turn_speed")
"""The limits on speeds."""
TRIAL_SPEED = 0.25
"""Share of the speed limits of a robot on trial."""
TRIAL_BOX = {"arm": 0.35, "base": 3.0}
"""Maximum distance of a robot on trial from its start, along each axis [m]."""
_ANY = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max, description="a finite number")]
_FINITE = Annotated[float, Meta(gt=0, le=sys.float_info.max, description="a finite number above 0")]


def _limit(default: float | None, least: float, most: float, unit: str, *, finite: bool = False) -> Any:
    """A limit, with its minimum and maximum for a live robot; `finite` if it cannot be disabled."""
    kind: Any = _FINITE if finite else AboveZero
    return field(default=default, metadata={"bounds": (least, most, unit), "type": kind if default else kind | None})


def _coordinate(default: float | None, least: float, most: float) -> Any:
    """A limit on a coordinate [m], of any sign; 0 is a limit like any other."""
    kind: Any = _ANY
    return field(default=default, metadata={"bounds": (least, most, "m"), "type": kind | None})


@dataclass(frozen=True)
class Limits:
    """The limits of the guards; infinity disables a limit on a speed, an acceleration, an age or a count."""

    position_margin: float = _limit(0.1, 0.01, 1.0, "rad", finite=True)
    """Distance of the joints from the ends of their travel [rad]."""
    joint_speed: float = _limit(1.0, 0.01, math.pi, "rad/s")
    """Maximum speed of a joint [rad/s]."""
    joint_acceleration: float = _limit(10.0, 0.1, 20.0, "rad/s^2")
    """Maximum acceleration of a joint [rad/s^2]."""
    tool_speed: float = _limit(0.25, 0.005, 1.0, "m/s")
    """Maximum speed of the tool [m/s]."""
    base_speed: float = _limit(0.5, 0.01, 1.5, "m/s")
    """Maximum speed of a base, forwards or backwards [m/s]."""
    turn_speed: float = _limit(0.7, 0.01, 2.0, "rad/s")
    """Maximum turning speed of a base [rad/s]."""
    base_acceleration: float = _limit(2.5, 0.1, 5.0, "m/s^2")
    """Maximum acceleration of a base [m/s^2]."""
    turn_acceleration: float = _limit(3.2, 0.1, 5.0, "rad/s^2")
    """Maximum turning acceleration of a base [rad/s^2]."""
    max_age: float | None = _limit(None, 0.01, 1.0, "s")
    """Maximum age of a state [s]; None: 0.1 for an arm, 0.5 for a base."""
    bad_ticks: float = _limit(3, 1.0, 10.0, "ticks")
    """Number of consecutive commands with NaN or infinity that stop the robot."""
    hold_time: float = _limit(0.5, 0.05, 2.0, "s")
    """Time for which the robot is held without a fresh state, or without an answer, before it is stopped [s]."""
    max_pause: float = _limit(1.0, 0.1, 5.0, "s")
    """Maximum time between two commands; a longer pause stops the robot [s]."""
    answer_time: float = _limit(0.3, 0.05, 2.0, "s")
    """Maximum time for the answer to a command, of a robot that answers commands [s]."""
    lag: float | None = _limit(None, 0.001, 0.5, "s")
    """Delay of the measured position behind the commands [s]; None: the lag in the robot's spec."""
    follow_tolerance: float = _limit(0.005, 0.001, 0.05, "rad", finite=True)
    """How far a joint at rest may be from its command, where `joint_speed` times the period is less [rad]."""
    reset_speed: float = _limit(0.25, 0.01, 1.0, "rad/s", finite=True)
    """Maximum joint speed on the way to the start pose, and until a distant first command is reached [rad/s]."""
    ramp_time: float = _limit(3.0, 0.5, 30.0, "s", finite=True)
    """Longest time for which a distant first command is approached slowly [s]."""
    reset_tolerance: float = _limit(0.02, 0.001, 0.1, "rad", finite=True)
    """How far a joint may be from the start pose [rad]."""
    reset_timeout: float = _limit(30.0, 0.1, 300.0, "s", finite=True)
    """Longest time to reach the start pose [s]."""
    trial_box: float | None = _limit(None, 0.05, 20.0, "m", finite=True)
    """Maximum distance of a robot on trial from its start, along each axis [m]; None: no limit, or on trial 0.35 for an
    arm, 3 for a base."""
    joint_jerk: float = _limit(500.0, 10.0, 5000.0, "rad/s^3")
    """Maximum jerk of a joint that speeds up [rad/s^3]; at 20 Hz `joint_acceleration` is the lower limit."""
    action_age: float = _limit(0.1, 0.01, 1.0, "s")
    """Maximum time from a state to the command computed from it [s]."""
    watchdog: float | None = _limit(None, 0.02, 1.0, "s")
    """Time within which a robot should stop by itself [s], for a warning; None: 0.1 for an arm, 0.5 for a base, or
    two periods if that is longer."""
    late_share: float = _limit(0.05, 0.01, 1.0, "share")
    """Share of late commands above which the guard warns."""
    link_warn: float = _limit(0.95, 0.5, 1.0, "share")
    """Share of ticks with a state and an answer in time below which the guard warns."""
    link_stop: float = _limit(0.9, 0.5, 1.0, "share")
    """Share of ticks with a state and an answer in time below which the robot is stopped."""
    clamp_warn: float = _limit(0.05, 0.01, 1.0, "share")
    """Share of commands changed to keep the robot out of a forbidden region above which the guard warns."""
    clamp_stop: float = _limit(0.2, 0.01, 1.0, "share")
    """Share of commands changed to keep the robot out of a forbidden region above which it is stopped."""
    singularity_slow: float = _limit(17.0, 5.0, 100.0, "condition number", finite=True)
    """Condition number above which an arm slows down, if its task moves the tool along straight lines."""
    singularity_stop: float = _limit(30.0, 6.0, 200.0, "condition number", finite=True)
    """Condition number that such an arm does not exceed."""
    clearance: float = _limit(0.005, 0.002, 0.1, "m", finite=True)
    """Distance that the links of an arm keep from each other and from the table [m]."""
    table_height: float = _coordinate(0.0, -2.0, 1.0)
    """Height of the table in ``base_link`` [m], below which no part of an arm goes."""
    box_x_min: float = _coordinate(-2.0, -2.5, 2.0)
    """Lowest x of the tool [m]."""
    box_x_max: float = _coordinate(2.0, -2.0, 2.5)
    """Highest x of the tool [m]."""
    box_y_min: float = _coordinate(-2.0, -2.5, 2.0)
    """Lowest y of the tool [m]."""
    box_y_max: float = _coordinate(2.0, -2.0, 2.5)
    """Highest y of the tool [m]."""
    box_z_min: float | None = _coordinate(None, -2.5, 2.0)
    """Lowest z of the tool [m]; None: `table_height` if the task commands a gripper, else unlimited."""
    box_z_max: float = _coordinate(2.0, -1.0, 2.5)
    """Highest z of the tool [m]."""
    laser_stop: float = _limit(0.3, 0.05, 2.0, "m", finite=True)
    """Distance to an obstacle in the direction of travel at which a base stops [m]."""
    laser_slow: float = _limit(0.4, 0.05, 3.0, "m", finite=True)
    """Distance to an obstacle in the direction of travel below which a base drives at 30 % of its speed limit [m]."""
    collision_time: float = _limit(2.0, 0.2, 10.0, "s", finite=True)
    """Time to a collision with an obstacle below which a base slows down [s]."""

    def __post_init__(self) -> None:
        for limit in fields(self):
            value = getattr(self, limit.name)
            number = check(value, limit.metadata["type"], f"The limit {limit.name}")
            if isinstance(value, (np.ndarray, np.generic)):  # an array could be changed after it was checked
                object.__setattr__(self, limit.name, number)

        for less, more in ORDERED:
            self._require_order(less, more)

    def _require_order(self, less: str, more: str) -> None:
        """`InvalidValue` if the limit `less` is above the limit `more`."""
        low, high = getattr(self, less), getattr(self, more)
        if low is not None and high is not None and low > high:
            raise InvalidValue(
                f"The limits {less} of {low:g} and {more} of {high:g} contradict each other: {less} is at most {more}."
            )

    @classmethod
    def of(cls, values: Mapping[str, float]) -> Limits:
        """The defaults, updated with the `values` of a profile.

        Raises:
            UnknownName: There is no such limit.
            InvalidValue: A limit is not above 0, or outside `BOUNDS`, or two contradict each other.
        """
        for name in values:
            if name not in BOUNDS:
                raise UnknownName("limit", name, BOUNDS)
        limits = cls(**values)
        limits.require_bounded()
        return limits

    def changed(self, values: Mapping[str, float]) -> Limits:
        """These limits with other `values`, as an operator gives them. Raises the errors of `of`."""
        if not isinstance(values, Mapping):
            raise InvalidValue(f"guards= must be limits by name, such as {{'joint_speed': 0.3}}, not {brief(values)}.")
        current = {limit.name: getattr(self, limit.name) for limit in fields(self)}
        limits = Limits.of({**current, **values})
        if "reset_speed" in values:  # in a profile it may be above the speed that a person lowered
            limits._require_order("reset_speed", "joint_speed")
        return limits

    def scaled(self, share: float) -> Limits:
        """These limits with `share` of the speeds, as far as `BOUNDS` allow."""
        return replace(self, **{name: max(BOUNDS[name][0], share * getattr(self, name)) for name in SPEEDS})

    @property
    def pace(self) -> float:
        """The smallest share of a default speed limit that these limits allow, at most 1."""
        return float(min(1.0, *(getattr(self, name) / getattr(Limits(), name) for name in SPEEDS)))

    def on_trial(self, *, base: bool) -> Limits:
        """These limits for a policy on trial on an arm or a base: `TRIAL_SPEED` of the speeds, and a `trial_box`.

        A slow arm that presses on an object is as far from its commands as a fast one, so `follow_tolerance` is wider.
        """
        return replace(
            self.scaled(TRIAL_SPEED),
            trial_box=self.trial_box or TRIAL_BOX["base" if base else "arm"],
            follow_tolerance=max(0.01, self.follow_tolerance),
            reset_timeout=min(BOUNDS["reset_timeout"][1], self.reset_timeout / TRIAL_SPEED),
        )

    def require_bounded(self) -> None:
        """`InvalidValue` if a limit is outside `BOUNDS`, which hold for every live robot."""
        for name, (least, most, unit) in BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise InvalidValue(
                    f"The limit {name} of a live robot must be {least:g} to {most:g} {unit}, not {value:g}."
                )
            if value is not None and unit == "ticks" and value % 1:
                raise InvalidValue(f"The limit {name} counts ticks and must be a whole number, not {value:g}.")


BOUNDS: Mapping[str, tuple[float, float, str]] = MappingProxyType(
    {limit.name: limit.metadata["bounds"] for limit in fields(Limits)}
)
"""Minimum, maximum and unit of each limit of a live robot: no typing error can disable a guard."""
ORDERED: tuple[tuple[str, str], ...] = (
    ("singularity_slow", "singularity_stop"),
    ("link_stop", "link_warn"),
    ("clamp_warn", "clamp_stop"),
    ("laser_stop", "laser_slow"),
    ("box_x_min", "box_x_max"),
    ("box_y_min", "box_y_max"),
    ("box_z_min", "box_z_max"),
)
"""Pairs of limits, the first of which is at most the second."""
BESIDE: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("reset_tolerance", "reset_timeout"), "reset_speed"),
        **dict.fromkeys(("laser_slow", "collision_time"), "laser_stop"),
        "follow_tolerance": "joint_speed",
        "hold_time": "max_age",
        "link_warn": "link_stop",
        "clamp_warn": "clamp_stop",
        "singularity_slow": "singularity_stop",
        "table_height": "box_z_min",
    }
)
"""Limits that are no `Guard.setting`, and one that is, of the same guard."""


def limits_of(guards: Iterable[Mapping[str, Any]]) -> set[str]:
    """The names of the limits that change at least one of `guards`, from `SafeRobot.guards`."""
    settings = ", ".join(guard["setting"] for guard in guards if guard["limit"] is not None).split(", ")
    return {name for name in BOUNDS if BESIDE.get(name, name) in settings}


def require_bounded(limits: Limits, spec: RobotSpec) -> None:
    """Check the limits of a live robot, its period and its lag.

    Raises:
        InvalidValue: A number is outside its bounds, or `limits` is a subclass, which could skip the check.
    """
    if type(limits) is not Limits:
        raise InvalidValue(f"The limits of a live robot must be Limits, not {type(limits).__name__}. Give Limits(...).")
    limits.require_bounded()
    if not 0.0 < spec.period <= LONGEST_PERIOD:
        raise InvalidValue(
            f"The period of {spec.name} must be above 0 and at most {LONGEST_PERIOD:g} s, not {spec.period:g} s: the "
            "robot moves for that long without a check. Command it more often."
        )
    most = BOUNDS["lag"][1]
    if limits.lag is None and not 0.0 <= spec.lag <= most:
        raise InvalidValue(
            f"{spec.name} may be 0 to {most:g} s behind its commands, not {spec.lag:g} s. Let its trajectories reach "
            "their points sooner, or give the limit lag."
        )


@dataclass(slots=True)
class Tick:
    """One command on its way through the guards, with lists of m numbers; a user's guard receives arrays (m,)."""

    goal: Numbers
    """Goal of the command; inside the position limits from `PositionLimits` on."""
    command: Numbers
    """Command to send, as changed by the guards so far."""
    last: Numbers
    """Command that was sent last, or the measured values if none was sent."""
    last_step: Numbers
    """Change of the last command in a time of `period`."""
    measured: Numbers
    """The measured value of each number of the command; NaN where nothing is measured."""
    before: Numbers
    """`measured` one tick before."""
    velocity: Numbers
    """Measured rate of change of each number of the command [unit/s]; NaN where nothing is measured."""
    age: float
    """Age of the newest state [s]."""
    period: float
    """Duration of the command [s]: the time since the last one was sent, at most one period of the robot."""
    pause: float = 0.0
    """Time since the last command was sent [s]; 0 for the first one, and where time passes only with commands."""
    elapsed: float = 0.0
    """Time from the state before to this one [s]; one period where time passes only with commands."""
    waiting: float = 0.0
    """Time since the oldest unanswered command was sent [s]; 0 if there is none, or the robot never answers."""
    approach: bool = False
    """Whether the robot is on its way to a start pose."""
    proving: bool = False
    """Whether the command belongs to the motion that proves the commands, which judges itself how the arm follows."""
    action_age: float = 0.0
    """Time from the state to the command computed from it [s]; 0 for a first command, and in lockstep."""
    kept_out: bool = False
    """Whether the previous command was changed to keep the robot out of a forbidden region."""
    ended: Numbers = field(default_factory=list)
    """Command that was sent shortly before this motion began, and that the robot may still be moving to; or empty."""
    rest: tuple[Numbers, Numbers] = ([], [])
    """Joints of a command, and where they come to rest if the arm brakes after it; see `ForbiddenRegion`."""
    signals: Mapping[str, Array] = field(default_factory=dict)
    """The newest measured signals, with shape (1, k) each; to be read only."""


TIMING_GUARDS = (3, 4, 15, 16)
"""Codes of the guards that look at when states, answers and commands come, and not at what the robot does."""


class Sealed(type):
    """A class whose attributes cannot be replaced."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise AttributeError(f"{cls.__name__}.{name} cannot be replaced: it keeps a robot safe.")

    def __delattr__(cls, name: str) -> None:
        raise AttributeError(f"{cls.__name__}.{name} cannot be removed: it keeps a robot safe.")


class Guard(metaclass=Sealed):
    """Base class of guards, which allows everything; subclasses override its methods to restrict commands."""

    number: str
    """Number in the table of guards in the documentation, such as ``"G8"``."""
    name: str
    unit: str
    limit_value: float
    """The limit, in `unit`."""
    patience: float = 1
    """Number of faults in a row that stop the robot; fewer hold it."""
    each: Sequence[float] = ()
    """The limit of each joint, where they may differ; `limit_value` is the greatest."""
    setting: str = ""
    """Name of the limit in `Limits` that sets `limit_value`; empty for a fixed one."""
    keeps_out: bool = False
    """Whether it changes commands to keep the robot out of a forbidden region, which `ChangedCommands` counts."""
    warning: str = ""
    """Warning for the operator, given before the guard acts; empty for none."""

    @property
    def title(self) -> str:
        """Name and number for messages: ``joint speed (G8)``."""
        return f"{self.name} ({self.number})"

    @property
    def code(self) -> int:
        """`number` as an integer: 8 for ``"G8"``; -1 for a guard without such a number."""
        digits = self.number.removeprefix("G")
        return int(digits) if digits.isdecimal() else -1

    def restart(self) -> None:
        """Forget the motion: after a connection, reset or halt the next command begins at the robot's position."""

    def forgive(self) -> None:
        """Forget faults, when an episode begins or a person resumes the robot."""

    def resumed(self) -> None:
        """Called when a person has ended a stop."""

    def start_fault(self, start: Numbers) -> str | None:
        """Why an arm must not go to the start pose `start` (m,), or None."""
        return None

    def fault(self, tick: Tick) -> str | None:
        """Why `tick` must not be executed at all, or None."""
        return None

    def hold(self, tick: Tick) -> Numbers:
        """The command (m,) that holds an arm if `tick` is not executed; not called on a user's guard."""
        return tick.last.copy()

    def limit(self, tick: Tick) -> bool:
        """Bring ``tick.command`` inside the limit; True if that changed it."""
        return False


def clip(tick: Tick, columns: Sequence[int], low: Numbers, high: Numbers) -> bool:
    """Clip `columns` of the command to `low` and `high`, a number for each column; True if that changed it."""
    changed = False
    for column, least, most in zip(columns, low, high, strict=True):
        wanted = tick.command[column]
        if wanted < least or wanted > most:
            tick.command[column], changed = (least if wanted < least else most), True
    return changed


def columns_in(signal: SignalSpec, unit: str) -> list[int]:
    """Indices of the numbers of `signal` that are in `unit`."""
    return [column for column, column_unit in enumerate(signal.units) if column_unit == unit]


def picker(columns: Sequence[int]) -> Callable[[Numbers], Numbers]:
    """A function that returns the numbers in `columns` of a list; faster for adjacent columns."""
    if columns and list(columns) == list(range(columns[0], columns[-1] + 1)):
        pick: Callable[[Numbers], Numbers] = operator.itemgetter(slice(columns[0], columns[-1] + 1))
        return pick
    some = operator.itemgetter(*columns) if columns else lambda _: ()
    return lambda values: list(some(values))


def is_base(spec: RobotSpec) -> bool:
    """True if commands are speeds of a base, False if they are positions of an arm's joints."""
    return "m/s" in spec.command.units


def tool_point_of(tool_position: ToolPosition) -> ToolPoint:
    """`tool_position` for one pose in plain numbers, which is faster; fastest for that of an `ArmGeometry`."""
    known = arm_of(tool_position)
    if known is not None:
        return known.tool_point

    def tool_point(q: Sequence[float]) -> tuple[float, float, float]:
        x, y, z = tool_position(np.array([q]))[0].tolist()
        return x, y, z

    return tool_point


def ticks_of(seconds: float, spec: RobotSpec) -> int:
    """Number of periods in a time [s], rounded up."""
    return math.ceil(seconds / spec.period - 1e-9)


def max_rate(command: SignalSpec) -> Numbers:
    """Maximum rate of change of each number [unit/s]; infinite where the data sheet gives none."""
    return list(command.max_rate or (math.inf,) * len(command.labels))


def position_range(spec: RobotSpec, limits: Limits) -> tuple[Numbers, Numbers]:
    """Lowest and highest command (m,), less the margin of the joints; `InvalidValue` if that leaves no room."""
    command = spec.command
    margins = [limits.position_margin if unit == "rad" else 0.0 for unit in command.units]
    low = [value + margin for value, margin in zip(command.low, margins, strict=True)]
    high = [value - margin for value, margin in zip(command.high, margins, strict=True)]
    for label, least, most in zip(command.labels, low, high, strict=True):
        if least > most:
            raise InvalidValue(f"The limit position_margin of {limits.position_margin:g} rad leaves {label} no room.")
    return low, high


def measured_places(spec: RobotSpec, units: Sequence[str]) -> list[tuple[int, str, int]]:
    """For each measured number of the command: its index, and the first signal and column with its label and unit."""
    measured = {
        pair: (signal.name, column)
        for signal in reversed(spec.signals)
        for column, pair in enumerate(zip(signal.labels, signal.units, strict=True))
    }
    numbers = enumerate(zip(spec.command.labels, units, strict=True))
    return [(place, *measured[pair]) for place, pair in numbers if pair in measured]
