"""Following (G23): a robot that does not follow its commands is held in place, and stopped if that continues.

A joint follows if it is behind its commands by no more than its known lag at its measured speed. The rest of the gap is
the distance that it would jump when released. At rest that is at most the joint's limit for one period, so that a
released joint never moves faster than its limit.
"""

import math
from collections import deque

from bam_envs.core.robot import RobotSpec
from bam_envs.safety.arm_guards import fastest_joints, within_reach
from bam_envs.safety.guard import (
    Guard,
    Limits,
    Numbers,
    Tick,
    ToolPosition,
    clip,
    columns_in,
    max_rate,
    picker,
    ticks_of,
    tool_point_of,
)

SHARE = 0.75
"""The allowed gap, as a share of the limit for one period."""
STRIKES = 3
"""Number of times that a robot does not follow until it is stopped; fewer hold it."""
FORGIVEN = 2.0
"""Time of following after which that count is reset to 0 [s]."""
LIKELY = (
    "look for a protective stop, a paused program, an inactive controller, a low speed slider, or something in its way"
)


class Following(Guard):
    """Base class for arms and bases: the recent commands, and the number of times the robot did not follow them."""

    number = "G23"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self._lag = spec.lag if limits.lag is None else limits.lag
        # A command lasts for a period after it is sent, and the robot is behind it by its lag.
        self._sent: deque[Numbers] = deque(maxlen=2 + ticks_of(self._lag, spec))
        self._strikes, self._good, self._forgiven = 0, 0, ticks_of(FORGIVEN, spec)
        self._spec, self._own_lag = spec, self._lag

    def relayed(self, delay: float) -> None:
        """Explain that the robot gets commands later by `delay` [s], from a live agent that has guards of its own."""
        self._lag = self._own_lag + delay
        self._sent = deque(maxlen=2 + ticks_of(self._lag, self._spec))

    def restart(self) -> None:
        """Forget the commands: the next one begins at the robot's position."""
        self._sent.clear()

    def forgive(self) -> None:
        """Reset the count, when an episode begins or a person resumes the robot."""
        self._strikes = self._good = 0

    def off(self, sent: Numbers, measured: Numbers) -> Numbers:
        """Distance of the measured values from the range of the recent commands, 0 inside it. Shape: (k,)."""
        self._sent.append(sent)
        off = [0.0] * len(sent)
        for at, (value, oldest, newest) in enumerate(zip(measured, self._sent[0], sent, strict=True)):
            if oldest <= value <= newest or newest <= value <= oldest:
                continue
            commands = [command[at] for command in self._sent]
            low, high = min(commands), max(commands)
            off[at] = low - value if value < low else high - value if value > high else 0.0  # NaN: it is not measured
        return off

    def is_struck(self, over: bool) -> bool:
        """Count a tick whose gap is `over` the limit; after `STRIKES` of them the robot is stopped."""
        if not over:
            self._good += 1
            self._strikes = 0 if self._good >= self._forgiven else self._strikes
            return False
        self._strikes, self._good = self._strikes + 1, 0
        self.patience = 1 if self._strikes >= STRIKES else math.inf
        self._sent.clear()
        return True


class JointFollowing(Following):
    """A command is no farther from the measured joint than its lag explains; a joint that does not follow is held."""

    name, unit, setting = "following", "rad", "lag"

    def __init__(self, spec: RobotSpec, limits: Limits, tool_position: ToolPosition | None) -> None:
        super().__init__(spec, limits)
        self._joints, self._period = columns_in(spec.command, "rad"), spec.period
        self._pick = picker(self._joints)
        self._tool = None if tool_position is None else tool_point_of(tool_position)
        self._tool_reach = limits.tool_speed * spec.period
        self._labels = [spec.command.labels[at] for at in self._joints]
        fastest, self._tolerance = fastest_joints(spec, limits, limits.reset_speed), limits.follow_tolerance
        self._fastest = fastest
        self._step = [speed * spec.period for speed in fastest]
        self._slow_step = [min(speed, limits.reset_speed) * spec.period for speed in fastest]
        self._reach = [max(step, self._tolerance) for step in self._step]
        self._slow_reach = [max(step, self._tolerance) for step in self._slow_step]
        self._allowed = [SHARE * reach for reach in self._reach]
        self._slow_allowed = [SHARE * reach for reach in self._slow_reach]
        self.limit_value = max(fastest) * (self._lag + self._period)

    def fault(self, tick: Tick) -> str | None:
        """Report the joint, the gap, and likely causes."""
        sent, measured = self._pick(tick.last), self._pick(tick.measured)
        off = self.off(sent, measured)
        # The farthest that a command may be from a joint at rest.
        allowed, farthest, over = self._slow_allowed if tick.approach else self._allowed, 0.0, False
        if any(off):
            for gap, most in zip(off, allowed, strict=True):
                size = abs(gap)
                farthest, over = max(farthest, size), over or size > most
        if not over and self._tool is not None and farthest > self._tolerance:
            explained = [value + gap for value, gap in zip(measured, off, strict=True)]
            over = math.dist(self._tool(measured), self._tool(explained)) > SHARE * self._tool_reach
        if not self.is_struck(over):
            return None
        at = max(range(len(off)), key=lambda column: abs(off[column]) / allowed[column])
        return (
            f"{self._labels[at]} does not follow its commands: it is {measured[at] - sent[at]:+.3f} rad from the last "
            f"one, and beyond a lag of {self._lag:g} s it may be {allowed[at]:.3f} rad, and the tool "
            f"{SHARE * self._tool_reach:.3f} m: {LIKELY}"
        )

    def hold(self, tick: Tick) -> Numbers:
        """The measured joints, approached no faster than the joints' limits. Shape: (m,)."""
        held = tick.last.copy()
        self._go_near(tick, self._pick(tick.measured), held)
        return held

    def limit(self, tick: Tick) -> bool:
        """Bring the command within one step of the explained position, so that a released joint cannot jump."""
        command, pick, reaches = tick.command, self._pick, self._slow_reach if tick.approach else self._reach
        explained, near, farther, changed = [], [], False, False
        rows = pick(command), pick(tick.last), pick(tick.measured), pick(tick.velocity), self._fastest, reaches
        for wanted, last, measured, reach in zip(*rows[:3], reaches, strict=True):
            gap = abs(wanted - measured)
            if not (gap <= reach and gap <= abs(wanted - last) + self._tolerance):
                break
        else:  # near enough even if the lag explains none of the gap
            return False
        for wanted, last, measured, speed, fastest, reach in zip(*rows, strict=True):
            gap = wanted - measured
            ahead = min(max(speed, -fastest), fastest) * self._lag
            # The lag explains a gap in the direction of the motion; NaN: the speed is not measured.
            part = (gap if abs(gap) < abs(ahead) else ahead) if gap * ahead > 0.0 else 0.0
            place = measured + part
            allowed = place - reach if wanted < place - reach else place + reach if wanted > place + reach else wanted
            changed = changed or allowed != wanted
            farther = farther or abs(wanted - place) > abs(wanted - last) + self._tolerance
            explained.append(place)
            near.append(allowed)
        if farther and self._tool is not None:  # at most the tool's limit for one period from there
            reached = within_reach(self._tool, explained, near, self._tool_reach)
            changed, near = changed or reached is not near, reached
        if not changed:
            return False
        self._go_near(tick, near, command)
        return True

    def _go_near(self, tick: Tick, wanted: Numbers, command: Numbers) -> None:
        """Set the joints of `command` as near to `wanted` as the limits of joints and tool allow from the last command.

        The measurement may be wrong.

        Args:
            tick: The tick.
            wanted: Joints [rad]. Shape: (k,).
            command: The command to change. Shape: (m,).
        """
        share = tick.period / self._period
        steps = [step * share for step in (self._slow_step if tick.approach else self._step)]
        last = self._pick(tick.last)
        rows = zip(wanted, last, steps, strict=True)
        near = [min(max(value, begin - step), begin + step) for value, begin, step in rows]
        if self._tool is not None:
            near = within_reach(self._tool, last, near, self._tool_reach * share)
        for at, value in zip(self._joints, near, strict=True):
            command[at] = value


class BaseFollowing(Following):
    """Commands stay within reach of the measured speed; a base that does not follow its commands is held."""

    setting = "lag"

    def __init__(self, name: str, unit: str, acceleration: float, spec: RobotSpec, limits: Limits) -> None:
        super().__init__(spec, limits)
        self.name, self.unit, rates = name, unit, max_rate(spec.command)
        self._columns = columns_in(spec.command, unit)
        fastest = [min(acceleration, rates[at]) for at in self._columns]
        self._ahead = [speed * (self._lag + spec.period) for speed in fastest]
        self.limit_value = max(self._ahead)
        self._change = [speed * spec.period for speed in fastest]
        self._allowed = [SHARE * change for change in self._change]
        self._reached: Numbers | None = None  # speed of a base that follows as well as its acceleration allows

    def restart(self) -> None:
        """Forget the reached speed as well: the base may still be moving."""
        super().restart()
        self._reached = None

    def fault(self, tick: Tick) -> str | None:
        """Report the measured speed and the commanded one."""
        sent, measured = [tick.last[at] for at in self._columns], [tick.measured[at] for at in self._columns]
        rows = zip(sent, self._reached or measured, self._change, strict=True)
        self._reached = [min(max(value, before - change), before + change) for value, before, change in rows]
        off = [abs(gap) for gap in self.off(self._reached, measured)]
        if not self.is_struck(any(gap > most for gap, most in zip(off, self._allowed, strict=True))):
            return None
        at = off.index(max(off))
        return (
            f"the base does not follow its commands: it goes at {measured[at]:.3f} {self.unit}, and was sent "
            f"{sent[at]:.3f} {self.unit}; beyond a lag of {self._lag:g} s it may be off by {self._allowed[at]:.3f} "
            f"{self.unit}: {LIKELY}"
        )

    def limit(self, tick: Tick) -> bool:
        """Clip the speed around the measured one; slower is always allowed."""
        low, high = [], []
        for at, ahead in zip(self._columns, self._ahead, strict=True):
            measured = tick.measured[at]
            unknown = math.isnan(measured)
            low.append(-math.inf if unknown else min(0.0, measured - ahead))
            high.append(math.inf if unknown else max(0.0, measured + ahead))
        return clip(tick, self._columns, low, high)
