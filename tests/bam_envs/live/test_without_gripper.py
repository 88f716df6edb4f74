"""Environments that command six joints: on an arm that has no gripper, and on one whose gripper is not theirs."""

import json

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.robot import Initial
from bam_envs.live.building import live_robot
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.remote.serve.robot_service import RobotService
from bam_envs.remote.serve.served_robot import ServedRobot
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur import START as EMPTY_START
from bam_envs.robots.ur import ur_model, ur_spec
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.tasks.ur_reach import START

ARM, GRIPPER = "/scaled_joint_trajectory_controller/joint_trajectory", "/gripper/commands"
SIX = ur_spec(ur_model("ur5e"), 0.1, with_object=False)
ACTION = np.array([0.1, -0.4, 0.4, 0.1, -0.2], np.float32)
HELD = 0.037
ROW = np.zeros(1, np.int64)


@pytest.fixture
def make():
    """`gymnasium.make` of a UR5e; closed at the end."""
    made = []

    def make_one(env_id, url):
        made.append(gym.make(env_id, robot=url, ur_model="ur5e", disable_env_checker=True))
        return made[-1]

    yield make_one
    for env in made:
        env.close()


@pytest.fixture
def serve(request):
    """Serve a robot as `bam-serve` does; its URL."""

    def start(robot, realtime, joints=START):
        server = BridgeServer(port=0).start()
        served = ServedRobot(robot, command_timeout=0.2, realtime=realtime)
        served.connect()
        served.reset(ROW, Initial({"joint_position": np.array([joints])}, ROW))
        service = RobotService(served, load_profile("ur5e"), server, CommandLease(0.5))
        service.start()
        for close in (served.close, server.close, service.close):
            request.addfinalizer(close)
        return server.url, served

    return start


def run(env, steps=6, start=START):
    """An episode, a halt, another one, and the end."""
    for _ in range(2):
        env.reset(seed=1)
        for _ in range(steps):
            env.step(ACTION)
        env.unwrapped.robot.halt()
    moved = env.unwrapped.state.signals["joint_position"][0] - start
    env.close()
    return np.abs(moved).max()


@pytest.mark.slow
def test_an_arm_without_gripper_runs_a_task_that_has_none(server, robot_on, make):
    scripted = robot_on(server, spec=SIX)
    scripted.signals["joint_position"][:] = START
    env = make("bam/ur-reach-v0", server.url)
    scripted.period = env.unwrapped.robot.spec.period
    assert env.unwrapped.robot.spec.command.labels == SIX.command.labels
    assert run(env) > 0.05
    assert {topic for topic, _, _ in scripted.commands} == {ARM, "/bam/halt"}
    assert {name: row["stopped"] for name, row in env.unwrapped.robot.report().items() if row["stopped"]} == {}


def test_nothing_that_is_sent_names_the_gripper(lax, robot_on, make):
    """On a server that says nothing of its topics: neither subscribed, nor advertised, nor published."""
    bus = lax()
    scripted = robot_on(bus)
    scripted.signals["joint_position"][:] = START
    run(make("bam/ur-reach-v0", bus.url), steps=3)
    said = [json.dumps(message) for _, message in bus.frames]
    assert any(ARM in one for one in said)
    assert [one for one in said if "gripper" in one] == []


def test_trajectories_for_the_joints_alone(server, robot_on):
    scripted = robot_on(server)
    robot = live_robot(server.url, SIX, profile="ur5e", command="trajectory")
    robot.connect()
    state = robot.reset(ROW, Initial({"joint_position": scripted.signals["joint_position"][None].copy()}, ROW))
    robot.step(state.command)
    robot.close()
    topic = "/scaled_joint_trajectory_controller/joint_trajectory"
    scripted.wait_for(lambda: scripted.halts and scripted.commands[-1][0] == topic)  # the hold follows the halt
    assert {topic for topic, _, _ in scripted.commands} == {topic, "/bam/halt"}
    assert scripted.on(topic)[0]["joint_names"] == list(SIX.command.labels)
    assert scripted.on(topic)[-1]["points"][0]["positions"] == scripted.signals["joint_position"].tolist()


@pytest.mark.slow
@pytest.mark.parametrize("realtime", [False, True])
def test_a_served_arm_with_a_gripper_keeps_its_width(serve, make, realtime):
    url, served = serve(FakeRobot(1), realtime, EMPTY_START)
    for _ in range(10):
        served.step(np.array([[*EMPTY_START, HELD]]))
    assert run(make("bam/ur-empty-v0", url), start=EMPTY_START) > 0.05
    np.testing.assert_array_equal(served.state.signals["gripper_width"], [[HELD]])
