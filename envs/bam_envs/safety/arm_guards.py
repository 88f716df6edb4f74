"""The guards of an arm.

They guarantee three things for any commands: the arm stays inside its position limits; no joint goes beyond the
farthest position that it was commanded to; and a limit that slows one joint slows all of them, so that the arm keeps
its direction.
"""

import math
from collections.abc import Sequence
from operator import le, sub

from bam_envs.core.robot import RobotSpec
from bam_envs.safety.guard import (
    Guard,
    Limits,
    Numbers,
    Tick,
    ToolPoint,
    ToolPosition,
    columns_in,
    max_rate,
    picker,
    position_range,
    tool_point_of,
)

ROUNDING = 1 + 1e-9
"""A step that is exactly as long as its limit must not exceed it by floating point rounding."""
_ROUNDS = 8
"""Maximum number of times that a step is shortened until the tool is slow enough."""
SHARE_AT_ONCE = 0.5
"""Share of its limit that a joint gets which goes to a command at once: slowed down by its side and released, it makes
the rest of one step and the whole of the next one within a period."""
JUMP = 0.05
"""Tolerance of the measured change of a joint beyond its fastest turn [rad]."""


def fastest_joints(spec: RobotSpec, limits: Limits, unlimited: float = math.inf) -> Numbers:
    """Maximum speed of each joint (k,) [rad/s], the lower of limit and data sheet; `unlimited` without either."""
    rates = max_rate(spec.command)
    fastest = [min(limits.joint_speed, rates[column]) for column in columns_in(spec.command, "rad")]
    return [speed if math.isfinite(speed) else unlimited for speed in fastest]


def fastest_commands(spec: RobotSpec, limits: Limits, unlimited: float = math.inf) -> Numbers:
    """Maximum speed at which each joint is commanded (k,) [rad/s]: so that it turns within its limit."""
    share = 1.0 if spec.is_timed else SHARE_AT_ONCE
    return [share * speed for speed in fastest_joints(spec, limits, unlimited)]


def joint_limits(spec: RobotSpec, of_each: Sequence[float] | None, limit: float) -> Numbers:
    """The lower one of `limit` and the robot's own limit `of_each` number of a command, for each joint (k,)."""
    return [limit if of_each is None else min(limit, of_each[at]) for at in columns_in(spec.command, "rad")]


class PositionLimits(Guard):
    """Joints keep a margin from the ends of their travel, the gripper stays in its range.

    A joint that is inside the margin may stay or go back, and must not come nearer to the end.
    """

    number, name, unit, setting = "G7", "position margin", "rad", "position_margin"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value = limits.position_margin
        self.low, self.high = position_range(spec, limits)

    def limit(self, tick: Tick) -> bool:
        """Clip the goal, joint by joint."""
        if all(map(le, self.low, tick.goal)) and all(map(le, tick.goal, self.high)):
            tick.command = tick.goal.copy()
            return False
        return self._clip(tick)

    def _clip(self, tick: Tick) -> bool:
        rows = zip(tick.goal, tick.last, self.low, self.high, strict=True)
        goal = [min(max(value, min(low, last)), max(high, last)) for value, last, low, high in rows]
        changed = goal != tick.goal
        tick.goal, tick.command = goal, goal.copy()
        return changed


class JointSpeed(Guard):
    """No joint is faster than the limit or its data sheet; the other joints slow down with it."""

    number, name, unit, setting = "G8", "joint speed", "rad/s", "joint_speed"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self._joints, self.each = columns_in(spec.command, "rad"), fastest_commands(spec, limits)
        self.limit_value, self._pick = max(self.each), picker(self._joints)
        self._period, self._reach = 0.0, list[float]()

    def limit(self, tick: Tick) -> bool:
        """Shorten the step of all joints."""
        if tick.period != self._period:
            self._period, self._reach = tick.period, [fastest * tick.period for fastest in self.each]
        if all(map(le, map(abs, map(sub, self._pick(tick.command), self._pick(tick.last))), self._reach)):
            return False
        return shorten(tick, self._joints, self._reach)


class RampIn(Guard):
    """A first command that is farther than one step from the arm is approached slowly, for a limited time."""

    number, name, unit, setting = "G14", "ramp-in speed", "rad/s", "reset_speed"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value, self._joints = limits.reset_speed, columns_in(spec.command, "rad")
        # If nothing limited a joint's speed, a first step of any length would count as near.
        fastest = fastest_joints(spec, limits, limits.reset_speed)
        self._one_step = [speed * spec.period * ROUNDING for speed in fastest]
        self._longest = math.ceil(limits.ramp_time / spec.period)
        self._left: int | None = None

    def restart(self) -> None:
        """Treat the next command as the first."""
        self._left = None

    def limit(self, tick: Tick) -> bool:
        """Shorten the steps until the command is reached."""
        if self._left == 0 and not tick.approach:
            return False
        reach = [self.limit_value * tick.period] * len(self._joints)
        if tick.approach:
            return shorten(tick, self._joints, reach)
        goal, last = tick.goal, tick.last
        far = any(abs(goal[at] - last[at]) > step for at, step in zip(self._joints, self._one_step, strict=True))
        self._left = 0 if not far else self._longest - 1 if self._left is None else self._left - 1
        return far and shorten(tick, self._joints, reach)


class ToolSpeed(Guard):
    """The tool is never faster than the limit, along a straight line from command to command."""

    number, name, unit, setting = "G10", "tool speed", "m/s", "tool_speed"

    def __init__(self, spec: RobotSpec, limits: Limits, tool_position: ToolPosition) -> None:
        self.limit_value, self._tool = limits.tool_speed, tool_point_of(tool_position)
        self._joints = columns_in(spec.command, "rad")
        self._pick = picker(self._joints)
        self._checked: tuple[Numbers, Numbers, float] | None = None
        # Where the tool is at the last command, and at the one after it that was found slow enough.
        self._here: tuple[Numbers, tuple[float, float, float]] = [], (0.0, 0.0, 0.0)
        self._there = self._here

    def limit(self, tick: Tick) -> bool:
        """Shorten the step of all joints."""
        last, wanted, reach = self._pick(tick.last), self._pick(tick.command), self.limit_value * tick.period
        if self._checked == (last, wanted, reach):  # called twice in a tick, and few commands change in between
            return False
        if self._here[0] != last:
            self._here = self._there if self._there[0] == last else (last, self._tool(last))
        slowed, there = within_reach(self._tool, last, wanted, reach, self._here[1])
        self._checked, self._there = (last, slowed, reach), (slowed, there)
        if slowed is wanted:
            return False
        for at, value in zip(self._joints, slowed, strict=True):
            tick.command[at] = value
        return True


class JointAcceleration(Guard):
    """Joints gain and lose speed gradually, and begin to brake early enough to stop at their goal.

    A joint gains speed within its own limit, the lower one of `joint_acceleration` and the description, and brakes
    within `joint_acceleration`: it never passes the goal of a command, unless a later command calls it back sooner than
    it can brake; then it passes the later goal only. If a change of direction is too sharp for all joints to turn
    together, each joint goes as far towards it as it may.
    """

    number, name, unit, setting = "G9", "joint acceleration", "rad/s^2", "joint_acceleration"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self._brakes = limits.joint_acceleration
        self.each = joint_limits(spec, spec.command.max_acceleration, self._brakes)
        self.limit_value = max(self.each)
        self._joints = columns_in(spec.command, "rad")
        self._pick, self._period = picker(self._joints), spec.period

    def limit(self, tick: Tick) -> bool:
        """Bring the step near to the last one."""
        pick, command, last = self._pick, tick.command, self._pick(tick.last)
        goal, before = pick(tick.goal), pick(tick.last_step)
        squared, shortened, share = tick.period**2, tick.period / self._period, 1.0
        for now, begin, end, about, most in zip(pick(command), last, goal, before, self.each, strict=True):
            way, gain = now - begin, most * squared
            if abs(way) > gain or abs(way) > abs(end - begin) * shortened or not -gain <= way - about <= gain:
                break  # it may have to brake
        else:
            return False
        wanted, distances = list(map(sub, pick(command), last)), list(map(abs, map(sub, goal, last)))
        change, braking = self._brakes * squared, self._brakes * self._period**2
        for way, distance in zip(map(abs, wanted), distances, strict=True):
            if way <= change and way <= distance * shortened:  # it can stop after that
                continue
            longest = distance if distance <= change else longest_step(distance, braking) * shortened
            if way > longest * ROUNDING:
                share = min(share, longest / way)
        slowed = wanted if share == 1.0 else [way * share for way in wanted]
        step = self._near(slowed, before, change, squared)
        if step is wanted or step == wanted:
            return False
        for at, begin, way in zip(self._joints, last, step, strict=True):
            command[at] = begin + way
        return True

    def _near(self, wanted: Numbers, before: Numbers, change: float, squared: float) -> Numbers:
        """The longest part of `wanted` within reach of the step `before`; if there is none, each joint by itself.

        Within reach is a joint that gains at most its own limit, or loses at most `change` on the way to rest.
        """
        lows, highs = list[float](), list[float]()
        for about, most in zip(before, self.each, strict=True):
            gain = most * squared
            lows.append(about - ROUNDING * max(gain, min(change, about)))
            highs.append(about + ROUNDING * max(gain, min(change, -about)))
        if all(map(le, lows, wanted)) and all(map(le, wanted, highs)):
            return wanted
        least, most = 0.0, 1.0
        for way, low, high in zip(wanted, lows, highs, strict=True):
            if low <= way <= high:
                if low > 0.0 or high < 0.0:  # a shorter part may be outside
                    least = max(least, (low if low > 0.0 else high) / way)
            elif way == 0.0:
                least, most = 2.0, -1.0
            else:
                ends = low / way, high / way
                least, most = max(least, min(ends)), min(most, max(ends))
        if least <= most:
            return [way * most for way in wanted]
        rows = zip(wanted, lows, highs, strict=True)
        return [min(max(way, low), high) for way, low, high in rows]


class JointJerk(Guard):
    """Joints that speed up do so gradually: their acceleration grows slowly. Braking is never held back.

    A joint has the lower one of `joint_jerk` and the description.
    """

    number, name, unit, setting = "G9", "joint jerk", "rad/s^3", "joint_jerk"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.each = joint_limits(spec, spec.command.max_jerk, limits.joint_jerk)
        self.limit_value = max(self.each)
        gains = joint_limits(spec, spec.command.max_acceleration, limits.joint_acceleration)
        rows = zip(columns_in(spec.command, "rad"), self.each, gains, strict=True)
        # The other joints reach any acceleration in one step.
        self._jerks = [(at, jerk) for at, jerk, gain in rows if jerk * spec.period < gain]
        self._before = [0.0] * len(spec.command.labels)  # speeds one command before the last one [unit/s]

    def restart(self) -> None:
        """The robot is at rest."""
        self._before = [0.0] * len(self._before)

    def limit(self, tick: Tick) -> bool:
        """Bring the steps of joints that speed up near to the last ones."""
        period, before, changed = tick.period, self._before, False
        self._before = [step / period for step in tick.last_step]
        for at, jerk in self._jerks:
            last, step, speed = tick.last[at], tick.command[at] - tick.last[at], self._before[at]
            way = math.copysign(1.0, step)
            gained = max(0.0, way * (speed - before[at]) / period) if way * speed > 0.0 else 0.0
            most = max(0.0, way * speed) * period + (gained + jerk * period) * period**2
            if way * step > most * ROUNDING:
                tick.command[at], changed = last + way * most, True
        return changed


class GripperSpeed(Guard):
    """The gripper's width changes no faster than its data sheet allows, from the last command or the measured width."""

    number, name, unit = "G8", "gripper speed", "m/s"

    def __init__(self, spec: RobotSpec) -> None:
        self._columns = columns_in(spec.command, "m")
        rates = max_rate(spec.command)
        self._rates = [rates[column] for column in self._columns]
        self.limit_value = min(self._rates)

    def limit(self, tick: Tick) -> bool:
        """Clip the width."""
        changed = False
        for column, rate in zip(self._columns, self._rates, strict=True):
            reach, last, measured, wanted = (
                rate * tick.period,
                tick.last[column],
                tick.measured[column],
                tick.command[column],
            )
            # Around a held object the last width is far below the fingers: opening begins at the fingers.
            low = (measured if measured < last else last) - reach  # NaN: it is not measured
            high = (measured if measured > last else last) + reach
            if not low <= wanted <= high:
                tick.command[column], changed = (low if wanted < low else high), True
        return changed


class MeasuredJump(Guard):
    """The robot is stopped if a joint's measured position changes by more than its maximum speed allows."""

    number, name, unit = "G7", "measured jump", "rad"

    def __init__(self, spec: RobotSpec) -> None:
        self.limit_value, self._period, rates = JUMP, spec.period, max_rate(spec.command)
        self._joints = [(at, rates[at], spec.command.labels[at]) for at in columns_in(spec.command, "rad")]
        self._pick = picker(columns_in(spec.command, "rad"))
        self._slowest = min(rate for _, rate, _ in self._joints)

    def fault(self, tick: Tick) -> str | None:
        """Report the joint with the largest jump."""
        measured, before, seconds = tick.measured, tick.before, max(self._period, tick.pause) + tick.age
        if max(map(abs, map(sub, self._pick(measured), self._pick(before)))) <= self._slowest * seconds + JUMP:
            return None
        worst, text = 0.0, None
        for at, fastest, label in self._joints:
            turned, most = abs(measured[at] - before[at]), fastest * seconds + self.limit_value
            if turned - most > worst:  # NaN: there was no tick before
                worst = turned - most
                text = (
                    f"{label} was measured {turned:.3f} rad from where it was a tick before, and it turns "
                    f"{most:.3f} rad at most in that time: look at what publishes its position"
                )
        return text


def within_reach(
    tool: ToolPoint, here: Numbers, there: Numbers, reach: float, start: tuple[float, float, float] | None = None
) -> tuple[Numbers, tuple[float, float, float]]:
    """The joints `there` (k,), moved so near to `here` that the tool travels `reach` [m] at most, and the tool there.

    `start` is the tool at `here`, where it is known.
    """
    start, near = start or tool(here), there
    for _ in range(_ROUNDS):
        end = tool(near)
        travel = math.dist(start, end)
        if travel <= reach * ROUNDING:
            return near, end
        share = 0.999 * reach / travel
        near = [begin + (end - begin) * share for begin, end in zip(here, near, strict=True)]
    return here, start


def longest_step(distance: float, change: float) -> float:
    """The longest next step after which a joint can still stop within `distance`.

    Each step may be shorter than the one before by `change`. If the first of n steps has length s and the last one is
    at most `change`, together they cover ``n s - change n (n - 1) / 2``.

    Args:
        distance: Not negative.
        change: Above 0, in the unit of `distance`.
    """
    steps = max(1.0, math.ceil((math.sqrt(1.0 + 8.0 * distance / change) - 1.0) / 2.0))
    return distance / steps + change * (steps - 1.0) / 2.0


def shorten(tick: Tick, joints: Sequence[int], reach: Numbers) -> bool:
    """Shorten the step of all `joints` until none is longer than its `reach` (k,); True if one was."""
    last, command, share = tick.last, tick.command, 1.0
    for at, most in zip(joints, reach, strict=True):
        way = abs(command[at] - last[at])
        if way > most * ROUNDING:
            share = min(share, most / way)
    if share == 1.0:
        return False
    for at in joints:
        command[at] = last[at] + share * (command[at] - last[at])
    return True
