"""Many environments in one: rows are what single environments are, ends, saving and restoring."""

import copy
import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot_env import RobotVectorEnv
from bam_envs.robots.fake import FakeRobot
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.scripted import SCRIPTED, scripted_policy
from bam_envs.testing.assertions import assert_same_value
from tests.bam_envs.making import EACH, QUICK, ROBOTS

ONE_OF_EACH = ("bam/pick-v0", "bam/avoidance-v0", "bam/ur-empty-v0")
"""An arm with a gripper, a base, an arm alone: for what does not depend on the task."""


def size_of(env):
    return env.single_action_space.shape[0]


def batch(actions_of, rows, steps, size):
    """Actions of rows 0 to n. Shape: (steps, n, size)."""
    return np.stack([actions_of(row, steps, size) for row in range(rows)], axis=1)


def doing_well(env_id, observation, actions):
    """`actions`, with those of the first rows from the scripted policy, if there is one: some episodes succeed."""
    if env_id not in SCRIPTED:
        return actions
    return np.concatenate([scripted_policy(env_id).act_batch(observation), actions[len(observation) :]])


def steps_of(env_id):
    """Steps in which scripted policies succeed, and at least two episodes of 50 steps end elsewhere."""
    return (260, {}) if env_id in SCRIPTED else (110, {"max_episode_steps": 50})


PARITY = [(env_id, {"parity": True, "rs_state_to_info": True}) for env_id, one in ENVIRONMENTS.items() if one.variants]
SAME = [(env_id, {"randomize": False}) for env_id in ONE_OF_EACH]
ALL = [*((env_id, {"randomize": True}) for env_id in ROBOTS), *SAME, *PARITY]
IDS = [f"{env_id}-{'-'.join(name for name, value in options.items() if value)}" for env_id, options in ALL]
KINDS = [one if one[0] in QUICK else pytest.param(*one, marks=pytest.mark.slow) for one in ALL]


@pytest.mark.parametrize(("env_id", "options"), KINDS, ids=IDS)
def test_a_row_is_a_single_environment_bit_for_bit(make, make_rows, actions_of, env_id, options):
    rows, seed = 2, 40
    steps, limit = steps_of(env_id)
    envs = make_rows(env_id, rows, **options, **limit)
    first, _ = envs.reset(seed=seed)
    record, observation = [], first
    for step, action in enumerate(batch(actions_of, rows, steps, size_of(envs))):
        action = doing_well(env_id, observation[:1], action) if step % 3 else action
        observation, *rest = envs.step(action)
        record.append((action, observation, *rest))
    ends = 0
    for row in range(rows):
        env = make(env_id, **options, **limit)
        np.testing.assert_array_equal(env.reset(seed=seed + row)[0], first[row])
        for action, observation, reward, terminated, truncated, infos in record:
            alone = env.step(action[row])
            assert alone[1:4] == (reward[row], terminated[row], truncated[row])
            last, said = observation[row], infos
            if alone[2] or alone[3]:
                ends += 1
                last, said = infos["final_obs"][row], infos["final_info"]
                assert infos["_final_obs"][row]
                assert infos["_final_info"][row]
                np.testing.assert_array_equal(env.reset()[0], observation[row])
            np.testing.assert_array_equal(alone[0], last)
            assert_says(said, row, alone[4])
    assert ends >= rows


def assert_says(infos, row, info):
    """What vector infos say of `row` is `info`; an ended row's own keys are those of the next episode."""
    names = [key for key in infos if not key.startswith("_") and infos["_" + key][row]]
    assert set(names) - {"final_obs", "final_info"} == set(info)
    for name, value in info.items():
        assert np.array_equal(infos[name][row], value) or infos[name][row] == value, name


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_it_speaks_like_gymnasiums_own_rows(make_rows, actions_of, env_id):
    rows = 3
    steps, limit = steps_of(env_id)
    ours = make_rows(env_id, rows, **limit)
    theirs = SyncVectorEnv(
        [lambda: gym.make(env_id, disable_env_checker=True, **limit)] * rows, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert ours.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    np.testing.assert_array_equal(ours.reset(seed=3)[0], theirs.reset(seed=3)[0])
    ends, observation = 0, ours.reset(seed=3)[0]
    for action in batch(actions_of, rows, min(steps, 210), size_of(ours)):
        action = doing_well(env_id, observation[:1], action)
        one, two = ours.step(action), theirs.step(action)
        observation = one[0]
        for left, right in zip(one[:4], two[:4], strict=True):
            np.testing.assert_array_equal(left, right)
            assert left.dtype == right.dtype
        assert_same_infos(one[4], two[4])
        ends += (one[2] | one[3]).sum()
    assert ends >= 3
    theirs.close()


def assert_same_infos(ours, theirs):
    """The same masks, and the same values where the mask says that there is one."""
    for key in set(ours) - set(theirs):
        assert not ours["_" + key.lstrip("_")].any(), key
    for key, value in theirs.items():
        if key.startswith("_"):
            np.testing.assert_array_equal(ours[key], value, err_msg=key)
        elif isinstance(value, dict):
            assert_same_infos(ours[key], value)
        else:
            for row in np.flatnonzero(theirs["_" + key]):
                np.testing.assert_array_equal(ours[key][row], value[row], err_msg=key)


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_reset_infos_are_those_of_gymnasiums_own_rows(make_rows, env_id):
    theirs = SyncVectorEnv([lambda: gym.make(env_id, disable_env_checker=True)] * 2)
    assert_same_infos(make_rows(env_id, 2).reset(seed=0)[1], theirs.reset(seed=0)[1])
    theirs.close()


@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_gymnasiums_own_rows_work(kind):
    envs = kind([lambda: gym.make("bam/pick-v0", disable_env_checker=True)] * 2)
    first, _ = envs.reset(seed=0)
    assert first.shape == (2, 18)
    observation, *_ = envs.step(envs.action_space.sample())
    assert np.isfinite(observation).all()
    envs.close()


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_seeds_are_one_a_row(make_rows, env_id):
    envs = make_rows(env_id, 3)
    together, _ = envs.reset(seed=5)
    np.testing.assert_array_equal(envs.reset(seed=[5, 6, 7])[0], together)
    np.testing.assert_array_equal(envs.reset(seed=[7, 5, 6])[0], together[[2, 0, 1]])
    assert (envs.reset()[0] != together).any() == (env_id != "bam/ur-empty-v0")  # which begins in one way only
    with pytest.raises(InvalidValue) as caught:
        envs.reset(seed=[1, 2])
    assert str(caught.value) == "seed must be one number or 3 of them, not 2."


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_rows_without_a_seed_go_on_from_their_generators(make_rows, env_id):
    envs, other = make_rows(env_id, 2), make_rows(env_id, 2)
    envs.reset(seed=0)
    other.reset(seed=0)
    np.testing.assert_array_equal(envs.reset(seed=[None, 9])[0][0], other.reset()[0][0])


@pytest.mark.parametrize("env_id", ONE_OF_EACH)
def test_some_rows_can_be_reset(make_rows, env_id):
    envs = make_rows(env_id, 3)
    envs.reset(seed=0)
    for _ in range(5):
        before, *_ = envs.step(np.ones(envs.action_space.shape, np.float32))
    np.testing.assert_array_equal(envs.unwrapped.elapsed, 5)
    after, _ = envs.reset(seed=20, options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    np.testing.assert_array_equal(after[1], envs.reset(seed=20)[0][1])
    np.testing.assert_array_equal(envs.unwrapped.elapsed, 0)


@pytest.mark.parametrize("mask", [np.array([True, False]), np.array([[True, False, True]])])
def test_a_mask_of_another_shape_is_refused(make_rows, mask):
    envs = make_rows("bam/pick-v0", 3)
    with pytest.raises(InvalidValue) as caught:
        envs.reset(options={"reset_mask": mask})
    assert str(caught.value) == f"reset_mask must have shape (3,), not {mask.shape}."


def test_bad_actions_are_refused(make_rows):
    envs = make_rows("bam/pick-v0", 3)
    with pytest.raises(ResetNeeded) as caught:
        envs.step(np.zeros((3, 5), np.float32))
    assert str(caught.value) == "No episode is running: it ended, or never began. Call reset() first."
    envs.reset(seed=0)
    with pytest.raises(InvalidValue) as caught:
        envs.step(np.zeros((5,), np.float32))
    assert str(caught.value) == "The actions must have shape (3, 5), not (5,)."
    actions = np.zeros((3, 5), np.float32)
    actions[1, 2], actions[2, 0] = np.nan, np.inf
    with pytest.raises(InvalidValue) as caught:
        envs.step(actions)
    assert str(caught.value) == "The actions must be finite; those of environments [1, 2] are not."


def without_physics(rows):
    return RobotVectorEnv(FakeRobot(rows), PickTask(rows), max_episode_steps=100)


def assert_same_steps(one, two, actions):
    for action in actions:
        left, right = one.step(action), two.step(action)
        for a, b in zip(left[:4], right[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        assert_same_infos(left[4], right[4])


@pytest.mark.parametrize("env_id", EACH)
def test_another_one_goes_on_exactly(make_rows, actions_of, env_id):
    one, two, three = (make_rows(env_id, 3, randomize=True, max_episode_steps=40) for _ in range(3))
    actions = batch(actions_of, 3, 100, size_of(one))
    one.reset(seed=11)
    for action in actions[:37]:
        observation, *_ = one.step(action)
    saved = one.unwrapped.state_dict()
    kept = copy.deepcopy(saved)
    np.testing.assert_array_equal(two.unwrapped.load_state_dict(saved), observation)
    assert_same_steps(one, two, actions[37:])
    assert_same_value(saved, kept)  # what was saved has not changed since
    three.unwrapped.load_state_dict(saved)
    assert_same_value(three.unwrapped.state_dict(), kept)
    one.unwrapped.load_state_dict(kept)
    assert_same_steps(one, three, actions[37:80])


@pytest.mark.parametrize("env_id", EACH)
def test_a_state_is_plain(make_rows, env_id):
    envs = make_rows(env_id, 2, randomize=True)
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
    json.dumps(envs.unwrapped.state_dict(), default=lambda array: np.asarray(array).tolist())


@pytest.mark.parametrize("env_id", EACH)
def test_saving_right_before_a_new_episode(make_rows, env_id):
    envs, other = make_rows(env_id, 2), make_rows(env_id, 2)
    envs.reset(seed=0)
    saved = envs.unwrapped.state_dict()
    envs.reset(seed=1)
    observation = other.unwrapped.load_state_dict(saved)
    np.testing.assert_array_equal(observation, envs.reset(seed=0)[0])


def test_without_physics_too(actions_of):
    one, two = without_physics(3), without_physics(3)
    actions = batch(actions_of, 3, 230, 5)
    one.reset(seed=0)
    for action in actions[:30]:
        one.step(action)
    two.load_state_dict(one.state_dict())
    assert_same_steps(one, two, actions[30:])


@pytest.mark.parametrize("env_id", EACH)
def test_no_number_is_ever_nan(make_rows, env_id):
    envs = make_rows(env_id, 24, randomize=True)
    envs.reset(seed=0)
    space, rng = envs.single_observation_space, np.random.default_rng(0)
    for step in range(210 if env_id == "bam/pick-v0" else 110):
        if step % 4 == 0:
            actions = rng.uniform(-2, 2, envs.action_space.shape).clip(-1, 1).astype(np.float32)
        observation, reward, *_ = envs.step(actions)
        assert np.isfinite(reward).all()
        assert (observation >= space.low).all()
        assert (observation <= space.high).all()
    for array in envs.unwrapped.state.signals.values():
        assert np.isfinite(array).all()


def test_a_time_limit_of_none_never_truncates():
    envs = RobotVectorEnv(FakeRobot(2), PickTask(2))
    envs.reset(seed=0)
    for _ in range(300):
        *_, truncated, _ = envs.step(np.zeros((2, 5), np.float32))
        assert not truncated.any()


def test_limits_of_steps_are_those_of_the_table(make_rows):
    for env_id, entry in ENVIRONMENTS.items():
        assert make_rows(env_id, 1).unwrapped.max_episode_steps == entry.time_limit


@pytest.mark.parametrize("env_id", EACH)
def test_a_pickled_environment_goes_on_as_the_first(make_rows, actions_of, env_id):
    first = make_rows(env_id, 3, randomize=True, max_episode_steps=40)
    first.reset(seed=0)
    actions = batch(actions_of, 3, 60, size_of(first))
    first.step(actions[0])
    second = pickle.loads(pickle.dumps(first))
    assert_same_steps(first, second, actions[1:])
    second.close()


def test_at_least_one_row():
    with pytest.raises(InvalidValue) as caught:
        gym.make_vec("bam/pick-v0", num_envs=0)
    assert str(caught.value) == "num_envs: expected a whole number of at least 1, found 0"
