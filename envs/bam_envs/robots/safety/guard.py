"""What a guard is, how far guards let a robot go, and what they look at."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.errors import InvalidValue, UnknownName
from bam_envs.robots.robot import RobotSpec, RobotState, SignalSpec

Array = NDArray[np.float64]


_FINITE = ("position_margin", "reset_speed", "ramp_time", "reset_tolerance", "reset_timeout")
_FROM_SPEC = ("max_age",)
PROFILE_TOPS = {
    "joint_speed": (math.pi, "rad/s"),
    "joint_acceleration": (20.0, "rad/s^2"),
    "tool_speed": (1.0, "m/s"),
    "base_speed": (1.5, "m/s"),
    "turn_speed": (2.0, "rad/s"),
    "base_acceleration": (5.0, "m/s^2"),
    "turn_acceleration": (5.0, "rad/s^2"),
    "max_age": (1.0, "s"),
    "bad_ticks": (10.0, "ticks"),
    "reset_speed": (1.0, "rad/s"),
    "reset_timeout": (300.0, "s"),
}
"""Widest limits that a profile may give, with their units: a slip in a file must not open a guard."""


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
    """So many ticks without a usable command or state, one after another, stop the robot."""
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
            InvalidValue: One is not above 0, or beyond what a profile may give.
        """
        names = [field.name for field in fields(cls)]
        for name in values:
            if name not in names:
                raise UnknownName("limit", name, names)
        limits = cls(**values)
        for name, (top, unit) in PROFILE_TOPS.items():
            if name in values and values[name] > top:
                raise InvalidValue(
                    f"The limit {name} of a profile may be {top:g} {unit} at most, not {values[name]:g}. "
                    "Give a wider one in a program: live_robot(..., limits=Limits(...))."
                )
        return limits


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
    """How far that was from what was sent before it."""
    measured: Array
    """What is measured of each number of the command; NaN where nothing is."""
    age: float
    """Of the newest state [s]."""
    approach: bool = False
    """Whether it is on the way to a start pose."""


class Guard:
    """One rule, silent about everything: override what it has to say."""

    number: str
    """As in the table of guards in the documentation, ``"G8"``."""
    name: str
    unit: str
    limit_value: float
    """The limit, in `unit`."""

    def restart(self) -> None:
        """The robot was connected, reset or halted: what comes next begins where it is."""

    def fault(self, tick: Tick) -> str | None:
        """Why nothing of `tick` may be executed, or None."""
        return None

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
