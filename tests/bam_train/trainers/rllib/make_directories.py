"""Run with a folder and an API, new or old: RLlib writes checkpoint directories, and its own actions beside them.

In a process of its own, so that the tests neither start Ray nor import RLlib for them. ``NAME.npz`` holds observations
and what RLlib's own restoring (`RLModule.from_checkpoint`, `Policy.from_checkpoint`) does on them.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import ray
import torch
from ray import cloudpickle
from ray.actor import _modify_class
from ray.rllib.algorithms.dqn import DQNConfig
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.connectors.env_to_module import EnvToModulePipeline, FlattenObservations, MeanStdFilter
from ray.rllib.connectors.module_to_env import ModuleToEnvPipeline
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModule, RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.policy.policy import Policy
from ray.rllib.utils.policy import local_policy_inference
from ray.tune.trainable import trainable

ROWS = 100
POLICY = "learner_group/learner/rl_module/default_policy"
SMALL = {"fcnet_hiddens": [16, 16]}
BUFFER = {"type": "MultiAgentPrioritizedReplayBuffer", "capacity": 100, "no_local_replay_buffer": True}


class Several(gym.Env):
    """Observations of several kinds; it never does anything."""

    observation_space = gym.spaces.Dict(
        {
            "b": gym.spaces.Box(-1, 1, (2, 2), np.float32),
            "a": gym.spaces.Discrete(3),
            "c": gym.spaces.MultiDiscrete([2, 3]),
        }
    )
    action_space = gym.spaces.Box(np.array([-1, 0], np.float32), np.array([1, 5], np.float32))

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


def new(folder, config, env, *, steps=0, pieces=(), spec=None):
    """An algorithm of the current API, with RLlib's actions."""
    connectors = [piece() for piece in pieces]
    runners = {"env_to_module_connector": lambda env, spaces=None, device=None: connectors} if pieces else {}
    config = (
        config.environment(env)
        .env_runners(num_env_runners=0, **runners)
        .learners(num_learners=0)
        .rl_module(**({"rl_module_spec": spec} if spec else {"model_config": DefaultModelConfig(**SMALL)}))
        .debugging(seed=0, log_level="ERROR")
    )
    algorithm = config.build_algo()
    if steps:
        algorithm.train()
    algorithm.save_to_path(str(folder))
    algorithm.stop()
    if spec is None:
        write(folder, *new_actions(folder))


def new_actions(folder):
    module = RLModule.from_checkpoint(f"{folder}/{POLICY}")
    before = EnvToModulePipeline.from_checkpoint(f"{folder}/env_runner/env_to_module_connector")
    after = ModuleToEnvPipeline.from_checkpoint(f"{folder}/env_runner/module_to_env_connector")
    for piece in before.connectors:
        piece._update_stats = False
    space, actions = before.input_observation_space, []
    observations = draw(space)
    for one in observations:
        episode = SingleAgentEpisode(
            observations=[one], observation_space=space, action_space=before.input_action_space
        )
        given = {"rl_module": module, "episodes": [episode], "explore": False, "shared_data": {}}
        batch = after(batch=module.forward_inference(before(batch={}, **given)), **given)
        actions.append(batch.get("actions_for_env", batch["actions"])[0])
    return observations, actions


def tuned(folder, copy):
    """The same as Ray Tune saves it: it runs an algorithm as an actor, whose class is pickled with all its code."""
    shutil.copytree(folder, copy)
    path = Path(copy, "class_and_ctor_args.pkl")
    given = cloudpickle.loads(path.read_bytes())
    path.write_bytes(cloudpickle.dumps({**given, "class": _modify_class(given["class"])}))


def old(folder, config, env, *, steps=0, **runners):
    """An algorithm of the old API, with RLlib's actions."""
    config = (
        config.api_stack(enable_rl_module_and_learner=False, enable_env_runner_and_connector_v2=False)
        .environment(env)
        .env_runners(num_env_runners=0, **runners)
        .framework("torch")
        .debugging(seed=0, log_level="ERROR")
    )
    algorithm = config.build_algo()
    if steps:
        algorithm.train()
    algorithm.save(str(folder))
    algorithm.stop()
    policy = Policy.from_checkpoint(f"{folder}/policies/default_policy")
    policy.agent_connectors.in_eval()
    observations = draw(gym.make(env).observation_space)
    actions = [local_policy_inference(policy, "e", "a", one, explore=False)[0][0] for one in observations]
    write(folder, observations, actions)


def draw(space):
    space.seed(1)
    return [space.sample() for _ in range(ROWS)]


def write(folder, observations, actions):
    if isinstance(observations[0], dict):
        arrays = {f"observation.{key}": np.stack([one[key] for one in observations]) for key in observations[0]}
    else:
        arrays = {"observation": np.stack(observations)}
    np.savez(f"{folder}.npz", **arrays, action=np.stack(actions))


PPO = {"minibatch_size": 50, "num_epochs": 1}


def all_new(root):
    batch = {"train_batch_size_per_learner": 100}
    new(f"{root}/ppo", PPOConfig().training(**PPO, **batch), "Pendulum-v1", steps=100, pieces=[MeanStdFilter])
    pieces = [FlattenObservations, MeanStdFilter]
    new(f"{root}/several", PPOConfig().training(**PPO, **batch), Several, steps=100, pieces=pieces)
    new(f"{root}/sac", SACConfig(), "Pendulum-v1")
    tuned(f"{root}/sac", f"{root}/tuned")
    new(f"{root}/dqn", DQNConfig(), "CartPole-v1")
    new(f"{root}/own", PPOConfig(), "Pendulum-v1", spec=RLModuleSpec(module_class=OwnModule))


def all_old(root):
    model = {"fcnet_hiddens": [16, 16]}
    filtered = {"observation_filter": "MeanStdFilter", "rollout_fragment_length": 100}
    old(
        f"{root}/ppo-old",
        PPOConfig().training(**PPO, train_batch_size=100, model=model),
        "Pendulum-v1",
        steps=1,
        **filtered,
    )
    sac = {"policy_model_config": model, "q_model_config": model}
    old(f"{root}/sac-old", SACConfig().training(replay_buffer_config=dict(BUFFER), **sac), "Pendulum-v1")
    dqn = {"model": model, "hiddens": [16]}
    old(f"{root}/dqn-old", DQNConfig().training(replay_buffer_config=dict(BUFFER), **dqn), "CartPole-v1")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        trainable.DEFAULT_STORAGE_PATH = folder  # else ~/ray_results
        ray.init("local", include_dashboard=False, log_to_driver=False, logging_level="error", num_cpus=1)
        {"new": all_new, "old": all_old}[sys.argv[2]](sys.argv[1])
        ray.shutdown()
