"""The scripted policies: what they see, and that they need no memory. How often they succeed: tests/scripts."""

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.scripted import SCRIPTED, Columns, Sight, numeric_jacobian, scripted_policy
from bam_envs.testing import ARM_HOME

IDS = tuple(SCRIPTED)


@pytest.mark.parametrize("env_id", IDS)
def test_actions_are_in_their_space_and_do_not_depend_on_other_rows(make_rows, env_id):
    envs = make_rows(env_id, 8)
    policy = scripted_policy(env_id)
    observation, _ = envs.reset(seed=0)
    for _ in range(60):
        actions = policy.act_batch(observation)
        assert actions.dtype == np.float32
        assert envs.action_space.contains(actions)
        alone = np.concatenate([policy.act_batch(row[None]) for row in observation])
        np.testing.assert_allclose(alone, actions, atol=1e-6)
        policy.reset()
        observation, *_ = envs.step(actions)


def test_no_policy_for_other_environments():
    with pytest.raises(UnknownName) as caught:
        scripted_policy("bam/pik-v0")
    assert str(caught.value) == "Unknown scripted policy 'bam/pik-v0'. Did you mean 'bam/pick-v0'?"


@pytest.mark.parametrize("env_id", sorted(set(ENVIRONMENTS) - set(SCRIPTED)))
def test_environments_without_one_say_which_have_one(env_id):
    with pytest.raises(InvalidValue) as caught:
        scripted_policy(env_id)
    assert str(caught.value) == (
        f"{env_id} has no scripted policy. These have one: bam/reach-v0, bam/pick-v0, bam/pick-place-v0."
    )


def test_columns_are_read_by_name():
    labels = PickTask.observation_labels
    observation = np.arange(2 * len(labels), dtype=np.float32).reshape(2, -1)
    taken = Columns(labels).take(observation, "tool_z", "tool_x")
    np.testing.assert_array_equal(taken, [[2.0, 0.0], [2.0 + len(labels), len(labels)]])


def test_sight_is_in_metres_and_radians():
    env = gym.make("bam/pick-v0", disable_env_checker=True)
    observation, _ = env.reset(seed=3)
    sight, state = Sight(Columns(PickTask.observation_labels), observation[None]), env.unwrapped.state
    tool, _ = GEOMETRY.tool_pose(state.signals["joint_position"])
    np.testing.assert_allclose(sight.offset, state.signals["object_position"] - tool, atol=1e-6)
    quaternion = state.signals["object_quaternion"][0]
    yaw = 2 * np.arctan2(quaternion[3], quaternion[0])
    assert abs(np.exp(4j * sight.turn[0]) - np.exp(4j * yaw)) < 1e-3
    assert not sight.closed[0]
    env.close()


def test_jacobian_predicts_small_moves():
    joints = np.stack([ARM_HOME, ARM_HOME + 0.3])
    turn = 1e-4 * np.random.default_rng(0).standard_normal((2, 6))
    move = GEOMETRY.tool_position(joints + turn) - GEOMETRY.tool_position(joints)
    np.testing.assert_allclose((numeric_jacobian(joints) @ turn[:, :, None])[:, :, 0], move, atol=1e-7)
