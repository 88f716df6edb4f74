"""RLlib writes checkpoint directories of its present API into the folder ROOT, and its own actions beside them.

``NAME.npz`` holds observations and what RLlib's own restoring (`RLModule.from_checkpoint`) does on them. It runs as
``__main__``, so that a directory holds our own classes and not their names.
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from ray.rllib.algorithms.dqn import DQNConfig
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module import EnvToModulePipeline, MeanStdFilter
from ray.rllib.connectors.module_to_env import ModuleToEnvPipeline
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModule, RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

POLICY = "learner_group/learner/rl_module/default_policy"


class Swings(gym.Env):
    """An environment that RLlib is given as a class, so that a directory does not name it."""

    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gym.spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, config=None):
        self.observation_space.seed(0)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, True, {}


class OwnModule(TorchRLModule):
    """A network that is not RLlib's."""

    def setup(self):
        self.layer = torch.nn.Linear(3, 2)

    def _forward(self, batch, **kwargs):
        return {"action_dist_inputs": torch.sin(self.layer(batch["obs"]))}


def make(folder, config, env, *, train=False, pieces=(), spec=None):
    """An algorithm, saved; and RLlib's actions."""
    runners = {"env_to_module_connector": lambda env, spaces=None, device=None: [one() for one in pieces]}
    small = {"model_config": DefaultModelConfig(fcnet_hiddens=[16, 16])}
    config = (
        config.environment(env)
        .env_runners(num_env_runners=0, **(runners if pieces else {}))
        .learners(num_learners=0)
        .rl_module(**({"rl_module_spec": spec} if spec else small))
        .debugging(seed=0, log_level="ERROR")
    )
    gym.registry.pop("rllib-single-agent-env-v0", None)  # RLlib registers it every time
    algorithm = config.build_algo()
    if train:
        algorithm.train()
    algorithm.save_to_path(folder)
    algorithm.stop()
    if not any(Path(algorithm.logdir).iterdir()):
        Path(algorithm.logdir).rmdir()
    observations, actions = acted(folder)
    np.savez(f"{folder}.npz", observation=observations, action=actions)


def acted(folder):
    module = RLModule.from_checkpoint(f"{folder}/{POLICY}")
    before = EnvToModulePipeline.from_checkpoint(f"{folder}/env_runner/env_to_module_connector")
    after = ModuleToEnvPipeline.from_checkpoint(f"{folder}/env_runner/module_to_env_connector")
    for piece in before.connectors:
        piece._update_stats = False
    space, actions = before.input_observation_space, []
    space.seed(1)
    observations = [space.sample() for _ in range(100)]
    for one in observations:
        episode = SingleAgentEpisode(
            observations=[one], observation_space=space, action_space=before.input_action_space
        )
        given = {"rl_module": module, "episodes": [episode], "explore": False, "shared_data": {}}
        batch = after(batch=module.forward_inference(before(batch={}, **given)), **given)
        actions.append(batch.get("actions_for_env", batch["actions"])[0])
    return np.stack(observations), np.stack(actions)


if __name__ == "__main__":
    root = globals()["ROOT"]
    ppo = PPOConfig().training(minibatch_size=50, num_epochs=1, train_batch_size_per_learner=100)
    make(f"{root}/ppo", ppo, "Pendulum-v1", train=True, pieces=[MeanStdFilter])
    make(f"{root}/dqn", DQNConfig(), "CartPole-v1")
    make(f"{root}/own", PPOConfig(), Swings, spec=RLModuleSpec(module_class=OwnModule))
