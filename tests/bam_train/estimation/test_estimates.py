"""Estimates on arrays: the numbers of obp, and of episodes that can be worked out by hand."""

import json
from pathlib import Path

import numpy as np
import pytest

from bam_train.estimation.estimates import (
    doubly_robust,
    estimate_mean,
    importance_sampling,
    self_normalised,
    weights_up_to,
)


@pytest.fixture(scope="module")
def obp():
    """Bandit data and estimates of obp 0.4.1; see make_obp_reference.py."""
    plain = json.loads(Path(__file__).with_name("obp_reference.json").read_text())
    return {name: np.array(value) for name, value in plain.items()}


def test_bandit_estimates_are_those_of_obp(obp):
    n = np.arange(len(obp["reward"]))
    ratios = obp["policy"][n, obp["action"]] / obp["pscore"]
    of_states, of_actions = (obp["policy"] * obp["model"]).sum(axis=1), obp["model"][n, obp["action"]]
    assert importance_sampling(obp["reward"], ratios, n).value == pytest.approx(obp["ips"], abs=1e-9)
    assert self_normalised(obp["reward"], ratios, n).value == pytest.approx(obp["snips"], abs=1e-9)
    assert estimate_mean(of_states).value == pytest.approx(obp["dm"], abs=1e-9)
    found = doubly_robust(obp["reward"], ratios, n, of_actions, of_states, np.zeros(len(n)))
    assert found.value == pytest.approx(obp["dr"], abs=1e-9)


def test_weights_are_products_within_an_episode():
    ratios, episode = np.array([2.0, 3.0, 0.5, 4.0, 0.0]), np.array([0, 0, 0, 1, 1])
    assert weights_up_to(ratios, episode) == pytest.approx([2, 6, 3, 4, 0])


def test_two_episodes_by_hand():
    """Weights 2, 6 and 1, 0.5: IPS weighs each reward by the ratios up to it, SNIPS the whole return by all of them."""
    rewards, ratios, episode = np.array([1.0, 2.0, 4.0, 8.0]), np.array([2.0, 3.0, 1.0, 0.5]), np.array([0, 0, 1, 1])
    assert importance_sampling(rewards, ratios, episode).value == (2 + 12 + 4 + 4) / 2
    found = self_normalised(rewards, ratios, episode)
    assert found.value == pytest.approx((6 * 3 + 0.5 * 12) / 6.5)
    assert found.effective == pytest.approx(6.5**2 / (36 + 0.25))
    assert not found.is_sound


def test_a_right_model_has_no_error_to_correct():
    """Both episodes end as the model says; doubly robust is then the model's value of the starts."""
    rewards, episode = np.array([0.0, 1.0, 0.0, 1.0]), np.array([0, 0, 1, 1])
    ones, after = np.ones(4), np.array([1.0, 0.0, 1.0, 0.0])
    found = doubly_robust(rewards, np.array([5.0, 9.0, 0.1, 7.0]), episode, ones, ones, after)
    assert (found.value, found.interval) == (1.0, (1.0, 1.0))


def test_the_interval_is_that_of_the_mean():
    found = estimate_mean(np.array([0.0, 1.0] * 50))
    assert found.interval == pytest.approx((0.5 - 0.098, 0.5 + 0.098), abs=1e-4)
    assert (found.effective, found.is_sound) == (100.0, True)


def test_snips_intervals_cover_a_bandit():
    """200 data sets of 200 rounds: the truth is 0.3 · 0.8 + 0.7 · 0.4."""
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        action = rng.random(200) < 0.5
        reward = (rng.random(200) < np.where(action, 0.8, 0.4)).astype(float)
        found = self_normalised(reward, np.where(action, 0.3, 0.7) / 0.5, np.arange(200))
        covered += found.interval[0] <= 0.52 <= found.interval[1]
    assert covered >= 184
