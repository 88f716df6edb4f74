"""Run the scripted policies on seeded episodes: the tasks are feasible and the physics is sound."""

from __future__ import annotations

import argparse
import time

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.registry import ENVIRONMENTS, resolve_id
from bam_envs.tasks.scripted import GRASP, SCRIPTED, scripted_policy

ROWS = 64


def run_episodes(env_id: str, episodes: int, seed: int, *, randomize: bool) -> tuple[int, NDArray[np.int64]]:
    """Episode k is seeded ``seed + k``; how many succeeded, and how many steps each took."""
    policy, successes, lengths = scripted_policy(env_id), 0, []
    for first in range(0, episodes, ROWS):
        rows = min(ROWS, episodes - first)
        env = gym.make_vec(env_id, num_envs=rows, randomize=randomize)
        observation, _ = env.reset(seed=seed + first)
        running = np.ones(rows, dtype=bool)
        length = np.zeros(rows, dtype=np.int64)
        while running.any():
            observation, _, terminated, truncated, infos = env.step(policy.act_batch(observation))
            length[running] += 1
            ended = running & (terminated | truncated)
            if ended.any():
                successes += int(infos["final_info"]["is_success"][ended].sum())
            running &= ~ended
        env.close()
        lengths.append(length)
    return successes, np.concatenate(lengths)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    known = ", ".join((*SCRIPTED, GRASP))
    parser.add_argument("--env", action="append", help=f"one of {known}; may be repeated; default: those of arms")
    parser.add_argument("--episodes", type=int, default=1000, help="episodes each (default 1000)")
    parser.add_argument("--seed", type=int, default=0, help="episode k is seeded seed + k (default 0)")
    parser.add_argument("--randomize", action="store_true", help="with domain randomisation")
    arguments = parser.parse_args()
    try:
        names = [resolve_id(name) for name in arguments.env or SCRIPTED]
        for name in names:
            scripted_policy(name)
    except BamEnvsError as error:
        parser.error(str(error))
    if arguments.episodes < 1:
        parser.error(f"--episodes must be at least 1, not {arguments.episodes}")
    print(f"{'environment':20}{'success':>9}{'episodes':>10}{'mean steps':>12}{'longest':>9}{'limit':>7}{'time':>9}")
    for name in names:
        start = time.monotonic()
        good, lengths = run_episodes(name, arguments.episodes, arguments.seed, randomize=arguments.randomize)
        limit, spent = ENVIRONMENTS[name].max_episode_steps, time.monotonic() - start
        steps = f"{lengths.mean():12.1f}{lengths.max():9}{limit:7}"
        print(f"{name:20}{good / arguments.episodes:9.2%}{arguments.episodes:10}{steps}{spent:7.1f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
