"""The deployment: a chain of agents that moves a robot at absolute deadlines.

Robot, journal and policy are agents of one `TemporalAgent`, which waits for each deadline before the policy acts; your
own agents join the same chain. At the end, for any reason (all episodes done, Ctrl-C, SIGTERM, a fault), the robot is
halted and closed before anything is reported.
"""

import math
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, Protocol

import gymnasium as gym

from bam_envs.core.errors import BamEnvsError, LinkLost, SafetyStop
from bam_envs.core.robot import RobotState
from bam_envs.core.timing import Pacer, TickTimes
from bam_envs.safety.guard import Tick
from bam_train.deploy.flight import RecorderAgent, Stopwatch
from bam_train.deploy.journal import Ending, EpisodeRecord, Journal
from bam_train.deploy.trials import Trials
from bam_train.errors import BamTrainError
from bam_train.loop import Agent, Agents, PolicyAgent, RobotAgent, TemporalAgent, Workspace
from bam_train.loop.gym.robot_agent import SAYS_SUCCESS, SUCCESS
from bam_train.loop.workspace import Sink
from bam_train.recording.recorder import ERROR, INFO, Recorder
from bam_train.signals import handled, interrupt

WINDOW = 1000
"""Minimum number of ticks that the workspace of a deployment keeps: 50 s at 20 Hz."""
STOP = "deployment/stop"
"""Variable (1,): whether the episode ends at this time."""
_ENDS = ("terminated", "truncated")


class Watcher(Protocol):
    """Displays the loop; called between ticks, so it must be fast."""

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Pacer) -> None:
        """Called after every step."""

    def ended(self, record: EpisodeRecord) -> None:
        """Called after every episode."""


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
    """A frozen policy and a robot in one loop, which runs once, with bounded memory.

    Args:
        env: The environment, already checked to fit the policy.
        policy: Has ``reset()`` and ``act(observation)``.
        pacer: The deadlines.
        journal: Updated at every tick.
        agents: Further agents, run after the policy; they declare the variables that they read and write.
        window: Minimum number of ticks that the workspace keeps.
        sink: ``sink(first_time, {variable: array (n, 1, ...)})`` gets every tick once, in order, episode by episode.
            It is called between two ticks, so it must be fast; if it fails, the deployment ends.
        recorder: Records every tick, if given; it has started, and is closed at the end. If it fails, the deployment
            goes on.
        trials: Where each episode is recorded as a trial, if given; may be exchanged between two episodes.
        boundary: Agent that runs between a deadline and the policy, and writes `STOP`, which ends the episode.
        switch: Handler of SIGINT and SIGTERM; None: one of its own.

    Raises:
        WiringError: An agent reads a variable that no agent writes; the robot has not been connected.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        policy: Any,
        pacer: Pacer,
        journal: Journal,
        *,
        agents: Sequence[Agent] = (),
        window: int = WINDOW,
        sink: Sink | None = None,
        recorder: Recorder | None = None,
        trials: Trials | None = None,
        boundary: Agent | None = None,
        switch: StopSwitch | None = None,
    ) -> None:
        self.env, self.pacer, self.journal, self.recorder, self.trials = env, pacer, journal, recorder, trials
        self.switch = switch or StopSwitch(lambda: self._robot.halt())
        """Handler of SIGINT and SIGTERM."""
        self._robot = _DeployedRobot(env, self.switch)
        self._workspace = Workspace(window=window, sink=None if sink is None else _silent_once_broken(sink))
        self._watch = watch = Stopwatch()
        names = self._robot.observation_names
        self._policy = policy_agent = _TimedPolicy(policy, names, watch)
        self.times = TickTimes(pacer.period)
        """Of the last ticks."""
        self._stop_variable = "env/done" if boundary is None else STOP
        chain: list[Agent] = [
            _StopAgent(self.switch, watch),
            self._robot,
            _JournalAgent(self, watch, getattr(env.unwrapped, "robot", None)),
            *(() if boundary is None else (boundary,)),
            policy_agent,
            *agents,
            _DetectorAgent(self, policy_agent),
        ]
        self._flight = RecorderAgent(recorder, env, names, journal, watch)
        chain.append(self._flight)
        self._loop = TemporalAgent(Agents(*chain))

    def connect(self) -> None:
        """Open the link to the robot, if there is one, without moving it; fails before the loop if it is missing."""
        self._robot.connect()

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
        """Let another policy act from the next action on; called between two ticks, as by the `boundary` agent."""
        policy.reset()
        self._policy.policy = policy

    def episode(self, watcher: Watcher, *, seed: int) -> EpisodeRecord:
        """Run one episode; afterwards the robot is halted, and stays connected. After an exception it is closed."""
        self._loop(self._workspace, t=0, stop_variable=self._stop_variable, seed=seed, watcher=watcher)
        self._robot.halt()  # the sink and the next reset may be slow
        record = self.journal.records[-1]
        if self.trials is not None:
            self.trials.end(record.success is True, record.end)
        self._workspace.flush()
        return record

    @property
    def latency(self) -> float:
        """Time from a deadline to the step that followed it, in the last tick [s]."""
        return self._watch.latency

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
            ending = Ending("interrupted", 128 + self.switch.came[0])
        except Exception as error:  # after any fault, the robot must be halted and the report made
            ending = ending_of(error)
        except BaseException:
            if not self._robot.closing:
                self._robot.halt()
            raise
        ending = _unless_it_fails(ending, "closing", self._robot.close)
        if self.trials is not None:
            ended = partial(self.trials.end, False, ending.reason)  # of an episode that was cut short
            ending = _unless_it_fails(ending, "recording the trial", ended)
        return _unless_it_fails(ending, "recording", self._workspace.flush)  # of an episode that was cut short


def ending_of(error: Exception) -> Ending:
    """The ending for an exception: it points the operator to the network, the robot, or the program."""
    text = fault_text(error).replace("call resume()", "run it again")  # the program ends here and cannot be resumed
    if isinstance(error, LinkLost):
        return Ending(f"link lost: {text}", 4)
    if isinstance(error, SafetyStop):
        return Ending(f"safety stop: {text}", 3)
    return Ending(f"fault: {text}", 1)


def _unless_it_fails(ending: Ending, what: str, end: Callable[[], None]) -> Ending:
    """Call `end`; its failure is a fault, unless there was one before."""
    try:
        end()
    except Exception as error:  # of the environment or the sink; the report is made in any case
        if ending.reason in ("episodes done", "interrupted"):
            return Ending(f"fault: {what} failed: {fault_text(error)}", 1)
    return ending


def _silent_once_broken(sink: Sink) -> Sink:
    """The sink, which is not called again after it has failed."""
    broken = False

    def guarded(first_time: int, piece: dict[str, Any]) -> None:
        nonlocal broken
        if not broken:
            broken = True  # until it returns without an exception
            sink(first_time, piece)
            broken = False

    return guarded


def fault_text(error: Exception) -> str:
    """The exception in one line, with its type unless it belongs to `bam_envs` or `bam_train`."""
    text = " ".join(str(error).split())
    is_clear = isinstance(error, (BamEnvsError, BamTrainError)) and text
    return text if is_clear else f"{type(error).__name__}: {text}".removesuffix(": ")


# ---- the agents beside robot and policy


class _StopAgent(Agent):
    """Runs before the robot's agent, so that the robot gets no command after a signal whose exception was lost."""

    reads = ()
    writes = ()

    def __init__(self, switch: StopSwitch, watch: Stopwatch) -> None:
        super().__init__()
        self._switch, self._watch = switch, watch

    def forward(self, t: int, **kwargs: Any) -> None:
        watch, watch.begun = self._watch, time.perf_counter()
        if t > 0:  # a reset follows no deadline
            watch.latency = watch.begun - watch.waited
        self._switch.raise_again()


class _TimedPolicy(PolicyAgent):
    """The policy's agent, which measures how long an action takes."""

    def __init__(self, policy: Any, names: tuple[str, ...], watch: Stopwatch) -> None:
        super().__init__(policy, names, single=True)
        self._declare(_TimedPolicy, reads=(*names, self._timestep, self._done), writes=(self.output,))
        self._watch = watch

    def forward(self, t: int, seed: Any = None, **kwargs: Any) -> None:
        watch, begun, computed = self._watch, time.perf_counter(), time.thread_time()
        try:
            super().forward(t, seed, **kwargs)
        finally:
            watch.acted, watch.computed = time.perf_counter() - begun, time.thread_time() - computed


class _DetectorAgent(Agent):
    """Compares what the policy sees and does, and how the robot answers, with its training, if it has a detector."""

    writes = ()

    def __init__(self, deployment: "Deployment", policy: PolicyAgent) -> None:
        super().__init__()
        self._policy, self._journal = policy, deployment.journal
        self._of: Any = None  # the detector of the running episode
        self._env: Any = deployment.env.unwrapped
        self._robot: Any = getattr(self._env, "robot", None)
        self._tell = getattr(self._robot, "tell_unusual", None)
        self._pace = getattr(getattr(self._robot, "limits", None), "pace", 1.0)
        self._stamp = math.nan
        self.reads = (*policy.names, "action", "env/done")

    def forward(self, t: int, **kwargs: Any) -> None:
        journal = self._journal
        detector: Any = getattr(self._policy.policy, "detector", None)
        if detector is None or self.get(("env/done", t))[0]:
            journal.unusual = None if detector is None else journal.unusual
            return
        if t == 0 or detector is not self._of:
            detector.begin(self._pace)
            self._of = detector
        seen, action = self.get((self._policy.names[0], t))[0], self.get(("action", t))[0]
        level = detector.step(seen, action, *self._answered(), held=getattr(self._robot, "is_held", False))
        text = f"{detector.reason} (score {level:.2f}, usual is at most 1)" if level > 1.0 else ""
        journal.compare(level, text, begins=t == 0)
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


class _DeployedRobot(RobotAgent):
    """The robot's agent, whose closing no signal interrupts."""

    closing = False

    def __init__(self, env: gym.Env[Any, Any], switch: StopSwitch) -> None:
        super().__init__(env)
        self._switch = switch

    def close(self) -> None:
        self.closing, self._switch.armed = True, False
        super().close()


class _JournalAgent(Agent):
    """Updates the journal, calls the watcher, then waits for the deadline of the next action."""

    reads = tuple(f"env/{name}" for name in ("reward", "done", *_ENDS, SUCCESS, SAYS_SUCCESS))
    reads_previous = ("action",)
    writes = ()

    def __init__(self, deployment: Deployment, watch: Stopwatch, robot: Any) -> None:
        super().__init__()
        self._deployment, self._journal, self._pacer = deployment, deployment.journal, deployment.pacer
        self._watch, self._robot = watch, robot

    def forward(self, t: int, seed: int, watcher: Watcher, **kwargs: Any) -> None:
        self._watch.stepped, done = time.perf_counter(), self.get(("env/done", t))[0]
        if t == 0:
            self._journal.begin(seed)
            if self._deployment.trials is not None:
                self._deployment.trials.begin(seed)  # before the first command
            self._pacer.start()
        else:  # the step that led to time t
            success = self.get((f"env/{SUCCESS}", t))[0] if self.get((f"env/{SAYS_SUCCESS}", t))[0] else None
            end = next(end for end in _ENDS if self.get((f"env/{end}", t))[0]) if done else "stopped"
            self._journal.warn(getattr(self._robot, "warnings", ()))
            record = self._journal.step(self.get(("env/reward", t))[0], success, end)
            watcher.ticked(record, self.get(("action", t - 1))[0], self._pacer)
            if end != "stopped":
                watcher.ended(record)
        if done:
            self._watch.late = 0.0
        else:
            self._wait(self._journal.records[-1], begins=t == 0)
        self._watch.waited = time.perf_counter()

    def _wait(self, record: EpisodeRecord, *, begins: bool) -> None:
        """Wait for the deadline of the next action."""
        pacer, watch, missed = self._pacer, self._watch, self._pacer.missed
        watch.late = pacer.wait()
        if not begins:
            missed = pacer.missed - missed
            record.slow += self._deployment.times.add(watch.late, missed, watch.acted, watch.computed)
