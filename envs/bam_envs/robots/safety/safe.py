"""SafeRobot: the one gate between whoever commands a live robot and the robot.

Every command goes through the guards of `bam_envs.robots.safety`. A command or state that cannot be used makes the
robot hold at once: an arm is sent its last command again, a base zero. Several such ticks in a row, or a measurement
beyond the data sheet, stop the robot until a person calls `resume`.

Longer than most files here: the gate and the seal of what it lets through stand side by side, so that nobody else can
make one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, Protocol, cast, final

import numpy as np
from numpy.typing import NDArray

from bam_envs.errors import InvalidValue, ResetNeeded, RobotFault, SafetyStop, StaleState
from bam_envs.robots.robot import Initial, Robot, RobotSpec, RobotState, Rows
from bam_envs.robots.safety.arm_guards import ToolPosition
from bam_envs.robots.safety.guard import Guard, Limits, Tick, is_base, joint_columns
from bam_envs.robots.safety.guards import Freshness, Shape, default_guards
from bam_envs.robots.safety.start_pose import StartPose

__all__ = ["ClearedCommand", "Limits", "LiveRobot", "SafeRobot"]

Array = NDArray[np.float64]
GRIPPER_TIME = 1.0
"""Longest that the gripper is waited for before an arm goes to its start pose [s]."""
FRESH_LOOKS, FRESH_PAUSE = 50, 0.005
"""How often a fresh state is looked for before a motion begins, and the time between two looks [s]."""
LATE = 2.0
"""A live robot that was sent nothing for so many periods need not be where it was going to: its dead-man may have
stopped it."""
_SEAL = object()


@final
class ClearedCommand:
    """A command that passed the guards, for the tick that it passed them in. Only a `SafeRobot` makes one."""

    __slots__ = ("_command", "_good", "status")

    def __init__(self, command: Array, status: int = 0, *, seal: object = None) -> None:
        if seal is not _SEAL:
            raise InvalidValue("Only a SafeRobot clears commands. Build the robot with live_robot(...).")
        self._command, self._good = command.copy(), True
        self._command.flags.writeable = False
        self.status = status
        """Number of the guard that changed it, 0 for none."""

    def __init_subclass__(cls) -> None:
        raise InvalidValue("Only a SafeRobot clears commands; there is no other kind of ClearedCommand.")

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise InvalidValue("A cleared command cannot be copied: it is good for one tick.")

    @property
    def command(self) -> Array:
        """What to send; read-only. Shape: (1, m).

        Raises:
            InvalidValue: Its tick is over.
        """
        if not self._good:
            raise InvalidValue(
                "The tick that this command was cleared for is over. Give the next one to the SafeRobot."
            )
        command: Array = self._command
        return command

    def _void(self) -> None:
        self._good = False


class LiveRobot(Protocol):
    """A `Robot` that takes cleared commands only, and whose `reset` moves nothing: it measures."""

    spec: RobotSpec
    num_robots: int
    needs_clearance: bool
    """True."""

    def connect(self) -> None:
        """As of any robot."""

    def reset(self, rows: Rows, initial: Initial) -> RobotState:
        """Measure; put the object of a simulated robot where `initial` says."""

    def step(self, command: ClearedCommand) -> RobotState:
        """Send `command`, and return the state one period later."""

    def measure(self) -> RobotState:
        """The newest state."""

    def age(self) -> float:
        """Age of the newest state [s]."""

    def halt(self) -> None:
        """As of any robot."""

    def close(self) -> None:
        """As of any robot."""


class SafeRobot:
    """One robot behind guards: a `Robot` around a `Robot`.

    A live robot (one with ``needs_clearance``) is handed a `ClearedCommand`, any other a plain array.

    Args:
        robot: One robot, simulated or live.
        guards: What to ask, in this order; `default_guards` of its spec. A live robot keeps all of those.
        limits: How far the guards let it go.
        tool_position: Forward kinematics of an arm that is no UR5e, (n, k) [rad] to (n, 3) [m].
        clock: Monotonic clock [s].

    Raises:
        InvalidValue: Several robots, a joint that is not measured, or a live robot without one of its guards.
    """

    def __init__(
        self,
        robot: Robot | LiveRobot,
        guards: Sequence[Guard] | None = None,
        *,
        limits: Limits | None = None,
        tool_position: ToolPosition | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if robot.num_robots != 1:
            raise InvalidValue(f"A SafeRobot guards one robot, not {robot.num_robots} stepped together.")
        self.limits = limits or Limits()
        self._live: Any = robot if getattr(robot, "needs_clearance", False) else None
        self._shape = Shape(robot.spec)
        self.guards: tuple[Guard, ...] = tuple(self._chosen(robot.spec, guards, tool_position))
        """In the order in which they are asked."""
        self.spec: RobotSpec = robot.spec
        self.num_robots = 1
        self.status = 0
        """Number of the last guard that changed the last command, or made the robot hold; 0 for none."""
        self._robot: Any = robot
        self._clock = clock
        self._is_base, self._places = is_base(robot.spec), _measured_places(robot.spec)
        self._counts = {guard.name: {"altered": 0, "stopped": 0} for guard in self.guards}
        self._stopped: tuple[str, str] | None = None
        self._bad, self._halts, self._sent_at = 0, 0, -math.inf
        self._forget()

    def _chosen(
        self, spec: RobotSpec, guards: Sequence[Guard] | None, tool_position: ToolPosition | None
    ) -> Sequence[Guard]:
        if guards is not None and self._live is None:
            return guards
        default = default_guards(spec, self.limits, tool_position=tool_position)
        if guards is None:
            return default
        missing = {guard.name for guard in default} - {guard.name for guard in guards}
        if missing:
            raise InvalidValue(
                f"A live robot keeps all of its guards; {', '.join(sorted(missing))} is missing. Put others between or "
                "behind those of default_guards(spec, limits), and change how far they let it go with limits."
            )
        return guards

    def _forget(self) -> None:
        """Nothing is known of the robot."""
        self._state: RobotState | None = None
        self._sent: Array | None = None  # what the robot was really sent last
        self._last: Array | None = None  # the same; None where the next command begins at what is measured
        self._last_step = np.zeros(len(self.spec.command.labels))

    @property
    def info(self) -> Any:
        """What the robot says of itself, or None."""
        return getattr(self._robot, "info", None)

    def age(self) -> float:
        """Age of the newest state of a live robot [s]; 0 for any other."""
        return 0.0 if self._live is None else float(self._live.age())

    def report(self) -> dict[str, dict[str, Any]]:
        """For each guard: number, limit, unit, how many commands it altered and how often it stopped the robot.

        The way to a start pose is not counted.
        """
        return {
            guard.name: {
                "number": guard.number,
                "limit": guard.limit_value,
                "unit": guard.unit,
                **self._counts[guard.name],
            }
            for guard in self.guards
        }

    def connect(self) -> None:
        """Connect the robot. Moves nothing."""
        self._robot.connect()

    def step(self, command: Array) -> RobotState:
        """Send `command` (1, m), as far as the guards let it; the state one period later says what was sent.

        Raises:
            InvalidValue: It has another shape; nothing was sent.
            ResetNeeded: Nothing is known of the robot yet.
            SafetyStop: A guard stopped the robot, now or earlier.
            StaleState: The same, for want of a fresh state.
        """
        self._require_free()
        return self._advance(self._shape.row(command))

    def _advance(self, goal: Array, *, approach: bool = False) -> RobotState:
        """One tick towards `goal` (m,)."""
        halts = self._halts
        try:
            tick = self._tick(goal, approach)
        except RobotFault:  # nobody knows where it is, and a base would go on
            self.halt()
            raise
        fault = self._fault(tick)
        if fault is None:
            self._limit(tick)
        else:
            self._hold(tick, *fault)
        return self._send(tick, halts)

    def _tick(self, goal: Array, approach: bool) -> Tick:
        last = self._begin_at()
        return Tick(goal, goal.copy(), last, self._last_step, self._measured(), self.age(), approach)

    def _begin_at(self) -> Array:
        """The last command, where the robot still follows it; else where it is, at rest. Shape: (m,)."""
        last = None if self._is_late() else self._last
        if last is None:
            last = self._measured_anew()
            self._last, self._last_step = last, np.zeros_like(last)
            self._restart_guards()
        return last

    def _is_late(self) -> bool:
        if self._live is None or getattr(self.info, "lockstep", False):
            return False
        return self._clock() - self._sent_at > LATE * self.spec.period

    def _measured_anew(self) -> Array:
        """What is measured now, as a command; a gripper goes on holding, or is open if nobody knows. Shape: (m,)."""
        if self._live is not None and self._state is not None:
            self._state = self._fresh_state()
        measured = self._measured()
        if self._is_base:
            return np.zeros_like(measured)
        if self._sent is None:  # fingers may be measured a little beyond their range, which no robot takes as a command
            known = np.where(np.isfinite(measured), measured, self.spec.command.high)
            inside: Array = np.clip(known, self.spec.command.low, self.spec.command.high)
            return inside
        begin: Array = self._sent.copy()
        joints = joint_columns(self.spec)
        begin[joints] = measured[joints]
        return begin

    def _measured(self) -> Array:
        """What is measured of each number of the command, NaN where nothing is. Shape: (m,)."""
        if self._state is None:
            raise ResetNeeded("Nothing is known of the robot yet. Call reset() first.")
        measured = np.full(len(self.spec.command.labels), np.nan)
        for place, name, column in self._places:
            measured[place] = self._state.signals[name][0, column]
        return measured

    def _fresh_state(self) -> RobotState:
        """The newest state. An old one is waited out for a little: after a pause of this process newer ones lie unread.

        Raises:
            StaleState: None came.
        """
        for _ in range(FRESH_LOOKS):
            fresh = self._is_fresh()  # asked first: what is measured afterwards can only be newer
            state: RobotState = self._live.measure()
            if fresh:
                return state
            time.sleep(FRESH_PAUSE)
        self._require_fresh()
        return cast(RobotState, self._live.measure())

    def _is_fresh(self) -> bool:
        age = self.age()
        return all(age <= guard.limit_value for guard in self.guards if isinstance(guard, Freshness))

    def _require_fresh(self) -> None:
        """An old state is no place to begin at: even to hold there would be a motion."""
        age = self.age()
        for guard in self.guards:
            if isinstance(guard, Freshness) and not age <= guard.limit_value:
                raise StaleState(
                    f"The newest state is {age:.3f} s old, and a motion begins at a state of at most "
                    f"{guard.limit_value:g} s. Nothing was sent; look at the link, at what publishes the state, and at "
                    "whether this computer is busy.",
                    age,
                    guard.limit_value,
                )

    def _restart_guards(self) -> None:
        for guard in self.guards:
            guard.restart()

    def _fault(self, tick: Tick) -> tuple[Guard, str] | None:
        for guard in self.guards:
            reason = guard.fault(tick)
            if reason is not None:
                return guard, reason
        return None

    def _limit(self, tick: Tick) -> None:
        self._bad = self.status = 0
        for guard in self.guards:
            if guard.limit(tick) and not tick.approach:
                self._note(guard)

    def _note(self, guard: Guard) -> None:
        self.status = int(guard.number[1:])
        self._counts[guard.name]["altered"] += 1

    def _hold(self, tick: Tick, guard: Guard, reason: str) -> None:
        """Send the last command again, or zero; stop the robot if that happened too often."""
        self._note(guard)
        self._bad += 1
        if self._bad >= self.limits.bad_ticks:
            self._stop(guard, f"{reason}, {self._bad} ticks on end")
        tick.command = np.zeros_like(tick.last) if self._is_base else tick.last.copy()

    def _send(self, tick: Tick, halts: int) -> RobotState:
        """Hand the command over; whatever goes wrong with it, the robot is halted."""
        cleared = ClearedCommand(tick.command[None], self.status, seal=_SEAL)
        handed: Any = cleared.command if self._live is None else cleared
        done, self._sent_at = False, self._clock()
        try:
            self._state = self._robot.step(handed)
            done = True
        finally:
            cleared._void()
            if not done or self._halts != halts:  # a halt of another thread may have come just before the command
                self.halt()
        self._sent = tick.command
        if self._halts == halts:
            self._last, self._last_step = tick.command, tick.command - tick.last
        self._require_in_range(self._state)
        return self._state

    def _require_in_range(self, state: RobotState) -> None:
        for guard in self.guards:
            reason = guard.trip(state)
            if reason is not None:
                self._stop(guard, reason)

    def _stop(self, guard: Guard, reason: str) -> NoReturn:
        """Halt, and stay so until a person resumes."""
        self.halt()
        self._counts[guard.name]["stopped"] += 1
        self._stopped = guard.name, f"{guard.number} {guard.name}: {reason}"
        message = f"The robot was stopped by {self._stopped[1]}. When it is safe, call resume()."
        if isinstance(guard, Freshness):
            raise StaleState(message, self.age(), guard.limit_value)
        raise SafetyStop(guard.name, message)

    def _require_free(self) -> None:
        if self._stopped is not None:
            name, reason = self._stopped
            raise SafetyStop(name, f"The robot is still stopped by {reason}. When it is safe, call resume().")

    def resume(self) -> None:
        """Let a stopped robot move again: a person's decision, never a program's. It begins where it is."""
        self._stopped, self._bad, self._last = None, 0, None

    def reset(self, rows: Rows, initial: Initial) -> RobotState:
        """Bring the robot to `initial`; a live arm opens its gripper and goes to its start pose slowly.

        Raises:
            InvalidValue: The start pose is outside the position limits; nothing moved.
            StartNotReached: It was not there in time; it carries the joints.
            SafetyStop: A guard stopped the robot, now or earlier.
        """
        self._require_free()
        start = None if self._is_base else StartPose(self.spec, self.limits, initial)
        if self._live is None:
            self._forget()
        else:
            self.halt()
        state = self._take(self._robot.reset(rows, initial))
        if start is not None and not start.is_near(self._measured()):
            self._approach(start)
            state = self._take(self._robot.reset(rows, initial))  # what the arm may have pushed is put back
        self._restart_guards()
        return RobotState(state.signals, state.stamp, self._begin_at()[None].copy())

    def _take(self, state: RobotState) -> RobotState:
        """Begin anew with `state`."""
        self._state, self._bad, self.status = state, 0, 0
        self._require_in_range(state)
        return state

    def _approach(self, start: StartPose) -> None:
        """Open the gripper where the arm is, then go to `start`."""
        opened = start.opened(self._begin_at())
        self._go(opened, GRIPPER_TIME, lambda: start.is_open(self._measured()))
        self._go(start.command, self.limits.reset_timeout, lambda: self._is_reached(start))
        if not self._is_reached(start):
            self.halt()
            raise start.failure(self._measured())

    def _is_reached(self, start: StartPose) -> bool:
        return start.is_reached(self._measured(), self._begin_at())

    def _go(self, goal: Array, longest: float, done: Callable[[], bool]) -> None:
        """Tick towards `goal` until `done`, at most for `longest` [s]."""
        for _ in range(math.ceil(longest / self.spec.period)):
            if done():
                return
            self._advance(goal, approach=True)

    def halt(self) -> None:
        """Stop moving and keep the link; what comes next begins where the robot is. From any thread; never raises."""
        self._halts += 1
        self._last = None
        self._robot.halt()

    def close(self) -> None:
        """Halt, then drop the link."""
        self._robot.close()
        self._forget()


def _measured_places(spec: RobotSpec) -> list[tuple[int, str, int]]:
    """Place in the command, signal and column of what is measured of a command.

    Raises:
        InvalidValue: A joint is not measured: the guards could not know where the arm is.
    """
    measured = {
        pair: (signal.name, column)
        for signal in reversed(spec.signals)
        for column, pair in enumerate(zip(signal.labels, signal.units, strict=True))
    }
    told = list(zip(spec.command.labels, spec.command.units, strict=True))
    missing = [label for label, unit in told if unit == "rad" and (label, unit) not in measured]
    if missing:
        raise InvalidValue(f"The guards need {', '.join(missing)} of {spec.name} measured in rad; no signal has it.")
    return [(place, *measured[pair]) for place, pair in enumerate(told) if pair in measured]
