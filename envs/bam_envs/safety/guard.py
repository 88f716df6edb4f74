"""What a guard is and what it looks at, and the limits up to which guards let a robot go."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.core.validation import check

Array = NDArray[np.float64]
ToolPosition = Callable[[Array], Array]
"""Forward kinematics: joints (n, k) [rad] to tool positions (n, 3) [m]."""
LONGEST_PERIOD = 1.0
"""Longest time between two commands to a live robot [s]: a command may go as far as its limits allow in that time."""


_ABOVE_ZERO = Annotated[float, Meta(gt=0, description="a number above 0")]
_FINITE = Annotated[float, Meta(gt=0, le=sys.float_info.max, description="a finite number above 0")]


def _limit(default: float | None, least: float, most: float, unit: str, *, finite: bool = False) -> Any:
    """A limit, with the minimum and maximum that a live robot may have; `finite` if it cannot be switched off."""
    kind: Any = _FINITE if finite else _ABOVE_ZERO
    return field(default=default, metadata={"bounds": (least, most, unit), "type": kind if default else kind | None})


@dataclass(frozen=True)
class Limits:
    """How far the guards let a robot go; infinity switches a speed, an acceleration, an age or a count off."""

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
    """Age of the oldest state that is acted on [s]; None for 0.1 of an arm and 0.5 of a base."""
    bad_ticks: float = _limit(3, 1.0, 10.0, "ticks")
    """This many commands in a row that are not finite stop the robot."""
    hold_time: float = _limit(0.5, 0.05, 2.0, "s")
    """How long the robot is held without a fresh state, or without an answer, before it is stopped [s]."""
    max_pause: float = _limit(1.0, 0.1, 5.0, "s")
    """Longest time between two commands after which the robot is not stopped [s]."""
    answer_time: float = _limit(0.3, 0.05, 2.0, "s")
    """Longest time in which a robot that answers commands has to answer one [s]."""
    lag: float | None = _limit(None, 0.001, 0.5, "s")
    """How far a robot that follows is behind its commands [s]; None for the lag in its spec."""
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

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            number = check(value, one.metadata["type"], f"The limit {one.name}")
            if isinstance(value, (np.ndarray, np.generic)):  # an array could be changed after it was checked
                object.__setattr__(self, one.name, number)

    @classmethod
    def of(cls, values: Mapping[str, float]) -> Limits:
        """The defaults, updated with the `values` of a profile.

        Raises:
            UnknownName: There is no such limit.
            InvalidValue: One is not above 0, or outside `BOUNDS`.
        """
        for name in values:
            if name not in BOUNDS:
                raise UnknownName("limit", name, BOUNDS)
        limits = cls(**values)
        limits.require_bounded()
        return limits

    def require_bounded(self) -> None:
        """`InvalidValue` if a limit is outside `BOUNDS`, in which those of live robots are."""
        for name, (least, most, unit) in BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise InvalidValue(
                    f"The limit {name} of a live robot must be {least:g} to {most:g} {unit}, not {value:g}."
                )


BOUNDS: Mapping[str, tuple[float, float, str]] = MappingProxyType(
    {one.name: one.metadata["bounds"] for one in fields(Limits)}
)
"""Minimum and maximum of each limit of a live robot, with its unit, whoever sets it: no typing error opens a guard."""


def require_bounded(limits: Limits, spec: RobotSpec) -> None:
    """Check the limits of a live robot, its period and its lag.

    Raises:
        InvalidValue: A number is outside its bounds, or `limits` is a subclass, which could skip the check.
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


@dataclass
class Tick:
    """One command on its way through the guards. Arrays have shape (m,)."""

    goal: Array
    """Where the command wants the robot to be; inside the position limits from `PositionLimits` on."""
    command: Array
    """What will be sent, as far as the guards have changed it."""
    last: Array
    """What was sent last, or what was measured if nothing was sent."""
    last_step: Array
    """How far the last command went in a time of `period`."""
    measured: Array
    """The measured value of each number of the command; NaN where nothing is measured."""
    before: Array
    """`measured` one tick ago."""
    velocity: Array
    """Measured rate of change of each number of the command [unit/s]; NaN where nothing is measured."""
    age: float
    """Age of the newest state [s]."""
    period: float
    """Time for which the command counts [s]: since the last one was sent, and at most one period of the robot."""
    pause: float = 0.0
    """Time since the last command was sent [s]; 0 for the first one, and where time passes only with commands."""
    waiting: float = 0.0
    """How long the robot has owed the answer to a command [s]; 0 if it owes none, or never answers."""
    approach: bool = False
    """Whether the robot is on its way to a start pose."""


class Sealed(type):
    """A class whose attributes cannot be replaced."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise AttributeError(f"{cls.__name__}.{name} cannot be replaced: it keeps a robot safe.")

    def __delattr__(cls, name: str) -> None:
        raise AttributeError(f"{cls.__name__}.{name} cannot be removed: it keeps a robot safe.")


class Guard(metaclass=Sealed):
    """One rule that allows everything: a subclass overrides what it restricts."""

    number: str
    """As in the table of guards in the documentation, ``"G8"``."""
    name: str
    unit: str
    limit_value: float
    """The limit, in `unit`."""
    patience: float = 1
    """This many faults in a row stop the robot; before that it is held."""

    @property
    def title(self) -> str:
        """Name and number, as messages have them: ``joint speed (G8)``."""
        return f"{self.name} ({self.number})"

    def restart(self) -> None:
        """The robot was connected, reset or halted: the next command begins where the robot is."""

    def fault(self, tick: Tick) -> str | None:
        """Why `tick` must not be executed at all, or None."""
        return None

    def hold(self, tick: Tick) -> Array:
        """What an arm is sent if `tick` is not executed: by default the last command again. Shape: (m,)."""
        held: Array = tick.last.copy()
        return held

    def limit(self, tick: Tick) -> bool:
        """Bring ``tick.command`` inside the limit; whether that changed it."""
        return False


def clip(tick: Tick, columns: Any, low: Array, high: Array) -> bool:
    """Clip `columns` of the command to `low` and `high`; whether that changed it."""
    wanted = tick.command[columns]
    tick.command[columns] = clipped = np.clip(wanted, low, high)
    return bool((clipped != wanted).any())


def columns_in(signal: SignalSpec, unit: str) -> NDArray[np.int64]:
    """Indices of the numbers of `signal` that are in `unit`."""
    return np.flatnonzero([one == unit for one in signal.units])


def is_base(spec: RobotSpec) -> bool:
    """Whether commands are speeds of a base; else they are positions of an arm's joints."""
    return "m/s" in spec.command.units


def ticks_of(seconds: float, spec: RobotSpec) -> int:
    """The periods in a time [s], rounded up."""
    return math.ceil(seconds / spec.period - 1e-9)


def max_rate(command: SignalSpec) -> Array:
    """Maximum rate of change of each number [unit/s]; infinite where the data sheet gives none."""
    return np.array(command.max_rate or (math.inf,) * len(command.labels))


def position_range(spec: RobotSpec, limits: Limits) -> tuple[Array, Array]:
    """Lowest and highest command, with the margin of the joints taken off; `InvalidValue` if that leaves no room."""
    margin = np.where([unit == "rad" for unit in spec.command.units], limits.position_margin, 0.0)
    low, high = np.array(spec.command.low) + margin, np.array(spec.command.high) - margin
    if (low > high).any():
        label = spec.command.labels[int(np.flatnonzero(low > high)[0])]
        raise InvalidValue(f"The limit position_margin of {limits.position_margin:g} rad leaves {label} no room.")
    return low, high


def measured_places(spec: RobotSpec, units: Sequence[str]) -> list[tuple[int, str, int]]:
    """Index in the command, signal, and column of the first signal that has the same label in that one of `units`."""
    measured = {
        pair: (signal.name, column)
        for signal in reversed(spec.signals)
        for column, pair in enumerate(zip(signal.labels, signal.units, strict=True))
    }
    numbers = enumerate(zip(spec.command.labels, units, strict=True))
    return [(place, *measured[pair]) for place, pair in numbers if pair in measured]
