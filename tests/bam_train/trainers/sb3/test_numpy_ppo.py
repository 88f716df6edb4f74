"""The update of PPO with NumPy: the same weights and the same log as stable-baselines3's own."""

from __future__ import annotations

import copy
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

from bam_train.trainers.sb3 import numpy_ppo
from bam_train.trainers.sb3.numpy_ppo import NumpyPPO, fits

ENV = "MountainCarContinuous-v0"
SMALL = {"n_steps": 40, "batch_size": 20, "n_epochs": 3, "seed": 3, "device": "cpu"}


def collected(kind, env=ENV, **options):
    """A model of PPO, or of ours, with a rollout of 40 steps; the rewards are those of the car, and some chance."""
    model = kind("MlpPolicy", gym.make(env), **{**SMALL, **options})
    model.set_logger(Logger(None, []))
    model.learn(0)
    collect(model, 0)
    return model


def collect(model, seed):
    torch.manual_seed(seed)
    _, callback = model._setup_learn(40, reset_num_timesteps=False)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, 40)
    chance = np.random.default_rng(seed).normal(size=(40, 1)).astype(np.float32)
    model.rollout_buffer.advantages += chance
    model.rollout_buffer.returns += chance


def update(model, seed):
    np.random.seed(seed)
    model.train()
    return torch.cat([one.detach().ravel() for one in model.policy.parameters()]).numpy()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"use_sde": True, "sde_sample_freq": 5, "ent_coef": 0.01, "policy_kwargs": {"log_std_init": -1.8}},
        {"policy_kwargs": {"activation_fn": torch.nn.ReLU, "net_arch": {"pi": [8, 9], "vf": [7]}}, "ent_coef": 0.01},
        {"policy_kwargs": {"net_arch": []}, "normalize_advantage": False, "clip_range": 0.01, "max_grad_norm": 0.01},
    ],
)
def test_the_same_data_give_the_same_weights_state_and_log(options):
    theirs, ours = collected(PPO, **options), collected(NumpyPPO, **options)
    assert fits(ours)
    for name in ("observations", "actions", "values", "log_probs", "returns"):  # computed by each
        found, wanted = (getattr(model.rollout_buffer, name) for model in (ours, theirs))
        np.testing.assert_allclose(found, wanted, atol=1e-4)
    ours.rollout_buffer = copy.deepcopy(theirs.rollout_buffer)
    before = torch.cat([one.detach().ravel() for one in ours.policy.parameters()]).numpy()
    for seed in (1, 2):  # the second goes on with the state of Adam
        wanted, found = update(theirs, seed), update(ours, seed)
        assert np.abs(wanted - before).max() > 1e-3
        assert np.abs(found - wanted).max() <= 1e-5
        log, own = theirs.logger.name_to_value, ours.logger.name_to_value
        assert {name: float(one) for name, one in own.items()} == pytest.approx(log, abs=1e-4)
        collect(theirs, seed)
        ours.rollout_buffer = copy.deepcopy(theirs.rollout_buffer)
    state, own = (model.policy.optimizer.state_dict()["state"] for model in (theirs, ours))
    for key in state:
        assert own[key]["step"] == state[key]["step"] == 12
        np.testing.assert_allclose(own[key]["exp_avg"], state[key]["exp_avg"], atol=1e-5)
        assert own[key]["exp_avg_sq"].shape == state[key]["exp_avg_sq"].shape


@pytest.mark.parametrize(
    ("options", "env"),
    [
        ({}, "CartPole-v1"),
        ({"target_kl": 0.1}, ENV),
        ({"clip_range_vf": 0.2}, ENV),
        ({"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}}, ENV),
        ({"policy_kwargs": {"optimizer_class": torch.optim.SGD}}, ENV),
        ({"policy_kwargs": {"activation_fn": torch.nn.ELU}}, ENV),
        ({"use_sde": True, "policy_kwargs": {"squash_output": True}}, ENV),
        ({"use_sde": True, "policy_kwargs": {"full_std": False}}, ENV),
    ],
)
def test_anything_else_is_updated_by_stable_baselines3(options, env, monkeypatch):
    theirs, ours = collected(PPO, env, **options), collected(NumpyPPO, env, **options)
    assert not fits(ours)
    monkeypatch.setattr(numpy_ppo, "_Update", None)
    np.testing.assert_array_equal(update(ours, 1), update(theirs, 1))


def test_it_is_made_saved_and_loaded_without_the_compiler_of_torch():
    code = f"""
import io, sys
from bam_train.trainers.sb3.numpy_ppo import NumpyPPO
model = NumpyPPO("MlpPolicy", {ENV!r}, **{SMALL!r}).learn(40)
model.save(io.BytesIO())
model.set_parameters(model.get_parameters())
print(model._n_updates, "torch._dynamo" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "3 False\n"
