"""The guards of an arm.

They guarantee three things for any commands: the arm stays inside its position limits; no joint goes beyond the
farthest position that it was commanded to; and a limit that slows one joint slows all of them, so that the arm keeps
its direction.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import RobotSpec
from bam_envs.safety.guard import Guard, Limits, Tick, ToolPosition, clip, columns_in, max_rate, position_range

Array = NDArray[np.float64]
ROUNDING = 1 + 1e-9
"""A step that is exactly as long as its limit must not exceed it by floating point rounding."""
_ROUNDS = 8
"""Most times that a step is shortened until the tool is slow enough."""
JUMP = 0.05
"""Tolerance of the measured change of a joint beyond its fastest turn [rad]."""


def fastest_joints(spec: RobotSpec, limits: Limits, unlimited: float = math.inf) -> Array:
    """Maximum speed of each joint (k,) [rad/s], the lower of limit and data sheet; `unlimited` without either."""
    fastest: Array = np.minimum(limits.joint_speed, max_rate(spec.command)[columns_in(spec.command, "rad")])
    return np.where(np.isfinite(fastest), fastest, unlimited)


class PositionLimits(Guard):
    """Joints keep a margin from the ends of their travel, the gripper stays in its range.

    A joint that is inside the margin may stay or go back, and must not come nearer to the end.
    """

    number, name, unit = "G7", "position margin", "rad"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value = limits.position_margin
        self.low, self.high = position_range(spec, limits)

    def limit(self, tick: Tick) -> bool:
        """Clip the goal, joint by joint."""
        goal = np.clip(tick.goal, np.minimum(self.low, tick.last), np.maximum(self.high, tick.last))
        changed = bool((goal != tick.goal).any())
        tick.goal, tick.command = goal, goal.copy()
        return changed


class JointSpeed(Guard):
    """No joint is faster than the limit or its data sheet; the other joints slow down with it."""

    number, name, unit = "G8", "joint speed", "rad/s"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self._joints, self._fastest = columns_in(spec.command, "rad"), fastest_joints(spec, limits)
        self.limit_value = float(self._fastest.max())

    def limit(self, tick: Tick) -> bool:
        """Shorten the step of all joints."""
        return _shorten(tick, self._joints, self._fastest * tick.period)


class RampIn(Guard):
    """A first command that is farther than one step from the arm is approached slowly, for a limited time."""

    number, name, unit = "G14", "ramp-in speed", "rad/s"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value, self._joints = limits.reset_speed, columns_in(spec.command, "rad")
        # If nothing limited a joint's speed, a first step of any length would count as near.
        self._one_step = fastest_joints(spec, limits, limits.reset_speed) * spec.period * ROUNDING
        self._longest = math.ceil(limits.ramp_time / spec.period)
        self._left: int | None = None

    def restart(self) -> None:
        """Treat the next command as the first."""
        self._left = None

    def limit(self, tick: Tick) -> bool:
        """Shorten the steps until the command is reached."""
        reach = self.limit_value * tick.period
        if tick.approach:
            return _shorten(tick, self._joints, reach)
        if self._left == 0:
            return False
        far = bool((np.abs(tick.goal - tick.last)[self._joints] > self._one_step).any())
        self._left = 0 if not far else self._longest - 1 if self._left is None else self._left - 1
        return far and _shorten(tick, self._joints, reach)


class ToolSpeed(Guard):
    """The tool is never faster than the limit, along a straight line from command to command."""

    number, name, unit = "G10", "tool speed", "m/s"

    def __init__(self, spec: RobotSpec, limits: Limits, tool_position: ToolPosition) -> None:
        self.limit_value, self._tool = limits.tool_speed, tool_position
        self._joints = columns_in(spec.command, "rad")

    def limit(self, tick: Tick) -> bool:
        """Shorten the step of all joints."""
        last, wanted = tick.last[self._joints], tick.command[self._joints]
        tick.command[self._joints] = slowed = within_reach(self._tool, last, wanted, self.limit_value * tick.period)
        return slowed is not wanted


class JointAcceleration(Guard):
    """Joints gain and lose speed gradually, and begin to brake early enough to stop at their goal.

    A joint therefore never passes the goal of a command, unless a later command calls it back sooner than it can brake;
    then it passes the later goal only. If a change of direction is too sharp for all joints to turn together, each
    joint goes as far towards it as it may.
    """

    number, name, unit = "G9", "joint acceleration", "rad/s^2"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value = limits.joint_acceleration
        self._joints = columns_in(spec.command, "rad")
        self._period = spec.period

    def limit(self, tick: Tick) -> bool:
        """Bring the step near to the last one."""
        last = tick.last[self._joints]
        wanted, before = tick.command[self._joints] - last, tick.last_step[self._joints]
        distance = np.abs(tick.goal[self._joints] - last)
        change = self.limit_value * tick.period**2
        longest = longest_step(distance, self.limit_value * self._period**2) * (tick.period / self._period)
        slowed = wanted * _least_share(np.where(distance <= change, distance, longest), np.abs(wanted))
        step = self._near(slowed, before, change * ROUNDING)
        if (step == wanted).all():
            return False
        tick.command[self._joints] = last + step
        return True

    @staticmethod
    def _near(wanted: Array, before: Array, change: float) -> Array:
        """The longest part of `wanted` within reach of the step `before`; if there is none, each joint by itself."""
        low, high = before - change, before + change
        if (wanted >= low).all() and (wanted <= high).all():
            return wanted
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ends = np.sort(np.stack([low / wanted, high / wanted]), axis=0)
        ends = np.where(wanted == 0, np.where((low <= 0) & (high >= 0), [[0.0], [1.0]], [[2.0], [-1.0]]), ends)
        least, most = max(0.0, float(ends[0].max())), min(1.0, float(ends[1].min()))
        return wanted * most if least <= most else np.clip(wanted, low, high)


class GripperSpeed(Guard):
    """The gripper's width changes no faster than its data sheet allows, from the last command or the measured width."""

    number, name, unit = "G8", "gripper speed", "m/s"

    def __init__(self, spec: RobotSpec) -> None:
        self._columns = columns_in(spec.command, "m")
        self._rate = max_rate(spec.command)[self._columns]
        self.limit_value = float(self._rate.min())

    def limit(self, tick: Tick) -> bool:
        """Clip the width."""
        reach, last, measured = self._rate * tick.period, tick.last[self._columns], tick.measured[self._columns]
        # Around a held object the last width is far below the fingers: opening begins at the fingers.
        return clip(tick, self._columns, np.fmin(last, measured) - reach, np.fmax(last, measured) + reach)


class MeasuredJump(Guard):
    """A joint that is measured farther from its last position than it can have turned is wrongly measured."""

    number, name, unit = "G7", "measured jump", "rad"

    def __init__(self, spec: RobotSpec) -> None:
        self.limit_value, self._joints = JUMP, columns_in(spec.command, "rad")
        self._fastest = max_rate(spec.command)[self._joints]
        self._labels = np.array(spec.command.labels)[self._joints]

    def fault(self, tick: Tick) -> str | None:
        """Report the joint with the largest jump."""
        turned = np.abs(tick.measured - tick.before)[self._joints]
        most = self._fastest * (max(tick.period, tick.pause) + tick.age) + self.limit_value
        over = turned > most  # NaN: there was no tick before
        if not over.any():
            return None
        at = int(np.argmax(turned - most))
        return (
            f"{self._labels[at]} was measured {turned[at]:.3f} rad from where it was a tick before, and it turns "
            f"{most[at]:.3f} rad at most in that time: look at what publishes its position"
        )


def tool_travel(tool_position: ToolPosition, here: Array, there: Array) -> float:
    """Distance between the tool positions at the joints `here` and `there`, both (k,) [rad]; in m."""
    return math.dist(*tool_position(np.stack([here, there])))


def within_reach(tool_position: ToolPosition, here: Array, there: Array, reach: float) -> Array:
    """The joints `there` (k,), moved so near to `here` that the tool travels `reach` [m] at most."""
    near = there
    for _ in range(_ROUNDS):
        travel = tool_travel(tool_position, here, near)
        if travel <= reach * ROUNDING:
            return near
        near = here + (near - here) * (0.999 * reach / travel)
    return here


def longest_step(distance: Array, change: float) -> Array:
    """The longest next step after which a joint can still stop within `distance`.

    Each step may be shorter than the one before by `change`. If the first of n steps has length s and the last one is
    at most `change`, together they cover ``n s - change n (n - 1) / 2``.

    Args:
        distance: Not negative. Shape: (k,).
        change: Above 0, in the unit of `distance`.
    """
    steps = np.maximum(1.0, np.ceil((np.sqrt(1.0 + 8.0 * distance / change) - 1.0) / 2.0))
    longest: Array = distance / steps + change * (steps - 1.0) / 2.0
    return longest


def _shorten(tick: Tick, joints: Any, reach: Any) -> bool:
    """Shorten the step of all `joints` until none is longer than its `reach`; True if one was."""
    last = tick.last[joints]
    step = tick.command[joints] - last
    share = _least_share(reach, np.abs(step))
    if share == 1.0:
        return False
    tick.command[joints] = last + share * step
    return True


def _least_share(allowed: Any, wanted: Array) -> float:
    """The largest factor, at most 1, that makes all of `wanted` as small as `allowed`."""
    over = wanted > allowed * ROUNDING
    return float((allowed / np.where(over, wanted, 1.0))[over].min()) if over.any() else 1.0
