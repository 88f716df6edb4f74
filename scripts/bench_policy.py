"""Time one action of a frozen policy against bare onnxruntime and stable-baselines3, interleaved in one process.

Observation array in, action array out, one observation at a time, one thread. The weights are random: only their number
matters. Compare ratios; the times are this machine's, now.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy and torch read it

TARGET_P50 = 30.0  # microseconds
TARGET_RATIO = 6.0
ROUND = 20  # calls of one contender before it is the next one's turn


def main() -> None:
    """Read the options, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layers", type=int, nargs="+", default=[64, 64], help="neurons of each hidden layer")
    parser.add_argument("--observation", type=int, default=30, help="numbers in an observation")
    parser.add_argument("--action", type=int, default=5, help="numbers in an action")
    parser.add_argument("--normalise", action="store_true", help="with VecNormalize inside the frozen policy")
    parser.add_argument("--calls", type=int, default=10_000, help="timed calls of each contender")
    options = parser.parse_args()
    if min(*options.layers, options.observation, options.action, options.calls) < 1:
        parser.error("every number must be at least 1")
    report(measure(contenders(options), options.calls), options)


def contenders(options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """Build one policy, three ways to run it."""
    import numpy as np
    import onnxruntime
    import torch
    from gymnasium import spaces
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from bam_envs.core.spaces import space_to_json
    from bam_train.policy import FrozenPolicy
    from bam_train.trainers.sb3.sb3_freezing import freeze

    torch.set_num_threads(1)
    observation, action = spaces.Box(-1, 1, (options.observation,)), spaces.Box(-1, 1, (options.action,))
    env = blank(observation, action)
    normaliser = VecNormalize(env, training=False) if options.normalise else None
    model = PPO("MlpPolicy", normaliser or env, policy_kwargs={"net_arch": options.layers}, device="cpu")
    graph = freeze(model, normaliser, observation, action)
    frozen = FrozenPolicy.from_graph(graph, space_to_json(observation), space_to_json(action))
    session_options = onnxruntime.SessionOptions()
    session_options.intra_op_num_threads = session_options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph, session_options, providers=["CPUExecutionProvider"])

    def predict(x: Any) -> Any:
        return model.predict(normaliser.normalize_obs(x) if normaliser else x, deterministic=True)[0]

    ways: dict[str, Callable[[Any], Any]] = {
        "FrozenPolicy.act": frozen.act,
        "onnxruntime": lambda x: session.run(["action"], {"observation": x[None]})[0][0],
        "SB3 predict": predict,
    }
    x = observation.sample()
    worst = max(float(np.abs(way(x) - predict(x)).max()) for way in ways.values())
    if not worst <= 1e-5:
        raise SystemExit(f"the contenders differ by {worst:.2g}: nothing to compare")
    return {name: partial(way, x) for name, way in ways.items()}


def blank(observation: Any, action: Any) -> Any:
    """Make an environment that only has spaces."""
    import gymnasium as gym
    from stable_baselines3.common.vec_env import DummyVecEnv

    class Blank(gym.Env[Any, Any]):
        observation_space, action_space = observation, action

    return DummyVecEnv([Blank])


def measure(ways: dict[str, Callable[[], Any]], calls: int) -> dict[str, list[float]]:
    """Time the contenders in turns, so that whatever else the machine does hits all of them.

    Returns:
        Times by name [us].
    """
    for way in ways.values():
        for _ in range(200):
            way()
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(max(1, calls // ROUND)):
        for name, way in ways.items():
            for _ in range(ROUND):
                start = time.perf_counter_ns()
                way()
                times[name].append((time.perf_counter_ns() - start) / 1e3)
    return times


def report(times: dict[str, list[float]], options: argparse.Namespace) -> None:
    """Print the table, and whether the targets were reached in this run."""
    import numpy as np

    p50 = {name: float(np.percentile(values, 50)) for name, values in times.items()}
    layers = "x".join(map(str, options.layers))
    print(f"{options.observation} -> {layers} -> {options.action}, {'' if options.normalise else 'not '}normalised")
    print(f"{'':18}{'p50 [us]':>10}{'p99 [us]':>10}{'times FrozenPolicy':>20}")
    for name, values in times.items():
        ratio = p50[name] / p50["FrozenPolicy.act"]
        print(f"{name:18}{p50[name]:10.1f}{np.percentile(values, 99):10.1f}{ratio:20.1f}")
    if options.layers != [64, 64]:
        print("targets are set for 64x64 only")
        return
    ours = p50["FrozenPolicy.act"]
    ratio = p50["SB3 predict"] / ours
    print(f"target p50 <= {TARGET_P50:.0f} us: {verdict(ours <= TARGET_P50)} ({ours:.1f} us)")
    print(
        f"target at least {TARGET_RATIO:.0f} times as fast as SB3: {verdict(ratio >= TARGET_RATIO)} ({ratio:.1f} times)"
    )


def verdict(reached: bool) -> str:
    """Say it in a word."""
    return "reached" if reached else "MISSED"


if __name__ == "__main__":
    main()
