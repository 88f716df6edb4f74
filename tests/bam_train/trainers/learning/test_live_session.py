"""The learner at an agent whose sockets are real, and whose robot is the test."""

import contextlib
import os
import threading
import time

import pytest

from bam_envs.rosbridge.server import BridgeServer, Site
from bam_envs.rosbridge.tokens import Tokens
from bam_train.agent.front.agent_socket import AgentSocket
from bam_train.agent.remote.agent_protocol import PATH, encode_message
from bam_train.agent.transitions import encode
from bam_train.checkpoint import Checkpoint
from bam_train.errors import RequestRefused, SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.trainers.learning.live_session import learn, live_settings

from .conftest import ENV, play

DEADLINE = 60.0
SMALL = {"critic_width": 16, "actor_width": 16, "history": 2, "batch_size": 16, "update_ratio": 1.0, "actor_after": 12}


class Hub:
    """Sends transitions to whoever learns, and keeps what is pushed."""

    def __init__(self, folder):
        self.incoming, self.pushed, self.listeners, self.state = folder / "incoming", [], [], "running"

    def ask(self, op, arguments, person, progress):
        if op == "push":
            kept = arguments["path"].rename(arguments["path"].with_name(f"kept-{len(self.pushed)}.zip"))
            FrozenPolicy.load(kept)
            digest = Checkpoint.open(kept).digest
            self.pushed.append((digest, arguments["stage"], arguments["when"]))
            return {"digest": digest, "active": digest, "lines": []}
        return {"state": self.state, "why": "a guard", "robot": "a line", "simulated": True}

    def listen(self, kind, listener):
        self.listeners.append(listener)
        return lambda: self.listeners.remove(listener)

    def left(self, person):
        pass


@pytest.fixture
def hub(tmp_path):
    return Hub(tmp_path)


@contextlib.contextmanager
def agent(hub, port=0):
    socket = AgentSocket(hub)
    try:
        with BridgeServer(
            port=port, tokens=Tokens({"secret": "administer"}), site=Site({}, {PATH: socket.serve})
        ) as server:
            yield server
    finally:
        socket.close()


class Learning(threading.Thread):
    """A learner in a thread of its own."""

    def __init__(self, url, folder, checkpoint=None, **given):
        super().__init__(daemon=True)
        self.url, self.folder, self.checkpoint = url, folder, checkpoint
        folder.mkdir(exist_ok=True)
        (folder / "token").touch(0o600)
        (folder / "token").write_text("secret\n")
        given["token_file"] = str(folder / "token")
        self.given = {"env": ENV, "hyperparameters": SMALL, **given} if checkpoint is None else given
        self.lines, self.stop, self.done, self.error = [], threading.Event(), None, None
        self.start()

    def run(self):
        places = {"out": self.folder / "out.zip", "runs": self.folder / "runs", "force": True}
        try:
            self.done = learn(
                *(self.url, self.given, self.checkpoint),
                **places,
                push_every=5,
                tell=self.lines.append,
                stopped=self.stop.is_set,
            )
        except Exception as error:
            self.error = error

    def end(self):
        self.stop.set()
        self.join(DEADLINE)
        assert not self.is_alive()
        return self.done


def until(condition):
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def tell(hub, transitions):
    until(lambda: hub.listeners)
    for listener in tuple(hub.listeners):
        listener(encode_message(encode(transitions)))


@pytest.fixture(autouse=True)
def niceness(monkeypatch):
    """By how much the learners gave way."""
    given = []
    monkeypatch.setattr("bam_train.trainers.learning.live_session.os.nice", given.append)
    return given


def test_transitions_become_candidates_and_a_result(hub, tmp_path, niceness):
    with agent(hub) as server:
        learner = Learning(server.url, tmp_path, steps=80)
        tell(hub, play(5, person=True))
        tell(hub, play(5, first=5))
        until(lambda: hub.pushed)
        tell(hub, play(10, first=10))
        learner.join(DEADLINE)
    assert (learner.error, learner.done) == (None, True)
    result = Checkpoint.open(tmp_path / "out.zip")
    assert hub.pushed[-1] == (result.digest, "auto", "episode")
    assert (result.manifest.steps, result.manifest.algorithm) == (80, "rlpd")
    text = f"the policy after 80 steps is in {tmp_path / 'out.zip'} ({result.digest[:12]}); it acts on the robot now"
    assert learner.lines[-1] == text
    cores = f"the agent runs on this computer too, and its ticks go first on the {os.cpu_count()} cores"
    assert (learner.lines[0], niceness) == (cores, [10])
    assert learner.lines[2] == f"learns from {server.url}: running, a line"


def test_a_learner_that_was_killed_goes_on_from_its_last_state(hub, tmp_path):
    with agent(hub) as server:
        first = Learning(server.url, tmp_path)
        tell(hub, play(3, person=True))
        until(lambda: (tmp_path / "runs").exists())
        time.sleep(0.5)
        assert first.end() is False
        last = Checkpoint.open(tmp_path / "runs" / "LiveLine-v0-rlpd" / "last.zip")
        assert last.manifest.steps == 12
        until(lambda: not hub.listeners)
        second = Learning(server.url, tmp_path, last, steps=40)
        tell(hub, play(7, first=3))
        second.join(DEADLINE)
    assert (second.error, second.done) == (None, True)
    assert Checkpoint.open(tmp_path / "out.zip").manifest.steps == 40


def test_the_agent_may_go_and_come_back(hub, tmp_path):
    with agent(hub) as server:
        learner = Learning(server.url, tmp_path)
        tell(hub, play(3))
        until(lambda: any("learns from" in line for line in learner.lines))
        url, port = server.url, server.port
    until(lambda: any("The robot goes on; this learner waits for it." in line for line in learner.lines))
    with agent(hub, port) as server:
        assert server.url == url
        tell(hub, play(2, first=3))
        time.sleep(0.5)
        assert learner.end() is False
    assert Checkpoint.open(tmp_path / "runs" / "LiveLine-v0-rlpd" / "last.zip").manifest.steps == 20


def test_it_says_why_no_steps_come(hub, tmp_path, monkeypatch):
    monkeypatch.setattr("bam_train.trainers.learning.live_session.TELL_EVERY", 0.05)
    with agent(hub) as server:
        learner = Learning(server.url, tmp_path)
        tell(hub, play(3))
        until(lambda: any(line.startswith("12 steps") for line in learner.lines))
        for state in ("stopped by a guard", "waiting for the robot"):
            hub.state = state
            remedy = f"; look at the robot, then: bam-agent resume {server.url}" if "stopped" in state else ""
            text = f"no steps come: the agent is {state} (a guard){remedy}"
            until(lambda text=text: text in learner.lines)
        tell(hub, play(1, first=3))
        until(lambda: any(line.startswith("16 steps") for line in learner.lines))
        learner.end()
    still = [line for line in learner.lines if "stopped by a guard" in line]
    assert len(still) == 1  # said once


def test_the_second_learner_is_refused(hub, tmp_path):
    with agent(hub) as server:
        first = Learning(server.url, tmp_path)
        until(lambda: hub.listeners)
        second = Learning(server.url, tmp_path / "second")
        second.join(DEADLINE)
        assert isinstance(second.error, RequestRefused)
        assert str(second.error).endswith("learns from this robot already, and there is one learner at a time.")
        assert second.error.exit_status == 3
        assert first.end() is False


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "env: expected a name, found nothing. Give --env NAME, that of the agent's checkpoint"),
        ({"env": ENV, "algo": "ppo"}, "--learner: the algorithm of a learner is rlpd; leave --algo and --trainer out"),
        (
            {"env": ENV, "transport": ["tcp://a:1"]},
            "--learner and --transport exclude each other: it learns from the agent's robot; give one",
        ),
    ],
)
def test_settings_that_do_not_fit_are_refused(given, message):
    with pytest.raises(SettingsError) as error:
        live_settings(given, None)
    assert str(error.value) == message
