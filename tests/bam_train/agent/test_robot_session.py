"""The agent's connection to a robot, with a served simulation at the other end: its recordings."""

import itertools
import resource
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from bam_envs.core.location import LiveRobot
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_train.agent import robot_session
from bam_train.agent.agent_options import AgentOptions
from bam_train.agent.robot_session import RobotSession
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.deployment import StopSwitch
from bam_train.environments import make_env
from bam_train.recording.recording import Recording

REACH = Path(__file__).parents[3] / "checkpoints" / "reach-ppo.zip"


@pytest.fixture
def session(tmp_path, monkeypatch):
    """Makes the session of a robot whose time passes with commands only."""
    monkeypatch.setattr(robot_session, "RECORD_AGAIN", 0.0)
    made, ticks = [], itertools.count()
    with ServedEnvironment(make_env("bam/reach-v0"), ServeOptions(port=0, fast=True)) as served:

        def make(**options):
            made.append(
                RobotSession(
                    AgentOptions(LiveRobot(served.bus.url), tmp_path, **options),
                    Checkpoint.open(REACH),
                    None,
                    between_ticks=lambda: next(ticks) % 6 == 5,  # an episode ends after some ticks
                    observers=(),
                    switch=StopSwitch(lambda: None),
                    admit=lambda env, lines: None,
                    sleep=lambda seconds: True,
                )
            )
            return made[-1]

        yield make
        for one in made:
            one.close()


def play(session):
    watcher = SimpleNamespace(ticked=lambda *tick: None, ended=lambda record: None)
    session.deployment.episode(watcher, seed=1)


def again(session, until):
    """The name of the recording that goes on, once there is one."""
    names = []
    until(lambda: names.append(session.record_again()) or names[-1])
    return names[-1]


def test_after_a_full_disk_the_next_episode_is_recorded_once_there_is_room(session, until, monkeypatch):
    session = session()
    assert session.record_again() == ""
    first = session.recorder
    resource.prlimit(first.pid, resource.RLIMIT_FSIZE, (1, 1))
    until(lambda: play(session) or session.recording_fault)
    assert (
        session.recording_fault == f"{first.path}: cannot be written: File too large; nothing is recorded from now on"
    )
    with monkeypatch.context() as full:
        full.setattr(robot_session.shutil, "disk_usage", lambda folder: SimpleNamespace(free=robot_session.ROOM - 1))
        assert session.record_again() == ""
        assert "bam-recorder-start" not in {thread.name for thread in threading.enumerate()}
    assert again(session, until) == str(session.recorder.path) != str(first.path)
    assert session.recording_fault == ""
    play(session)
    session.recorder.close()
    assert len(Recording.open(session.recorder.path).arrays("action")[""]) == 6


def test_the_goal_of_the_episode_is_told_once_there_is_one(session):
    session = session(no_record=True)
    assert session.goals() == []
    play(session)
    assert session.goals() == [session.task.goal[0].tolist()]


def test_where_no_recording_can_begin_one_does_once_there_is_room(session, tmp_path, until, caplog, monkeypatch):
    """It is said once, although each attempt is for a file of another name."""
    names = (Path(f"recordings/{number}-reach.mcap") for number in range(10**6))
    monkeypatch.setattr(robot_session, "recording_names", lambda env_id: [next(names)])
    (tmp_path / "recordings").write_text("no folder")
    session = session()
    until(lambda: session.record_again() or session.recording_fault)
    before = session.recording_fault
    until(lambda: session.record_again() or session.recording_fault != before)
    play(session)
    assert "cannot be written" in session.recording_fault
    (tmp_path / "recordings").unlink()
    again(session, until)
    assert session.recording_fault == ""
    assert [one.getMessage() for one in caplog.records if "Nothing is recorded" in one.getMessage()] == [
        caplog.records[0].getMessage()
    ]


def test_without_recordings_none_begins(session):
    session = session(no_record=True)
    play(session)
    assert (session.recorder, session.recording_fault, session.record_again()) == (None, "", "")
