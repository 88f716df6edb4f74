"""The resident program on a robot's computer: it owns the robot, and runs the active policy episode after episode.

Only the main thread moves the robot: the loop of a `Deployment` while the policy drives, or the newest command of the
person who has taken over. Requests wait in a queue and are executed by the main thread between two ticks; a halt is
executed at once, in the thread in which it comes, and so is a pause while the robot is being connected.

Longer than most files: it is one object with one state, and every request that changes it.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_envs import __version__
from bam_envs.core.errors import BamEnvsError, LinkLost, NotInCommand, NotReady, RemoteError, SafetyStop
from bam_envs.core.robot import Initial
from bam_train.agent.agent_messages import Answer, Ask, Drive, Halt, Message, Report, Rows, Sent
from bam_train.agent.agent_options import AgentOptions
from bam_train.agent.agent_states import TRANSITIONS, State
from bam_train.agent.robot_session import RobotSession
from bam_train.agent.succession import Choice, Succession, done_by
from bam_train.agent.transitions import TransitionCollector, TransitionLog, encode
from bam_train.agent.versions import Versions
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.deployment import Stopped, StopSwitch, excuse_of, fault_text
from bam_train.deploy.episode import EpisodeStep
from bam_train.deploy.journal import LATE, EpisodeRecord
from bam_train.errors import BamTrainError, ContractRefused, FormatError, PolicyError, RequestRefused, kind_of

if TYPE_CHECKING:
    from bam_train.agent.audit import Audit

_log = logging.getLogger(__name__)
_LINK_POLL_PERIOD = 0.2  # time between two looks at the link while the robot rests [s]
_RECONNECT_PERIOD = 1.0  # time between two attempts to reach the robot [s]
_REPORT_PERIOD = 0.5  # time between two reports while nothing changes [s]
_LOG_PERIOD = 60.0  # least time between two warnings of a guard in the log, and two reasons to wait for the robot [s]
COMMAND_LIFETIME = 0.2
"""Age of a person's newest command from which the robot rests, at least one and a half periods [s]."""
ROBOT_FITS = "the robot is there, and fits"
"""Why the agent no longer waits."""
_RECENT_EPISODES = 20  # episodes in the status
_HALTING_REQUESTS = ("pause", "take")
"""Requests for which the robot is halted before they are executed."""
_WITHOUT_ROBOT = ("pause", "resume")
"""Requests that are executed also while the main thread connects the robot, which takes long on a busy computer."""


def _advised(error: Exception) -> str:
    """The exception in one line, which says what ends a stop of the agent's robot."""
    return fault_text(error).replace("call resume()", "resume the agent")


class _Interrupted(BaseException):
    """A request ends the way to the start pose."""


@dataclass(frozen=True)
class Driver:
    """Who has taken over."""

    lease: str
    """Name of the lease's owner on the port."""
    who: str
    """The same for people."""
    ran: bool
    """Whether the policy drove before."""


class Resident:
    """The live agent, which runs in the main thread until it is asked to end.

    Args:
        options: What it drives.
        versions: Its versions; one of them is called `CHAMPION`.
        audit: Where every change of state is written.
        send: Sends a message to the front process.
        tell: Called with a line for the operator.
        admit: See `RobotSession`.
        is_running: Whether the policy drives as soon as the robot is there.
        connect: Connects the robot; `RobotSession`.
    """

    def __init__(
        self,
        options: AgentOptions,
        versions: Versions,
        audit: Audit,
        *,
        send: Callable[[Message], None],
        tell: Callable[[str], None],
        admit: Callable[[Any, Sequence[str]], None],
        is_running: bool,
        connect: Callable[..., RobotSession] = RobotSession,
    ) -> None:
        self.options, self.audit = options, audit
        self.state, self.why, self.since = State.WAITING, "it starts", time.time()
        self.switch = StopSwitch(self.halt)
        """Handler of signals."""
        self.session: RobotSession | None = None
        self.driver: Driver | None = None
        self.succession = Succession(self, versions)
        """Which version acts."""
        self._stage = options.stage
        self._chosen: Choice | None = None  # acts as soon as it may
        self.send = send
        self.transitions = TransitionLog()
        """For a learner."""
        self.transitions.wanted = False
        self._tell, self._admit, self._connect = tell, admit, connect
        self._news = threading.Condition()
        self._hurry = threading.Event()  # a request that ends the tick
        self._requests: deque[tuple[Callable[[], dict[str, Any] | None], int]] = deque()
        self._command: Drive | None = None
        self._is_running, self._quitting, self._connecting = is_running, False, False
        # Why, once a guard stopped the robot, and once a person or a fault paused it.
        self._stopped, self._paused = "", "" if is_running else "it started paused"
        self._last_stop = ""  # why a guard stopped the robot, until a person resumes it
        self._was_connected = self._holds = self._was_cut_short = False
        self._seed, self._reported = options.seed, 0.0
        self._episodes: deque[int | None] = deque(maxlen=_RECENT_EPISODES)
        self._ticks = self._completed = self._successes = 0
        self._late = self._slow = 0  # late ticks of earlier connections, and those that a policy made late
        self._link_ms = self._loop_ms = 0.0
        self._logged: dict[str, tuple[str, float]] = {}  # by title: the last line of the log, and when [s]

    # ---- what other threads call

    def halt(self) -> None:
        """Stop the robot now; the next command begins at its position. Thread-safe."""
        session = self.session
        if session is not None:
            session.robot.halt()

    def take(self, message: Message) -> None:
        """Take a message of the front process. Thread-safe; returns at once."""
        if isinstance(message, Drive):
            with self._news:
                self._command = message
                self._news.notify()
        elif isinstance(message, Halt):
            self.halt()
            if message.stop:
                why = message.why or "the stop button"
                self.post(lambda: self._pause(message.who, message.address, why), without_robot=True)
        elif isinstance(message, Ask):
            self._ask(message)

    def post(self, do: Callable[[], dict[str, Any] | None], number: int = 0, *, without_robot: bool = False) -> None:
        """Let the main thread call `do` between two ticks; its result answers the request `number`. Thread-safe.

        Args:
            do: Called.
            number: Of the request; 0: nobody waits.
            without_robot: Call it in this thread, if the main thread connects the robot and no request waits.
        """
        with self._news:
            if without_robot and self._connecting and not self._requests:
                self._answer(do, number)
            else:
                self._requests.append((do, number))
                self._news.notify()

    def front_died(self) -> None:
        """The front process died, and with it every client: whoever drives holds now, and the agent is paused then."""
        self.halt()

        def end() -> None:
            self.transitions.wanted = False
            if self.driver is not None:
                self._hand_back("the agent", "", self.driver.lease, why="the front process died, and with it the link")

        self.post(end)

    def quit(self) -> None:
        """End the program between two ticks. Thread-safe."""

        def end() -> None:
            self._quitting = True

        self.post(end)

    def _ask(self, ask: Ask) -> None:
        known: dict[str, Callable[..., dict[str, Any] | None]] = {
            "pause": self._pause,
            "resume": self._resume,
            "take": self._take_over,
            "cut": self._cut,
            "hand_back": self._hand_back,
            "scene": self._scene,
            "rollback": self._roll_back,
            "transitions": self._stream,
        }
        do = known.get(ask.op)
        if ask.op in ("push", "use"):
            self.succession.begin(ask)
        elif do is None:
            self.send(Answer(ask.number, error=f"{ask.op}: this agent does not know that", kind="RequestRefused"))
        else:
            without = ask.op in _WITHOUT_ROBOT
            self.post(lambda: do(ask.who, ask.address, **ask.arguments), ask.number, without_robot=without)
            if ask.op in _HALTING_REQUESTS:
                self._hurry.set()
                self.halt()

    # ---- the main thread

    def run(self) -> None:
        """Run until `quit`, or a signal, which raises `Stopped`; then the robot is halted, and the link dropped."""
        try:
            self._report()
            while not self._quitting:
                self._armed(self._turn)
        finally:
            self.switch.armed = False
            self._drop("the program ends")

    @property
    def _connected(self) -> RobotSession:
        if self.session is None:
            raise RequestRefused(f"The agent waits for the robot: {self.why}")
        return self.session

    def _armed(self, do: Callable[[], None]) -> None:
        """Call `do`, which a signal may interrupt."""
        self.switch.armed = True
        self.switch.raise_again()
        try:
            do()
        finally:
            self.switch.armed = False

    def _turn(self) -> None:
        """One episode, one look at a resting robot, or one command of a person."""
        self._execute()
        if (stop := self._unnoticed_stop) is not None:
            self._failed(stop)
        elif self.session is None:
            self._reach_robot()
        elif self.driver is not None:
            self._drive()
        elif self._is_running:
            self._play()
        else:
            self._rest()

    def _execute(self) -> None:
        """Execute the requests that wait."""
        self._hurry.clear()
        while self._requests:
            with self._news:
                do, number = self._requests.popleft()
            self._answer(do, number)

    def _answer(self, do: Callable[[], dict[str, Any] | None], number: int) -> None:
        try:
            result = do()
            answer = Answer(number, result=result or {})
        except (BamTrainError, BamEnvsError) as error:
            answer = Answer(number, error=_advised(error), kind=kind_of(error))
        if number:
            self.send(answer)

    @property
    def _unnoticed_stop(self) -> SafetyStop | None:
        """The stop of a guard that came while a request was executed, whose sender alone has heard of it."""
        stopped = None if self.session is None else self.session.robot.stopped
        if stopped is None:
            return None
        text = f"The robot was stopped by {stopped}. When it is safe, call resume()."
        return SafetyStop(stopped.partition(" (")[0], text)

    def between_ticks(self) -> bool:
        """Called by the loop between a deadline and the policy: whether the episode ends here."""
        self._was_cut_short = self._hurry.is_set()
        return self._settled()

    def _look(self, step: EpisodeStep) -> None:
        self._loop_ms += 0.05 * (1e3 * step.latency - self._loop_ms)

    def _settled(self) -> bool:
        """Execute what waits, and swap the policy if that is asked for now; whether the episode ends here."""
        if self._requests:
            self._execute()
        if self._chosen is not None and self._chosen.at_once and not self._slows(self._chosen):
            self._activate()
        return not self._plays()

    def _plays(self) -> bool:
        """Whether the episode that runs goes on."""
        waits = (self._chosen is not None and self._chosen.at_once) or self._unnoticed_stop is not None
        return self._is_running and self.driver is None and not waits and not self._quitting

    def _play(self) -> None:
        """One episode of the active policy."""
        if self._chosen is not None:
            self._activate()
        session = self._connected
        if session.is_real and self._stage is not None and self._stage != session.stage:
            self._drop(f"for the stage {self._stage}")
            return
        session.deployment.trials = self.succession.trials()
        self._record_again()
        self._change(self._driving, ROBOT_FITS if self.state is State.WAITING else self.why)
        journal = session.deployment.journal
        begun = journal.begun
        try:
            if (trials := session.deployment.trials) is not None:
                self._seed = trials.next_seed(self._seed)
            seed, self._seed = self._seed, self._seed + 1
            record = session.deployment.episode(self, seed=seed)
        except _Interrupted:
            self.halt()
            return
        except Stopped:
            self.succession.interrupted("the agent was ended")
            raise
        except Exception as error:
            self._failed(error)
            if journal.begun > begun:  # else the policy has not acted: the arm was on its way to its start pose
                self._judge(session, journal.records[-1], error)
            return
        if record.end == "stopped":
            self.succession.interrupted(self._why_cut_short)
            return
        self._completed += 1
        self._successes += record.success is True
        self._episodes.append(None if record.success is None else int(record.success))
        self.succession.ended(record)

    def _judge(self, session: RobotSession, record: EpisodeRecord, error: Exception) -> None:
        """Judge the policy whose episode ended with `error`: by a stop of a guard, or by the loss of the link."""
        excuse = excuse_of(error, session.robot, session.deployment.times)
        if self._stopped or excuse:
            self.succession.cut_short(record, self._stopped, excuse)

    @property
    def _why_cut_short(self) -> str:
        """Why the episode was ended between two ticks: by what a person asked for."""
        if self._quitting and self._is_running:
            return "the agent was ended"
        return self.why if self._chosen is None else f"another version acts: {self._chosen.why}"

    @property
    def _driving(self) -> State:
        """The state in which the policy drives."""
        on_trial = self.succession.is_candidate or (self.session is not None and self.session.stage == "trial")
        return State.TRIAL if on_trial else State.RUNNING

    def choose(self, choice: Choice) -> None:
        """Let another version act as soon as it may. Thread-safe."""

        def set_choice() -> None:
            self._chosen = choice

        if threading.current_thread() is threading.main_thread():
            set_choice()
        else:
            self.post(set_choice)

    def promoted(self, why: str) -> None:
        """The active version is the champion; it moves at the stage of the agent's setting from the next episode on."""
        self._stage = self.options.stage
        if self.state.drives:
            self._change(self._driving, why)

    def _slows(self, choice: Choice) -> bool:
        """Whether the episode ends first: the robot gets closer limits, or the policy computes its first chunk."""
        session = self.session
        if getattr(choice.policy, "chunk", None) is not None:
            return True
        return session is not None and session.is_real and choice.stage == "trial" and session.stage != "trial"

    def _activate(self) -> None:
        """Let the chosen version act from now on."""
        choice, self._chosen = self._chosen, None
        if choice is None:
            return
        before = self.succession.active
        replaced = self.succession.activate(choice)
        if self.session is not None:
            deployment = self.session.deployment
            if deployment.trials is not None:
                with contextlib.suppress(FormatError):  # then the episode counts for the version that began it
                    deployment.trials.end(False, f"another version acts: {choice.why}", void=True)
            deployment.trials = self.succession.trials()  # an episode on its way to its start is one of this version
            deployment.swap(choice.policy)
        self._stage = choice.stage or self._stage
        after = choice.version.digest[:12]
        self.note("swap", f"{after} acts instead of {before.digest[:12]}: {choice.why}", choice.who)
        if self.state.drives:
            self._change(self._driving, choice.why, choice.who)
        choice.active.set()
        self._report()
        if replaced is not None:  # who waits for its outcome sees the state that it led to
            replaced.close("replaced: another version acts")

    # ---- the robot rests, or a person drives it

    def _rest(self) -> None:
        self._change(State.STOPPED if self._stopped else State.PAUSED, self.why)
        self._activate()
        self._record_again()
        with self._news:
            self._news.wait_for(lambda: bool(self._requests) or bool(self.switch.came), _LINK_POLL_PERIOD)
        self._require_link()
        self._report(_REPORT_PERIOD)

    def _record_again(self) -> None:
        if self.session is not None and (name := self.session.record_again()):
            acts = f"{self.succession.active.digest[:12]} acts"  # which `Recording.policies` reads
            self.note("recording", f"the recording goes on in {name}; {acts}")

    def _require_link(self) -> None:
        if self.session is not None and not self.session.is_up:
            self._failed(LinkLost(f"{self.options.robot.text}: no state came for more than a second."))

    def _drive(self) -> None:
        """Send the newest command of the person who has taken over, or rest while there is none."""
        session = self._connected
        life = max(COMMAND_LIFETIME, 1.5 * session.robot.spec.period)
        with self._news:
            self._news.wait_for(lambda: bool(self._requests) or self._command is not None, life)
            drive, self._command = self._command, None
        if self._requests:
            return
        if drive is None or self.driver is None or drive.driver != self.driver.lease:
            if not self._holds:  # once: each halt of an arm holds it where gravity has pulled it
                session.robot.halt()
            self._holds = True
            self._require_link()
            self._report(_REPORT_PERIOD)
            return
        self._holds = False
        try:
            if session.robot.is_unproved:  # this motion is the first: the next command comes after it
                session.robot.prove()
                self._report(_REPORT_PERIOD)
                return
            session.robot.step(np.array([drive.command]))
            session.deployment.record_command()
            self._ticks += 1
        except _Interrupted:
            session.robot.halt()
            self._holds = True
        except Exception as error:
            self._failed(error)
        self._report(_REPORT_PERIOD)

    def _sent(self, tick: Any, state: Any) -> None:
        """After each command: requests may interrupt the way to a start pose, and the proof of the commands."""
        session = self.session
        if session is None:
            return
        session.deployment.sent(tick, state)
        self.send(Sent(list(tick.command)))
        self._link_ms += 0.05 * (1e3 * tick.age - self._link_ms)
        if tick.approach and self._requests:
            driver = self.driver
            ends = self._settled()
            if ends if driver is None else self.driver is not driver or self._holds:
                raise _Interrupted

    # ---- the link

    def _reach_robot(self) -> None:
        """Connect, and check the contract; on failure wait a little."""
        if not self._stopped:
            self._change(State.WAITING, self.why)
        try:
            self._activate()
            checkpoint = Checkpoint.open(self.succession.active.path)
            self.session = self._connected_to(checkpoint)
        except (BamEnvsError, BamTrainError) as error:
            may_pass = isinstance(error, BamEnvsError) or (isinstance(error, ContractRefused) and error.passes)
            if not (self._was_connected or may_pass):
                raise  # a setting, a file or a robot that is wrong when the program starts
            if not self._stopped:
                self._change(State.WAITING, fault_text(error))
                self._log_anew(self.state.value, f"{self.state.value}: {self.why}")
            with self._news:
                self._news.wait_for(lambda: bool(self._requests), _RECONNECT_PERIOD)
            self._report(_REPORT_PERIOD)
            return
        self._was_connected = True
        self._logged = {title: ("", at) for title, (_, at) in self._logged.items()}  # what comes again is said again
        self._admit = lambda env, lines: None  # the operator is asked once
        self.session.deployment.swap(self.succession.policy())
        self.succession.load_previous()
        self.session.robot.observe(self._sent)
        self.note("connected", f"{self.options.robot.text}: the robot fits, stage {self.session.stage}")
        if self._stopped:
            self._change(State.STOPPED, self._stopped)
        elif not self._is_running:
            self._change(State.PAUSED, self._paused or ROBOT_FITS)

    def _connected_to(self, checkpoint: Checkpoint) -> RobotSession:
        try:
            with self._news:
                self._connecting = True
            return self._connect(
                self.options,
                checkpoint,
                self._stage,
                between_ticks=self.between_ticks,
                observers=[
                    self._look,
                    TransitionCollector(
                        self.transitions, lambda: self.succession.active.digest, lambda: self._was_cut_short
                    ),
                ],
                switch=self.switch,
                admit=self._admit,
                sleep=self._hurry.wait,
            )
        finally:
            with self._news:
                self._connecting = False

    def _drop(self, why: str) -> None:
        """Halt the robot and drop the link."""
        session, self.session = self.session, None
        if session is not None:
            session.event(f"the link is dropped: {why}")
            session.close()
            self._late += session.deployment.times.late
            self._slow += session.deployment.times.slow

    def _failed(self, error: Exception) -> None:
        """What a fault while the robot moved leads to: waiting for the robot, stopped by a guard, or paused."""
        text, session = _advised(error), self.session
        stopped = isinstance(error, SafetyStop) or (session is not None and session.robot.stopped is not None)
        self.halt()
        self._drop(text)
        driver, self.driver = self.driver, None
        if stopped:  # also by the age of its state: only a person lets it move again
            self._stopped = self._last_stop = text
            self._is_running = False
            self._change(State.STOPPED, text)
        elif isinstance(error, (LinkLost, RemoteError, NotReady)):  # or somebody else drives: it goes on when it can
            self._change(State.WAITING, text)
        else:
            if not isinstance(error, (BamTrainError, BamEnvsError)):
                _log.error("The episode failed", exc_info=error)
            if isinstance(error, PolicyError) and self.succession.policy_failed(text):
                self._change(State.WAITING, text)  # until the other version is connected
                return
            self._is_running, self._paused = False, f"paused by a fault: {text}"
            self._change(State.PAUSED, self._paused)
        if driver is not None:  # who drove hears of the stop first, and then that the lease has ended
            self._end_driving(driver, text)

    # ---- requests, in the main thread

    def _pause(self, who: str, address: str, why: str = "") -> dict[str, Any]:
        self.halt()
        self._is_running, self._stopped = False, ""
        self._paused = done_by("paused", who, why) + f"; before that: {self._last_stop}" * bool(self._last_stop)
        if self.driver is not None:
            self._end_driving(self.driver, f"paused by {who}")
        if self.session is None:
            self.note("pause", self._paused, who, address)
        else:
            self._change(State.PAUSED, self._paused, who, address)
        return self.status()

    def _resume(self, who: str, address: str, why: str = "") -> dict[str, Any]:
        if self.driver is not None:
            raise RequestRefused(
                f"{self.driver.who} drives the robot; take it back first, or wait until it is handed back"
            )
        if self._last_stop:
            self.note("resume", f"{who} lets the robot move again after: {self._last_stop}", who, address)
        self._stopped, self._last_stop, self._paused, self._is_running = "", "", "", True
        text = done_by("resumed", who, why)
        if self.session is None:
            self.note("resume", text, who, address)
        else:
            self._change(self._driving, text, who, address)
        return self.status()

    def _take_over(self, who: str, address: str, lease: str, force: bool = False) -> dict[str, Any]:
        if self.session is None or self._stopped:
            reason = self._stopped or self.why
            raise NotInCommand(f"The agent is {self.state.value} ({reason}); nobody can take over now.")
        self.halt()
        if self.driver is not None and self.driver.lease != lease:
            self.note("take over", f"{who} takes over from {self.driver.who}", who, address)
        ran = self._is_running if self.driver is None else self.driver.ran
        self.driver, self._command, self._is_running, self._holds = Driver(lease, who, ran), None, False, True
        self._change(State.TAKEN_OVER, f"taken over by {who}", who, address)
        return self.status()

    def _cut(self, who: str, address: str, lease: str, how: str) -> None:
        """The link of the owner was cut: hold; the front process ends the lease later."""
        if self.driver is not None and self.driver.lease == lease:
            self.halt()
            self._command, self._holds = None, True
            self._change(State.TAKEN_OVER, f"the link of {self.driver.who} {how}; the robot holds", who, address)

    def _hand_back(
        self, who: str, address: str, lease: str, resume: bool | None = None, why: str = ""
    ) -> dict[str, Any]:
        driver = self.driver
        if driver is None or driver.lease != lease:
            return self.status()
        self.halt()
        # A program goes back to what was before, whose pause a person lifts.
        goes_on = (self.options.resume and driver.ran if resume is None else resume) and not why
        text = why or f"handed back by {who}"
        self._end_driving(driver, text)
        self._is_running = goes_on
        if goes_on:
            self._paused = self._last_stop = ""
            self._change(self._driving, text, who, address)
        else:
            self._change(State.PAUSED, "; ".join(filter(None, (text, self._paused))), who, address)
        return self.status()

    def _end_driving(self, driver: Driver, why: str) -> None:
        self.driver, self._command = None, None
        self.send(Report({**self.status(), "ended": driver.lease, "why": why}))

    def _scene(self, who: str, address: str, pose: list[list[float]] | None, seed: int) -> None:
        """Put the scene of a simulated robot in place, for the person who drives."""
        session = self.session
        if session is None or session.is_real:
            raise RequestRefused("Only a simulated robot has a scene that can be set.")
        robot = session.robot
        signals = dict(robot.measure().signals)  # an arm begins where it is: it does not move
        signals.pop("object_pose", None)
        if pose is not None:
            signals["object_pose"] = np.array(pose)
        try:
            robot.reset(np.array([0]), Initial(signals, np.array([seed])))
        except _Interrupted:  # such as the end of the link of the person who drives
            robot.halt()
            raise RequestRefused("Another request ended the way to the start pose; the robot holds.") from None

    def _stream(self, who: str, address: str, on: bool) -> None:
        """Send the transitions to a learner from now on, or no longer."""
        self.transitions.wanted = on

    def _roll_back(self, who: str, address: str, why: str = "") -> dict[str, Any]:
        choice = self.succession.back(who, done_by("rolled back", who, why))
        if self.succession.choice is not None:  # who waits for its outcome hears that, not that it was replaced
            self.succession.choice.result = self.succession.choice.result or choice.why
        self._chosen = choice
        if not self._plays():
            self._activate()
        return {**self.status(), "digest": choice.version.digest}

    # ---- what is shown

    def ticked(self, record: EpisodeRecord, action: Any, pacer: Any) -> None:
        """Called by the deployment after every step."""
        self._ticks += 1
        self._report(_REPORT_PERIOD)

    def ended(self, record: EpisodeRecord) -> None:
        """Called by the deployment after every episode."""

    def _change(self, state: State, why: str, who: str = "the agent", where: str = "") -> None:
        """Go to `state`, if it is another one or for another reason, and write that down."""
        before = self.state
        if before is state and why == self.why:
            return
        if before is not state and state not in TRANSITIONS[before]:
            raise RuntimeError(f"no transition leads from {before.value} to {state.value}")
        self.state, self.why, self.since = state, why, time.time()
        if before is not state:
            self.note("state", f"{before.value} -> {state.value}: {why}", who, where, before)
        self._report()

    def note(self, what: str, text: str, who: str = "the agent", where: str = "", before: State | None = None) -> None:
        """Write to the log, the recording and the audit file; `before` is the state that the event has changed."""
        if what != "refused":  # which the front process has logged, with the address
            self._tell(text)
        if self.session is not None:
            self.session.event(f"{text} ({who}{f' at {where}' if where else ''})")
        after, digest = None if before is None else self.state, self.succession.active.digest
        self.audit.write(what, text, who=who, where=where, digest=digest, before=before, after=after)

    def status(self) -> dict[str, Any]:
        """The status for everybody who looks."""
        session = self.session
        journal = None if session is None else session.deployment.journal
        record = journal.records[-1] if journal is not None and journal.records else None
        return {
            "state": self.state.value,
            "why": self.why,
            "since": self.since,
            "active": self.succession.active.digest,
            "names": dict(self.succession.names),
            "trial": self.succession.progress,
            "stage": None if session is None else session.stage,
            "owner": None if self.driver is None else self.driver.who,
            "robot": self.options.robot.text if session is None else session.robot.info.text,
            "identity": self.options.robot.robot_name if session is None else session.identity,
            "simulated": None if session is None else not session.is_real,
            "env": self.succession.active.env,
            "period": None if session is None else session.robot.spec.period,
            "episode": 0 if journal is None else journal.begun,
            "steps": 0 if record is None else record.length,
            "ticks": self._ticks,
            "episodes": self._completed,
            "successes": self._successes,
            "recent": list(self._episodes),
            "late": self._late + (0 if session is None else session.deployment.times.late),
            "slow": self._slow + (0 if session is None else session.deployment.times.slow),
            "link_ms": round(self._link_ms, 3),
            "loop_ms": round(self._loop_ms, 3),
            "recording": None if session is None or session.recorder is None else str(session.recorder.path),
            "marks": [] if session is None else list(session.marks),
            "goals": [] if session is None else session.goals(),
            "unusual": None if journal is None else journal.unusual,
            "warnings": self._warnings(),
            "guards": {} if session is None else session.robot.report(),
            "agent": __version__,
        }

    def _warnings(self) -> list[str]:
        """What the operator should know: of the guards, the ticks, the recording and the audit file."""
        files = {"recording": self.session and self.session.recording_fault, "audit": self.audit.fault}
        found = {**self._motion_warnings(), **{title: fault for title, fault in files.items() if fault}}
        return [f"{title}: {text}" for title, text in found.items()]

    def _motion_warnings(self) -> dict[str, str]:
        """Those of the guards, and of late ticks, by title, as long as they hold."""
        if self.session is None:
            return {}
        warnings = dict(one.partition(": ")[::2] for one in self.session.deployment.warnings)
        late = self.session.deployment.times.warning
        return warnings if LATE in warnings or not late else {**warnings, "late ticks": late}

    def _report(self, least: float = 0.0) -> None:
        """Send the status, and transitions, unless the last ones are younger than `least` [s]."""
        now = time.monotonic()
        if now - self._reported >= least:
            self._reported = now
            self.send(Report(self.status()))
            for title, text in self._motion_warnings().items():  # recorder and audit file log theirs
                self._log_anew(title, f"warning: {title}: {text}")
            if self.transitions.wanted and (rows := self.transitions.take()) is not None:
                self.send(Rows(encode(rows)))

    def _log_anew(self, title: str, text: str) -> None:
        """Write `text` to the log, unless it is the last one of this `title`, or that came less than a minute ago."""
        now, (before, at) = time.monotonic(), self._logged.get(title, ("", -math.inf))
        if text != before and now - at >= _LOG_PERIOD:
            self._logged[title] = text, now
            self._tell(text)
