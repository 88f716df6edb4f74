"""A policy that draws its actions: about the best ones, inside the action space, the same for a seed."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from ray.rllib.algorithms.ppo import PPOConfig

from bam_envs.core.spaces import space_to_json
from bam_train.errors import SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.trainers.rllib.rllib_freezing import FrozenModule, RLlibPolicy, parts_of

OBSERVED = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
ACTED = gym.spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 4.0], np.float32))
SEEN = np.array([0.1, -0.5, 0.3], np.float32)


def made(**model):
    """Module and configuration."""
    config = PPOConfig().environment(observation_space=OBSERVED, action_space=ACTED)
    config.rl_module(model_config={"fcnet_hiddens": [8], **model})
    torch.manual_seed(0)  # its weights; what ran before has drawn from the same generator
    return config.get_rl_module_spec(spaces={"default_policy": (OBSERVED, ACTED)}).build(), config


def drawn(policy, count, seed):
    torch.manual_seed(seed)
    return np.array([policy.act(SEEN) for _ in range(count)])


def test_actions_are_drawn_about_the_best_one_and_stay_inside():
    module, config = made()
    policy = RLlibPolicy(module, None, config, (OBSERVED, ACTED), explore=True)
    policy.reset()
    actions = drawn(policy, 300, seed=1)
    assert actions.dtype == np.float32
    assert ((ACTED.low <= actions) & (actions <= ACTED.high)).all()
    assert (actions.std(axis=0) > 0.5).all()
    graph = FrozenModule(parts_of(module, None, config, (OBSERVED, ACTED))).onnx_file()
    frozen = FrozenPolicy.from_graph(graph, space_to_json(OBSERVED), space_to_json(ACTED))
    np.testing.assert_allclose(actions.mean(axis=0), frozen.act(SEEN), atol=0.4)


def test_a_seed_gives_the_same_actions_though_the_trainer_goes_on():
    module, config = made()
    policy = RLlibPolicy(module, None, config, (OBSERVED, ACTED), explore=True)
    first = drawn(policy, 4, seed=3)
    with torch.no_grad():
        for value in module.parameters():
            value.add_(1.0)
    np.testing.assert_array_equal(drawn(policy, 4, seed=3), first)


def test_a_recurrent_policy_is_refused():
    module, config = made(use_lstm=True)
    with pytest.raises(SettingsError, match="a recurrent policy cannot explore here"):
        RLlibPolicy(module, None, config, (OBSERVED, ACTED), explore=True)
