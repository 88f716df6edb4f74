"""Which version acts: candidates that come, are promoted, rolled back, or refused while the old one acts on."""

import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from bam_envs.core.location import LiveRobot
from bam_train.agent.agent_messages import Ask, RequestProgress
from bam_train.agent.agent_options import AgentOptions
from bam_train.agent.agent_states import State
from bam_train.agent.succession import Succession
from bam_train.agent.versions import Versions
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.journal import EpisodeRecord
from bam_train.environments import interface_of, make_env
from bam_train.errors import RequestRefused

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"
PICK, REACH = CHECKPOINTS / "pick-ppo.zip", CHECKPOINTS / "reach-ppo.zip"


class Agent:
    """A resident without a robot: what was chosen acts at once."""

    def __init__(self, folder, given=PICK):
        self.options = AgentOptions(LiveRobot("ws://127.0.0.1:9090"), folder)
        versions = Versions(folder / "versions")
        env = versions.first(given).env
        interface = interface_of(make_env(env))
        self.session = SimpleNamespace(env_id=env, env_kwargs={}, interface=interface, is_real=False, identity="")
        self.session.says_success = True
        self.succession, self.sent, self.notes = Succession(self, versions), [], []
        self.answered, self.state, self.why, self.since = threading.Event(), State.TRIAL, "", 0.0
        self.on_progress = lambda text: None

    def send(self, message):
        self.sent.append(message)
        if isinstance(message, RequestProgress):
            self.on_progress(message.text)
        if hasattr(message, "kind"):
            self.answered.set()

    def post(self, do, number=0):
        do()

    def note(self, what, text, who="the agent", where=""):
        self.notes.append((what, text))

    def choose(self, choice):
        replaced = self.succession.activate(choice)
        choice.active.set()
        if replaced is not None:
            replaced.close("replaced: another version acts")

    def promoted(self, why):
        pass

    def status(self):
        return {"stage": "full", "state": "running", "names": self.succession.names, "active": "", "owner": None}

    def ask(self, op, **arguments):
        self.answered.clear()
        self.succession.begin(Ask(1, op, arguments, "anna", "10.0.0.7"))
        assert self.answered.wait(60)
        return self.sent[-1]


@pytest.fixture
def agent(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return Agent(tmp_path)


@pytest.fixture
def better(tmp_path, forge):
    """A file with the policy of another training."""
    path = tmp_path / "better.zip"
    path.write_bytes(PICK.read_bytes())
    return forge(path, seed=7)


def test_a_pushed_candidate_acts_and_is_promoted_by_its_trials(agent, better):
    old, new = agent.succession.active.digest, Checkpoint.open(better).digest
    answer = agent.ask("push", path=str(better), file="better.zip", why="it is faster")
    assert agent.succession.choice.why == "pushed by anna: it is faster"
    assert (answer.error, answer.result["digest"]) == ("", new)
    assert answer.result["lines"][1] == "fits bam/pick-v0: spaces, 50 signals, period 0.05 s"
    assert not better.exists()
    assert agent.succession.active.digest == new
    assert agent.succession.names == {"champion": old, "given": old, "candidate": new}
    assert agent.succession.rolls_back_to == old  # in its first trial, before which there was none
    trials = agent.succession.trials()
    assert (agent.succession.progress["done"], agent.succession.progress["needed"]) == (0, 33)
    for seed in range(33):
        trials.begin(seed)
        trials.end(True, "terminated")
        agent.succession.ended(EpisodeRecord(seed, success=True, end="terminated"))
        if seed == 4:
            assert agent.succession.progress == {
                "done": 5,
                "needed": 33,
                "text": "5 of 5 trials succeeded; 28 more without a failure would show more than 90 %",
            }
    assert (agent.succession.progress, agent.succession.rolls_back_to) == (None, old)
    assert agent.succession.names == {"champion": new, "given": old, "previous": old}
    text = "33 of 33 trials succeeded, which shows more than 90 % (error probability at most 5 %)"
    assert agent.notes[-1] == ("promoted", f"{new[:12]} is the champion: {text}")


def test_nobody_waits_for_trials_that_decide_nothing(agent, better):
    agent.session.says_success = False
    active = agent.succession.active
    assert agent.ask("push", path=str(better), wait=True).error == (
        "bam/pick-v0 reports no success, so that no trial here decides: do the trials with bam-deploy --stage trial, "
        "then push with --stage full"
    )
    assert agent.succession.active is active


SLOW = {"success": True, "length": 300, "end": "terminated", "slow": 57}


@pytest.mark.parametrize(
    ("episodes", "why"),
    [
        (
            [{"success": False, "end": "truncated"}] * 3,
            "0 of 3 episodes succeeded, which shows less than 90 % (error probability at most 5 %)",
        ),
        ([SLOW], "its actions took so long that 57 of 300 ticks were late, and at most 5 % may be"),
    ],
)
def test_a_candidate_that_fails_or_is_too_slow_for_this_computer_is_rolled_back(agent, better, episodes, why):
    old = agent.succession.active.digest
    agent.ask("push", path=str(better))
    choice = agent.succession.choice
    for seed, episode in enumerate(episodes):
        agent.succession.ended(EpisodeRecord(seed, **episode))
    assert agent.succession.active.digest == old
    assert agent.succession.names == {"champion": old, "given": old}
    assert choice.result == f"rolled back: {why}"


@pytest.mark.parametrize("first", [State.TRIAL, State.PAUSED])
def test_who_waits_for_the_trials_is_told_why_they_rest(agent, better, until, first):
    def tell(state, why, text):
        agent.state, agent.why = state, why
        until(lambda: agent.sent[-1] == RequestProgress(1, text))

    since, once = time.strftime("since %H:%M:%S", time.localtime(0.0)), "once somebody resumes the agent: "
    resume, agent.state, agent.why = f"The trials go on {once}bam-agent resume URL", first, "paused by bob: lunch"
    agent.succession.begin(Ask(1, "push", {"path": str(better), "wait": True}, "anna", "10.0.0.7"))
    if first is State.PAUSED:  # the trials have not begun
        paused = f"the agent is paused {since}: paused by bob: lunch. Its trials begin {once}bam-agent resume URL"
        until(lambda: agent.sent[-1] == RequestProgress(1, f"is the candidate; {paused}"))
        tell(State.TRIAL, "resumed by bob", "the trials begin")
    else:
        tell(State.TRIAL, "pushed by anna", "acts as the candidate; its trials decide")
    why = "The robot was stopped by following (G23): the elbow is away. When it is safe, resume the agent."
    tell(State.STOPPED, why, f"the agent is stopped by a guard {since}: {why} {resume}")
    tell(State.TRIAL, "resumed by bob", "the trials go on")
    tell(State.PAUSED, "paused by bob", f"the agent is paused {since}: paused by bob. {resume}")
    text = f"the agent is waiting for the robot {since}: no state came. The trials go on once the robot is there again"
    tell(State.WAITING, "no state came.", text)
    rest = "The trials go on once the robot is handed back and the agent runs"
    tell(State.TAKEN_OVER, "taken over by bob", f"the agent is taken over {since}: taken over by bob. {rest}")
    agent.state = State.TRIAL
    agent.succession.choice.close("promoted: 33 of 33")
    assert agent.answered.wait(60)
    assert agent.sent[-1].result["outcome"] == "promoted: 33 of 33"


def test_an_episode_that_the_computer_cut_short_does_not_count(agent, better):
    old, new = agent.succession.active.digest, Checkpoint.open(better).digest
    agent.ask("push", path=str(better))
    trials = agent.succession.trials()
    for seed in range(4):
        trials.begin(seed)
        agent.succession.cut_short(EpisodeRecord(seed, length=50), "following (G23)", "the computer is busy")
    assert agent.succession.active.digest == new
    assert (trials.evidence.trials, trials.evidence.successes) == (0, 0)
    text = f"the episode that was cut short does not count against {new[:12]}: the computer is busy"
    assert agent.notes == [("trial", text)] * 4
    for seed in (9, 10):
        trials.begin(seed)
        agent.succession.cut_short(EpisodeRecord(seed, length=50), "following (G23)")
    assert agent.succession.active.digest == old
    assert trials.evidence.trials == 2


def test_a_refused_candidate_changes_nothing(agent, better):
    before = dict(agent.succession.names)
    better.write_bytes(better.read_bytes()[:-100])
    answer = agent.ask("push", path=str(better), file="better.zip")
    why = "not a whole zip file: truncated, altered or something else. Copy it again from its source, or train again"
    assert (answer.kind, answer.error) == ("CandidateRefused", f"better.zip: {why}")
    assert agent.notes == [("refused", f"better.zip: {why}")]
    assert not better.exists()
    assert agent.succession.names == before


def test_a_push_waits_a_little_for_a_robot_that_is_away(agent, better, monkeypatch):
    path, session, agent.session, agent.why = better.read_bytes(), agent.session, None, "no state came."

    def come_back(text):
        if text == "waits at most 20 s for the robot: no state came":
            agent.session = session

    agent.on_progress = come_back
    assert agent.ask("push", path=str(better)).error == ""
    assert agent.succession.is_candidate
    better.write_bytes(path)
    agent.session, agent.on_progress = None, lambda text: None
    monkeypatch.setattr("bam_train.agent.succession.ROBOT_TIMEOUT", 0.0)
    answer = agent.ask("push", path=str(better))
    why = "the agent has waited 0 s for the robot, and checks no candidate without it; push it later: no state came"
    assert (answer.kind, answer.error) == ("RequestRefused", why)


def test_a_real_robot_that_is_lost_during_a_check_stays_a_real_one(agent, better):
    """Its candidate acts as a trial when it is there again, and at full speed only with enough trials."""
    real = SimpleNamespace(**{**vars(agent.session), "is_real": True, "identity": "serial number 7"})
    agent.options = replace(agent.options, allow_unsigned=True)

    def lose(text):
        agent.session = None

    content, agent.on_progress = better.read_bytes(), lose
    for stage, kind in (("full", "TrialsNeeded"), ("auto", "")):
        better.write_bytes(content)
        agent.session = real
        assert agent.ask("push", path=str(better), stage=stage).kind == kind
    assert agent.succession.choice.stage == "trial"
    agent.succession.trials().begin(3)
    assert "serial number 7" in (agent.options.folder / "trials.jsonl").read_text()


def test_a_version_of_another_environment_does_not_act(tmp_path, agent):
    """The agent ran it once, in the same folder."""
    pick, reach = agent.succession.active.digest, Checkpoint.open(REACH).digest
    other = Agent(tmp_path, REACH)
    assert other.succession.names == {"champion": reach, "given": reach, "previous": pick}
    answer = other.ask("use", version="previous")
    why = "was trained on bam/pick-v0, and the agent runs bam/reach-v0. Push a checkpoint for that"
    assert (answer.kind, answer.error) == ("CandidateRefused", f"{pick[:12]}: {why}")
    with pytest.raises(RequestRefused) as caught:
        other.succession.back("anna", "it is slow")
    why = f"{pick[:12]} was trained on bam/pick-v0, and the agent runs bam/reach-v0"
    assert str(caught.value) == f"There is no version to roll back to: {why}."
    assert other.succession.active.digest == reach
