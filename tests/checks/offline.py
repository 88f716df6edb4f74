"""Offline RL on a public benchmark: a Minari data set becomes ours, every algorithm learns from it, a table compares.

    python -m tests.checks offline mujoco/hopper/medium-v0 --algos bc,iql,td3bc --steps 50000 --seeds 3

The score is that of D4RL, 100 (return - random) / (expert - random), where the data set has its reference returns. A
data set that is not on this computer is downloaded by Minari. Needs: pip install "bam-train[offline,sim]" minari
"""

import json
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro

from bam_train.cli.flags import Count, TrainConfig
from bam_train.cli.train import train
from bam_train.data import DataSet, DataSetInfo, DataSetWriter, Episode
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy


@dataclass(frozen=True, kw_only=True)
class Flags:
    dataset: tyro.conf.Positional[str]
    """Id of a Minari data set."""
    algos: str = "bc,iql"
    """Algorithms of bam-train --data, separated by commas."""
    steps: Count = 50_000
    """Updates of each run."""
    seeds: Count = 3
    """Runs of each algorithm."""
    episodes: Count = 100
    """Episodes of each evaluation."""
    out: Path = Path("runs/benchmark")
    """Folder of data set and checkpoints."""


def convert(name, place):
    """Write the Minari data set `name` as one of ours; returns its reference returns, of chance and of an expert."""
    import minari

    source = minari.load_dataset(name, download=name not in minari.list_local_datasets())
    metadata = source.storage.metadata
    spec = source.env_spec
    env = "unknown/Environment-v0" if spec is None else spec.id
    info = DataSetInfo(env, {}, source.observation_space, source.action_space, period=0.05)
    if not (place / "meta" / "info.json").exists():
        with DataSetWriter(place, info) as writer:
            for one in source.iterate_episodes():
                last = bool(one.terminations[-1]), bool(one.truncations[-1])
                facts = {"minari": name, "episode": int(one.id)}
                rewards = np.asarray(one.rewards, np.float64)
                writer.add(Episode(one.observations, one.actions, rewards, *last, facts=facts))
    return metadata.get("ref_min_score"), metadata.get("ref_max_score")


def returns(policy, env, episodes):
    """Mean return of a policy in simulation; None where its environment is not here."""
    if env not in gym.registry:
        return None
    return evaluate(FrozenPolicy.load(policy), env, {}, episodes=episodes).return_mean


def row(place, algo, args, low, high):
    """Train `algo` with every seed, and evaluate the last weights."""
    env, found = DataSet.open(place).info.env, []
    for seed in range(args.seeds):
        out = args.out / f"{algo}-{seed}.zip"
        flags = TrainConfig(data=str(place), algo=algo, steps=args.steps, seed=seed, out=out, runs=args.out, force=True)
        train(flags)
        found.append(returns(out, env, args.episodes))
    known = [one for one in found if one is not None]
    table = {"algo": algo, "seeds": args.seeds, "returns": known}
    if known and low is not None and high is not None:
        scores = 100 * (np.array(known) - low) / (high - low)
        table |= {"score": round(float(scores.mean()), 1), "spread": round(float(scores.std()), 1)}
    return table


def main(flags):
    """Print one JSON object for each algorithm."""
    place = flags.out / flags.dataset.replace("/", "-")
    low, high = convert(flags.dataset, place)
    for algo in flags.algos.split(","):
        print(json.dumps(row(place, algo, flags, low, high)), flush=True)
    return 0
