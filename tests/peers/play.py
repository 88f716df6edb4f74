"""Plays seeded episodes of bam/pick: with random actions, and with the policy of a checkpoint.

As a program it plays them at the address given, through `open_transport`, and prints them as JSON; the transport's
options follow as NAME=VALUE.
"""

import json
import sys
from pathlib import Path

from bam_train.policy.frozen_policy import FrozenPolicy

CHECKPOINT = Path(__file__).parents[2] / "checkpoints" / "pick-ppo.zip"
RANDOM_SEEDS, RANDOM_STEPS = (0, 7), 30
POLICY_SEEDS = (1_000_000, 1_000_001, 1_000_002)


def play(env):
    """Every number of every step, as plain values."""
    policy = FrozenPolicy.load(CHECKPOINT)
    env.action_space.seed(11)
    episodes = [play_one(env, seed, lambda _: env.action_space.sample(), RANDOM_STEPS) for seed in RANDOM_SEEDS]
    return episodes + [play_one(env, seed, policy.act, 10_000) for seed in POLICY_SEEDS]


def play_one(env, seed, act, most):
    observation, info = env.reset(seed=seed)
    steps = [{"observation": plain(observation)}]
    while len(steps) <= most:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        flags = {"terminated": bool(terminated), "truncated": bool(truncated), "success": bool(info["is_success"])}
        steps.append({"observation": plain(observation), "reward": float(reward), **flags})
        if terminated or truncated:
            break
    return steps


def plain(observation):
    if isinstance(observation, dict):
        return {name: plain(value) for name, value in observation.items()}
    return observation.tolist()


def main(url, *options):
    from bam_envs.remote.remote_env import RemoteEnv, open_transport

    env = RemoteEnv(open_transport(url, **dict(option.split("=") for option in options)))
    try:
        print(json.dumps(play(env)), flush=True)
    finally:
        env.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
