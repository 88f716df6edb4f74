"""Nobody but who drives moves the robot: attackers who hear every topic, against the whole server."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from bam_envs.core.errors import RemoteError
from bam_envs.robots.profile import load_profile
from bam_envs.ros.freshness import Tagger, read_echo, read_tag
from bam_envs.ros.messages import tag_text
from bam_envs.rosbridge.client import RosbridgeLink
from tests.bam_envs.making import encode_command

UR5E = load_profile("ur5e")
ACTION = np.array([0.3, -0.4, 0.4, 0.1, -0.2], np.float32)


class Watcher:
    """Somebody else's client: hears the states and every command, and what it is refused."""

    def __init__(self, url):
        self.link, self.heard, self.refusals = RosbridgeLink(url), [], []
        self.states, self.news = [], threading.Condition()
        self.link.on_status(lambda status: self._note(self.refusals, status["msg"]))
        self.link.connect()
        for topic, kind in {(sink.topic, sink.type) for sink in UR5E.sinks()}:
            self.link.advertise(topic, kind)
            self.link.subscribe(topic, kind, lambda message, _, topic=topic: self._note(self.heard, (topic, message)))
        self.link.subscribe(
            "/joint_states", "sensor_msgs/JointState", lambda message, _: self._note(self.states, message)
        )
        self.link.call("/rosapi/get_time", "rosapi/GetTime", {}, 10.0)  # by now it is subscribed

    def _note(self, where, what):
        with self.news:
            where.append(what)
            self.news.notify_all()

    def wait_for(self, condition):
        with self.news:
            assert self.news.wait_for(condition, 10.0)


@pytest.fixture
def watcher():
    watchers = []

    def start(url):
        watchers.append(Watcher(url))
        return watchers[-1]

    yield start
    for one in watchers:
        one.link.close()


@pytest.mark.parametrize("pace", ["fast", "realtime"])
def test_a_watcher_takes_no_robot_over_from_a_running_policy(serve_env, watcher, make, pace):
    url = serve_env(**{pace: True}).bus.url
    live = make("bam/pick-v0", robot=url, guards={"lag": 0.5, "max_pause": 5.0})  # on a busy computer, too
    live.reset(seed=1)
    live.step(ACTION)
    thief = watcher(url)
    live.step(ACTION)
    thief.wait_for(lambda: thief.heard and thief.states and read_echo(thief.states[-1]["header"]["frame_id"]))
    arm, heard = next((topic, message) for topic, message in thief.heard if topic == UR5E.sinks()[-1].topic)
    joints = np.array(heard["points"][0]["positions"])
    tag = read_tag(tag_text(heard))
    assert read_echo(thief.states[-1]["header"]["frame_id"])[0] == tag.session
    spec, far = live.unwrapped.robot.spec, np.append(joints + 1.0, 0.085)
    ahead = replace(tag, sequence=tag.sequence + 10**6, mac="")
    forger = Tagger(session=tag.session, key=bytes(32))
    forged = [encode_command(UR5E, spec, far, ahead, "trajectory", sign=sign)[-1][2] for sign in (None, forger.sign)]
    point = {**heard["points"][0], "positions": far[:6].tolist()}
    forged += [heard, {**heard, "points": [point]}, {"joint_names": heard["joint_names"], "points": [point]}]
    for message in forged:
        thief.link.publish(arm, message)
    thief.wait_for(lambda: len(thief.refusals) == len(forged))
    wrong = f"{arm}: session {tag.session}: the signature of a message on {arm} is wrong"
    elsewhere = f"{arm}: session {tag.session} is of another connection"
    assert thief.refusals[:4] == [wrong, wrong, elsewhere, wrong]
    assert "is in command, not " in thief.refusals[4]
    for _ in range(3):
        live.step(ACTION)
        assert np.abs(live.unwrapped.state.signals["joint_position"][0] - joints).max() < 0.5


def test_a_reset_opens_a_session_where_the_old_one_is_not_known_any_more(serve_env, make):
    served = serve_env(fast=True)
    live = make("bam/pick-v0", robot=served.bus.url)
    live.reset(seed=1)
    live.step(ACTION)
    served.robot_service.sessions.end(live.unwrapped.robot._robot._session.tagger.session)
    with pytest.raises(RemoteError, match="is not open here: reset\\(\\), which opens one at /bam/session"):
        live.step(ACTION)
    served.lease.release(served.lease.holder)
    live.reset(seed=1)
    live.step(ACTION)


def test_who_leaves_lets_the_next_one_drive_at_once(serve_env, make):
    url = serve_env(fast=True).bus.url
    for _ in range(2):
        live = make("bam/pick-v0", robot=url)
        live.reset(seed=1)
        live.step(ACTION)
        live.close()
