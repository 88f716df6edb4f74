"""Our vector environments, as stable-baselines3 takes them."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import DummyVecEnv

from bam_train.errors import SettingsError
from bam_train.trainers.sb3.sb3_vec_env import BatchVecEnv, make_training_env


def right(venv):
    return np.ones((venv.num_envs, 1), np.float32)


def play(venv, steps):
    """Step to the right; every result."""
    return [venv.step(right(venv)) for _ in range(steps)]


def test_the_end_of_an_episode_in_the_words_of_stable_baselines3(rows):
    venv = BatchVecEnv(rows(2))
    venv.seed(3)
    first = venv.reset()
    starts = [np.random.default_rng(3 + row).uniform(-0.5, 0.5) for row in range(2)]
    assert first[:, 0] == pytest.approx(starts)
    results = play(venv, 6)
    ends = [next(i for i, result in enumerate(results) if result[2][row]) for row in range(2)]
    for row, (start, end) in enumerate(zip(starts, ends, strict=True)):
        steps = int(np.floor((1 - start) / 0.3)) + 1
        info = results[end][3][row]
        assert end + 1 == steps
        assert info["TimeLimit.truncated"] is False
        assert info["is_success"] is True
        assert info["terminal_observation"][0] == pytest.approx(start + 0.3 * steps, abs=1e-6)
        assert info["episode"]["l"] == steps
        assert info["episode"]["r"] == pytest.approx(sum(start + 0.3 * (i + 1) for i in range(steps)))
        assert abs(results[end][0][row, 0]) <= 0.5
        assert all(result[3][row] == {} for result in results[:end])


def test_the_time_limit_is_a_truncation(rows):
    venv = BatchVecEnv(rows(1))
    venv.reset()
    results = [venv.step(np.zeros((1, 1), np.float32)) for _ in range(12)]
    assert [bool(result[2][0]) for result in results] == [False] * 11 + [True]
    assert results[-1][3][0]["TimeLimit.truncated"] is True
    assert results[-1][3][0]["is_success"] is False
    assert results[-1][3][0]["episode"]["l"] == 12


def test_types_and_copies(rows):
    venv = BatchVecEnv(rows(3))
    observations = [venv.reset()]
    observation, reward, done, infos = venv.step(right(venv))
    observations.append(observation)
    assert (observation.dtype, observation.shape) == (np.float32, (3, 2))
    assert (reward.dtype, done.dtype, len(infos)) == (np.float32, bool, 3)
    assert not np.shares_memory(*observations)
    assert not np.array_equal(*observations)


def test_a_seed_is_used_once(rows):
    venv = BatchVecEnv(rows(2))
    venv.seed(5)
    first, second = venv.reset(), venv.reset()
    venv.seed(5)
    assert np.array_equal(venv.reset(), first)
    assert not np.array_equal(first, second)


def test_a_saved_state_goes_on_exactly(rows):
    venv, other = BatchVecEnv(rows(3)), BatchVecEnv(rows(3))
    venv.seed(1)
    venv.reset()
    play(venv, 2)
    other.load_state_dict(venv.state_dict())
    for one, two in zip(play(venv, 8), play(other, 8), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one[:3], two[:3], strict=True))
        assert [info.get("episode") for info in one[3]] == [info.get("episode") for info in two[3]]


def test_dictionaries_of_observations_are_copied_by_key(rows):
    class Keyed(rows):
        def __init__(self):
            super().__init__(2)
            self.single_observation_space = gym.spaces.Dict({"x": self.single_observation_space})

        def _observe(self):
            return {"x": super()._observe().copy()}

    venv = BatchVecEnv(Keyed())
    observations = venv.reset()
    found, _, _, infos = venv.step(right(venv))
    assert observations["x"].shape == found["x"].shape == (2, 2)
    assert not np.shares_memory(observations["x"], found["x"])
    assert infos == [{}, {}]


def test_environments_that_cannot_be_adapted(rows):
    late, shifted = rows(1), rows(1)
    late.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    shifted.single_action_space = gym.spaces.Discrete(3, start=1)
    with pytest.raises(SettingsError, match=r"expected autoreset mode SAME_STEP, found AutoresetMode\.NEXT_STEP"):
        BatchVecEnv(late)
    with pytest.raises(SettingsError, match=r"expected actions that count from 0, found Discrete\(3, start=1\)$"):
        BatchVecEnv(shifted)


def test_one_value_for_all_rows(rows):
    venv = BatchVecEnv(rows(3))
    assert venv.get_attr("num_envs") == [3, 3, 3]
    venv.set_attr("mark", 7)
    assert venv.get_attr("mark", indices=[1]) == [7]
    assert venv.env_method("state_dict", indices=0)[0]["elapsed"].tolist() == [0, 0, 0]
    assert venv.env_is_wrapped(gym.Wrapper) == [False] * 3


def test_other_environments_take_turns(corridor):
    venv = make_training_env(corridor, {}, 2)
    assert isinstance(venv, DummyVecEnv)
    venv.reset()
    done = [venv.step([1, 1]) for _ in range(3)][-1]
    assert done[3][0]["is_success"] in (True, False)
    venv.close()


def test_rows_that_somebody_else_used_begin_anew(rows):
    venv = BatchVecEnv(rows(2))
    venv.seed(3)
    first = venv.reset()
    venv.step(right(venv))
    last = venv.step(right(venv))[0]
    assert venv.can_be_saved
    venv.batch.reset(seed=[100, 101])  # an evaluation
    venv.interrupt(last)
    venv.seed(3)
    observations, rewards, done, infos = venv.step(right(venv))
    np.testing.assert_array_equal(observations, first)
    assert (rewards.tolist(), done.tolist()) == ([0.0, 0.0], [True, True])
    for row in range(2):
        assert sorted(infos[row]) == ["TimeLimit.truncated", "terminal_observation"]
        assert infos[row]["TimeLimit.truncated"] is True
        np.testing.assert_array_equal(infos[row]["terminal_observation"], last[row])
    assert not venv.step(right(venv))[2].any()
