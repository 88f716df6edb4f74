"""Bandits: tables, rewards, the best arm."""

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.local.bandits import ClassicBandit, ContextBandit, ImageBandit


@pytest.mark.parametrize("kind", [ClassicBandit, ContextBandit, ImageBandit])
def test_a_table_is_that_of_its_seed(kind):
    one, same, other = (kind(1, n_arms=7, table_seed=seed).expected for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()
    assert one.shape[1] == 7


def test_one_arm_always_wins():
    chances = ContextBandit(1, n_state=200).expected
    assert chances.shape == (200, 5)
    np.testing.assert_array_equal(chances.max(axis=1), 1.0)
    assert chances.min() > 0
    np.testing.assert_array_equal(ClassicBandit(1).expected.shape, (1, 5))


def pulled(env_id, arm_of, n=2000, **options):
    """Observations before the step, arms, rewards, successes and infos of `n` episodes."""
    envs = gym.make_vec(env_id, num_envs=n, **options)
    observation, _ = envs.reset(seed=0)
    arms = arm_of(envs.unwrapped.task)
    _, reward, terminated, truncated, infos = envs.step(arms)
    assert terminated.all()
    assert not truncated.any()
    return observation, arms, reward, infos["final_info"]


@pytest.mark.parametrize("env_id", ["bam/classic-bandit-v0", "bam/context-bandit-v0"])
def test_arms_win_as_often_as_the_table_says(env_id):
    rng = np.random.default_rng(0)
    context, arms, reward, info = pulled(env_id, lambda task: rng.integers(5, size=2000))
    chances = gym.make(env_id).unwrapped.task.expected[context, arms]
    np.testing.assert_array_equal(info["threshold"], chances)
    np.testing.assert_array_equal(reward, np.where(info["random_value"] < chances, 1, -1))
    np.testing.assert_array_equal(info["is_success"], chances == 1)
    assert abs((reward == 1).mean() - chances.mean()) < 0.03
    assert len(np.unique(context)) == (1 if "classic" in env_id else 10)


@pytest.mark.parametrize("env_id", ["bam/classic-bandit-v0", "bam/context-bandit-v0", "bam/image-bandit-v0"])
def test_the_best_arm_is_a_success(env_id):
    *_, reward, info = pulled(env_id, lambda task: task.expected[task.context].argmax(axis=1))
    assert info["is_success"].all()
    assert "image" in env_id or (reward == 1).all()


def test_rewards_of_a_picture_are_normal():
    pictures, arms, reward, info = pulled("bam/image-bandit-v0", lambda task: task.context % 5, height=2, width=4)
    assert pictures.shape == (2000, 2, 4, 1)
    assert set(np.unique(pictures)) == {0, 255}
    task = ImageBandit(1, height=2, width=4)
    context = (pictures.reshape(2000, 8) // 255) @ (1 << np.arange(8))
    np.testing.assert_array_equal(info["mean"], task.expected[context, arms])
    away = (reward - info["mean"]) / info["std"]
    assert abs(away.mean()) < 0.1
    assert abs(away.std() - 1) < 0.05
    assert 0.05 <= task.spread.min() < task.spread.max() <= 0.2


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (ClassicBandit, {"n_arms": 0}, "n_arms: expected a whole number of at least 1, found 0"),
        (ContextBandit, {"n_state": "x"}, "n_state: expected a whole number of at least 1, found 'x'"),
        (ContextBandit, {"table_seed": -1}, "table_seed: expected a whole number of at least 0, found -1"),
        (ImageBandit, {"height": 13, "width": 1}, "height * width: expected at most 12 pixels, found 13"),
    ],
)
def test_options_that_are_refused(kind, options, message):
    with pytest.raises(InvalidValue) as caught:
        kind(1, **options)
    assert str(caught.value) == message


def test_the_best_bar_is_red():
    task = ClassicBandit(1)
    reds = (task.picture()[..., 0] == 200).any(axis=0).nonzero()[0] // 24
    assert set(reds) == {task.expected[0].argmax()}
