"""The resident with a stand-in for the robot: what requests and faults lead to, in the order in which they come."""

import queue
import threading
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from bam_envs.core.errors import LinkLost, NotReady, ProtocolError, SafetyStop, StaleState, StartNotReached
from bam_envs.core.location import LiveRobot
from bam_envs.core.timing import TickTimes
from bam_train.agent import resident
from bam_train.agent.agent_messages import Answer, Ask, Drive, Halt, Report
from bam_train.agent.agent_options import AgentOptions
from bam_train.agent.agent_states import State
from bam_train.agent.resident import Resident
from bam_train.agent.succession import Choice
from bam_train.agent.versions import CANDIDATE, Versions
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.journal import LATE as LATE_TICKS
from bam_train.deploy.journal import Journal
from bam_train.errors import ContractRefused

PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"
DEADLINE = 20.0
STOPPED = "following (G23): elbow does not follow its commands"


class Session:
    """A connected robot, whose episodes last until a request ends them, or until a test gives them a fault."""

    stage, is_real, is_up, marks, recorder, recording_fault, identity = "full", False, True, (), None, "", ""

    def __init__(self, agent, faults):
        self._agent, self._faults = agent, faults
        self.robot = SimpleNamespace(
            stopped=None,
            code=23,
            info=SimpleNamespace(text="a robot"),
            spec=SimpleNamespace(period=0.05),
            halt=lambda: None,
            report=dict,
            observe=lambda observer: setattr(self, "observer", observer),
            is_unproved=False,
            measure=lambda: SimpleNamespace(signals={}),
            reset=self._reset,
        )
        self.deployment = SimpleNamespace(
            journal=Journal(0),
            times=TickTimes(0.05),
            episode=self._episode,
            swap=lambda policy: None,
            trials=None,
            latency=0.0,
            warnings=(),
            sent=lambda tick, state: None,
            record_command=lambda: None,
        )

    def goals(self):
        return []

    def _episode(self, watcher, seed):
        record = self.deployment.journal.begin(seed)
        if self.deployment.trials is not None:
            self.deployment.trials.begin(seed)
        while not self._agent.between_ticks():
            if self._faults:
                self._fail(*self._faults.popleft())
        return record

    def _reset(self, env_ids, initial):
        """The scene that a program sets: a guard stops the robot meanwhile."""
        self._fail(
            SafetyStop("following", f"The robot was stopped by {STOPPED}. When it is safe, call resume()."), STOPPED
        )

    def _fail(self, error, stopped, ticks=()):
        for tick in ticks:
            self.deployment.times.add(*tick)
        self.robot.stopped = stopped
        raise error

    def record_again(self):
        return ""

    def event(self, text):
        pass

    def close(self):
        pass


class Bench:
    """A resident in a thread, asked as the front process asks it."""

    def __init__(self, folder, *, is_running=True, connect=None, **options):
        versions = Versions(folder / "versions")
        versions.first(PICK)
        self.faults, self.events, self.log, self._answers = deque(), [], [], queue.Queue()
        self._number, self._changed, self.reports, self._seen = 0, threading.Condition(), [{}], 0
        self.agent = Resident(
            AgentOptions(LiveRobot("ws://127.0.0.1:1"), folder, **options),
            versions,
            SimpleNamespace(write=self._write, fault=""),
            send=self._take,
            tell=self.log.append,
            admit=lambda env, lines: None,
            is_running=is_running,
            connect=connect or (lambda *arguments, **more: Session(self.agent, self.faults)),
        )
        self._thread = threading.Thread(target=self.agent.run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.agent.quit()
        self._thread.join(DEADLINE)
        assert not self._thread.is_alive()

    def _write(self, what, text, **fields):
        self.events.append((what, text, fields["who"], fields["before"], fields["after"]))

    def _take(self, message):
        if isinstance(message, Answer):
            self._answers.put(message)
        elif isinstance(message, Report):
            with self._changed:
                self.reports.append(message.status)
                self._changed.notify_all()

    def ask(self, op, who="anna", **arguments):
        """The answer to a request."""
        self._number, self._seen = self._number + 1, len(self.reports) - 1
        self.agent.take(Ask(self._number, op, arguments, who, "10.0.0.7"))
        return self._answers.get(timeout=DEADLINE)

    def fail(self, *fault):
        """Let the episode that runs end with a fault."""
        self._seen = len(self.reports) - 1
        self.faults.append(fault)

    @property
    def status(self):
        return self.reports[-1]

    def state(self, state):
        """The reason for a state, once the agent was in it after the last request or fault."""

        def reached():
            return next((one for one in self.reports[self._seen :] if one.get("state") == state.value), None)

        with self._changed:
            assert self._changed.wait_for(reached, DEADLINE), self.status
            return reached()["why"]

    def changes(self):
        """What was written down: the changes of state, with their reason and who caused them."""
        return [(after.value, text.split(": ", 1)[1], who) for _, text, who, _, after in self.events if after]


@pytest.fixture
def bench(tmp_path):
    return lambda **options: Bench(tmp_path, **options)


# Faults while the policy drives: whether the agent goes on by itself, or a person must look first


@pytest.mark.parametrize(
    ("error", "stopped", "state", "goes_on"),
    [
        (LinkLost("the link dropped"), None, State.WAITING, True),
        (NotReady("not ready"), None, State.WAITING, True),
        (StaleState("the state is old", 1.0, 0.1), None, State.WAITING, True),
        (StaleState("stopped by state age (G3)", 1.0, 0.1), "state age (G3)", State.STOPPED, False),
        (SafetyStop("tool speed", "stopped by tool speed (G10)"), "tool speed (G10)", State.STOPPED, False),
        (StartNotReached("something holds the arm", {}), None, State.PAUSED, False),
        (ProtocolError("a joint is missing"), None, State.PAUSED, False),
    ],
)
def test_a_fault_while_the_policy_drives(bench, error, stopped, state, goes_on):
    with bench() as running:
        running.state(State.RUNNING)
        running.fail(error, stopped)
        running.state(state)
        if goes_on:
            running.state(State.RUNNING)
        else:
            for _ in range(3):  # turns, at least
                assert running.ask("transitions", on=False).error == ""
    after = [one for one, *_ in running.changes()]
    assert after[:2] == [State.RUNNING.value, state.value]
    assert (State.RUNNING.value in after[2:]) is goes_on


def test_a_busy_robot_is_waited_for_also_at_the_start_and_a_wrong_one_is_refused(bench):
    busy = ContractRefused("age", "age: expected at most 0.1 s, found 0.197 s", passes=True)
    refusals = [busy, busy]

    def connect(*arguments, **more):
        if refusals:
            raise refusals.pop()
        return Session(running.agent, running.faults)

    running = bench(connect=connect)
    with running:
        running.state(State.RUNNING)
    assert {status.get("why") for status in running.reports} >= {"it starts", str(busy)}

    refusals.append(ContractRefused("topic", "topic /joint_states: expected sensor_msgs/JointState"))
    with pytest.raises(ContractRefused, match="topic"):
        bench(connect=connect).agent.run()


def test_a_pause_is_answered_while_the_robot_is_connected(bench):
    begun, goes_on = threading.Event(), threading.Event()

    def connect(*arguments, **more):
        begun.set()
        assert goes_on.wait(DEADLINE)
        return Session(running.agent, running.faults)

    running = bench(connect=connect)
    with running:
        assert begun.wait(DEADLINE)
        running.ask("pause", who="boris")
        running.ask("resume", who="boris")
        assert running.ask("pause").result["state"] == State.WAITING.value
        goes_on.set()
        assert running.state(State.PAUSED) == "paused by anna"
        running.ask("resume")
        running.state(State.RUNNING)
    assert [(what, text) for what, text, *_ in running.events if what in ("pause", "resume")] == [
        ("pause", "paused by boris"),
        ("resume", "resumed by boris"),
        ("pause", "paused by anna"),
    ]
    assert running.changes()[:2] == [
        (State.PAUSED.value, "paused by anna", "the agent"),
        (State.RUNNING.value, "resumed by anna", "anna"),
    ]


def test_a_stop_while_a_request_is_executed_is_a_state_and_is_written_down_once(bench):
    with bench() as running:
        running.state(State.RUNNING)
        running.ask("take", who="a program", lease="it")
        answer = running.ask("scene", who="a program", pose=None, seed=1)
        why = f"The robot was stopped by {STOPPED}. When it is safe, resume the agent."
        assert (answer.error, answer.kind) == (why, "SafetyStop")
        assert running.state(State.STOPPED) == why
        assert running.status["owner"] is None
        assert running.ask("take", who="a program", lease="it").kind == "NotInCommand"
    assert running.changes()[1:] == [
        (State.TAKEN_OVER.value, "taken over by a program", "a program"),
        (State.STOPPED.value, why, "the agent"),
    ]


def test_late_ticks_are_said_in_the_log_but_not_in_each_report(bench):
    def warned():
        return [line for line in running.log if line.startswith("warning: ")]

    with bench() as running:
        running.state(State.RUNNING)
        session = running.agent.session
        for tick in [IN_TIME] * 94 + [LATE] * 4 + [SLOW] * 2:
            session.deployment.times.add(*tick)
        session.deployment.warnings = ("link quality (G16): only 93 of the last 100 ticks",)
        running.ask("pause")
        late = "late ticks: 6 of the last 100 ticks missed their deadline, 2 of them because of the policy"
        late += ": end other programs"
        assert running.status["warnings"] == ["link quality (G16): only 93 of the last 100 ticks", late]
        assert warned() == [f"warning: {one}" for one in running.status["warnings"]]
        session.deployment.times.add(*LATE)
        running.ask("resume")
        running.ask("pause")
        assert running.status["warnings"][1] == late.replace("6 of the last", "7 of the last")
        assert len(warned()) == 2
        session.deployment.warnings = (f"{LATE_TICKS}: 7 of the last 100 commands were late",)  # says the same
        running.ask("resume")
        assert running.status["warnings"] == [*session.deployment.warnings]  # the link is good again


def test_what_the_front_process_logs_is_not_logged_twice(bench):
    with bench() as running:
        running.state(State.RUNNING)
        refusal = running.ask("use", version="ffff").error
        running.ask("transitions", on=False)  # in a later turn
        assert ("refused", refusal, "anna", None, None) in running.events
        assert refusal not in running.log


def test_why_the_robot_is_waited_for_is_in_the_log_once_in_each_outage(bench, monkeypatch):
    monkeypatch.setattr(resident, "_LOG_PERIOD", 0.0)
    monkeypatch.setattr(resident, "_RECONNECT_PERIOD", 0.01)
    tried, outcomes = threading.Event(), iter(["away", "away", "there", "away", "away"])

    def connect(*arguments, **more):
        if (outcome := next(outcomes, "done")) == "there":
            return Session(running.agent, deque([(LinkLost("the link dropped"), None)]))
        if outcome == "done":
            tried.set()
        raise LinkLost("nothing listens there")

    running = bench(connect=connect)
    with running:
        assert tried.wait(DEADLINE)
    assert running.log.count("waiting for the robot: nothing listens there") == 2


def test_a_request_that_comes_on_the_way_to_a_scene_ends_that_and_not_the_agent(bench):
    def connect(*arguments, **more):
        session = Session(running.agent, running.faults)

        def reset(env_ids, initial):
            running.agent.post(lambda: running.agent._cut("the front", "", "it", "was cut"))  # as of a killed program
            session.observer(SimpleNamespace(command=[0.0], age=0.0, approach=True), None)

        session.robot.reset = reset
        return session

    running = bench(connect=connect)
    with running:
        running.state(State.RUNNING)
        running.ask("take", who="a program", lease="it")
        answer = running.ask("scene", who="a program", pose=None, seed=1)
        assert answer.error == "Another request ended the way to the start pose; the robot holds."
        assert running.ask("resume").kind == "RequestRefused"  # it is alive
        assert running.status["why"] == "the link of a program was cut; the robot holds"


def test_a_pause_does_not_hide_a_stop(bench):
    with bench() as running:
        running.state(State.RUNNING)
        running.fail(STOP, STOPPED)
        why = running.state(State.STOPPED)
        running.ask("pause", why="the table is full")
        assert running.state(State.PAUSED) == f"paused by anna: the table is full; before that: {why}"
        running.ask("resume")
        running.state(State.RUNNING)
        running.ask("pause")
        assert running.state(State.PAUSED) == "paused by anna"
    resumed = [text for what, text, *_ in running.events if what == "resume"]
    assert resumed == [f"anna lets the robot move again after: {why}"]


# Whose fault it is


@pytest.fixture
def candidate(forge, tmp_path):
    """Lets another version act as a candidate."""

    def act(running, trials=None):
        path = tmp_path / "candidate.zip"
        path.write_bytes(PICK.read_bytes())
        version = running.agent.succession.versions.add(Checkpoint.open(forge(path, seed=7)))
        choice = Choice(version, None, {CANDIDATE: version.digest}, "pushed by anna", "anna", trials=trials)
        running.agent.choose(choice)
        assert choice.active.wait(DEADLINE)
        return choice

    return act


IN_TIME, LATE, SLOW = (0.0, 0, 0.0003, 0.00002), (0.06, 1, 0.0003, 0.00002), (0.03, 1, 0.075, 0.02)
STOP = SafetyStop("following", f"The robot was stopped by {STOPPED}.")


@pytest.mark.parametrize(
    ("stop", "is_back"),
    [
        ((STOP, STOPPED, [IN_TIME] * 20), True),
        ((STOP, STOPPED, [LATE] * 20), False),
        ((STOP, STOPPED, [*[SLOW] * 15, *[LATE] * 5]), True),
        ((LinkLost("gone"), None, [IN_TIME] * 20), False),
    ],
    ids=["calm", "busy", "slow", "link"],
)
def test_a_candidate_is_rolled_back_for_its_own_stops_only(bench, candidate, stop, is_back):
    with bench() as running:
        running.state(State.RUNNING)
        choice = candidate(running)
        for _ in range(2):
            running.state(State.TRIAL)
            running.fail(*stop)
            if stop[1]:
                running.state(State.STOPPED)
                running.ask("resume")
            else:
                running.state(State.WAITING)
        running.state(State.RUNNING if is_back else State.TRIAL)
        if is_back:  # told once the champion acts
            assert choice.outcome.wait(DEADLINE)
            assert running.agent.state is State.RUNNING
            assert running.ask("rollback").error.startswith("There is no version to roll back to")
        assert choice.outcome.is_set() is is_back
        if not is_back:  # who waits for the trials hears that a person rolled back
            running.ask("pause")
            running.ask("rollback", why="it drops the cube")
            assert choice.outcome.wait(DEADLINE)
            assert choice.result == "rolled back by anna: it drops the cube"
    excused = [text for what, text, *_ in running.events if what == "trial"]
    assert len(excused) == (0 if is_back else 2)


class BookedTrials:
    """The trials of a candidate, as they are written down."""

    threshold, evidence = 0.9, SimpleNamespace(is_enough=True, trials=1, text="1 of 1")

    def __init__(self):
        self.rows, self._runs, self.began = [], False, threading.Event()

    def next_seed(self, first):
        return first

    def begin(self, seed):
        self.rows.append("begun")
        self._runs = True
        self.began.set()

    def end(self, success, reason, *, void=False):
        if self._runs:
            self.rows.append((success, reason, void))
        self._runs = False


def test_after_a_promotion_the_state_says_why(bench, candidate):
    def connect(*arguments, **more):
        session = Session(running.agent, running.faults)

        def episode(watcher, seed):
            record = session.deployment.journal.begin(seed)
            while not (session.deployment.trials or running.agent.between_ticks()):
                pass  # until the candidate is pushed
            return replace(record, success=True, end="terminated") if session.deployment.trials else record

        session.deployment.episode = episode
        return session

    running = bench(connect=connect)
    with running:
        running.state(State.RUNNING)
        assert candidate(running, BookedTrials()).outcome.wait(DEADLINE)
    assert running.changes()[1:] == [
        (State.TRIAL.value, "pushed by anna", "anna"),
        (State.RUNNING.value, "promoted: 1 of 1", "the agent"),
    ]


@pytest.mark.parametrize("at", ["on the way to its start", "in mid-episode"])
def test_an_episode_of_another_version_is_no_trial_of_a_candidate(bench, candidate, at):
    """A roll-back that comes on the way to the start pose, or in mid-episode: the champion plays what remains."""
    trials, played = BookedTrials(), []

    def connect(*arguments, **more):
        session = Session(running.agent, running.faults)

        def episode(watcher, seed):
            deployment, agent = session.deployment, running.agent
            record, is_trial = deployment.journal.begin(seed), deployment.trials is trials
            if is_trial and at == "in mid-episode":
                deployment.trials.begin(seed)
            if is_trial:
                agent.choose(agent.succession.back("anna", "rolled back"))
                if at == "in mid-episode":
                    agent.between_ticks()
                else:
                    agent.post(lambda: None)
                    session.observer(SimpleNamespace(command=[0.0], age=0.0, approach=True), None)
            if deployment.trials is not None and at != "in mid-episode":
                deployment.trials.begin(seed)
            while not (is_trial or played or agent.between_ticks() or deployment.trials is not None):
                pass  # until the candidate is pushed
            if deployment.trials is not None:
                deployment.trials.end(True, "terminated")
            played.extend([True] * is_trial)
            return record

        session.deployment.episode = episode
        return session

    running = bench(connect=connect)
    with running:
        running.state(State.RUNNING)
        choice = candidate(running, trials)
        assert choice.outcome.wait(DEADLINE)
        running.state(State.RUNNING)
    assert played
    ended = [(False, "another version acts: rolled back", True)] if at == "in mid-episode" else []
    assert trials.rows == (["begun", *ended] if at == "in mid-episode" else ended)


@pytest.mark.parametrize(
    ("ask", "why"),
    [
        (("pause", {"why": "look"}), "paused by anna: look"),
        (("take", {"lease": "1"}), "taken over by anna"),
        (Halt("anna", stop=True), "paused by anna: the stop button"),
        ("quit", "the agent was ended"),
    ],
    ids=["pause", "take over", "stop", "quit"],
)
def test_an_episode_that_a_person_ends_is_no_trial_of_the_candidate(bench, candidate, ask, why):
    trials, running = BookedTrials(), bench(is_running=False)
    with running:
        running.state(State.PAUSED)
        candidate(running, trials)
        running.ask("resume")
        assert trials.began.wait(DEADLINE)
        if isinstance(ask, Halt):
            running.agent.take(ask)
        elif ask != "quit":
            running.ask(ask[0], **ask[1])
            running.ask("transitions", on=False)  # in a later turn: the episode has ended
    assert trials.rows == ["begun", (False, why, True)]
    (text,) = (text for what, text, *_ in running.events if what == "trial")
    assert text.endswith(f": {why}")
    assert running.agent.status()["trial"]["done"] == 1


def test_what_a_person_drives_into_is_not_the_candidates_fault(bench, candidate):
    with bench() as running:
        running.state(State.RUNNING)
        choice = candidate(running)
        for lease in ("1", "2"):
            running.ask("take", lease=lease)
            running.ask("scene", pose=None, seed=1)
            running.state(State.STOPPED)
            running.ask("resume")
            running.state(State.TRIAL)
        assert not choice.outcome.is_set()


# The first command of somebody who has taken over


@pytest.mark.parametrize("interrupted", [False, True])
def test_the_first_motion_of_a_driver_proves_the_commands(bench, interrupted):
    """And a request ends it at once."""
    did, moves = [], threading.Event()

    def connect(*arguments, **more):
        session = Session(running.agent, running.faults)

        def prove():
            tick = SimpleNamespace(command=[0.0], age=0.0, approach=True)
            session.observer(tick, None)
            moves.set()
            while interrupted:
                session.observer(tick, None)
            did.append("proved")
            session.robot.is_unproved = False

        def step(command):
            did.append(command.tolist())
            moves.set()

        session.robot.is_unproved, session.robot.prove, session.robot.step = True, prove, step
        session.robot.halt = lambda: did.append("halted")
        return session

    running = bench(connect=connect)
    with running:
        running.state(State.RUNNING)
        running.ask("take", who="first", lease="1")
        did.clear()
        running.agent.take(Drive([0.1], "1"))
        assert moves.wait(DEADLINE)
        if interrupted:
            running.ask("pause", who="anna", why="look")
            assert running.state(State.PAUSED) == "paused by anna: look"
            assert set(did) == {"halted"}
            return
        moves.clear()
        running.agent.take(Drive([0.2], "1"))
        assert moves.wait(DEADLINE)
        assert did[0] == "proved"
        assert [one for one in did if isinstance(one, list)] == [[[0.2]]]


# A pause is lifted by a person only


@pytest.mark.parametrize("resume", [False, True])
def test_what_a_take_over_goes_back_to_and_that_a_program_does_not_lift_the_pause_of_a_person(bench, resume):
    with bench(resume=resume) as running:
        running.state(State.RUNNING)
        running.ask("take", who="first", lease="1")
        running.ask("take", who="second", lease="2", force=True)
        running.ask("hand_back", who="second", lease="2")
        assert running.state(State.RUNNING if resume else State.PAUSED) == "handed back by second"
        running.ask("pause", who="anna", why="hand in the cell")
        for lease in ("1", "2"):
            running.ask("take", who="a program", lease=lease)
            running.ask("hand_back", who="a program", lease=lease)
            assert running.state(State.PAUSED) == "handed back by a program; paused by anna: hand in the cell"
        running.ask("take", who="bob", lease="3")
        running.ask("hand_back", who="bob", lease="3", resume=True)  # by the button of the console
        assert running.state(State.RUNNING) == "handed back by bob"


@pytest.mark.parametrize("why", ["it starts", "the lease ended", "the stop button", "a fault"])
def test_a_program_lifts_no_other_pause_either(bench, why):
    with bench(resume=True, is_running=why != "it starts") as running:
        running.state(State.PAUSED if why == "it starts" else State.RUNNING)
        if why == "the lease ended":
            running.ask("take", who="first", lease="1")
            running.ask("hand_back", who="the agent", lease="1", why="the lease of first ended")
        elif why == "the stop button":
            running.agent.take(Halt("anna", stop=True))
        elif why == "a fault":
            running.fail(ProtocolError("a joint is missing"), None)
            running.state(State.WAITING)  # until the robot is connected anew
        running.state(State.PAUSED)
        running.ask("take", who="a program", lease="2")
        running.ask("hand_back", who="a program", lease="2")
        assert running.state(State.PAUSED).startswith("handed back by a program")


def test_a_pause_while_the_robot_is_away_holds_and_is_written_down(bench):
    away = threading.Event()

    def connect(*arguments, **more):
        if away.is_set():
            raise LinkLost("gone")
        return Session(running.agent, running.faults)

    running = bench(connect=connect)
    with running:
        running.state(State.RUNNING)
        away.set()
        running.fail(LinkLost("gone"), None)
        running.state(State.WAITING)
        running.ask("pause", why="hand in the cell")
        away.clear()
        assert running.state(State.PAUSED) == "paused by anna: hand in the cell"
        away.set()
        running.ask("resume")
        running.state(State.RUNNING)
    noted = [(what, text) for what, text, who, _, _ in running.events if who == "anna"]
    assert noted == [("pause", "paused by anna: hand in the cell"), ("state", "paused -> running: resumed by anna")]
