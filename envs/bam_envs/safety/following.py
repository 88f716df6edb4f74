"""Following (G23): a robot that does not follow its commands is held in place, and stopped if that continues.

A joint follows if it is behind its commands by no more than its known lag at its measured speed. The rest of the gap is
its jump if whatever holds it lets go. At rest that is at most the joint's limit for one period, so that it never moves
faster than its limit.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import RobotSpec
from bam_envs.safety.arm_guards import fastest_joints, tool_travel, within_reach
from bam_envs.safety.guard import Guard, Limits, Tick, ToolPosition, clip, columns_in, max_rate, ticks_of

Array = NDArray[np.float64]
SHARE = 0.75
"""The allowed gap, as a share of the limit for one period."""
STRIKES = 3
"""Number of times that a robot does not follow until it is stopped; fewer hold it."""
FORGIVEN = 2.0
"""Following for this long [s] sets that count back to 0."""
LIKELY = (
    "look for a protective stop, a paused program, an inactive controller, a low speed slider, or something in its way"
)


class Following(Guard):
    """Base class for arms and bases: the recent commands, and the number of times the robot did not follow them."""

    number = "G23"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self._lag = spec.lag if limits.lag is None else limits.lag
        # A command lasts for a period after it is sent, and the robot is behind it by its lag.
        self._sent: deque[Array] = deque(maxlen=2 + ticks_of(self._lag, spec))
        self._strikes, self._good, self._forgiven = 0, 0, ticks_of(FORGIVEN, spec)

    def restart(self) -> None:
        """Forget the commands: the next one begins at the robot's position."""
        self._sent.clear()

    def forgive(self) -> None:
        """Reset the count, when an episode begins or a person resumes the robot."""
        self._strikes = self._good = 0

    def off(self, sent: Array, measured: Array) -> Array:
        """Distance of the measured values from the range of the recent commands, 0 inside it. Shape: (k,)."""
        self._sent.append(sent)
        commands = np.stack(self._sent)
        off: Array = np.clip(measured, commands.min(axis=0), commands.max(axis=0)) - measured
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

    name, unit = "following", "rad"

    def __init__(self, spec: RobotSpec, limits: Limits, tool_position: ToolPosition | None) -> None:
        super().__init__(spec, limits)
        self._joints, self._period = columns_in(spec.command, "rad"), spec.period
        self._tool, self._tool_reach = tool_position, limits.tool_speed * spec.period
        self._labels = np.array(spec.command.labels)[self._joints]
        self._fastest = fastest_joints(spec, limits, limits.reset_speed)
        self._slowest = np.minimum(self._fastest, limits.reset_speed)
        self._tolerance = limits.follow_tolerance
        self.limit_value = float(self._fastest.max()) * (self._lag + self._period)

    def _reach(self, tick: Tick) -> Array:
        """Farthest that a command may be from a joint at rest [rad]. Shape: (k,)."""
        fastest = self._slowest if tick.approach else self._fastest
        reach: Array = np.maximum(fastest * self._period, self._tolerance)
        return reach

    def fault(self, tick: Tick) -> str | None:
        """Report the joint, the gap, and likely causes."""
        sent, measured = tick.last[self._joints], tick.measured[self._joints]
        off, allowed = self.off(sent, measured), SHARE * self._reach(tick)
        over = bool((np.abs(off) > allowed).any())  # NaN: it is not measured
        if not over and self._tool is not None and (np.abs(off) > self._tolerance).any():
            over = tool_travel(self._tool, measured, measured + off) > SHARE * self._tool_reach
        if not self.is_struck(over):
            return None
        at = int(np.argmax(np.abs(off) / allowed))
        return (
            f"{self._labels[at]} does not follow its commands: it is {measured[at] - sent[at]:+.3f} rad from the last "
            f"one, and beyond a lag of {self._lag:g} s it may be {allowed[at]:.3f} rad, and the tool "
            f"{SHARE * self._tool_reach:.3f} m: {LIKELY}"
        )

    def hold(self, tick: Tick) -> Array:
        """The measured joints, approached no faster than the joints' limits. Shape: (m,)."""
        held: Array = tick.last.copy()
        held[self._joints] = self._near(tick, tick.measured[self._joints])
        return held

    def limit(self, tick: Tick) -> bool:
        """Bring the command within one step of the explained position, so that a released joint cannot jump."""
        wanted, measured = tick.command[self._joints], tick.measured[self._joints]
        ahead = np.clip(np.nan_to_num(tick.velocity[self._joints]), -self._fastest, self._fastest) * self._lag
        explained = measured + np.clip(wanted - measured, np.minimum(ahead, 0.0), np.maximum(ahead, 0.0))
        jump = np.abs(wanted - explained)
        reach = self._reach(tick)
        near = np.clip(wanted, explained - reach, explained + reach)
        farther = (jump > np.abs(wanted - tick.last[self._joints]) + self._tolerance).any()
        if farther and self._tool is not None:  # at most the tool's limit for one period from there
            near = within_reach(self._tool, explained, near, self._tool_reach)
        if (near == wanted).all():
            return False
        tick.command[self._joints] = self._near(tick, near)
        return True

    def _near(self, tick: Tick, wanted: Array) -> Array:
        """`wanted`, at most one step from the last command: the measurement may be wrong."""
        last, step = tick.last[self._joints], (self._slowest if tick.approach else self._fastest) * self._period
        near: Array = np.clip(wanted, last - step, last + step)
        return near


class BaseFollowing(Following):
    """A base that does not follow its commands is sent no more speed than it can gain, and then 0."""

    def __init__(self, name: str, unit: str, acceleration: float, spec: RobotSpec, limits: Limits) -> None:
        super().__init__(spec, limits)
        self.name, self.unit = name, unit
        self._columns = columns_in(spec.command, unit)
        self._fastest = np.minimum(acceleration, max_rate(spec.command)[self._columns])
        self._ahead = self._fastest * (self._lag + spec.period)
        self.limit_value = float(self._ahead.max())
        self._change = self._fastest * spec.period
        self._allowed = SHARE * self._change
        self._reached: Array | None = None  # speed of a base that follows as well as its acceleration allows

    def restart(self) -> None:
        """Forget the reached speed as well: the base may still be moving."""
        super().restart()
        self._reached = None

    def fault(self, tick: Tick) -> str | None:
        """Report the measured speed and the commanded one."""
        sent, measured = tick.last[self._columns], tick.measured[self._columns]
        before = measured if self._reached is None else self._reached
        self._reached = np.clip(sent, before - self._change, before + self._change)
        off = np.abs(self.off(self._reached, measured))
        if not self.is_struck(bool((off > self._allowed).any())):
            return None
        at = int(np.argmax(off))
        return (
            f"the base does not follow its commands: it goes at {measured[at]:.3f} {self.unit}, and was sent "
            f"{sent[at]:.3f} {self.unit}; beyond a lag of {self._lag:g} s it may be off by {self._allowed[at]:.3f} "
            f"{self.unit}: {LIKELY}"
        )

    def limit(self, tick: Tick) -> bool:
        """Clip the speed around the measured one; slower is always allowed."""
        measured = tick.measured[self._columns]
        low, high = np.minimum(0.0, measured - self._ahead), np.maximum(0.0, measured + self._ahead)
        return clip(tick, self._columns, low, high)
