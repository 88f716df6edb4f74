"""Following (G23): a robot that does not follow its commands is held in place, and stopped if that continues.

A joint follows if it is behind its commands by no more than its lag at its measured speed. The rest of the gap is the
distance that it would jump when released: at most its limit for one period, so that a released joint never moves faster
than that. A joint that moves away from its commands stops a real robot at once: what moves is not what was commanded. A
simulated arm, whose controllers are softer, is also pushed that far by the objects that it touches: while it is held
and its gap shrinks, that counts once.
"""

import math
from collections import deque
from operator import gt

from bam_envs.core.robot import RobotSpec
from bam_envs.safety.arm_guards import fastest_commands, within_reach
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
STUCK, STUCK_TIME = 0.002, 2.0
"""An arm none of whose joints moves by so much [rad] for so long [s], although its commands go on, is stopped."""
SLOWEST_GAIN, GAIN_TIME = 0.25, 0.2
"""Least acceleration of a base that follows [m/s^2, rad/s^2], and the time over which it is measured [s]."""
OLD_STATE = 0.1
"""Longest age of a state for which it is compared with older commands [s]: it says where the robot was then."""
LIKELY = (
    "look for a protective stop, a paused program, an inactive controller, a low speed slider, or something in its way"
)
PRESSES = (
    "it presses on something, such as the object or the table, as the policy asks, and a real arm is stopped sooner: "
    "train the policy further, with randomize=true"
)
"""The same of a simulated robot, which has no such states."""


class Following(Guard):
    """Base class for arms and bases: the recent commands, and the number of times the robot did not follow them."""

    number = "G23"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self._lag = spec.lag if limits.lag is None else limits.lag
        # A command lasts for a period after it is sent, and the robot is behind it by its lag: also after a halt, when
        # the next motion begins before the robot is at rest.
        self._recent = 2 + ticks_of(self._lag, spec)
        self._sent: deque[Numbers] = deque(maxlen=self._recent + ticks_of(OLD_STATE, spec))
        self._strikes, self._good, self._forgiven = 0, 0, ticks_of(FORGIVEN, spec)
        self._spec, self._own_lag, self._period = spec, self._lag, spec.period
        self._ended: Numbers = []  # see Tick
        self._yields = False

    def connected(self, delay: float, *, yields: bool) -> None:
        """Take what is known of the robot now.

        Args:
            delay: Time by which it gets commands later, from a live agent that has guards of its own [s].
            yields: Whether it is simulated, and yields to what it touches.
        """
        self._yields = yields
        self._lag = self._own_lag + delay
        self._recent = 2 + ticks_of(self._lag, self._spec)
        self._sent = deque(maxlen=self._recent + ticks_of(OLD_STATE, self._spec))

    @property
    def likely(self) -> str:
        """Likely causes of a gap, for messages."""
        return PRESSES if self._yields and self._spec.command.units[0] == "rad" else LIKELY

    def resumed(self) -> None:
        """Forget the commands: the robot is at rest where a person found it."""
        self._sent.clear()

    def begin(self, tick: Tick) -> None:
        """In the first tick of a motion, forget the commands before it if the robot is at rest since."""
        if tick.ended is not self._ended:
            self._ended = tick.ended
            if not tick.ended:
                self._sent.clear()
            elif self._sent:
                self._sent.append(self.pick_from(tick.ended))

    def pick_from(self, command: Numbers) -> Numbers:
        """The numbers of a command that this guard compares. Shape: (m,) to (k,)."""
        raise NotImplementedError

    def forgive(self) -> None:
        """Reset the count, when an episode begins or a person resumes the robot."""
        self._strikes = self._good = 0

    def off(self, sent: Numbers, measured: Numbers, age: float) -> Numbers:
        """Distance of values measured `age` [s] ago from the range of the commands until then, 0 inside it (k,)."""
        self._sent.append(sent)
        off, since = [0.0] * len(sent), self._recent + int(min(age, OLD_STATE) / self._period)
        known = [*self._sent][-since:]
        for value, oldest, newest in zip(measured, known[0], sent, strict=True):
            if not (oldest <= value <= newest or newest <= value <= oldest):
                break
        else:
            return off
        for at, (value, *commands) in enumerate(zip(measured, *known, strict=True)):
            low, high = min(commands), max(commands)
            off[at] = low - value if value < low else high - value if value > high else 0.0  # NaN: it is not measured
        return off

    def is_struck(self, over: bool, *, most: int = STRIKES) -> bool:
        """Count a tick whose gap is `over` the limit; at the number `most` of them the robot is stopped."""
        if not over:
            self._good += 1
            self._strikes = 0 if self._good >= self._forgiven else self._strikes
            return False
        self._strikes, self._good = self._strikes + 1, 0
        self.patience = 1 if self._strikes >= most else math.inf
        return True


class JointFollowing(Following):
    """A command is no farther from the measured joint than its lag explains; a joint that does not follow is held."""

    name, unit, setting = "following", "rad", "lag"

    def __init__(self, spec: RobotSpec, limits: Limits, tool_position: ToolPosition | None) -> None:
        super().__init__(spec, limits)
        self._joints = columns_in(spec.command, "rad")
        self._pick = picker(self._joints)
        self._tool = None if tool_position is None else tool_point_of(tool_position)
        self._tool_reach = limits.tool_speed * spec.period
        self._labels = [spec.command.labels[at] for at in self._joints]
        fastest, self._tolerance = fastest_commands(spec, limits, limits.reset_speed), limits.follow_tolerance
        self._fastest = fastest
        self._step = [speed * spec.period for speed in fastest]
        self._slow_step = [min(speed, limits.reset_speed) * spec.period for speed in fastest]
        self._reach = [max(step, self._tolerance) for step in self._step]
        self._slow_reach = [max(step, self._tolerance) for step in self._slow_step]
        self._allowed = [SHARE * reach for reach in self._reach]
        self._slow_allowed = [SHARE * reach for reach in self._slow_reach]
        self.limit_value = max(fastest) * (self._lag + self._period)
        self._known_lag = math.inf  # as measured
        self._stuck, self._stuck_ticks, self._place = 0, ticks_of(STUCK_TIME, spec), list[float]()
        self._moved: Numbers = []  # in the period before [rad]
        self._gap = 0.0  # the greatest one when the arm did not follow the last time [rad]
        self._change = limits.joint_acceleration * spec.period**2

    def measured(self, lag: float) -> None:
        """Take the measured `lag` of this arm [s]: a gap that it does not explain is one that the arm may jump."""
        self._known_lag = lag

    def restart(self) -> None:
        """Forget the motion."""
        self._stuck, self._moved = 0, list[float]()

    def fault(self, tick: Tick) -> str | None:
        """Report the joint, the gap, and likely causes."""
        if tick.proving:
            return None
        sent, measured = self._pick(tick.last), self._pick(tick.measured)
        if self._stuck > self._stuck_ticks:
            self._stuck, self.patience = 0, 1
            return f"no joint has moved for {STUCK_TIME:g} s, and the arm was commanded to move: {self.likely}"
        self.begin(tick)
        off = self.off(sent, measured, tick.age)
        # The farthest that a command may be from a joint at rest.
        allowed, farthest, over = self._slow_allowed if tick.approach else self._allowed, 0.0, False
        if any(off):
            sizes = list(map(abs, off))
            farthest, over = max(sizes), any(map(gt, sizes, allowed))
        if not over and self._tool is not None and farthest > self._tolerance:
            explained = [value + gap for value, gap in zip(measured, off, strict=True)]
            over = math.dist(self._tool(measured), self._tool(explained)) > SHARE * self._tool_reach
        if not over:
            self.is_struck(over)
            return None
        at = max(range(len(off)), key=lambda column: abs(off[column]) / allowed[column])
        moved = measured[at] - self._pick(tick.before)[at]  # NaN in a first tick
        away = moved * off[at] < 0.0 and abs(moved) > allowed[at] / 2 and not self._yields
        # Its command goes to the measured joints no faster than the tool may, which takes a slow arm some ticks.
        retreats = self._yields and self._strikes > 0 == self._good and farthest < self._gap
        self._gap = farthest
        if retreats:
            self.patience = math.inf
        else:
            self.is_struck(over, most=1 if away else STRIKES)
        if away:
            return (
                f"{self._labels[at]} moved {moved:+.3f} rad within a period, away from its commands: what moves is not "
                f"what was commanded, or something pushes the arm"
            )
        return (
            f"{self._labels[at]} does not follow its commands: it is {measured[at] - sent[at]:+.3f} rad from the last "
            f"one, and beyond a lag of {self._lag:g} s it may be {allowed[at]:.3f} rad, and the tool "
            f"{SHARE * self._tool_reach:.3f} m: {self.likely}"
        )

    def pick_from(self, command: Numbers) -> Numbers:
        """The joints of a command [rad]. Shape: (m,) to (k,)."""
        return self._pick(command)

    def hold(self, tick: Tick) -> Numbers:
        """The measured joints, approached no faster than the joints' limits. Shape: (m,)."""
        held = tick.last.copy()
        self._go_near(tick, self._pick(tick.measured), held)
        return held

    def limit(self, tick: Tick) -> bool:
        """Bring the command within one step of the explained position, so that a released joint cannot jump."""
        if tick.proving:
            return False
        command, pick, reaches = tick.command, self._pick, self._slow_reach if tick.approach else self._reach
        wanted, last, measured = pick(command), pick(tick.last), pick(tick.measured)
        inf, change, tolerance, turned = math.inf, self._change, self._tolerance, list[float]()
        before, self._moved = self._moved or [inf] * len(last), turned
        lag, places, near, farther = min(self._lag, self._known_lag), list[float](), list[float](), False
        measured_before, speeds = pick(tick.before), pick(tick.velocity)
        rows = zip(wanted, last, measured, measured_before, speeds, self._fastest, reaches, before, strict=True)
        for goal, sent, here, was, speed, fastest, reach, moved_before in rows:
            gap, moved, place = sent - here, abs(here - was) if was == was else inf, here  # NaN in a first tick
            if gap:
                ahead = (speed if -fastest <= speed <= fastest else min(max(speed, -fastest), fastest)) * lag
                # The lag explains a gap in the direction of the motion; NaN: the speed is not measured.
                if gap * ahead > 0.0:
                    place = here + (gap if abs(gap) < abs(ahead) else ahead)
                farther = farther or abs(goal - place) > abs(goal - sent) + tolerance
            low, high = place - reach, place + reach
            # A joint that has just made up for a gap, faster than it may speed up, makes a step that much shorter.
            if moved - moved_before > change:
                step = reach - min(reach, moved - moved_before - change)
                low, high = max(low, min(sent, place) - step), min(high, max(sent, place) + step)
            turned.append(moved)
            near.append(low if goal < low else high if goal > high else goal)
            places.append(place)
        changed = near != wanted
        if farther and self._tool is not None:  # at most the tool's limit for one period from there
            reached, _ = within_reach(self._tool, places, near, self._tool_reach)
            changed, near = changed or reached is not near, reached
        if not changed:
            self._stuck = 0
            return False
        self._count_stuck(measured)
        self._go_near(tick, near, command)
        return True

    def _count_stuck(self, measured: Numbers) -> None:
        """Count the commands in a row that were held back because the arm does not follow, while no joint moves."""
        if not self._stuck or any(abs(now - at) > STUCK for now, at in zip(measured, self._place, strict=True)):
            self._stuck, self._place = 0, measured
        self._stuck += 1

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
            near, _ = within_reach(self._tool, last, near, self._tool_reach * share)
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
        self._expected, self._acceleration = fastest, name.replace("following", "acceleration").replace(" ", "_")
        self._reached: Numbers | None = None  # speed of a base that follows as well as its acceleration allows
        self._speeds: deque[Numbers] = deque(maxlen=1 + ticks_of(GAIN_TIME, spec))  # as measured

    def restart(self) -> None:
        """Forget the motion and the reached speed: the base may still be moving."""
        self._reached = None
        self._speeds.clear()

    def fault(self, tick: Tick) -> str | None:
        """Report the measured speed and the commanded one."""
        self.begin(tick)
        sent, measured = [tick.last[at] for at in self._columns], [tick.measured[at] for at in self._columns]
        rows = zip(sent, self._reached or measured, self._change, strict=True)
        self._reached = [min(max(value, before - change), before + change) for value, before, change in rows]
        off = [abs(gap) for gap in self.off(self._reached, measured, tick.age)]
        self._speeds.append(measured)
        over = any(gap > most for gap, most in zip(off, self._allowed, strict=True))
        at = off.index(max(off))
        if over and self._is_gaining(at, sent[at], measured):
            over = False
        if not self.is_struck(over):
            return None
        return (
            f"the base does not follow its commands: it goes at {measured[at]:.3f} {self.unit}, and was sent "
            f"{sent[at]:.3f} {self.unit}; beyond a lag of {self._lag:g} s it may be off by {self._allowed[at]:.3f} "
            f"{self.unit}: {self.likely}"
        )

    def pick_from(self, command: Numbers) -> Numbers:
        """The speed of a command, in `unit`. Shape: (m,) to (k,)."""
        return [command[at] for at in self._columns]

    def _is_gaining(self, at: int, sent: float, measured: Numbers) -> bool:
        """Whether a base that is behind goes towards what it was sent, with less acceleration than expected.

        From then on its measured acceleration is expected.
        """
        seconds = (len(self._speeds) - 1) * self._spec.period
        if len(self._speeds) < (self._speeds.maxlen or 0):
            return False
        gain = (measured[at] - self._speeds[0][at]) / seconds * math.copysign(1.0, sent - measured[at])
        if gain < SLOWEST_GAIN:
            return False
        if gain < self._expected[at]:
            self._change[at] = gain * self._spec.period
            self.warning = (
                f"the base accelerates at {gain:.2g} {self.unit}^2, and {self._expected[at]:.2g} {self.unit}^2 were "
                f"expected; set the limit {self._acceleration} to that, so that it follows its commands"
            )
        self._reached = measured
        self._sent.clear()
        return True

    def limit(self, tick: Tick) -> bool:
        """Clip the speed around the measured one; slower is always allowed."""
        low, high = [], []
        for at, ahead in zip(self._columns, self._ahead, strict=True):
            measured = tick.measured[at]
            unknown = math.isnan(measured)
            low.append(-math.inf if unknown else min(0.0, measured - ahead))
            high.append(math.inf if unknown else max(0.0, measured + ahead))
        return clip(tick, self._columns, low, high)
