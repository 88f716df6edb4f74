"""The guards of timing and link: late actions, late ticks, link quality, changed commands, watchdog, ramp after a stop.

Some of them warn before they stop the robot: their `warning` is set until its cause is gone.
"""

from collections import deque

from bam_envs.core.robot import RobotSpec
from bam_envs.core.timing import least_lateness
from bam_envs.safety.arm_guards import fastest_joints, shorten
from bam_envs.safety.guard import Guard, Limits, Tick, clip, columns_in, is_base

TICKS = 100
"""Number of recent ticks of which shares are computed."""
LATE_TICKS = 10
"""Number of consecutive late commands that stop the robot."""


class ActionAge(Guard):
    """A command is sent only while the state that it was computed from is recent; a later one is not executed."""

    number, name, unit, setting, patience = "G4", "action age", "s", "action_age", LATE_TICKS

    def __init__(self, limits: Limits) -> None:
        self.limit_value = limits.action_age

    def fault(self, tick: Tick) -> str | None:
        """Report the age of the action."""
        if tick.action_age <= self.limit_value:
            return None
        return (
            f"the command came {tick.action_age:.3f} s after the state that it was computed from, and at most "
            f"{self.limit_value:g} s are allowed: the policy takes too long, or the computer is busy"
        )


class Share(Guard):
    """Base class: counts the ticks among the last 100 for which `is_counted` is true, and judges their number."""

    unit = "share of 100 ticks"

    def __init__(self) -> None:
        self._tick, self._counted = 0, deque[int]()  # numbers of the current tick, and of the counted ones

    def is_counted(self, tick: Tick) -> bool:
        """Whether `tick` is counted."""
        raise NotImplementedError

    def judge(self, counted: int) -> str | None:
        """Warn, or report why a tick is not executed, when `counted` ticks, this one included, are above 0 or were."""
        raise NotImplementedError

    def forgive(self) -> None:
        """Forget the counted ticks."""
        self._counted.clear()
        self.warning = ""

    @property
    def counted(self) -> int:
        """Number of counted ticks among the last 100."""
        return len(self._counted)

    @property
    def seen(self) -> int:
        """Number of ticks among which they are counted: 100, or fewer at first."""
        return min(self._tick, TICKS)

    def fault(self, tick: Tick) -> str | None:
        """Count this tick, and report what `judge` does."""
        self._tick += 1
        if self.is_counted(tick):
            self._counted.append(self._tick)
        elif not self._counted:
            return None
        if self._counted[0] <= self._tick - TICKS:
            self._counted.popleft()
        return self.judge(len(self._counted))


class LateTicks(Share):
    """Late commands are counted, and too many give a warning; ten in a row stop the robot: command pace (G15)."""

    number, name, setting = "G15", "late ticks", "late_share"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        super().__init__()
        self.limit_value, self._period = limits.late_share, spec.period
        self._by = least_lateness(spec.period)

    def is_counted(self, tick: Tick) -> bool:
        """Whether the command is late."""
        return tick.pause > self._period + self._by

    def judge(self, counted: int) -> str | None:
        """Return None: this guard only warns."""
        if counted > TICKS * self.limit_value + 1e-9:
            self.warning = (
                f"{counted} of the last {self.seen} commands were more than {1000 * self._by:.0f} ms late, and "
                f"{TICKS * self.limit_value:g} may be: the robot moves unevenly, because the policy takes too long "
                "or the computer is busy; end other programs, or use a faster policy"
            )
        elif not counted:
            self.warning = ""
        return None


class LinkQuality(Share):
    """The robot is stopped if too many states are too old, or too many commands are not answered in time."""

    number, name, setting = "G16", "link quality", "link_stop"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        super().__init__()
        self.limit_value, self._warn = limits.link_stop, limits.link_warn
        self._max_age, self._answer = limits.max_age or (0.5 if is_base(spec) else 0.1), limits.answer_time

    def is_counted(self, tick: Tick) -> bool:
        """Whether a state or an answer did not come in time."""
        return not tick.age <= self._max_age or tick.waiting > self._answer

    def judge(self, counted: int) -> str | None:
        """Report the number of good ticks once the link is back; while it is down, other guards hold the robot."""
        if not counted:
            self.warning = ""
            return None
        good = f"only {self.seen - counted} of the last {self.seen} ticks had a state and an answer in time"
        self.warning = good if counted > TICKS * (1.0 - self._warn) + 1e-9 else ""
        if self._counted[-1] == self._tick or counted <= TICKS * (1.0 - self.limit_value) + 1e-9:
            return None
        return (
            f"{good}, and {TICKS * (1.0 - self.limit_value):.0f} may lack them: look at the load of this computer and "
            "of the robot's, and at the network, or come nearer to its access point"
        )


class ChangedCommands(Share):
    """The robot is stopped if too many commands had to be changed to keep it out of forbidden regions."""

    number, name, setting = "G18", "changed commands", "clamp_stop"

    def __init__(self, limits: Limits) -> None:
        super().__init__()
        self.limit_value, self._warn = limits.clamp_stop, limits.clamp_warn

    def is_counted(self, tick: Tick) -> bool:
        """Whether the previous command was changed to keep the robot out of a forbidden region."""
        return tick.kept_out

    def judge(self, counted: int) -> str | None:
        """Report the number of changed commands."""
        if not counted:
            self.warning = ""
            return None
        text = f"{counted} of the last {self.seen} commands were changed to keep the robot out of a forbidden region"
        self.warning = text if counted > TICKS * self._warn + 1e-9 else ""
        if counted <= TICKS * self.limit_value + 1e-9:
            return None
        self.forgive()  # after the stop, the count begins again
        return f"{text}, and {TICKS * self.limit_value:.0f} are allowed: the report names the guards that changed them"


class Watchdog(Guard):
    """A robot should stop by itself when commands stop; this guard only warns if it is not known to do so in time."""

    number, name, unit, setting = "G5", "robot's watchdog", "s", "watchdog"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value = limits.watchdog or max(0.5 if is_base(spec) else 0.1, 2.0 * spec.period)
        self._holds = not any(unit.endswith("/s") for unit in spec.command.units)

    def connected(self, watchdog: float | None) -> None:
        """Set the warning from the time after which the robot stops by itself [s]; 0: never; None: unknown.

        An arm that takes positions needs no watchdog: it moves to the last position that it was sent, and holds it.
        """
        self.warning = ""
        if watchdog is None or watchdog == 0.0:
            known = "is not known to stop" if watchdog is None else "does not stop"
            if not self._holds:
                self.warning = (
                    f"the robot {known} by itself: when this computer or the link fails it keeps driving; keep a hand "
                    "on its emergency stop, and set the time after which it stops in its profile (watchdog = 0.1)"
                )
        elif not watchdog <= self.limit_value:
            self.warning = (
                f"the robot stops by itself only {watchdog:g} s after the last command, and {self.limit_value:g} s "
                "are expected: shorten its time-out"
            )


class RampAfterStop(Guard):
    """After a stop that a person has ended, the robot's speed limits grow from 0 to their values."""

    number, name, unit, setting = "G14", "ramp-in after a stop", "s", "ramp_time"

    def __init__(self, spec: RobotSpec, limits: Limits) -> None:
        self.limit_value, self._left = limits.ramp_time, 0.0
        self._joints = columns_in(spec.command, "rad")
        self._fastest = fastest_joints(spec, limits, limits.reset_speed)
        speeds = {"m/s": limits.base_speed, "rad/s": limits.turn_speed}
        rows = zip(spec.command.units, spec.command.high, strict=True)
        self._speeds = [min(speeds[unit], high) for unit, high in rows if unit in speeds]

    def resumed(self) -> None:
        """Begin the ramp."""
        self._left = self.limit_value

    def limit(self, tick: Tick) -> bool:
        """Shorten the step of all joints, or clip the speeds of a base."""
        if self._left <= 0.0:
            return False
        self._left -= tick.period
        share = 1.0 - max(0.0, self._left) / self.limit_value
        if self._joints:
            return shorten(tick, self._joints, [fastest * share * tick.period for fastest in self._fastest])
        speeds = [speed * share for speed in self._speeds]
        return clip(tick, range(len(speeds)), [-speed for speed in speeds], speeds)
