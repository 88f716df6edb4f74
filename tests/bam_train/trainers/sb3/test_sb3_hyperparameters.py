"""Hyperparameters against the constructors of stable-baselines3."""

from __future__ import annotations

import copy
import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

from bam_train.errors import SettingsError
from bam_train.trainers.algorithms import SB3_ALGORITHMS
from bam_train.trainers.sb3.sb3_hyperparameters import (
    build,
    check_pictures,
    complete,
    complete_normalize,
    default_policy,
)

NUMBERS = gym.spaces.Box(-1, 1, (3,))
IMAGE = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)


@pytest.mark.parametrize("name", SB3_ALGORITHMS)
def test_defaults_are_json_and_complete_twice_is_once(name):
    values = complete(SB3_ALGORITHMS[name], {}, NUMBERS)
    assert json.loads(json.dumps(values)) == values
    assert complete(SB3_ALGORITHMS[name], values, NUMBERS) == values
    assert not {"env", "seed", "device", "verbose", "tensorboard_log"} & values.keys()


@pytest.mark.parametrize(
    ("name", "space", "policy"),
    [
        ("ppo", NUMBERS, "MlpPolicy"),
        ("dqn", IMAGE, "CnnPolicy"),
        ("sac", gym.spaces.Dict({"a": NUMBERS}), "MultiInputPolicy"),
        ("recurrent-ppo", NUMBERS, "MlpLstmPolicy"),
        ("recurrent-ppo", gym.spaces.Dict({"a": IMAGE}), "MultiInputLstmPolicy"),
        ("ppo", gym.spaces.Discrete(3), "MlpPolicy"),
    ],
)
def test_the_policy_fits_what_is_observed(name, space, policy):
    assert default_policy(SB3_ALGORITHMS[name], space) == policy


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("ppo", {"lerning_rate": 1}, "Unknown ppo hyperparameter 'lerning_rate'. Did you mean 'learning_rate'?"),
        ("ppo", {"step": 1}, "Unknown ppo hyperparameter 'step'. Did you mean 'steps'?"),
        ("ppo", {"batch_size": 1.5}, "batch_size: expected a whole number, found 1.5"),
        ("ppo", {"seed": 1}, "seed is not a hyperparameter here: use --seed"),
        ("sac", {"verbose": 1}, "verbose is not a hyperparameter here: bam-train takes care of it"),
        ("dqn", {"policy": "MlpPolcy"}, "policy: unknown policy 'MlpPolcy' of dqn. Did you mean 'MlpPolicy'?"),
        (
            "ppo",
            {"policy_kwargs": {"net_arc": [8]}},
            "Unknown policy_kwargs argument 'net_arc'. Did you mean 'net_arch'?",
        ),
        (
            "ppo",
            {"policy_kwargs": {"net_arch": ["a"]}},
            "policy_kwargs.net_arch: expected a list of whole numbers or a table of lists of whole numbers, "
            "found ['a']",
        ),
        (
            "ppo",
            {"policy_kwargs": {"activation_fn": "tan"}},
            "policy_kwargs.activation_fn: unknown 'tan'. Did you mean 'tanh'?",
        ),
        (
            "td3",
            {"action_noise": "pink_0.1"},
            'action_noise: expected "normal_0.1" or "ornstein-uhlenbeck_0.1", found \'pink_0.1\'',
        ),
        ("ppo", {"gamma": 1.5}, "gamma: expected a number from 0 to 1, found 1.5"),
        ("sac", {"tau": 2}, "tau: expected a number from 0 to 1, found 2"),
        ("ppo", {"learning_rate": 0}, "learning_rate: expected a number above 0, found 0"),
        ("ppo", {"learning_rate": "lin_0"}, "learning_rate: expected a number above 0, found 0.0"),
        ("ppo", {"learning_rate": float("nan")}, "learning_rate: expected a number above 0, found nan"),
        ("ppo", {"n_steps": 0}, "n_steps: expected a whole number of at least 1, found 0"),
        ("ppo", {"batch_size": -4}, "batch_size: expected a whole number of at least 1, found -4"),
        ("td3", {"train_freq": [0, "step"]}, "train_freq: expected a whole number of at least 1, found 0"),
        ("sac", {"learning_starts": -1}, "learning_starts: expected a number of at least 0, found -1"),
    ],
)
def test_what_does_not_fit_is_one_line(name, given, message):
    with pytest.raises(SettingsError) as caught:
        complete(SB3_ALGORITHMS[name], given, NUMBERS)
    assert str(caught.value) == message


def test_build_makes_objects_and_changes_nothing():
    given = {"learning_rate": "lin_3e-4", "policy_kwargs": {"activation_fn": "Tanh", "net_arch": [8]}}
    values = complete(SB3_ALGORITHMS["ppo"], given, NUMBERS)
    before = copy.deepcopy(values)
    arguments = build(values, gym.spaces.Discrete(2))
    assert values == before
    assert arguments["policy_kwargs"]["activation_fn"] is torch.nn.Tanh
    assert arguments["learning_rate"](1.0) == 3e-4
    assert arguments["learning_rate"](0.25) == pytest.approx(0.75e-4)
    assert arguments["learning_rate"](0.0) == 0.0


def test_build_makes_tuples_and_noise():
    given = {"train_freq": [2, "episode"], "action_noise": "normal_0.25"}
    arguments = build(complete(SB3_ALGORITHMS["td3"], given, NUMBERS), gym.spaces.Box(-1, 1, (2,)))
    assert arguments["train_freq"] == (2, "episode")
    assert isinstance(arguments["action_noise"], NormalActionNoise)
    assert arguments["action_noise"]._sigma.tolist() == [0.25, 0.25]
    noisy = complete(SB3_ALGORITHMS["td3"], {"action_noise": "ornstein-uhlenbeck_0.1"}, NUMBERS)
    assert isinstance(build(noisy, gym.spaces.Box(-1, 1, (2,)))["action_noise"], OrnsteinUhlenbeckActionNoise)


def test_normalize():
    assert complete_normalize(False, 0.9) is False
    assert complete_normalize(True, 0.9) == {"gamma": 0.9}
    assert complete_normalize({"norm_reward": False, "gamma": 0.5}, 0.9) == {"gamma": 0.5, "norm_reward": False}
    with pytest.raises(
        SettingsError, match=r"^Unknown normalize argument 'norm_rewards'\. Did you mean 'norm_reward'\?$"
    ):
        complete_normalize({"norm_rewards": False}, 0.9)


def test_the_line_about_actions_names_what_fits():
    with pytest.raises(SettingsError) as caught:
        SB3_ALGORITHMS["dqn"].require_actions("bam/pick-v0", "Box")
    assert str(caught.value) == (
        "dqn does not fit bam/pick-v0: it takes Discrete actions, found Box. "
        "Use one of: a2c, crossq, ddpg, ppo, recurrent-ppo, sac, td3, tqc, trpo."
    )


def test_schedules_and_auto_are_in_range():
    values = complete(SB3_ALGORITHMS["sac"], {"learning_rate": "lin_1e-3", "ent_coef": "auto_0.1"}, NUMBERS)
    assert (values["learning_rate"], values["ent_coef"]) == ("lin_1e-3", "auto_0.1")


def picture(dtype, *shape):
    return gym.spaces.Box(0, 255 if dtype == np.uint8 else 1, shape, dtype)


def test_pictures_that_are_none_for_the_library():
    fine = gym.spaces.Dict(front=picture(np.uint8, 64, 48, 3), wrist=picture(np.uint8, 3, 48, 64))
    assert check_pictures(fine) == []
    told = "is learnt as plain numbers: a picture for a convolutional network is uint8 from 0 to 255"
    assert check_pictures(picture(np.float32, 64, 48, 3)) == [f"the observation, float32 of shape (64, 48, 3), {told}"]
    odd = gym.spaces.Dict(front=picture(np.uint8, 64, 3, 48))
    expected = r"observation 'front' is a picture of shape \(64, 3, 48\): expected \(height, width, channels\) or "
    with pytest.raises(SettingsError, match=expected):
        check_pictures(odd)
