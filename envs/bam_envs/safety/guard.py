"""What a guard is, how far guards let a robot go, and what they look at."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import RobotSpec, RobotState, SignalSpec

Array = NDArray[np.float64]


_FINITE = ("position_margin", "reset_speed", "ramp_time", "reset_tolerance", "reset_timeout", "follow_tolerance")
_FROM_SPEC = ("max_age", "lag")
BOUNDS: Mapping[str, tuple[float, float, str]] = MappingProxyType(
    {
        "position_margin": (0.01, 1.0, "rad"),
        "joint_speed": (0.01, math.pi, "rad/s"),
        "joint_acceleration": (0.1, 20.0, "rad/s^2"),
        "tool_speed": (0.005, 1.0, "m/s"),
        "base_speed": (0.01, 1.5, "m/s"),
        "turn_speed": (0.01, 2.0, "rad/s"),
        "base_acceleration": (0.1, 5.0, "m/s^2"),
        "turn_acceleration": (0.1, 5.0, "rad/s^2"),
        "max_age": (0.01, 1.0, "s"),
        "bad_ticks": (1.0, 10.0, "ticks"),
        "hold_time": (0.05, 2.0, "s"),
        "max_pause": (0.1, 5.0, "s"),
        "answer_time": (0.05, 2.0, "s"),
        "lag": (0.001, 0.5, "s"),
        "follow_tolerance": (0.001, 0.05, "rad"),
        "reset_speed": (0.01, 1.0, "rad/s"),
        "ramp_time": (0.5, 30.0, "s"),
        "reset_tolerance": (0.001, 0.1, "rad"),
        "reset_timeout": (0.1, 300.0, "s"),
    }
)
"""Least and greatest limits of a live robot, with their units, whoever gives them: a slip must not open a guard."""
LONGEST_PERIOD = 1.0
"""Longest time between two commands to a live robot [s]: a command may go as far as its limits for so long."""


@dataclass(frozen=True)
class Limits:
    """How far the guards let a robot go; infinity switches a speed, an acceleration, an age or a count off."""

    position_margin: float = 0.1
    """Distance of the joints from the ends of their travel [rad]."""
    joint_speed: float = 1.0
    """Fastest joint [rad/s]."""
    joint_acceleration: float = 10.0
    """Fastest change of a joint's speed [rad/s^2]."""
    tool_speed: float = 0.25
    """Fastest tool [m/s]."""
    base_speed: float = 0.5
    """Fastest drive, forwards or backwards [m/s]."""
    turn_speed: float = 0.7
    """Fastest turn of a base [rad/s]."""
    base_acceleration: float = 2.5
    """Fastest gain of the drive's speed [m/s^2]."""
    turn_acceleration: float = 3.2
    """Fastest gain of the turn's speed [rad/s^2]."""
    max_age: float | None = None
    """Oldest state that is acted on [s]; None for 0.1 of an arm and 0.5 of a base."""
    bad_ticks: float = 3
    """So many commands that are not finite, one after another, stop the robot."""
    hold_time: float = 0.5
    """Longest that the robot is held for want of a fresh state, or of an answer, before it is stopped [s]."""
    max_pause: float = 1.0
    """Longest time between two commands after which the robot is not stopped [s]."""
    answer_time: float = 0.3
    """Longest that a robot that answers commands may take for it [s]."""
    lag: float | None = None
    """How far a robot that follows is behind its commands [s]; None for what is known of it."""
    follow_tolerance: float = 0.005
    """Farthest that a joint at rest may be from its command, where `joint_speed` times the period is less [rad]."""
    reset_speed: float = 0.25
    """Fastest joint on the way to the start pose, and until a far first command is caught up with [rad/s]."""
    ramp_time: float = 3.0
    """Longest that a far first command is gone to slowly [s]."""
    reset_tolerance: float = 0.02
    """Farthest that a joint may be from the start pose [rad]."""
    reset_timeout: float = 30.0
    """Longest way to the start pose [s]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None and field.name in _FROM_SPEC:
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
                raise InvalidValue(f"The limit {field.name} must be above 0, not {value!r}.")
            if value == math.inf and field.name in _FINITE:
                raise InvalidValue(f"The limit {field.name} must be finite.")

    @classmethod
    def of(cls, values: Mapping[str, float]) -> Limits:
        """The defaults with `values` of a profile in their place.

        Raises:
            UnknownName: There is no such limit.
            InvalidValue: One is not above 0, or beyond what a live robot may have.
        """
        names = [field.name for field in fields(cls)]
        for name in values:
            if name not in names:
                raise UnknownName("limit", name, names)
        limits = cls(**values)
        limits.require_bounded()
        return limits

    def require_bounded(self) -> None:
        """Refuse what no live robot may have.

        Raises:
            InvalidValue: A limit is outside `BOUNDS`.
        """
        for name, (least, most, unit) in BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise InvalidValue(
                    f"The limit {name} of a live robot must be {least:g} to {most:g} {unit}, not {value:g}."
                )


@dataclass
class Tick:
    """One command on its way through the guards. Arrays have shape (m,)."""

    goal: Array
    """Where it wants the robot to be; inside its limits from `PositionLimits` on."""
    command: Array
    """What will be sent, as far as the guards have got."""
    last: Array
    """What was sent last, or what was measured where nothing was."""
    last_step: Array
    """How far it went with that in a time of `period`."""
    measured: Array
    """What is measured of each number of the command; NaN where nothing is."""
    before: Array
    """The same, one tick ago."""
    velocity: Array
    """How fast each number of the command is measured to change [unit/s]; NaN where nothing is."""
    age: float
    """Of the newest state [s]."""
    period: float
    """For how long the command counts [s]: the time since the last one was sent, one period of the robot at most."""
    pause: float = 0.0
    """Time since the last command was sent [s]; 0 where there was none, or time passes only with commands."""
    waiting: float = 0.0
    """How long the robot has owed the answer to a command [s]; 0 where it owes none, or gives none."""
    approach: bool = False
    """Whether it is on the way to a start pose."""


class Sealed(type):
    """A class whose attributes cannot be replaced, so that no assignment opens a guard."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise AttributeError(f"{cls.__name__}.{name} cannot be replaced: it keeps a robot safe.")

    def __delattr__(cls, name: str) -> None:
        raise AttributeError(f"{cls.__name__}.{name} cannot be removed: it keeps a robot safe.")


class Guard(metaclass=Sealed):
    """One rule, silent about everything: override what it has to say."""

    number: str
    """As in the table of guards in the documentation, ``"G8"``."""
    name: str
    unit: str
    limit_value: float
    """The limit, in `unit`."""
    patience: float = 1
    """So many faults, one tick after another, stop the robot; before that it is held."""

    def restart(self) -> None:
        """The robot was connected, reset or halted: what comes next begins where it is."""

    def fault(self, tick: Tick) -> str | None:
        """Why nothing of `tick` may be executed, or None."""
        return None

    def hold(self, tick: Tick) -> Array:
        """What an arm is sent where nothing of `tick` is executed: by default the last command again. Shape: (m,)."""
        held: Array = tick.last.copy()
        return held

    def limit(self, tick: Tick) -> bool:
        """Bring ``tick.command`` inside the limit; whether that changed it."""
        return False

    def trip(self, state: RobotState) -> str | None:
        """Why the robot that measured `state` must be stopped, or None."""
        return None


def columns_in(signal: SignalSpec, unit: str) -> NDArray[np.int64]:
    """Places of the numbers of `signal` that are in `unit`."""
    return np.flatnonzero([one == unit for one in signal.units])


def joint_columns(spec: RobotSpec) -> Any:
    """Places of the joints in a command: a slice where they are side by side, which is quicker."""
    columns = columns_in(spec.command, "rad")
    if len(columns) and columns[-1] - columns[0] + 1 == len(columns):
        return slice(int(columns[0]), int(columns[-1]) + 1)
    return columns


def is_base(spec: RobotSpec) -> bool:
    """Whether commands are speeds of a base; else they are positions of an arm's joints."""
    return "m/s" in spec.command.units


def default_age(spec: RobotSpec) -> float:
    """Oldest state that is acted on [s]."""
    return 0.5 if is_base(spec) else 0.1


def require_bounded(limits: Limits, spec: RobotSpec) -> None:
    """Refuse limits that no live robot may have, and a robot that is commanded too seldom or follows too late.

    Raises:
        InvalidValue: A number is outside its bounds, or `limits` are of a kind that could say otherwise.
    """
    if type(limits) is not Limits:
        raise InvalidValue(f"The limits of a live robot must be Limits, not {type(limits).__name__}. Give Limits(...).")
    limits.require_bounded()
    most = BOUNDS["lag"][1]
    if limits.lag is None and not 0.0 <= spec.lag <= most:
        raise InvalidValue(
            f"{spec.name} may be 0 to {most:g} s behind its commands, not {spec.lag:g} s. Let its trajectories reach "
            "their points sooner, or give the limit lag."
        )
    if not 0.0 < spec.period <= LONGEST_PERIOD:
        raise InvalidValue(
            f"The period of {spec.name} must be above 0 and at most {LONGEST_PERIOD:g} s, not {spec.period:g} s: for "
            "so long a command may go as far as the limits let it. Command it more often."
        )


def ticks_of(seconds: float, spec: RobotSpec) -> int:
    """The periods in a time [s], rounded up."""
    return math.ceil(seconds / spec.period - 1e-9)


def max_rate(command: SignalSpec) -> Array:
    """Fastest change of each number [unit/s]; infinite where the data sheet says nothing."""
    return np.array(command.max_rate or (math.inf,) * len(command.labels))


def position_range(spec: RobotSpec, limits: Limits) -> tuple[Array, Array]:
    """Lowest and highest command; joints have their margin taken off.

    Raises:
        InvalidValue: The margin leaves a joint no room.
    """
    margin = np.where([unit == "rad" for unit in spec.command.units], limits.position_margin, 0.0)
    low, high = np.array(spec.command.low) + margin, np.array(spec.command.high) - margin
    if (low > high).any():
        label = spec.command.labels[int(np.flatnonzero(low > high)[0])]
        raise InvalidValue(f"The limit position_margin of {limits.position_margin:g} rad leaves {label} no room.")
    return low, high
