"""Run the scripted policies on seeded episodes: the tasks are feasible and the physics is sound."""

from __future__ import annotations

import argparse
import time
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.registry import ENVIRONMENTS, resolve_id
from bam_envs.tasks.scripted import GRASP, SCRIPTED, scripted_policy
from bam_train.environments import make_vector_env
from bam_train.evaluation import waves

ROWS = 64


def run_episodes(env_id: str, episodes: int, seed: int, *, randomize: bool) -> tuple[int, NDArray[np.int64]]:
    """Episode k is seeded ``seed + k``; how many succeeded, and how many steps each took."""
    with closing(make_vector_env(env_id, {"randomize": randomize}, min(ROWS, episodes))) as envs:
        played = [one for wave in waves(envs, scripted_policy(env_id), episodes=episodes, seed=seed) for one in wave]
    return sum(bool(one.success) for one in played), np.array([one.length for one in played])


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
