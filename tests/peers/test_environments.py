"""The same episodes of one environment in process and through every transport, also through a rosbridge server that is
not ours and as a ROS 2 node; and the policy of a checkpoint ends them with the same success."""

import contextlib
import json
import os
import re
import runpy
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.remote.remote_env import RemoteEnv, open_transport
from bam_envs.remote.serve.env_server import LocalTransport
from tests.peers.conftest import Peer

HERE = Path(__file__).parent
play = runpy.run_path(str(HERE / "play.py"))["play"]
SERVE = ("-m", "bam_train.cli.serve", "--env", "bam/pick", "--fast")


def closely(theirs, ours, tolerance):
    """Every number within `tolerance`, everything else equal."""
    if isinstance(ours, dict):
        assert theirs.keys() == ours.keys()
        for name, value in ours.items():
            closely(theirs[name], value, tolerance)
    elif isinstance(ours, list) and ours and isinstance(ours[0], (dict, list)):
        assert len(theirs) == len(ours)
        for one, other in zip(theirs, ours, strict=True):
            closely(one, other, tolerance)
    elif isinstance(ours, (float, list)):
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=tolerance)
    else:
        assert theirs == ours


@pytest.fixture(scope="module")
def here():
    """The episodes in process."""
    env = gym.make("bam/pick-v0")
    yield play(env)
    env.close()


def address(line):
    return re.search(r"(ws|tcp)://\S+?(?=,? )", line).group()


@pytest.fixture
def served(python):
    """Serves bam/pick with `bam-serve`; its lines, one for each way in."""

    def serve(*flags, ways=1):
        program = python(*SERVE, *flags)
        return [program.line("bam-serve: bam/pick-v0 on ") for _ in range(ways)]

    return serve


def played(url, **options):
    with contextlib.closing(RemoteEnv(open_transport(url, **options))) as env:
        return play(env)


def test_the_policy_picks(here):
    assert [episode[-1]["success"] for episode in here[-3:]] == [True, True, True]


def test_local(here):
    with contextlib.closing(RemoteEnv(LocalTransport(gym.make("bam/pick-v0")))) as env:
        assert play(env) == here


def test_tcp_and_embedded_rosbridge(served, here):
    rosbridge, tcp = map(address, served("--port", "0", "--tcp", "0", ways=2))
    assert played(tcp) == here
    assert played(rosbridge) == here
    assert played(rosbridge, channel="topics") == here


@pytest.fixture(scope="module")
def via(rosbridge, running_robot):
    """The address of `bam-serve` behind the server that is not ours."""
    program = Peer([sys.executable, *SERVE, "--via", rosbridge.url, "--namespace", "via"], dict(os.environ))
    with contextlib.closing(program):
        yield address(program.line("bam-serve: bam/pick-v0 on "))


@pytest.mark.parametrize("channel", ["service", "topics"])
def test_through_the_other_server(channel, via, rosbridge, here):
    closely(played(f"{rosbridge.url}/via", channel=channel), here, 1e-6)


LEAVES = """
from bam_envs.remote.remote_env import make_remote_env
env = make_remote_env("", "ros2://native", name="leaver", channel="service")
env.reset(seed=1)
env.step(env.action_space.sample())
"""
SUCCESS, FAILURE = {"value": 1}, {"value": 2}


@pytest.mark.parametrize("way", ["embedded", "via"])
def test_a_foreign_client_steps_it(way, request, served, roslibjs):
    """One that knows the service and its fields, and nothing of ours."""
    embedded = way == "embedded"
    url = address(served("--namespace", way, "--port", "0")[0]) if embedded else request.getfixturevalue("via")
    action = [0.5, -0.25, 0.125, 0.0, 1.0]
    answers = roslibjs("gym_client.mjs", url, f"/{way}/gym_env/gym_api_request", "5", json.dumps(action))
    with contextlib.closing(gym.make("bam/pick-v0")) as env:
        first, _ = env.reset(seed=5)
        second, reward, *_ = env.step(np.float32(action))
    assert answers["unasked"]["header"]["error_code"] == FAILURE
    for name in ("reset", "step", "close"):
        assert answers[name]["header"]["error_code"] == SUCCESS, answers[name]["header"]
    closely(answers["reset"]["feedback"][0]["observation"], first.tolist(), 1e-6)
    feedback = answers["step"]["feedback"][0]
    closely(feedback["observation"], second.tolist(), 1e-6)
    closely(feedback["reward"], float(reward), 1e-6)
    assert (feedback["executed"], feedback["terminated"], feedback["truncated"]) == (True, False, False)


def test_as_a_ros_2_node(ros_python, rosbridge, running_robot, here):
    node = ros_python(*SERVE, "--rclpy", "--namespace", "native")
    node.line("bam-serve: bam/pick-v0 on ")
    rosbridge.wait_for("/native/gym_env/gym_api_request", "bam_msgs/GymAPI")
    closely(played(f"{rosbridge.url}/native"), here, 1e-6)
    for channel in ("service", "topics"):
        client = ros_python(HERE / "play.py", "ros2://native", f"channel={channel}")
        closely(json.loads(client.line("[", limit=60.0)), here, 1e-6)
        assert client.wait() == 0
    left = ros_python("-c", LEAVES)
    assert (left.wait(), left.output) == (0, [])
    node.line("bam-serve: leaver")
    assert node.line("bam-serve: leaver").endswith(" is no longer in command")
