"""One environment: Gymnasium's contract, ends, errors, repeatability."""

import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FlattenObservation, NormalizeObservation, RecordEpisodeStatistics, RescaleAction

from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot_env import RobotEnv
from bam_envs.make_env import make_env
from bam_envs.robots.fake import FakeRobot
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.scripted import SCRIPTED, scripted_policy
from bam_envs.testing.assertions import assert_same_value
from tests.bam_envs.making import EACH, each

ONE_OF_EACH = ("bam/pick-v0", "bam/avoidance-v0", "bam/ur-empty-v0")
"""An arm with a gripper, a base, an arm alone: for what does not depend on the task."""

SAME_START = "bam/ur-empty-v0"
"""Where every episode begins in the same way, unless the arms differ."""
SURVIVED = ("bam/ur-avoidance-v0", "bam/ur-track-v0")
"""Where the task is to reach the time limit unhurt."""


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
        assert left[1:-1] == right[1:-1]
        assert_same_value(left[-1], right[-1], "info")


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_gymnasiums_checker_has_nothing_to_say(env_id):
    """With pictures; without them, every environment in the tests of the tasks' contract."""
    env = gym.make(env_id, randomize=True, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_gymnasiums_checker_accepts_a_robot_without_physics():
    check_env(RobotEnv(FakeRobot(), PickTask()), skip_render_check=True)


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_wrappers_work_without_a_warning(env_id):
    env = RescaleAction(gym.make(env_id, max_episode_steps=30), np.float32(-2.0), np.float32(2.0))
    env = RecordEpisodeStatistics(NormalizeObservation(FlattenObservation(env)))
    env.reset(seed=0)
    for _ in range(30):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    assert "episode" in info
    env.close()


@pytest.mark.parametrize("env_id", EACH)
def test_the_same_seed_is_the_same_trajectory(make, actions_of, env_id):
    def run(seed):
        return played(make(env_id, randomize=True, max_episode_steps=60), actions, seed)

    actions = actions_of(0, 100, make(env_id).action_space.shape[0])
    one = run(seed=7)
    assert len(one) > 101  # also of the episodes after the first
    assert_same(one, run(seed=7))
    assert (one[5][0] != run(seed=8)[5][0]).any()


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_the_same_environment_repeats_itself(make, actions_of, env_id):
    env = make(env_id, randomize=True, max_episode_steps=30)
    actions = actions_of(3, 50, env.action_space.shape[0])
    assert_same(played(env, actions, seed=1), played(env, actions, seed=1))


@pytest.mark.parametrize("env_id", EACH)
def test_episodes_differ(make, env_id):
    env = make(env_id)
    starts = [env.reset(seed=0)[0], *(env.reset()[0] for _ in range(3))]
    assert len({start.tobytes() for start in starts}) == (1 if env_id == SAME_START else 4)


PLACES = {"target_coord": (3,), "target_rot": (4,)}
"""Infos that are no numbers, texts or objects, and their shapes."""


@pytest.mark.parametrize("env_id", EACH)
@pytest.mark.parametrize("wire", [False, True])
def test_infos_are_plain_and_can_be_pickled(make, env_id, wire):
    env = make(env_id, rs_state_to_info=True) if wire and ENVIRONMENTS[env_id].variants else make(env_id)
    outcome = {} if env_id == "bam/joints-v0" else {"is_success": False}  # it does not know what success is
    _, info = env.reset(seed=0)
    assert info == outcome
    *_, info = env.step(env.action_space.sample())
    assert info.get("is_success") is outcome.get("is_success")
    assert type(info.get("distance", 0.0)) is float
    for name, shape in PLACES.items():
        place = info.get(name, np.zeros(shape))
        assert (type(place), place.shape, place.dtype) == (np.ndarray, shape, np.float64)
    assert_same_value(pickle.loads(pickle.dumps(info)), info, "info")
    plain = {name: value for name, value in info.items() if name not in PLACES}
    assert json.loads(json.dumps(plain)) == plain
    assert ("rs_state" in plain) == (wire and bool(ENVIRONMENTS[env_id].variants))


def finished(env, policy, seed):
    """The last step of an episode that `policy` plays."""
    observation, _ = env.reset(seed=seed)
    while True:
        step = env.step(policy.act_batch(observation[None])[0])
        observation = step[0]
        if step[2] or step[3]:
            return step


@pytest.mark.parametrize("env_id", SCRIPTED)
def test_success_terminates(make, env_id):
    env = make(env_id)
    _, reward, terminated, truncated, info = finished(env, scripted_policy(env_id), seed=0)
    assert (terminated, truncated, info["is_success"]) == (True, False, True)
    assert reward > 9.0


def still(env_id, env):
    """The action that does nothing. Where the obstacle comes to an arm that does, it makes way."""
    action = np.zeros(env.action_space.shape, np.float32)
    action[:1] = env_id == "bam/ur-avoidance-v0"
    return action


@pytest.mark.parametrize("env_id", each([*ONE_OF_EACH, *SURVIVED]))
def test_the_time_limit_truncates(make, env_id):
    env, limit = make(env_id), ENVIRONMENTS[env_id].max_episode_steps
    env.reset(seed=0)
    action = still(env_id, env)
    for step in range(1, limit + 1):
        *_, terminated, truncated, info = env.step(action)
        assert not terminated
        assert truncated == (step == limit)
        assert info["is_success"] == (truncated and env_id in SURVIVED)


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


ENDED = {
    "bam/navigation-v0": ("out of boundary", [-1, 0]),
    "bam/avoidance-v0": ("collision", [1, 1]),
    "bam/ur-reach-v0": ("collision", [0, -1, 0, 0, 0]),
    "bam/ur-empty-v0": ("collision", [0, -1, 0, 0, 0]),
    "bam/ur-avoidance-v0": ("collision", [0, -1, 0, 0, 0]),
    "bam/ur-track-v0": ("collision", [-1, -1, -1, -1, -1]),
    "bam/isaac-reach-v0": ("collision", [0, 0, 1, 0, 0, 0]),
}
"""How an episode ends without success, and the action that is kept until it does."""


class Kept:
    """A policy that gives the same action again and again."""

    def __init__(self, action):
        self.action = np.array([action], np.float32)

    def act_batch(self, observations):
        return self.action


@pytest.mark.parametrize("env_id", ENDED)
def test_failure_terminates(make, env_id):
    status, action = ENDED[env_id]
    *_, terminated, truncated, info = finished(make(env_id), Kept(action), seed=0)
    assert (terminated, truncated, info["is_success"], info["final_status"]) == (True, False, False, status)


@pytest.mark.parametrize("env_id", EACH)
def test_no_step_without_an_episode(env_id):
    env = make_env(env_id)
    action = np.zeros(env.action_space.shape, np.float32)
    before = [lambda: None, env.close]
    if env_id != "bam/joints-v0":  # nothing ends its episodes
        policy = scripted_policy(env_id) if env_id in SCRIPTED else Kept(ENDED[env_id][1])
        before.insert(1, lambda: finished(env, policy, seed=0))
    for prepare in before:
        prepare()
        with pytest.raises(ResetNeeded) as caught:
            env.step(action)
        assert str(caught.value) == "No episode is running: it ended, or never began. Call reset() first."
    env.reset()
    env.step(action)
    env.close()


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_bad_actions_are_refused_and_nothing_moves(make, env_id):
    env = make(env_id)
    env.reset(seed=0)
    before, size = env.unwrapped.state, env.action_space.shape[0]
    bad = [0.0, float("nan"), *[0.0] * (size - 2)]
    with pytest.raises(InvalidValue) as caught:
        env.step(np.array(bad, np.float32))
    assert str(caught.value) == f"The action must be finite numbers, not {bad}."
    with pytest.raises(InvalidValue) as caught:
        env.step(np.zeros(size - 1, np.float32))
    assert str(caught.value) == f"The action must have shape ({size},), not ({size - 1},)."
    assert env.unwrapped.state is before


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_actions_may_be_lists(make, env_id):
    one, two = make(env_id), make(env_id)
    one.reset(seed=0)
    two.reset(seed=0)
    action = [0.5, -0.5, 0.25, 0.0, 1.0, -1.0][: one.action_space.shape[0]]
    np.testing.assert_array_equal(one.step(action)[0], two.step(np.array(action, np.float32))[0])


@pytest.mark.parametrize("env_id", EACH)
def test_describe_names_every_number(make, env_id):
    env = make(env_id).unwrapped
    said = json.loads(json.dumps(env.describe()))
    assert list(said) == ["observation", "action", "state", "command"]
    env.reset(seed=0)
    assert len(said["observation"]) == env.observation_space.shape[0]
    assert len(said["action"]) == env.action_space.shape[0]
    assert len(said["command"]) == env.state.command.shape[1]
    assert len(said["state"]) == sum(signal.shape[1] for signal in env.state.signals.values())
    for rows in said.values():
        assert all({"name", "unit", "low", "high"} <= set(row) for row in rows)
        assert len({(row["name"], row["unit"]) for row in rows}) == len(rows)
    assert env.period == ENVIRONMENTS[env_id].period
    assert env.metadata["render_fps"] == round(1 / env.period)


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_closing_twice_and_starting_again(make, env_id):
    env = make(env_id)
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
