"""The simulated robot of `bam-serve` in a ROS graph: through a rosbridge server that is not ours, and as a node."""

import contextlib
import re
import runpy
import threading
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.rosbridge.client import RosbridgeLink

player = runpy.run_path(str(Path(__file__).parent / "play.py"))
POSITIONS, GRIPPER = "/forward_position_controller/commands", "/gripper/commands"
ARRAY = "std_msgs/Float64MultiArray"
FAR = 1.0
NEAR = 0.6
"""What a joint turns at its full speed until the command timeout stops it is half of this [rad]."""


@pytest.fixture(params=["via", "rclpy"])
def served(request, rosbridge, running_robot, python, ros_python):
    """Serves bam/pick at the pace that is asked for; the robot's address."""

    def serve(pace):
        name = f"{request.param}_{pace}"
        arguments = ["-m", "bam_train.cli.serve", "--env", "bam/pick", f"--{pace}", "--namespace", name]
        if request.param == "via":
            program = python(*arguments, "--via", rosbridge.url)
        else:
            program = ros_python(*arguments, "--rclpy")
        program.line("bam-serve: bam/pick-v0 on ")
        rosbridge.wait_for(f"/{name}/bam/robot", "std_srvs/Trigger")
        return f"{rosbridge.url}/{name}"

    return serve


def test_the_policy_picks_with_it(served):
    """The task runs here, the robot there; its time goes on with the commands."""
    policy = player["FrozenPolicy"].load(player["CHECKPOINT"])
    with contextlib.closing(gym.make("bam/pick-v0", robot=served("fast"))) as env:
        episodes = [player["play_one"](env, seed, policy.act, 200) for seed in player["POLICY_SEEDS"]]
    assert [episode[-1]["success"] for episode in episodes] == [True, True, True]


@pytest.fixture
def bridge_without(ros2, new_rosbridge, tmp_path):
    """A server that finds no message package of those names."""

    def start(*packages):
        whole = ros2["AMENT_PREFIX_PATH"]
        for folder in ("share", "lib"):
            (tmp_path / folder).mkdir()
            for one in (Path(whole) / folder).iterdir():
                if one.name not in packages and one.name.partition("__")[0].removeprefix("lib") not in packages:
                    (tmp_path / folder / one.name).symlink_to(one)
        libraries = ros2["LD_LIBRARY_PATH"].replace(f"{whole}/lib:", f"{tmp_path}/lib:")
        return new_rosbridge({**ros2, "AMENT_PREFIX_PATH": str(tmp_path), "LD_LIBRARY_PATH": libraries})

    return start


def test_a_server_without_bam_msgs(bridge_without, python):
    """Its answer is waited for: what it does not carry is said, and not announced."""
    url = bridge_without("bam_msgs").url
    program = python("-m", "bam_train.cli.serve", "--env", "CartPole-v1", "--via", url)
    assert program.line("bam-serve: ").startswith(
        f"bam-serve: {url} does not carry /gym_env/gym_api_request (bam_msgs/GymAPI): load message definition "
    )
    assert program.line("bam-serve: ") == (
        f'bam-serve: CartPole-v1 on {url}, fast: /gym_env/request and reply (channel="topics")'
    )


def test_a_server_that_carries_nothing_of_use(bridge_without, python):
    url = bridge_without("bam_msgs", "std_msgs").url
    program = python("-m", "bam_train.cli.serve", "--env", "CartPole-v1", "--via", url)
    assert program.wait() == 1
    assert program.output[-1] == f"bam-serve: {url} carries nothing of use of what is served here."


def test_a_watcher_of_the_graph_does_not_drive_it(served):
    """All senders come through one bridge: what tells them apart is the key that only the driver was given."""
    url, action = served("fast"), [0.3, -0.4, 0.4, 0.1, -0.2]
    heard, came = [], threading.Event()
    env = gym.make("bam/pick-v0", robot=url, profile="ur5e_position", max_episode_steps=1000)
    with contextlib.closing(env), contextlib.closing(RosbridgeLink(url)) as thief:
        env.reset(seed=1)
        thief.connect()
        joints = thief.namespace + POSITIONS
        thief.advertise(joints, ARRAY)
        thief.subscribe(joints, ARRAY, lambda message, _: (heard.append(message), came.set()))
        assert any(env.step(np.float32(action)) and came.is_set() for _ in range(500))
        (dimension, *_), data = heard[0]["layout"]["dim"], [value + 1.0 for value in heard[0]["data"]]
        ahead = {**dimension, "label": re.sub(r" q=\d+ ", " q=1000000 ", dimension["label"])}
        for label in (dimension, ahead, {**ahead, "label": ahead["label"].partition(" m=")[0]}):
            for _ in range(5):
                thief.publish(joints, {"layout": {"dim": [label], "data_offset": 0}, "data": data})
                thief.publish(joints, heard[0])
                env.step(np.float32(action))
                state = env.unwrapped.state.signals["joint_position"][0]
                assert np.abs(state - np.array(heard[0]["data"])).max() < 0.6


class Watch:
    """Looks at the last joint until it has moved and rests again."""

    def __init__(self):
        self.newest, self.angles = None, []
        self.began, self.moved, self.rests = threading.Event(), threading.Event(), threading.Event()

    def __call__(self, message, _):
        self.newest = message["position"]
        self.angles.append(message["position"][5])
        self.began.set()
        if abs(self.turned) > 0.01:
            self.moved.set()
        if self.moved.is_set() and abs(message["velocity"][5]) < 1e-3:
            self.rests.set()

    @property
    def turned(self):
        return self.angles[-1] - self.angles[0]


def test_it_stops_by_itself_when_commands_stop(served):
    """A single command goes far; the command timeout ends the motion on its way."""
    watch, link = Watch(), RosbridgeLink(served("realtime"))
    joints, gripper, states = (link.namespace + topic for topic in (POSITIONS, GRIPPER, "/joint_states"))
    with contextlib.closing(link):
        link.connect()
        link.advertise(joints, ARRAY)
        link.advertise(gripper, ARRAY)
        link.subscribe(states, "sensor_msgs/JointState", watch)
        assert watch.began.wait(10.0)
        target = [*watch.newest[:5], watch.newest[5] + FAR]
        while not watch.moved.wait(0.3):  # ROS loses what it sends before it knows who listens
            link.publish(gripper, {"data": [0.085]})
            link.publish(joints, {"data": target})
        assert watch.rests.wait(10.0)
    assert 0.01 < watch.turned < NEAR
