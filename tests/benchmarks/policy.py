"""One action of a frozen policy against bare onnxruntime and stable-baselines3, interleaved in one process.

Observation array in, action array out, one observation at a time, one thread. The weights are random: only their number
matters.
"""

from dataclasses import dataclass

import numpy as np
from gymnasium import Env, spaces

from bam_envs.core.spaces import space_to_json
from bam_train.cli.flags import Count
from bam_train.errors import SettingsError
from tests.benchmarks import harness
from tests.benchmarks.harness import at_least, percentiles, timed

TURN = 20
"""Calls of one contender before it is the next one's turn."""


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    layers: tuple[Count, ...] = (64, 64)
    """Neurons of each hidden layer."""
    observation: Count = 30
    """Numbers in an observation."""
    action: Count = 5
    """Numbers in an action."""
    normalise: bool = False
    """With VecNormalize inside the frozen policy."""


class Blank(Env):
    """An environment that only has spaces."""

    def __init__(self, observation, action):
        self.observation_space, self.action_space = observation, action


def contenders(flags):
    """One policy, run in three ways."""
    import onnxruntime
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from bam_train.policy import FrozenPolicy
    from bam_train.trainers.sb3.sb3_freezing import FrozenModel

    torch.set_num_threads(1)
    observation, action = spaces.Box(-1, 1, (flags.observation,)), spaces.Box(-1, 1, (flags.action,))
    env = DummyVecEnv([lambda: Blank(observation, action)])
    normaliser = VecNormalize(env, training=False) if flags.normalise else None
    model = PPO("MlpPolicy", normaliser or env, policy_kwargs={"net_arch": list(flags.layers)}, device="cpu")
    graph = FrozenModel(model, normaliser, observation, action).onnx_file()
    frozen = FrozenPolicy.from_graph(graph, space_to_json(observation), space_to_json(action))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    x = observation.sample()
    ways = {
        "FrozenPolicy.act": lambda: frozen.act(x),
        "onnxruntime": lambda: session.run(["action"], {"observation": x[None]})[0][0],
        "SB3 predict": lambda: model.predict(normaliser.normalize_obs(x) if normaliser else x, deterministic=True)[0],
    }
    worst = max(float(np.abs(way() - ways["SB3 predict"]()).max()) for way in ways.values())
    if not worst <= 1e-5:
        raise SettingsError(f"the contenders differ by {worst:.2g}: nothing to compare")
    return ways


def measure_action(flags):
    """Time of an action."""
    ways = contenders(flags)
    for way in ways.values():
        timed(way, 200)
    turns = [{name: timed(way, TURN) for name, way in ways.items()} for _ in range(max(1, flags.times(10_000) // TURN))]
    times = {name: np.concatenate([one[name] for one in turns]) for name in ways}
    ours, small = np.median(times["FrozenPolicy.act"]), flags.layers == (64, 64)  # the goals are set for 64 x 64 only
    layers = " x ".join(map(str, flags.layers))
    yield f"{flags.observation} -> {layers} -> {flags.action}, {'' if flags.normalise else 'not '}normalised"
    for name, one in times.items():
        yield percentiles(name, one, "us", p50=30 if small and name == "FrozenPolicy.act" else None)
    for name in ("onnxruntime", "SB3 predict"):
        yield at_least(f"{name} takes, of FrozenPolicy.act", np.median(times[name]) / ours, 6 * (name[0] == "S"), "x")
