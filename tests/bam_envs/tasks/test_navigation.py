"""Driving to a place: observations, rewards, ends, samples and options, in numbers."""

import copy
import math

import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import RobotState
from tests.bam_envs.making import make_task

ENV = "bam/navigation-v0"
ROW = np.zeros(1, np.int64)


def at(x, y, yaw=0.0, v=0.0, w=0.0):
    signals = {"base_pose": np.array([[x, y, yaw]]), "base_velocity": np.array([[v, w]])}
    return RobotState(signals, np.zeros(1), np.zeros((1, 2)))


def begun(start=(0.0, 0.0, 0.0), target=(3.0, 4.0, 0.0), **options):
    task = make_task("bam/navigation-v0", 1, **options)
    initial = task.sample_initial(ROW, [np.random.default_rng(0)], {"start_pose": start, "target_pose": target})
    np.testing.assert_array_equal(initial.signals["base_pose"], [start])
    task.on_reset(ROW, at(*start))
    return task


def act(*action):
    return np.array([action], np.float32)


def test_what_is_observed():
    task = begun()
    state = at(1.0, 2.0, math.pi / 2, 0.25, -0.35)
    bearing = math.atan2(2.0, 2.0) - math.pi / 2
    expected = [math.sqrt(8) / 4, bearing / math.pi, 0.5, -0.5]
    np.testing.assert_allclose(task.observe(state), [expected], rtol=1e-6)
    parity = begun(parity=True)
    np.testing.assert_array_equal(parity.observe(state), np.float32([[math.sqrt(8), bearing, 0.25, -0.35]]))


def test_the_bearing_is_from_minus_pi_to_pi():
    task = begun(target=(-1.0, 0.0, 0.0), parity=True)
    for yaw, bearing in ((0.0, -math.pi), (0.1, math.pi - 0.1), (-0.1, -math.pi + 0.1), (-3.0, -math.pi + 3.0)):
        assert task.observe(at(0.0, 0.0, yaw))[0, 1] == np.float32(bearing)


def test_actions_are_speeds():
    task = begun()
    np.testing.assert_array_equal(task.command(act(1.0, -0.5), at(0, 0)), [[0.5, -0.35]])
    np.testing.assert_array_equal(task.command(act(-7.0, 7.0), at(0, 0)), [[-0.5, 0.7]])


def test_rewards():
    task = begun()
    score = task.score(at(0.3, 0.4), act(-0.5, 1.0))
    np.testing.assert_allclose(score.reward, [0.5 * 0.5 - 0.005 - 0.0015 - 0.0003], rtol=1e-12)
    score = task.score(at(0.0, 0.0), act(0.0, 0.0))
    np.testing.assert_allclose(score.reward, [-0.25 - 0.005], rtol=1e-12)
    assert (score.terminated.item(), score.success.item(), score.info["final_status"].item()) == (False, False, "")
    assert score.info["distance"].item() == 5.0
    np.testing.assert_array_equal(score.info["target_coord"], [[3.0, 4.0, 0.0]])


def test_rewards_of_robo_gym():
    task = begun(parity=True)
    action = act(-0.3, 0.7)
    power = np.float32(0.30) * np.float32(0.3) + np.float32(0.03) * np.float32(0.7)
    assert task.score(at(0.3, 0.4), action).reward.item() == -float(power)  # no shaping, in float32
    reward = task.score(at(0.6, 0.8), action).reward.item()
    assert reward == -50 * 4.0 - -50 * 4.5 - float(np.float32(0.30) * np.float32(0.3)) - float(np.float32(0.03 * 0.7))


@pytest.mark.parametrize(("parity", "reward"), [(False, 2.0), (True, 200.0)])
def test_success(parity, reward):
    for distance, arrived in ((0.2, False), (0.1999, True)):
        task = begun(target=(2.0, 0.0, 0.0), parity=parity)
        score = task.score(at(2.0 - distance, 0.0), act(1.0, 0.0))
        if distance == 0.2:  # as near as rounding allows
            assert score.info["distance"].item() == pytest.approx(0.2)
        else:
            assert (score.terminated.item(), score.success.item()) == (arrived, arrived)
            assert (score.reward.item(), score.info["final_status"].item()) == (reward, "success")


@pytest.mark.parametrize(("parity", "reward"), [(False, -2.0), (True, -200.0)])
def test_the_boundary(parity, reward):
    places = {(10.001, 0): True, (-10.001, 0): True, (0, 10.001): True, (0, -10.001): not parity, (9.99, -9.99): False}
    for (x, y), outside in places.items():
        score = begun(parity=parity).score(at(x, y), act(0.0, 0.0))
        assert score.terminated.item() == outside, (x, y)
        assert score.info["final_status"].item() == ("out of boundary" if outside else "")
        assert (score.reward.item() == reward) == outside


def test_five_hundred_steps_in_parity():
    task = begun(parity=True)
    for _ in range(499):
        assert not task.score(at(0, 0), act(0, 0)).terminated.item()
    other = copy.deepcopy(task)
    score = task.score(at(0, 0), act(0, 0))
    assert (score.terminated.item(), score.reward.item()) == (True, 0.0)
    assert score.info["final_status"].item() == "max_steps_exceeded"
    score = other.score(at(3.0, 3.9), act(0, 0))  # arrived in the last step
    assert (score.reward.item(), score.success.item()) == (200.0, True)
    assert score.info["final_status"].item() == "max_steps_exceeded"


def test_time_limits(make, make_rows):
    for parity, env in ((False, make(ENV)), (True, make(ENV, parity=True))):
        env.reset(seed=1)
        steps = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(500)]
        assert steps[:499] == [(False, False)] * 499
        assert steps[499] == ((True, True) if parity else (False, True))
    for parity, ends in ((False, [False, True]), (True, [True, True])):
        envs = make_rows(ENV, 3, parity=parity)
        envs.reset(seed=1)
        for _ in range(500):
            _, _, terminated, truncated, infos = envs.step(np.zeros((3, 2), np.float32))
        assert [terminated.all(), truncated.all()] == ends
        status = infos["final_info"]["final_status"].tolist()
        assert status == ["max_steps_exceeded"] * 3


def test_samples():
    task = make_task("bam/navigation-v0", 2000)
    rows = np.arange(2000)
    pose = task.sample_initial(rows, [np.random.default_rng(seed) for seed in rows]).signals["base_pose"]
    state = RobotState({"base_pose": pose}, np.zeros(2000), np.zeros((2000, 2)))
    task.on_reset(rows, state)
    for values, low, high in ((pose[:, 0], -2, 2), (pose[:, 1], -2, 2), (pose[:, 2], -math.pi, math.pi)):
        assert values.min() == pytest.approx(low, abs=0.02)
        assert values.max() == pytest.approx(high, abs=0.02)
    assert np.abs(task.target[:, :2]).max() <= 1.0
    assert (task.target[:, 2] == 0).all()
    assert 1.0 <= task.distance(state).min() < 1.01


@pytest.mark.parametrize("kind", [list, tuple, np.array, np.float32])
def test_options(make, make_rows, kind):
    env = make(ENV, parity=True)
    options = {"start_pose": kind([1.0, -1.0, 0.5]), "target_pose": kind([0.0, 1.0, 2.0])}
    env.reset(seed=1, options=options)
    np.testing.assert_array_equal(env.unwrapped.state.signals["base_pose"], [[1.0, -1.0, 0.5]])
    np.testing.assert_array_equal(env.unwrapped.task.target, [[0.0, 1.0, 2.0]])
    env.reset(seed=1)
    assert (env.unwrapped.task.target != [0.0, 1.0, 2.0]).all()
    envs = make_rows(ENV, 2)
    envs.reset(seed=1, options=options)
    np.testing.assert_array_equal(envs.unwrapped.task.target, [[0.0, 1.0, 2.0]] * 2)


def test_a_yaw_that_goes_round(make):
    env = make(ENV)
    env.reset(options={"start_pose": [0.0, 0.0, 3 * math.pi / 2]})
    np.testing.assert_allclose(env.unwrapped.state.signals["base_pose"], [[0.0, 0.0, -math.pi / 2]])


@pytest.mark.parametrize(
    ("pose", "text"),
    [
        ([1.0, 2.0], "start_pose (x, y [m], yaw [rad]) must be 3 finite numbers, not [1.0, 2.0]."),
        ([1, 2, math.nan], "start_pose (x, y [m], yaw [rad]) must be 3 finite numbers, not [1, 2, nan]."),
        ("here", "start_pose (x, y [m], yaw [rad]) must be 3 finite numbers, not 'here'."),
        ([0, 11, 0], "start_pose must be within 10 m of the origin along x and y, not [0.0, 11.0, 0.0]."),
    ],
)
def test_bad_poses(make, pose, text):
    with pytest.raises(InvalidValue) as caught:
        make(ENV).reset(options={"start_pose": pose})
    assert str(caught.value) == text


def test_none_is_no_pose(make):
    """As in robo-gym."""
    env = make(ENV)
    drawn, _ = env.reset(seed=1)
    same, _ = env.reset(seed=1, options={"start_pose": None, "target_pose": None})
    np.testing.assert_array_equal(drawn, same)


def test_a_robot_that_stays_where_it_is_is_not_started_elsewhere():
    task = make_task("bam/navigation-v0")
    task.sample_initial(ROW, [np.random.default_rng(0)], {"start_pose": [1.0, 0.0, 0.0]})
    with pytest.raises(InvalidValue) as caught:
        task.on_reset(ROW, at(0.5, 0.0))
    assert str(caught.value) == (
        "start_pose: this robot stays where it is, at [0.5, 0.0, 0.0], and does not start at [1.0, 0.0, 0.0] "
        "(x, y [m], yaw [rad]). Drive it there, or leave start_pose out."
    )


def test_the_state_of_robo_gyms_server(make):
    space = make_task("bam/navigation-v0", parity=True).observation_space
    np.testing.assert_array_equal(space.low, np.float32([-np.inf, -math.pi, -1.1, -1.6]))
    np.testing.assert_array_equal(space.high, np.float32([np.inf, math.pi, 1.1, 1.6]))
    env = make(ENV, parity=True, rs_state_to_info=True)
    env.reset(options={"start_pose": [1.0, -1.0, 0.5], "target_pose": [0.0, 1.0, 0.0]})
    sent = env.step(np.float32([0.2, 0.0]))[4]["rs_state"]
    assert len(sent) == 1030
    np.testing.assert_allclose(sent[:8], [0, 1, 0, 1 + 0.01 * math.cos(0.5), -1 + 0.01 * math.sin(0.5), 0.5, 0.1, 0])
    assert sent[8:1020] == [29.0] * 1012
    assert sent[1020:] == [0.0] * 10
