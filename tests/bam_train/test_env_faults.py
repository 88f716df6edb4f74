"""Environments that give NaN or infinity: which, of which environment, at which step."""

from __future__ import annotations

import copy
import math

import gymnasium as gym
import numpy as np
import pytest

from bam_train.env_faults import FiniteEnv, FiniteVectorEnv
from bam_train.environments import make_vector_env
from bam_train.errors import EnvironmentFailed
from bam_train.evaluation import evaluate
from bam_train.trainers.sb3.sb3_vec_env import make_training_env

CASES = [
    ({}, "observation[1] is nan at step 3 of an episode"),
    ({"at": 0}, "observation[1] is nan at step 0 of an episode"),
    ({"at": 5, "value": -math.inf}, "observation[1] is -inf at step 5 of an episode"),
    ({"nested": True, "at": 5}, "observation['b'][1] is nan at step 5 of an episode"),
    ({"signal": "reward", "value": math.inf}, "reward is inf at step 3 of an episode"),
]
REMEDY = "expected finite numbers: correct the environment"


def failure(play):
    """What is said while an environment is played."""
    with pytest.raises(EnvironmentFailed) as caught:
        play()
    return str(caught.value)


@pytest.mark.parametrize(("kwargs", "text"), CASES)
def test_one_environment(spoilt, kwargs, text):
    env = FiniteEnv(gym.make(spoilt, disable_env_checker=True, **kwargs), spoilt)

    def play():
        for _ in range(2):
            env.reset(seed=1)
            for _ in range(5):
                env.step(0)

    assert failure(play) == f"test/Spoilt-v0: {text}; {REMEDY}"


@pytest.mark.parametrize(("kwargs", "text"), CASES)
def test_rows(spoilt, kwargs, text):
    """Also in what is observed last, which the first observation of the next episode stands in for."""
    rows = FiniteVectorEnv(make_vector_env(spoilt, kwargs, 3), spoilt)

    def play():
        rows.reset(seed=1)
        for _ in range(5):
            rows.step(np.zeros(3, np.int64))

    assert failure(play) == f"test/Spoilt-v0: {text} in environment 0; {REMEDY}"


def test_what_training_of_stable_baselines3_gets(spoilt):
    venv = make_training_env(spoilt, {}, 2)
    venv.reset()
    expected = f"test/Spoilt-v0: observation[1] is nan at step 3 of an episode in environment 0; {REMEDY}"
    assert failure(lambda: [venv.step([0, 0]) for _ in range(3)]) == expected


def test_a_signal_of_ours_has_a_name(monkeypatch):
    """And its step is counted through a saved state."""
    first, second = (make_training_env("bam/reach-v0", {}, 2) for _ in range(2))
    first.reset()
    still = np.zeros((2, *first.action_space.shape), np.float32)
    first.step(still)
    second.load_state_dict(first.state_dict())
    label = second.batch.describe()["observation"][2]["name"]
    task, seen = second.batch.task, np.zeros((2, *second.observation_space.shape), np.float32)
    seen[1, 2] = np.inf
    monkeypatch.setattr(task, "observe", lambda state: seen)
    text = failure(lambda: second.step(still))
    assert text == f"bam/reach-v0: observation {label!r} is inf at step 2 of an episode in environment 1; {REMEDY}"


def test_evaluation(spoilt):
    class Still:
        def reset(self, rows=None):
            """It remembers nothing."""

        def act_batch(self, observations):
            return np.zeros(len(observations), np.int64)

    expected = f"test/Spoilt-v0: observation[1] is nan at step 3 of an episode in environment 0; {REMEDY}"
    assert failure(lambda: evaluate(Still(), spoilt, episodes=2)) == expected


def test_rows_are_otherwise_the_environments_own():
    rows = FiniteVectorEnv(make_vector_env("bam/reach-v0", {}, 2), "bam/reach-v0")
    assert rows.period == rows.unwrapped.period
    rows.reset(seed=3)
    other = copy.deepcopy(rows)
    actions = np.zeros((2, *rows.single_action_space.shape), np.float32)
    assert np.array_equal(rows.step(actions)[0], other.step(actions)[0])
    rows.reset(options={"reset_mask": np.array([True, False])})
    assert rows.episode_steps.tolist() == [0, 1]
