"""Bases' environments on a live robot: a simulated base behind our rosbridge server, as `bam-serve` offers it."""

import math

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.remote.serve.served_robot import ServedRobot
from tests.bam_envs.making import CART

NAVIGATION, AVOIDANCE = "bam/navigation-v0", "bam/avoidance-v0"


@pytest.fixture
def serve(serve_env):
    """Serve an environment whose base was put somewhere: ``serve(id, pose, model, **options)``."""

    def start(env_id, pose, model="mir100", **options):
        served = serve_env(env_id, gym.make(env_id, robot_model=model, disable_env_checker=True), **options)
        assert isinstance(served.env.unwrapped.robot, ServedRobot)
        served.env.reset(seed=3, options={"start_pose": pose})
        return served

    return start


def live(make, served, env_id, **options):
    return make(env_id, robot=served.bus.url, **options)


@pytest.mark.parametrize("options", [{"fast": True}, {}])
def test_navigation_drives_to_the_target_from_where_the_base_is(serve, make, options):
    served = serve(NAVIGATION, [0.4, -0.3, 0.7], **options)
    assert served.endpoints[0].endswith("and a mir100's topics")
    env = live(make, served, NAVIGATION)
    env.reset(seed=1)
    task = env.unwrapped.task
    np.testing.assert_allclose(env.unwrapped.state.signals["base_pose"], [[0.4, -0.3, 0.7]], atol=1e-6)
    assert math.dist(task.target[0, :2], (0.4, -0.3)) >= 1.0
    for number in range(400):
        bearing = env.unwrapped.task.observe(env.unwrapped.state)[0, 1] * math.pi
        action = np.clip([1.0 if abs(bearing) < 0.3 else 0.0, 2 * bearing], -1, 1).astype(np.float32)
        _, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated or (not options and number >= 10):
            break
    if options:
        assert (reward, info["final_status"], info["is_success"]) == (2.0, "success", True)
    else:  # a few steps of real time are enough; on a busy computer it may stand again by now
        moved = served.env.unwrapped.robot.state.signals["base_pose"] - [0.4, -0.3, 0.7]
        assert np.abs(moved).max() > 0.01


@pytest.mark.parametrize("model", ["mir100", "turtlebot4", CART])
def test_a_live_base_sees_what_the_simulated_one_sees_and_stops_before_it(serve, make, model):
    """The same commands, here and there, until the lasers slow the live base down."""
    pose = [0.0, -2.6, math.pi / 2]
    served = serve(AVOIDANCE, pose, model, fast=True)
    there, here = live(make, served, AVOIDANCE, robot_model=model), make(AVOIDANCE, robot_model=model)
    forward = np.eye(1, *there.action_space.shape, dtype=np.float32)[0]
    here.reset(seed=3, options={"start_pose": pose, "target_pose": [0.0, 2.5, 0.0]})
    there.reset(seed=8, options={"target_pose": [0.0, 2.5, 0.0]})
    assert there.unwrapped.state.truth == {}
    seen, zones = 0, there.unwrapped.robot.report()["laser zones"]
    for _ in range(100):
        one, two = here.step(forward), there.step(forward)
        zones = there.unwrapped.robot.report()["laser zones"]
        if zones["altered"] or one[2]:
            break
        np.testing.assert_allclose(one[0], two[0], atol=0.05)  # but for the noise of its rays
        seen += 1
    assert seen > 10
    np.testing.assert_array_equal(served.env.unwrapped.task.obstacles, here.unwrapped.task.obstacles)
    assert zones["number"] == "G12"
    for _ in range(60):
        assert not there.step(forward)[2]
    assert served.env.unwrapped.robot.state.truth["collision"].tolist() == [False]
    assert np.abs(served.env.unwrapped.robot.state.signals["base_velocity"]).max() < 0.01


def test_somewhere_else_than_it_is(serve, make):
    env = live(make, serve(NAVIGATION, [0.0, 0.0, 0.0], fast=True), NAVIGATION)
    with pytest.raises(InvalidValue, match=r"start_pose: this robot stays where it is, at \[0.0, 0.0, 0.0\]"):
        env.reset(options={"start_pose": [1.0, 1.0, 0.0]})
