"""One environment: Gymnasium's contract, ends, errors, repeatability."""

import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FlattenObservation, NormalizeObservation, RecordEpisodeStatistics, RescaleAction

import bam_envs
from bam_envs.errors import InvalidValue, ResetNeeded
from bam_envs.registry import ENVIRONMENTS, make_env
from bam_envs.robot_env import RobotEnv
from bam_envs.robots.fake import FakeRobot
from bam_envs.scripted import scripted_policy
from bam_envs.tasks.pick import PickTask

IDS = tuple(bam_envs.ENVIRONMENTS)


def played(env, actions, seed):
    """Observations, rewards, ends and infos of `actions` from `seed`, beginning anew at each end."""
    said = [env.reset(seed=seed)]
    for action in actions:
        said.append(env.step(action))
        if said[-1][2] or said[-1][3]:
            said.append(env.reset())
    return said


def assert_same(one, two):
    assert len(one) == len(two)
    for left, right in zip(one, two, strict=True):
        np.testing.assert_array_equal(left[0], right[0])
        assert left[1:] == right[1:]


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("randomize", [False, True])
def test_gymnasiums_checker_has_nothing_to_say(env_id, randomize):
    env = gym.make(env_id, randomize=randomize, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_gymnasiums_checker_accepts_a_robot_without_physics():
    check_env(RobotEnv(FakeRobot(), PickTask()), skip_render_check=True)


@pytest.mark.parametrize("env_id", IDS)
def test_wrappers_work_without_a_warning(env_id):
    env = RescaleAction(gym.make(env_id), np.float32(-2.0), np.float32(2.0))
    env = RecordEpisodeStatistics(NormalizeObservation(FlattenObservation(env)))
    env.reset(seed=0)
    for _ in range(ENVIRONMENTS[env_id].max_episode_steps):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    assert "episode" in info
    env.close()


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("randomize", [False, True])
def test_the_same_seed_is_the_same_trajectory(make, actions_of, env_id, randomize):
    size = make(env_id).action_space.shape[0]
    actions = actions_of(0, 150, size)
    one = played(make(env_id, randomize=randomize), actions, seed=7)
    assert_same(one, played(make(env_id, randomize=randomize), actions, seed=7))
    other = played(make(env_id, randomize=randomize), actions, seed=8)
    assert (one[0][0] != other[0][0]).any()


def test_the_same_environment_repeats_itself(make, actions_of):
    env = make("bam/pick-v0", randomize=True)
    actions = actions_of(3, 120, 5)
    assert_same(played(env, actions, seed=1), played(env, actions, seed=1))


@pytest.mark.parametrize("env_id", IDS)
def test_episodes_differ(make, env_id):
    env = make(env_id)
    starts = [env.reset(seed=0)[0], *(env.reset()[0] for _ in range(3))]
    assert len({start.tobytes() for start in starts}) == 4


@pytest.mark.parametrize("env_id", IDS)
def test_infos_are_plain_and_can_be_pickled(make, env_id):
    env = make(env_id)
    _, info = env.reset(seed=0)
    assert info == {"is_success": False}
    *_, info = env.step(env.action_space.sample())
    assert info["is_success"] is False
    assert type(info["distance"]) is float
    assert json.loads(json.dumps(info)) == info
    assert pickle.loads(pickle.dumps(info)) == info


def finished(env, policy, seed):
    """The last step of an episode that `policy` plays."""
    observation, _ = env.reset(seed=seed)
    while True:
        step = env.step(policy.act_batch(observation[None])[0])
        observation = step[0]
        if step[2] or step[3]:
            return step


@pytest.mark.parametrize("env_id", IDS)
def test_success_terminates(make, env_id):
    env = make(env_id)
    _, reward, terminated, truncated, info = finished(env, scripted_policy(env_id), seed=0)
    assert (terminated, truncated, info["is_success"]) == (True, False, True)
    assert reward > 9.0


@pytest.mark.parametrize("env_id", IDS)
def test_the_time_limit_truncates(make, env_id):
    env = make(env_id)
    env.reset(seed=0)
    still = np.zeros(env.action_space.shape, np.float32)
    for step in range(1, ENVIRONMENTS[env_id].max_episode_steps + 1):
        *_, terminated, truncated, info = env.step(still)
        assert not terminated
        assert not info["is_success"]
        assert truncated == (step == ENVIRONMENTS[env_id].max_episode_steps)


@pytest.mark.parametrize("env_id", ["bam/pick-v0", "bam/pick-place-v0"])
def test_a_cube_off_the_table_terminates_without_success(make, env_id):
    env = make(env_id)
    env.reset(seed=0)
    physics = env.unwrapped.robot.physics
    physics.qpos[0, 8:11] = 0.99, 0.0, 0.02  # past the edge
    for _ in range(10):
        _, reward, terminated, truncated, info = env.step(np.zeros(5, np.float32))
        if terminated:
            break
    assert (terminated, truncated, info["is_success"]) == (True, False, False)
    assert reward < -1.0


@pytest.mark.parametrize("env_id", IDS)
def test_no_step_without_an_episode(env_id):
    env = make_env(env_id)
    for prepare in (lambda: None, lambda: finished(env, scripted_policy(env_id), seed=0)):
        prepare()
        with pytest.raises(ResetNeeded) as caught:
            env.step(np.zeros(env.action_space.shape, np.float32))
        assert str(caught.value) == "No episode is running: it ended, or never began. Call reset() first."
    env.reset()
    env.step(np.zeros(env.action_space.shape, np.float32))
    env.close()


def test_bad_actions_are_refused_and_nothing_moves(make):
    env = make("bam/pick-v0")
    env.reset(seed=0)
    before = env.unwrapped.state
    with pytest.raises(InvalidValue) as caught:
        env.step(np.array([0, 0, np.nan, 0, 0], np.float32))
    assert str(caught.value) == "The action must be finite numbers, not [0.0, 0.0, nan, 0.0, 0.0]."
    with pytest.raises(InvalidValue) as caught:
        env.step(np.zeros(4, np.float32))
    assert str(caught.value) == "The action must have shape (5,), not (4,)."
    assert env.unwrapped.state is before


def test_actions_may_be_lists(make):
    one, two = make("bam/pick-v0"), make("bam/pick-v0")
    one.reset(seed=0)
    two.reset(seed=0)
    action = [0.5, -0.5, 0.25, 0.0, 1.0]
    np.testing.assert_array_equal(one.step(action)[0], two.step(np.array(action, np.float32))[0])


@pytest.mark.parametrize("env_id", IDS)
def test_describe_names_every_number(make, env_id):
    env = make(env_id).unwrapped
    said = json.loads(json.dumps(env.describe()))
    assert list(said) == ["observation", "action", "state", "command"]
    assert len(said["observation"]) == env.observation_space.shape[0]
    assert len(said["action"]) == env.action_space.shape[0]
    assert len(said["command"]) == 7
    for rows in said.values():
        assert all({"name", "unit", "low", "high"} <= set(row) for row in rows)
    assert env.period == 0.05
    assert env.metadata["render_fps"] == 20


def test_closing_twice_and_starting_again(make):
    env = make("bam/pick-v0")
    first, _ = env.reset(seed=0)
    env.close()
    env.close()
    np.testing.assert_array_equal(env.reset(seed=0)[0], first)


def test_a_robot_without_a_picture_says_so():
    env = RobotEnv(FakeRobot(), PickTask(), render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(InvalidValue) as caught:
        env.render()
    assert str(caught.value) == "The robot 'fake' has no picture; use render_mode=None."
