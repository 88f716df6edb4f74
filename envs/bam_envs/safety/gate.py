"""SafeRobot: the one gate through which commands reach a live robot.

If a command or state cannot be used, the robot holds at once: an arm is sent its last command again, a base zero.
Several such ticks in a row, or a measurement beyond the data sheet, stop the robot until a person calls `resume`.

Longer than most files: `SafeRobot` and `ClearedCommand` share a file so that no other module can clear a command.
"""

import inspect
import math
import time
import weakref
from collections.abc import Callable, Sequence
from dataclasses import fields
from itertools import accumulate
from typing import Any, NoReturn, final

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, ResetNeeded, SafetyStop, StaleState, StartNotReached
from bam_envs.core.robot import EnvIds, Initial, Robot, RobotSpec, RobotState
from bam_envs.safety.first_motion import OPENS_WITHIN, PROOF, STILL, FirstMotion, NotAsCommanded, ProofMotion
from bam_envs.safety.following import Following, JointFollowing
from bam_envs.safety.guard import (
    TIMING_GUARDS,
    Guard,
    Limits,
    Numbers,
    Sealed,
    Tick,
    ToolPosition,
    columns_in,
    is_base,
    measured_places,
    picker,
    position_range,
    require_bounded,
)
from bam_envs.safety.guards import LATE, CommandShape, Freshness, MeasuredLimits, default_guards
from bam_envs.safety.link_guards import LateTicks, Share, Watchdog
from bam_envs.safety.unusual import UnusualObservations

__all__ = ["ClearedCommand", "Limits", "SafeRobot"]

Array = NDArray[np.float64]
Observer = Callable[[Tick, RobotState], None]
"""See `SafeRobot.observe`."""
LATE_COMMAND = 1.5
"""Periods after the last command from which a command is called late in a message."""
RELAYED = 2.0
"""Longest time for which a live agent keeps a command of whoever has taken over: the tick in which it came, and the one
in which its own guards execute it [periods]."""
GRIPPER_TIME = 1.0
"""Longest wait for the gripper to open before an arm goes to its start pose [s]."""
GRIPPER_NEAR = 0.002
"""Tolerance within which a gripper counts as open [m]."""
AT_REST_AFTER = 1.0
"""Time after the last command from which the robot counts as at rest: twice the longest lag [s]."""
FRESH_STATE_TRIES, FRESH_PAUSE = 50, 0.005
"""Number of checks for a fresh state before a motion begins, and the time between two checks [s]."""


@final
class ClearedCommand(metaclass=Sealed):
    """A command that passed the guards, for one robot and one tick; made by a `SafeRobot`, which keeps its numbers."""

    __slots__ = ("__weakref__",)

    def __init__(self, *arguments: object, **options: object) -> None:
        raise InvalidValue("Only a SafeRobot clears commands. Build the robot with live_robot(...).")

    def __init_subclass__(cls) -> None:
        raise InvalidValue("Only a SafeRobot clears commands; ClearedCommand has no subclasses.")

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise InvalidValue("A cleared command cannot be copied: it is good for one tick.")

    def for_robot(self, robot: object) -> Array:
        """The command to `robot` in this tick, read-only (1, m); `InvalidValue` for another robot, or a later tick."""
        if self not in _CLEARED:
            raise InvalidValue(
                "The tick that this command was cleared for is over. Give the next one to the SafeRobot."
            )
        cleared_for, command = _CLEARED[self]
        if cleared_for is not robot:
            raise InvalidValue("The command was cleared for another robot, with that one's limits.")
        return command


_CLEARED: dict[ClearedCommand, tuple[object, Array]] = {}


def _clear(robot: object, command: Array) -> ClearedCommand:
    """Clear `command` (1, m), which becomes read-only, for `robot`, valid until it is removed from `_CLEARED`."""
    cleared = object.__new__(ClearedCommand)
    command.flags.writeable = False
    _CLEARED[cleared] = robot, command
    return cleared


@final
class SafeRobot(metaclass=Sealed):
    """One robot behind the guards of `default_guards`: a `Robot` around a `Robot`.

    A live robot (one whose ``needs_clearance`` is true) receives a `ClearedCommand`, any other a plain array. It has
    ``measure()``, the newest state; ``age()``, the age of that state [s]; and, if it answers commands, ``waiting()``,
    the time since the oldest unanswered command [s]; and, if it is paced, ``await_due()``, which waits for the time of
    the next command, so that the guards judge it by the time at which it is sent. Its ``reset`` only measures.

    Args:
        robot: One robot, simulated or live.
        guards: Further guards, applied before the default ones.
        limits: The limits of the guards; those of a live robot are inside `guard.BOUNDS`.
        tool_position: Forward kinematics of an arm other than a UR5e, (n, k) [rad] to (n, 3) [m].
        straight: Whether the commands move the tool of an arm along straight lines, so that singularities count.
        clock: Monotonic clock [s].

    Raises:
        InvalidValue: Several robots, a joint that is not measured, a limit that no live robot may have, or a live robot
            that has a `SafeRobot` already.
    """

    __slots__ = (
        "__weakref__",
        "_bad",
        "_before",
        "_checks",
        "_clock",
        "_code",
        "_ended",
        "_every",
        "_facts",
        "_further",
        "_guards",
        "_halts",
        "_is_base",
        "_kept_out",
        "_last",
        "_limiters",
        "_limits",
        "_live",
        "_measured_at",
        "_observer",
        "_places",
        "_read",
        "_report",
        "_returned_at",
        "_robot",
        "_sent",
        "_sent_at",
        "_shape",
        "_spec",
        "_speed",
        "_speeds",
        "_state",
        "_status",
        "_stopped",
        "_tell",
        "_tell_step",
        "_trips",
        "_unmeasured",
    )

    def __init__(
        self,
        robot: Robot,
        guards: Sequence[Guard] = (),
        *,
        limits: Limits | None = None,
        tool_position: ToolPosition | None = None,
        straight: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if robot.num_robots != 1:
            raise InvalidValue(f"A SafeRobot guards one robot, not {robot.num_robots} stepped together.")
        self._limits, self._spec = limits or Limits(), robot.spec
        self._live: Any = robot if getattr(robot, "needs_clearance", False) else None
        if self._live is not None:
            require_bounded(self._limits, robot.spec)
        self._observer: Observer | None = None
        self._tell: Any = getattr(self._live, "tell_status", None)
        self._tell_step: Any = getattr(self._live, "tell_step", None)
        self._shape = CommandShape(robot.spec)
        self._further = tuple(guards)
        self._guards = tuple(default_guards(robot.spec, self._limits, tool_position=tool_position, straight=straight))
        self._checks = tuple(one for one in self._guards if type(one).fault is not Guard.fault)
        self._every = (*self._further, *self._guards)
        self._trips = tuple(one for one in self._guards if isinstance(one, MeasuredLimits))
        self._unmeasured = [math.nan] * len(robot.spec.command.labels)
        self._limiters = tuple(one for one in self._guards if type(one).limit is not Guard.limit)
        self._robot: Any = robot
        self._clock, self._is_base, command = clock, is_base(robot.spec), robot.spec.command
        places = measured_places(robot.spec, command.units)
        speeds = measured_places(robot.spec, [f"{unit}/s" for unit in command.units])
        self._read = tuple(dict.fromkeys(name for _, name, _ in (*places, *speeds)))
        self._places, self._speeds = picker(self._columns(places)), picker(self._columns(speeds))
        unmeasured = {*columns_in(command, "rad")} - {place for place, _, _ in places}
        if unmeasured:  # the guards need the position of the arm
            names = ", ".join(command.labels[at] for at in sorted(unmeasured))
            raise InvalidValue(f"The guards need {names} of {robot.spec.name} measured in rad; no signal has it.")
        self._facts = {id(one): (one.title, one.code) for one in self._every}
        self._report: dict[str, dict[str, Any]] = {}
        for one in self._every:
            facts = {"number": one.number, "limit": one.limit_value, "unit": one.unit}
            self._report[one.name] = {**facts, "altered": 0, "held": 0, "stopped": 0}
        self._stopped: tuple[str, str] | None = None
        self._bad, self._halts, self._status, self._code = 0, 0, "", 0
        self._sent_at: float | None = None
        self._returned_at, self._kept_out = 0.0, False
        self._measured_at = 0.0, 0.0  # times of the last two states
        self._forget()
        if self._live is not None:  # two gates would each allow a whole step
            other = _GUARDED.get(robot)
            if other is not None and other() is not None:
                raise InvalidValue(f"{self.spec.name} has a SafeRobot already; command it through that one.")
            _GUARDED[robot] = weakref.ref(self)

    def __init_subclass__(cls) -> None:
        raise InvalidValue("A SafeRobot has no subclasses: it keeps a robot safe. Give it further guards with guards=.")

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise InvalidValue(
            f"The SafeRobot of {self.spec.name} cannot be copied: a robot has one gate. Build another SafeRobot for "
            "another robot."
        )

    def _forget(self) -> None:
        """Forget all states and commands."""
        self._state: RobotState | None = None
        self._before: Numbers | None = None  # measured values of the tick before
        self._sent: Numbers | None = None  # the last command that the robot was sent
        self._ended: Numbers = []  # the same, when the motion began
        self._last: Numbers | None = None  # the same; None if the next command begins at the measured position
        self._speed = [0.0] * len(self.spec.command.labels)  # of the last command [unit/s]

    @property
    def spec(self) -> RobotSpec:
        """The spec of the robot."""
        return self._spec

    @property
    def num_robots(self) -> int:
        """Always 1."""
        return 1

    @property
    def limits(self) -> Limits:
        """The limits of the guards."""
        return self._limits

    @property
    def status(self) -> str:
        """The last guard that changed the last command, held or stopped the robot: ``"joint speed (G8)"``; or empty."""
        return self._status

    @property
    def code(self) -> int:
        """`status` as the number of that guard: 8 for G8, 0 for none, -1 for a further guard without a number."""
        return self._code

    @property
    def is_held(self) -> bool:
        """Whether the last command was not executed, and the robot is held in place."""
        return self._bad > 0

    @property
    def stopped(self) -> str | None:
        """The guard that stopped the robot and its reason, until a person calls `resume`; None if it may move."""
        return None if self._stopped is None else self._stopped[1]

    @property
    def warnings(self) -> tuple[str, ...]:
        """The current warnings of the guards: ``"link quality (G16): only 93 of the last 100 ticks ..."``."""
        return tuple(f"{one.title}: {one.warning}" for one in self._every if one.warning)

    @property
    def info(self) -> Any:
        """The robot's description of itself, or None."""
        return getattr(self._robot, "info", None)

    @property
    def profile(self) -> Any:
        """The profile of a live robot; None of any other."""
        return getattr(self._live, "profile", None)

    @property
    def agent_state(self) -> str:
        """The state of a live agent once its robot was handed back, such as ``"paused"``; "" if it is unknown."""
        return getattr(self._live, "agent_state", "")

    @property
    def agent_guards(self) -> dict[str, dict[str, Any]]:
        """As `report`, of that agent's guards, without limits and without guards that did nothing; see `TakeOver`."""
        return getattr(self._live, "agent_guards", {})

    def not_ready(self) -> str | None:
        """Why a live robot reports that it cannot move now, or None. May call its services: only at rest."""
        why: str | None = getattr(self._live, "not_ready", lambda: None)()
        return why

    @property
    def enabling(self) -> tuple[Any, ...]:
        """The services that `enable` will call: `service` and what it `does`; empty if none is left."""
        return tuple(getattr(self._live, "enabling", ()))

    def enable(self) -> None:
        """Call the services before which a live robot takes no commands, once its operator has agreed.

        `NotReady` names the first that does not succeed.
        """
        if self.enabling:
            self._live.enable()

    def age(self) -> float:
        """Age of the newest state of a live robot [s]; 0 for any other."""
        return 0.0 if self._live is None else float(self._live.age())

    def measure(self) -> RobotState:
        """The newest state of a live robot; raises StaleState if it is too old for a motion to begin."""
        return _copied(self._fresh_state())

    def guards(self) -> list[dict[str, Any]]:
        """The guards in order: number, name, limit, those of joints, unit, setting in `Limits`, and what it does."""
        every = dict.fromkeys(self._every)  # the tool's speed is limited twice
        return [
            {
                "number": one.number,
                "name": one.name,
                "limit": one.limit_value if math.isfinite(one.limit_value) else None,
                "each": [*one.each],
                "unit": one.unit,
                "setting": one.setting,
                "does": inspect.cleandoc(type(one).__doc__ or "").partition("\n\n")[0].replace("\n", " "),
            }
            for one in every
        ]

    def report(self) -> dict[str, dict[str, Any]]:
        """For each guard: number, limit, unit, commands altered, ticks held, and stops of the robot.

        Commands that were altered, and ticks held, on the way to a start pose are not counted.
        """
        return {name: dict(row) for name, row in self._report.items()}

    def observe(self, observer: Observer) -> None:
        """Call ``observer(tick, state)`` after each command that was sent, with the state that it led to.

        It is called between two commands, so it must be fast, and it must change neither argument.
        """
        self._observer = observer

    def react(self, reaction: str) -> None:
        """Set what unusual observations lead to: ``"warn"``, ``"hold"`` or ``"stop"``."""
        for guard in self._guards:
            if isinstance(guard, UnusualObservations):
                guard.react(reaction)

    def tell_unusual(self, reason: str) -> None:
        """Take the reason why the observations of this episode are unusual for the policy; see `react`.

        An empty one ends a warning, once the episode has ended or another policy acts, and neither a hold nor a stop.
        """
        for guard in self._guards:
            if isinstance(guard, UnusualObservations):
                guard.told(reason)

    def tell_step(self, *step: Any, **ends: Any) -> None:
        """Pass on the numbers of a step of the environment, for a learner at the robot's side; see `TakeOver`."""
        if self._tell_step is not None:
            self._tell_step(*step, **ends)

    def connect(self) -> None:
        """Connect the robot. Moves nothing."""
        self._robot.connect()
        watchdog, has_agent = getattr(self.info, "watchdog", None), getattr(self.info, "agent", False)
        simulated = not self._is_real() and not getattr(self._live, "stands_for_a_real_one", False)
        for guard in self._guards:
            if isinstance(guard, Following):
                guard.connected(RELAYED * self.spec.period if has_agent else 0.0, yields=simulated)
            if isinstance(guard, FirstMotion):
                guard.connected(simulated=simulated)
            # A live agent halts the robot by itself, and the watchdog behind it is the agent's concern.
            if isinstance(guard, Watchdog) and not has_agent and (watchdog is not None or self._is_real()):
                guard.connected(watchdog)

    def _is_real(self) -> bool:
        return self._live is not None and not getattr(self.info, "simulated", False)

    def step(self, command: Array) -> RobotState:
        """Send `command` (1, m), as limited by the guards; returns the state one period later, with the sent command.

        Raises:
            InvalidValue: It has another shape; nothing was sent.
            ResetNeeded: No state is known yet.
            SafetyStop: A guard stopped the robot, now or earlier.
            StaleState: The same, because there was no fresh state.
        """
        self._require_free()
        if self.is_unproved:
            raise ResetNeeded(
                f"Nothing shows yet that commands reach the joints of {self.spec.name}. Call reset() first."
            )
        return self._advance(self._shape.numbers(command))

    def _advance(self, goal: Numbers, *, approach: bool = False, proving: bool = False) -> RobotState:
        """One tick towards `goal` (m,)."""
        halts, came = self._halts, self._clock()
        try:
            getattr(self._live, "await_due", _nothing)()
            tick = self._tick(goal, approach, came, proving)
            fault = self._fault(tick)
            if fault is None:
                self._limit(tick)
            else:
                self._hold(tick, *fault)
            return self._send(tick, halts)
        except BaseException:  # of the robot, of a further guard or of the observer: a base would drive on
            if self._halts == halts:
                self.halt()
            raise

    def _tick(self, goal: Numbers, approach: bool, came: float, proving: bool) -> Tick:
        pause = self._pause()
        # Before its commands are proved, an arm that was commanded to stay is not told to stay elsewhere after a pause.
        last = self._begin_at(0.0 if proving else pause)
        values, period = self._values(), self._spec.period
        measured, speeds = self._places(values), self._speeds(values)
        before = self._unmeasured if self._before is None else self._before
        self._before = measured
        time_passed = min(period, pause or period)
        elapsed = max(0.0, self._measured_at[1] - self._measured_at[0]) if pause else period
        known = zip(speeds, measured, before, strict=True)
        return Tick(
            goal=goal,
            command=goal.copy(),
            last=last,
            last_step=[speed * time_passed for speed in self._speed],
            measured=measured,
            before=before,
            velocity=[speed if speed == speed else (now - old) / max(period, elapsed) for speed, now, old in known],
            age=self.age(),
            period=time_passed,
            pause=pause,
            elapsed=elapsed,
            waiting=getattr(self._live, "waiting", float)(),
            approach=approach,
            proving=proving,
            action_age=came - self._returned_at if pause else 0.0,
            kept_out=self._kept_out,
            ended=self._ended,
            signals=self._state.signals if self._state is not None else {},
        )

    def _in_lockstep(self) -> bool:
        return bool(getattr(self.info, "lockstep", False))

    def _pause(self) -> float:
        """Time since the last command of a motion [s]; 0 for the first one, and in lockstep."""
        sent_at = self._sent_at  # read once: a halt in another thread clears it
        if self._live is None or sent_at is None or self._in_lockstep():
            return 0.0
        return self._clock() - sent_at

    def _begin_at(self, pause: float) -> Numbers:
        """The last command if the robot still follows it, else its measured position, at rest. Shape: (m,)."""
        last, sent_at = self._last, self._sent_at  # read once: a halt in another thread clears them
        if (
            last is not None
            and pause <= LATE * self._spec.period
            and (sent_at is not None or self._live is None or self._in_lockstep())
        ):
            return last
        if self._live is not None:
            self._state = self._fresh_state()
            self._require_in_range(self._state)  # a motion does not begin at a wrong measurement
        measured, command = self._measured(), self.spec.command
        if self._is_base:
            last = [0.0] * len(measured)
        elif self._sent is None:
            # A gripper that is not measured is taken as open; fingers may be measured a little beyond their range.
            rows = zip(measured, command.low, command.high, strict=True)
            last = [min(max(value, low), high) if math.isfinite(value) else high for value, low, high in rows]
        else:  # the gripper keeps its grip
            last = self._sent.copy()
            for joint in columns_in(command, "rad"):
                last[joint] = measured[joint]
        self._last, self._speed, self._before = last, [0.0] * len(last), None
        is_recent = self._sent is not None and self._clock() - self._returned_at <= AT_REST_AFTER
        self._ended = (self._sent or []).copy() if is_recent else []
        self._restart()
        return last

    def _columns(self, places: list[tuple[int, str, int]]) -> list[int]:
        """Where in `_values` each number of the command is measured. Shape: (m,)."""
        sizes = {signal.name: len(signal.labels) for signal in self._spec.signals}
        begins = dict(zip(self._read, accumulate((sizes[name] for name in self._read), initial=0), strict=False))
        known = {place: begins[name] + column for place, name, column in places}
        return [known.get(place, sum(sizes[name] for name in self._read)) for place in range(len(self._unmeasured))]

    def _values(self) -> Numbers:
        """The newest values of the signals that are read, one after the other, then NaN for what is not measured."""
        if self._state is None:
            raise ResetNeeded("Nothing is known of the robot yet. Call reset() first.")
        signals, values = self._state.signals, Numbers()
        for name in self._read:
            values += signals[name][0].tolist()
        values.append(math.nan)
        return values

    def _measured(self) -> Numbers:
        """The measured value of each number of the command; NaN if not measured. Shape: (m,)."""
        return self._places(self._values())

    def _fresh_state(self) -> RobotState:
        """The newest state, or `StaleState`: even holding an outdated position would be a motion.

        Waits briefly for a newer one: after a pause of this process, messages may be unread.
        """
        limit = next(guard.limit_value for guard in self._guards if isinstance(guard, Freshness))
        for _ in range(FRESH_STATE_TRIES):
            age = self.age()  # read first: a later measurement can only be newer
            state: RobotState = self._live.measure()
            if age <= limit:
                return state
            time.sleep(FRESH_PAUSE)
        raise StaleState(
            f"The newest state is {age:.3f} s old, and a motion begins at a state of at most {limit:g} s. Nothing was "
            "sent; look at the link, at what publishes the state, and at whether this computer is busy.",
            age,
            limit,
        )

    def _restart(self, *, forgive: bool = False) -> None:
        for guard in self._every:
            guard.restart()
            if forgive:
                guard.forgive()

    def _fault(self, tick: Tick) -> tuple[Guard, str] | None:
        for guard in self._checks:
            if (reason := guard.fault(tick)) is not None:
                return guard, reason
        for guard in self._further:
            if (reason := guard.fault(_copy(tick))) is not None:
                return guard, reason
        return None

    def _limit(self, tick: Tick) -> None:
        self._bad, self._status, self._code, self._kept_out = 0, "", 0, False
        for guard in self._further:
            asked = _copy(tick)
            if guard.limit(asked):
                tick.goal = self._shape.numbers(np.asarray(asked.command)[None])
                if not all(map(math.isfinite, tick.goal)):
                    raise InvalidValue(f"The guard {guard.name} commanded {tick.goal}: correct it; nothing was sent.")
                tick.command = tick.goal.copy()
                self._note(guard, "altered")
        for guard in self._limiters:
            if guard.limit(tick) and not tick.approach:
                self._note(guard, "altered")

    def _note(self, guard: Guard, effect: str, *, counts: bool = True) -> None:
        self._status, self._code = self._facts[id(guard)]
        self._report[guard.name][effect] += counts
        self._kept_out |= guard.keeps_out

    def _hold(self, tick: Tick, guard: Guard, reason: str) -> None:
        """Send a command that holds the robot in place; stop the robot after too many ticks in a row."""
        self._kept_out = False
        self._note(guard, "held", counts=not tick.approach)
        self._bad += 1
        if self._bad >= guard.patience:
            once = self._bad == 1 or isinstance(guard, Share)
            busy = "" if guard.code in TIMING_GUARDS else self._busy(tick)
            self._stop(guard, f"{reason}{'' if once else f', {self._bad} ticks in a row'}{busy}")
        if self._is_base:
            tick.command = [0.0] * len(tick.last)
        else:
            tick.command = tick.last.copy() if guard in self._further else guard.hold(tick)
        tick.last = tick.command  # at rest: the next command begins there

    def _busy(self, tick: Tick) -> str:
        """What else can be behind a fault, as the end of a message: an old state, or late commands; empty for none."""
        period, what = self._spec.period, ""
        late = next(guard for guard in self._guards if isinstance(guard, LateTicks))
        if tick.age > period:
            what = f"the newest state was {tick.age:.2f} s old"
        elif tick.pause > LATE_COMMAND * period:
            what = f"the last command was sent {tick.pause:.2f} s ago"
        elif late.counted:
            what = f"{late.counted} of the last {late.seen} commands were late"
        return what and f"; {what}: this computer or the link is busy"

    def _send(self, tick: Tick, halts: int) -> RobotState:
        """Send the command; halt the robot if that fails."""
        if self._tell is not None:
            self._tell(self._code, self._status, stopped=False)
        done, self._sent_at, command = False, self._clock(), np.array([tick.command])
        handed: Any = command if self._live is None else _clear(self._robot, command)  # at the last: it is taken back
        try:
            self._state = self._robot.step(handed)
            done, self._returned_at = True, self._clock()
            self._measured_at = self._measured_at[1], self._returned_at - self.age()
        finally:
            if self._live is not None:
                _CLEARED.pop(handed, None)
            if not done or self._halts != halts:  # a halt of another thread may have come just before the command
                self.halt()
        self._sent = tick.command
        if self._halts == halts:
            rows = zip(tick.command, tick.last, strict=True)
            self._last, self._speed = tick.command, [(now - before) / tick.period for now, before in rows]
        if self._observer is not None:
            self._observer(tick, self._state)
        self._require_in_range(self._state)
        return _copied(self._state)  # changes by the caller must not reach the guards

    def _require_in_range(self, state: RobotState) -> None:
        for guard in self._trips:
            if (reason := guard.trip(state)) is not None:
                self._stop(guard, reason)

    def _stop(self, guard: Guard, reason: str) -> NoReturn:
        """Halt, and refuse commands until a person resumes."""
        self._stopped = guard.name, f"{guard.title}: {reason}"  # first: nothing that fails below ends the stop
        self.halt()
        self._note(guard, "stopped")
        if self._tell is not None:
            self._tell(self._code, self._status, stopped=True)
        if (why := self.not_ready()) is not None:
            self._stopped = guard.name, f"{guard.title}: not ready: {why}: {reason}"
        unseen = " Whether it stands is not known: stop it by hand if it moves." if isinstance(guard, Freshness) else ""
        message = f"The robot was stopped by {self._stopped[1]}.{unseen} When it is safe, call resume()."
        if unseen:
            raise StaleState(message, self.age(), guard.limit_value)
        raise SafetyStop(guard.name, message)

    def _require_free(self) -> None:
        if self._stopped is not None:
            name, reason = self._stopped
            raise SafetyStop(name, f"The robot is still stopped by {reason}. When it is safe, call resume().")

    def resume(self) -> None:
        """Let a stopped robot move again, from its position. A person decides this, never a program."""
        if self._stopped is not None:
            for guard in self._every:
                guard.resumed()
        self._stopped, self._bad, self._last, self._sent_at, self._before = None, 0, None, None, None
        self._status, self._code, self._kept_out = "", 0, False
        self._restart(forgive=True)

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Bring the robot to `initial`; a live arm opens its gripper and goes to its start pose slowly.

        Raises:
            InvalidValue: The start pose is not one that the guards allow; nothing moved.
            StartNotReached: The arm was not there in time; the error holds the joints.
            SafetyStop: A guard stopped the robot, now or earlier.
        """
        self._require_free()
        start = None if self._is_base else self._start_pose(initial)
        if self._live is None:
            self._forget()
        else:
            self.halt()
        self._restart(forgive=True)
        state = self._take(self._robot.reset(env_ids, initial))
        if self.is_unproved:
            self.prove()
        if start is not None and (self._joints_off(start) or not self._is_open()):
            self._approach(start)
            state = self._take(self._robot.reset(env_ids, initial))  # put back objects that the arm may have pushed
        self._restart(forgive=True)
        begin = self._begin_at(self._pause())
        self._sent_at = None  # the first command may come at any time
        return RobotState(_copied(state).signals, state.stamp, np.array([begin]), state.truth)

    @property
    def is_unproved(self) -> bool:
        """Whether `reset` will first prove the commands of a live arm; see `prove`."""
        proof = getattr(self._live, "proof", None)
        return proof is not None and not proof.is_done

    @property
    def proof_plan(self) -> str:
        """What `reset` will first move to prove the commands of a live arm; empty for nothing."""
        if not self.is_unproved:
            return ""
        last = self.spec.command.labels[columns_in(self.spec.command, "rad")[-1]]
        which, since = "each joint moves", ""
        if self._live.proof.is_known:
            which, since = f"{last} moves", f"; all were proved on {self._live.proof.since}"
        return f"{which} {PROOF:g} rad and back, to prove that commands reach the joints that are meant{since}"

    def prove(self, *, anew: bool = False) -> list[RobotState]:
        """Move each joint a little and back, to prove that commands reach the joints that are meant.

        An arm whose commands were proved before, with these controllers, moves its last joint only, unless `anew` is
        set. `reset` does this by itself with a live arm, once a connection. Returns the states of the motion.

        Raises:
            NotReady: The commands cannot be proved without a motion that may be large; nothing has moved.
            ResetNeeded: No state is known yet.
            SafetyStop: The arm did not move as commanded.
        """
        self._require_free()
        proof, columns = getattr(self._live, "proof", None), columns_in(self.spec.command, "rad")
        if proof is not None:
            proof.require_provable()
        if self._state is None and self._live is not None:
            self._take(self._fresh_state())
        rest = self._begin_at(0.0).copy()
        low, high = position_range(self.spec, self.limits)
        motion = ProofMotion(
            [self.spec.command.labels[at] for at in columns],
            [self._measured()[at] for at in columns],
            [(low[at] + high[at]) / 2 for at in columns],
            self.spec.period,
            self.spec.lag if self.limits.lag is None else self.limits.lag,
            is_timed=proof is not None and proof.is_timed,
            sag=self.limits.follow_tolerance,
        )
        states, is_shortened = list[RobotState](), False
        moves = motion.moves(every=anew or proof is None or not proof.is_known)
        try:
            joints, reach = next(moves)
            while True:
                for at, value in zip(columns, joints, strict=True):
                    rest[at] = value
                if proof is not None:
                    self._live.reach, self._live.joints_only = reach, True
                states.append(self._advance(rest.copy(), approach=True, proving=True))
                is_shortened |= any(abs(self._sent[at] - rest[at]) > STILL for at in columns if self._sent)
                measured, motion.age = self._measured(), self.age()
                joints, reach = moves.send([measured[at] for at in columns])
        except StopIteration:
            pass
        except NotAsCommanded as error:
            edge = "the guards shorten the motion that proves the commands, at the edge of where the arm may go"
            self._stop(self._first_motion, f"{edge}: jog it away" if is_shortened else f"{error}")
        finally:
            if proof is not None:
                self._live.reach, self._live.joints_only = None, False
        self._know_lag(motion.measured_lag)
        if proof is not None:
            self._live.tell_proved(motion.measured_lag)
        return states

    @property
    def _first_motion(self) -> FirstMotion:
        return next(one for one in self._guards if isinstance(one, FirstMotion))

    def _know_lag(self, lag: float) -> None:
        for guard in self._guards:
            if isinstance(guard, JointFollowing):
                guard.measured(lag)

    def _take(self, state: RobotState) -> RobotState:
        """Restart from `state`."""
        self._state, self._before, self._bad, self._status, self._code = state, None, 0, "", 0
        self._require_in_range(state)
        return state

    def _start_pose(self, initial: Initial) -> Numbers:
        """The joints of `initial` as a command, the gripper open. Shape: (m,)."""
        start, labels = list(self.spec.command.high), self.spec.command.labels
        joints = np.asarray(initial.signals["joint_position"])[0].tolist()
        for column, value in zip(columns_in(self.spec.command, "rad"), joints, strict=True):
            start[column] = value
        low, high = position_range(self.spec, self.limits)
        for column, value in enumerate(start):
            if not low[column] <= value <= high[column]:  # NaN is not
                raise InvalidValue(
                    f"The start pose has {labels[column]} at {value:.3f} rad, outside the "
                    f"{low[column]:.3f} to {high[column]:.3f} rad that the guards allow. Choose another start, or a "
                    "smaller position_margin."
                )
        for guard in self._every:
            if (reason := guard.start_fault(start)) is not None:
                raise InvalidValue(f"{guard.title} does not allow the start pose: {reason}.")
        return start

    def _joints_off(self, start: Numbers) -> dict[str, float]:
        """The joints that are not measured at `start` (m,), with their remaining distance [rad]."""
        measured, near = self._measured(), self.limits.reset_tolerance
        far = {at: start[at] - measured[at] for at in columns_in(self.spec.command, "rad")}
        return {self.spec.command.labels[at]: gap for at, gap in far.items() if not abs(gap) <= near}

    def _is_open(self) -> bool:
        """Whether the gripper is measured open; one that is not measured (NaN) counts as open."""
        measured, widest = self._measured(), self.spec.command.high
        return not any(abs(widest[at] - measured[at]) > GRIPPER_NEAR for at in columns_in(self.spec.command, "m"))

    def _approach(self, start: Numbers) -> None:
        """Open the gripper with the arm in place, then go to `start` (m,)."""
        joints, grippers = columns_in(self.spec.command, "rad"), columns_in(self.spec.command, "m")

        def is_reached() -> bool:  # all joints are measured there, and were sent there
            sent = self._begin_at(0.0)
            return all(sent[at] == start[at] for at in joints) and not self._joints_off(start)

        opened = self._begin_at(0.0).copy()
        for at in grippers:
            opened[at] = start[at]
        # In its first motion a gripper shows that it opens when it is commanded to, or the robot is stopped.
        opens = GRIPPER_TIME if self._first_motion.opens else 2 * OPENS_WITHIN
        goals = (opened, opens, self._is_open), (start, self.limits.reset_timeout, is_reached)
        for goal, longest, done in goals:
            for _ in range(math.ceil(longest / self.spec.period)):
                if done():
                    break
                self._advance(goal.copy(), approach=True)
        if not is_reached():
            self.halt()
            off, why = self._joints_off(start), self.not_ready()
            where = ", ".join(f"{name} is {far:+.3f} rad from it" for name, far in off.items()) or "it is on its way"
            readiness = "" if why is None else f"Not ready: {why}. "
            raise StartNotReached(
                f"{readiness}The arm did not reach its start pose in {self.limits.reset_timeout:g} s: {where}. "
                "Look for what holds it, or raise the limit reset_timeout.",
                off,
            )

    def halt(self) -> None:
        """Stop moving and keep the link; the next command begins at the robot's position. Thread-safe; never raises."""
        self._halts += 1
        self._last = self._sent_at = None
        self._robot.halt()

    def close(self) -> None:
        """Halt, then drop the link."""
        self._robot.close()
        self._forget()


_GUARDED: weakref.WeakKeyDictionary[Any, weakref.ref[SafeRobot]] = weakref.WeakKeyDictionary()


def _nothing() -> None:
    """Do nothing."""


def _copied(state: RobotState) -> RobotState:
    """The state with copies of its arrays."""
    signals = {name: values.copy() for name, values in state.signals.items()}
    return RobotState(signals, state.stamp, state.command.copy(), state.truth)


def _copy(tick: Tick) -> Tick:
    """The tick with arrays (m,) for a user's guard, which may change the command only."""
    values = (getattr(tick, one.name) for one in fields(tick) if one.name != "signals")
    signals = {name: array.copy() for name, array in tick.signals.items()}
    return Tick(*(np.array(value) if isinstance(value, list) else value for value in values), signals=signals)  # type: ignore[arg-type, misc]
