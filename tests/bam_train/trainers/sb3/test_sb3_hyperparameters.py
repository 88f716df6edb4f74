"""Hyperparameters against the constructors of stable-baselines3."""

from __future__ import annotations

import copy
import inspect
import json
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecNormalize

from bam_train.errors import SettingsError
from bam_train.trainers.algorithms import SB3_ALGORITHMS
from bam_train.trainers.library_arguments import Other, as_written, parameters, table
from bam_train.trainers.sb3.sb3_model import build
from bam_train.trainers.sb3_hyperparameters import (
    NORMALISER,
    check_pictures,
    complete,
    complete_normalize,
    default_policy,
)

NUMBERS = gym.spaces.Box(-1, 1, (3,))
IMAGE = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)
SMALL = gym.spaces.Box(0, 255, (35, 48, 3), np.uint8)
CHOICE = gym.spaces.Discrete(3)
SEVERAL = gym.spaces.Dict(front=IMAGE, k=CHOICE, x=NUMBERS)


@pytest.mark.parametrize("name", SB3_ALGORITHMS)
def test_arguments_in_the_source_are_those_of_the_classes(name):
    kind, reference = SB3_ALGORITHMS[name].load(), SB3_ALGORITHMS[name].reference
    pairs = [(kind, reference), (VecNormalize, NORMALISER)]
    policies = table(reference, "policy_aliases")
    assert [*policies] == [*kind.policy_aliases]
    pairs += [(kind.policy_aliases[policy], where) for policy, where in policies.items()]
    for one, where in pairs:
        known, found = inspect.signature(one.__init__).parameters, parameters(where)
        assert [*found] == [*known]
        for argument in known.keys() - {"env", "venv", "device", "observation_space", "action_space", "action_noise"}:
            assert as_written(found[argument].annotation) == as_written(known[argument].annotation)
            assert found[argument].default in (known[argument].default, Other)


def test_a_class_without_a_source_is_imported(monkeypatch):
    with pytest.raises(ModuleNotFoundError, match="No module named 'no_library'"):
        parameters("no_library:Kind")
    module, ours = ModuleType("made_here"), type("Ours", (PPO,), {"__init__": lambda self, policy, decay=0.5: None})
    module.Ours = ours
    module.__spec__ = ModuleSpec("made_here", None, origin="/nowhere/made_here.py")
    monkeypatch.setitem(sys.modules, "made_here", module)
    assert parameters("made_here:Ours")["decay"].default == 0.5
    policies = table("made_here:Ours", "policy_aliases")
    assert policies["MlpPolicy"] == "stable_baselines3.common.policies:ActorCriticPolicy"


def test_annotations_are_read_without_what_they_import(tmp_path, monkeypatch):
    taken = "self, a: 'int | None' = None, b: type[th.nn.Module] = th.nn.ReLU, c: Wave = 2"
    (tmp_path / "no_torch_here.py").write_text(f"class Kind:\n    def __init__({taken}): ...")
    monkeypatch.syspath_prepend(tmp_path)
    found = parameters("no_torch_here:Kind")
    hints = [as_written(found[name].annotation) for name in "abc"]
    assert (hints, [found[name].default for name in "abc"]) == ([int | None, str, Other], [None, Other, 2])
    assert "no_torch_here" not in sys.modules


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
        (
            "ppo",
            {"normalize": True},
            "normalize is not a hyperparameter here: it is a setting of the run; give it beside the hyperparameters, "
            "not among them",
        ),
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
        ("ppo", {"learning_rate": 0}, "learning_rate: expected a number above 0, found 0"),
        ("ppo", {"learning_rate": "lin_0"}, "learning_rate: expected a number above 0, found 0.0"),
        ("ppo", {"learning_rate": float("nan")}, "learning_rate: expected a number above 0, found nan"),
        ("ppo", {"n_steps": 0}, "n_steps: expected a whole number of at least 1, found 0"),
        ("td3", {"train_freq": [0, "step"]}, "train_freq: expected a whole number of at least 1, found 0"),
        ("sac", {"learning_starts": -1}, "learning_starts: expected a number of at least 0, found -1"),
        (
            "ppo",
            {"policy": "CnnPolicy"},
            "policy: CnnPolicy is for images, uint8 from 0 to 255, found float32 (3,). Leave policy out",
        ),
        (
            "dqn",
            {"policy": "MultiInputPolicy"},
            "policy: MultiInputPolicy is for a Dict of observations, found float32 (3,). Leave policy out",
        ),
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


@pytest.mark.parametrize(
    ("space", "policy", "text"),
    [
        (SMALL, "CnnPolicy", "images of at least 36 pixels along the shorter side, found uint8 (35, 48, 3)"),
        (SEVERAL, "MlpPolicy", "a single observation, found a Dict of front, k, x"),
    ],
)
def test_a_policy_for_other_observations(space, policy, text):
    with pytest.raises(SettingsError) as caught:
        complete(SB3_ALGORITHMS["ppo"], {"policy": policy}, space)
    assert str(caught.value) == f"policy: {policy} is for {text}. Leave policy out"


def test_an_own_extractor_makes_other_observations_fit():
    own = {"policy": "CnnPolicy", "policy_kwargs": {"features_extractor_class": "FlattenExtractor"}}
    assert complete(SB3_ALGORITHMS["ppo"], own, NUMBERS)["policy"] == "CnnPolicy"


@pytest.mark.parametrize(
    ("given", "space", "expected"),
    [
        (False, NUMBERS, False),
        (True, NUMBERS, {"gamma": 0.9}),
        (True, IMAGE, {"gamma": 0.9, "norm_obs": False}),
        (True, CHOICE, {"gamma": 0.9, "norm_obs": False}),
        (True, SEVERAL, {"gamma": 0.9, "norm_obs_keys": ["x"]}),
        (True, gym.spaces.Dict(a=NUMBERS, b=NUMBERS), {"gamma": 0.9}),
        ({"norm_reward": False, "gamma": 0.5}, NUMBERS, {"gamma": 0.5, "norm_reward": False}),
        ({"norm_obs_keys": ["front", "x"]}, SEVERAL, {"gamma": 0.9, "norm_obs_keys": ["front", "x"]}),
    ],
)
def test_normalize(given, space, expected):
    assert complete_normalize(given, 0.9, space) == expected


@pytest.mark.parametrize(
    ("given", "space", "text"),
    [
        ({"norm_rewards": False}, NUMBERS, "Unknown normalize argument 'norm_rewards'. Did you mean 'norm_reward'?"),
        (
            {"clip_obs": 5.0},
            SEVERAL,
            "normalize: observation 'k' is Discrete(3), which cannot be normalised; "
            "give --set normalize.norm_obs_keys='[\"x\"]'",
        ),
        (
            {"norm_obs_keys": ["y"]},
            SEVERAL,
            "normalize.norm_obs_keys: there is no observation 'y'. Choose from: front, k, x.",
        ),
        (
            {"norm_obs_keys": ["x"]},
            NUMBERS,
            "normalize.norm_obs_keys: is for a Dict of observations, and there is one; leave it out",
        ),
        (
            {"clip_obs": 5.0},
            IMAGE,
            "normalize: the observation is uint8 (36, 36, 3), which cannot be normalised; "
            "give --set normalize.norm_obs=false",
        ),
    ],
)
def test_what_cannot_be_normalised_is_one_line(given, space, text):
    with pytest.raises(SettingsError) as caught:
        complete_normalize(given, 0.9, space)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("space", "what"),
    [
        (gym.spaces.Text(3), "the observation is a Text"),
        (gym.spaces.Dict(x=NUMBERS, note=gym.spaces.Text(3)), "observation 'note' is a Text"),
        (gym.spaces.Tuple([NUMBERS, CHOICE]), "the observation is a Tuple"),
        (gym.spaces.Sequence(CHOICE), "the observation is a Sequence"),
    ],
)
def test_the_line_about_observations(space, what):
    with pytest.raises(SettingsError) as caught:
        SB3_ALGORITHMS["ppo"].require_observations("My-v0", space)
    kinds = "Box, Discrete, MultiDiscrete or MultiBinary, or a Dict of them"
    remedy = "Leave it out, or turn it into numbers, in the environment"
    assert str(caught.value) == f"ppo does not fit My-v0: {what}, expected {kinds}. {remedy}"
    for fits in (NUMBERS, SEVERAL):
        SB3_ALGORITHMS["ppo"].require_observations("My-v0", fits)


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
    assert check_pictures(SMALL) == []
    expected = r"^observation 'a' is a picture of shape \(35, 48, 3\): expected at least 36 pixels along the shorter "
    with pytest.raises(SettingsError, match=expected):
        check_pictures(gym.spaces.Dict(a=SMALL))
