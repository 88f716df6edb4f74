"""The deployment: the loop that moves a robot at absolute deadlines, from its first episode to its end.

At the end, for any reason (all episodes done, Ctrl-C, SIGTERM, a fault), the robot is halted and closed before anything
is reported.

Longer than most files: signals, loop and end are one object, as each must know of the others to halt the robot.
"""

import contextlib
import math
import signal
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import gymnasium as gym

from bam_envs.core.errors import BamEnvsError, LinkLost, NotInCommand, SafetyStop
from bam_envs.core.robot import RobotState
from bam_envs.core.robot_env import halt_and_close, robot_of
from bam_envs.core.timing import Pacer, TickTimes
from bam_envs.safety.guard import TIMING_GUARDS, Tick
from bam_train.checkpoint.detector import vectors
from bam_train.deploy.episode import EpisodeLoop, EpisodeStep, Watcher
from bam_train.deploy.flight import FlightLog
from bam_train.deploy.journal import Ending, EpisodeRecord, Journal
from bam_train.deploy.trials import Trials
from bam_train.errors import BamTrainError
from bam_train.policy.background import Background
from bam_train.recording.recorder import ERROR, INFO, Recorder
from bam_train.signals import handled, interrupt


class Stopped(BaseException):
    """A signal that ends the deployment."""


class StopSwitch:
    """Handles signals: while armed, a signal raises `Stopped`; otherwise it is only recorded, as a halt may be running.

    The second signal halts the robot and raises KeyboardInterrupt, which ends the program at once. The third raises it
    without the halt, in case that hangs.

    Args:
        halt: Halts the robot; may be called at any moment.
    """

    def __init__(self, halt: Callable[[], None]) -> None:
        self._halt = halt
        self.armed = False
        """Whether a signal may interrupt the main thread now."""
        self.came: list[int] = []
        """The signals so far."""

    def raise_again(self) -> None:
        """Raise `Stopped` if a signal came: Python discards an exception in a callback, such as a ``__del__``."""
        if self.came:
            raise Stopped

    def __call__(self, number: int) -> None:
        """Handle a signal, in the main thread."""
        self.came.append(number)
        if len(self.came) > 1:
            try:
                if len(self.came) == 2:
                    self._halt()
            finally:
                interrupt(self.came[0])
        if self.armed:
            self.armed = False
            raise Stopped


class Deployment:
    """A frozen policy and a robot in one loop, which runs once, with bounded memory; see `EpisodeLoop`.

    Args:
        env: The environment, already checked to fit the policy.
        policy: Has ``reset()`` and ``act(observation)``; if it has chunks and the loop has deadlines, it runs in a
            `Background`.
        pacer: The deadlines.
        journal: Updated at every tick.
        observers: Called with each `EpisodeStep` once the policy has decided, so they must be fast; if one fails, the
            deployment ends. A ``flush()`` that one has is called after every episode, once the robot rests.
        recorder: Records every tick, if given; it has started, and is closed at the end. If it fails, the deployment
            goes on.
        trials: Where each episode is recorded as a trial, if given; may be exchanged between two episodes.
        between_ticks: Called between a deadline and the policy; whether the episode ends there.
        switch: Handler of SIGINT and SIGTERM; None: one of its own.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        policy: Any,
        pacer: Pacer,
        journal: Journal,
        *,
        observers: Sequence[Callable[[EpisodeStep], None]] = (),
        recorder: Recorder | None = None,
        trials: Trials | None = None,
        between_ticks: Callable[[], bool] = lambda: False,
        switch: StopSwitch | None = None,
    ) -> None:
        self.env, self.pacer, self.journal, self.recorder, self.trials = env, pacer, journal, recorder, trials
        self.switch = switch or StopSwitch(self._halt)
        """Handler of SIGINT and SIGTERM."""
        self._loop = EpisodeLoop(
            env, self._beside(policy), pacer, journal, raise_again=self.switch.raise_again, between_ticks=between_ticks
        )
        self.judge: Callable[[EpisodeRecord], bool | None] = lambda record: None
        """Called after a trial whose environment reports no success; whether it succeeded, None if nobody says."""
        self._closing = self._closed = False
        self._flight = FlightLog(recorder, env, journal)
        self._loop.observers += [*observers, _Comparison(env, self._loop, journal), self._flight.record]

    def connect(self) -> None:
        """Open the link to the robot, if there is one, without moving it; fails before the loop if it is missing."""
        self._closed = False
        if (robot := robot_of(self.env)) is not None:
            robot.connect()

    def handles_signals(self) -> AbstractContextManager[None]:
        """Within the ``with`` block, SIGINT and SIGTERM go to the switch, even if ignored; `run` uses this itself."""
        return handled(self.switch, (signal.SIGINT, signal.SIGTERM), ignored_too=True)

    def run(self, watcher: Watcher, *, seed: int) -> Ending:
        """Run ``journal.wanted`` episodes; episode k gets ``seed + k``. Their exceptions become the `Ending`."""
        with self.handles_signals():
            ending = None
            try:
                ending = self._run(watcher, seed)
                return ending
            finally:
                self._end_recording(ending)

    def swap(self, policy: Any) -> None:
        """Let another policy act from the next action on; called between two ticks."""
        self._loop.policy.reset()  # nothing that it has planned is sent
        policy.reset()
        self._loop.policy = self._beside(policy)
        self._forget_unusual()
        self.journal.unusual = None

    def _beside(self, policy: Any) -> Any:
        """The policy itself, or in a thread beside the loop."""
        if getattr(policy, "chunk", None) is None or self.pacer.period is None:
            return policy
        task, robot = getattr(self.env.unwrapped, "task", None), robot_of(self.env)
        return Background(
            policy,
            self.pacer.period,
            fade=getattr(task, "action_step", None),
            is_held=lambda: bool(getattr(robot, "is_held", False)),
        )

    def episode(self, watcher: Watcher, *, seed: int) -> EpisodeRecord:
        """Run one episode; afterwards the robot is halted, and stays connected. After an exception it is closed.

        The trial of an episode that `between_ticks` ended is left to the caller.
        """
        self._closed = False
        try:
            record = self._loop.run(watcher, seed=seed, begins=self._begins)
        except BaseException:
            with contextlib.suppress(Exception):  # the fault itself is what the operator must see
                self._close()
            raise
        finally:
            if isinstance(self._loop.policy, Background):
                self._loop.policy.reset()  # nothing that it has planned is sent
            self._forget_unusual()
        self._halt()  # the sink and the next reset may be slow
        if self.trials is not None and record.end != "stopped":
            self._end_trial(self.trials, record)
        self._flush()
        return record

    def _end_trial(self, trials: Trials, record: EpisodeRecord) -> None:
        """Record the trial of a whole episode; one of which nobody knows whether it succeeded does not count."""
        if record.success is None and (success := self.judge(record)) is not None:
            self.journal.judged(record, success)
            if self.recorder is not None:
                self.recorder.event(f"the operator says: {'a success' if success else 'no success'}")
        void = record.success is None
        trials.end(record.success is True, "nobody said whether it succeeded" if void else record.end, void=void)

    def _begins(self, seed: int) -> None:
        if self.trials is not None:
            self.trials.begin(seed)  # before the first command

    def _flush(self) -> None:
        for observer in self._loop.observers:
            if (flush := getattr(observer, "flush", None)) is not None:
                flush()

    def _halt(self) -> None:
        if (robot := robot_of(self.env)) is not None:
            robot.halt()

    def _close(self) -> None:
        """Halt the robot and close the environment, which no signal interrupts; a second call does nothing."""
        self._closing, self.switch.armed = True, False
        if not self._closed:
            halt_and_close(self.env)
            self._closed = True

    def _forget_unusual(self) -> None:
        """End the warning of unusual observations: it is of one policy, in one episode."""
        if (tell := getattr(robot_of(self.env), "tell_unusual", None)) is not None:
            tell("")

    @property
    def warnings(self) -> tuple[str, ...]:
        """The current warnings of the robot's guards, and of the policy; the journal has the earlier ones too."""
        return self._loop.warnings

    @property
    def times(self) -> TickTimes:
        """Of the last ticks."""
        return self._loop.times

    def sent(self, tick: Tick, state: RobotState) -> None:
        """Take a command that a `SafeRobot` has sent, for the recording: `SafeRobot.observe` has one observer only."""
        self._flight.sent(tick, state)

    def record(self, recorder: Recorder) -> None:
        """Record with another recorder, which has started, from the next episode on; the one before is not closed."""
        self.recorder = recorder
        self._flight.begin(recorder)

    def record_command(self) -> None:
        """Record the last command, if no tick has: that of a person who drives, or the one before a fault."""
        self._flight.record_last_command()

    def _end_recording(self, ending: Ending | None) -> None:
        """Record how it ended; without an ending, leave the rest to the recorder's process, which outlives this one."""
        if self.recorder is None:
            return
        self.record_command()
        if ending is None:
            self.recorder.event("ended at once, by a signal", ERROR)
        else:
            self.recorder.event(ending.reason, ERROR if ending.status in (1, 3, 4) else INFO)
            self.recorder.close()

    def _run(self, watcher: Watcher, seed: int) -> Ending:
        by_person, excuse = False, ""
        try:
            try:
                self.switch.armed = True
                self.switch.raise_again()  # for an earlier signal
                for k in range(self.journal.wanted):
                    self.episode(watcher, seed=seed + k)
            finally:  # inside the outer try: a signal that comes before this line is still caught
                self.switch.armed = False
            ending = Ending("episodes done", 0)
        except Stopped:
            ending, by_person = Ending("interrupted", 128 + self.switch.came[0]), True
        except Exception as error:  # after any fault, the robot must be halted and the report made
            ending, excuse = ending_of(error), excuse_of(error, robot_of(self.env), self.times)
        except BaseException:
            if not self._closing:
                self._halt()
            raise
        ending = _unless_it_fails(ending, "closing", self._close)
        if self.trials is not None:  # of an episode that was cut short
            ended = partial(self.trials.end, False, excuse or ending.reason, void=by_person or excuse != "")
            ending = _unless_it_fails(ending, "recording the trial", ended)
        return _unless_it_fails(ending, "recording", self._flush)  # of an episode that was cut short


def ending_of(error: Exception) -> Ending:
    """The ending for an exception: it points the operator to the network, the robot, or the program."""
    text = fault_text(error).replace("call resume()", "run it again")  # the program ends here and cannot be resumed
    if isinstance(error, LinkLost):
        return Ending(f"link lost: {text}", 4)
    if isinstance(error, SafetyStop):
        return Ending(f"safety stop: {text}", 3)
    return Ending(f"fault: {text}", 1)


def excuse_of(error: Exception, robot: Any, times: TickTimes) -> str:
    """Why an episode that `error` ended is no verdict on the policy, in one line; "" if that may be the policy's fault.

    Args:
        error: The exception.
        robot: The robot, behind its guards.
        times: Of the last ticks.
    """
    is_ours = getattr(robot, "stopped", None) is not None
    if is_ours or isinstance(error, SafetyStop):  # else by a guard of the live agent there
        return times.excuse(by_time=is_ours and robot.code in TIMING_GUARDS)
    if isinstance(error, LinkLost):
        return "the link to the robot, or to the server of the policy, was lost"
    return "somebody else drives the robot" if isinstance(error, NotInCommand) else ""


def _unless_it_fails(ending: Ending, what: str, end: Callable[[], None]) -> Ending:
    """Call `end`; its failure is a fault, unless there was one before."""
    try:
        end()
    except Exception as error:  # of the environment or the sink; the report is made in any case
        if ending.reason in ("episodes done", "interrupted"):
            return Ending(f"fault: {what} failed: {fault_text(error)}", 1)
    return ending


def fault_text(error: Exception) -> str:
    """The exception in one line, with its type unless it belongs to `bam_envs` or `bam_train`."""
    text = " ".join(str(error).split())
    is_clear = isinstance(error, (BamEnvsError, BamTrainError)) and text
    return text if is_clear else f"{type(error).__name__}: {text}".removesuffix(": ")


class _Comparison:
    """Compares what the policy sees and does, and how the robot answers, with its training, if it has a detector."""

    def __init__(self, env: gym.Env[Any, Any], loop: EpisodeLoop, journal: Journal) -> None:
        self._loop, self._journal = loop, journal
        self._of: Any = None  # the detector of the running episode
        self._env: Any = env.unwrapped
        self._robot = robot_of(env)
        self._tell = getattr(self._robot, "tell_unusual", None)
        self._pace = getattr(getattr(self._robot, "limits", None), "pace", 1.0)
        self._stamp = math.nan

    def __call__(self, step: EpisodeStep) -> None:
        journal, detector = self._journal, getattr(self._loop.policy, "detector", None)
        if detector is None or step.is_last:
            journal.unusual = None if detector is None else journal.unusual
            return
        if step.number == 0 or detector is not self._of:
            detector.begin(self._pace)
            self._of = detector
        seen, held = vectors(step.arrays)[0], getattr(self._robot, "is_held", False)
        level = detector.step(seen, step.action, *self._answered(), held=held)
        text = f"{detector.reason} (score {level:.2f}, usual is at most 1)" if level > 1.0 else ""
        journal.compare(level, text, begins=step.number == 0)
        if text and self._tell is not None:
            self._tell(text)

    def _answered(self) -> tuple[Any, float]:
        """The command that was sent before the newest state, and the time since the state before [periods]."""
        state = getattr(self._env, "last_state", None)
        if state is None:
            return None, 1.0
        stamp = float(state.stamp[0])
        before, self._stamp = self._stamp, stamp
        return state.command[0], (stamp - before) / self._robot.spec.period
