"""Offline RL on a public benchmark: a Minari data set becomes ours, every algorithm learns from it, a table compares.

    python scripts/offline_benchmark.py mujoco/hopper/medium-v0 --algos bc,iql,td3bc --steps 50000 --seeds 3

The score is that of D4RL, 100 (return - random) / (expert - random), where the data set has its reference returns. A
data set that is not on this computer is downloaded by Minari. Needs: pip install "bam-train[offline,sim]" minari
"""

import argparse
import contextlib
import json
from pathlib import Path

import gymnasium as gym
import numpy as np

from bam_train.cli.flags import TrainConfig
from bam_train.cli.train import train
from bam_train.data import DataSet, DataSetInfo, DataSetWriter, Episode
from bam_train.errors import BamTrainError
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy


def convert(name: str, place: Path) -> tuple[float | None, float | None]:
    """Write the Minari data set `name` as one of ours; returns its reference returns, of chance and of an expert."""
    import minari

    source = minari.load_dataset(name, download=name not in minari.list_local_datasets())
    metadata = source.storage.metadata
    spec = source.env_spec
    info = DataSetInfo(
        "unknown/Environment-v0" if spec is None else spec.id,
        {},
        source.observation_space,
        source.action_space,
        period=0.05,
    )
    if not (place / "meta" / "info.json").exists():
        with DataSetWriter(place, info) as writer:
            for one in source.iterate_episodes():
                last = bool(one.terminations[-1]), bool(one.truncations[-1])
                facts = {"minari": name, "episode": int(one.id)}
                rewards = np.asarray(one.rewards, np.float64)
                writer.add(Episode(one.observations, one.actions, rewards, *last, facts=facts))
    return metadata.get("ref_min_score"), metadata.get("ref_max_score")


def returns(policy: Path, env: str, episodes: int) -> float | None:
    """Mean return of a policy in simulation; None where its environment is not here."""
    if env not in gym.registry:
        return None
    return evaluate(FrozenPolicy.load(policy), env, {}, episodes=episodes).return_mean


def row(place: Path, algo: str, args: argparse.Namespace, low: float | None, high: float | None) -> dict[str, object]:
    """Train `algo` with every seed, and evaluate the last weights."""
    env, found = DataSet.open(place).info.env, []
    for seed in range(args.seeds):
        out = args.out / f"{algo}-{seed}.zip"
        flags = TrainConfig(data=str(place), algo=algo, steps=args.steps, seed=seed, out=out, runs=args.out, force=True)
        train(flags)
        found.append(returns(out, env, args.episodes))
    known = [one for one in found if one is not None]
    table: dict[str, object] = {"algo": algo, "seeds": args.seeds, "returns": known}
    if known and low is not None and high is not None:
        scores = 100 * (np.array(known) - low) / (high - low)
        table |= {"score": round(float(scores.mean()), 1), "spread": round(float(scores.std()), 1)}
    return table


def main() -> None:
    """Print one JSON object for each algorithm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="id of a Minari data set")
    parser.add_argument("--algos", default="bc,iql", help="algorithms of bam-train --data, separated by commas")
    parser.add_argument("--steps", type=int, default=50_000, help="updates of each run")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=100, help="episodes of each evaluation")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"), help="folder of data set and checkpoints")
    args = parser.parse_args()
    place = args.out / args.dataset.replace("/", "-")
    with contextlib.suppress(BrokenPipeError):
        try:
            low, high = convert(args.dataset, place)
            for algo in args.algos.split(","):
                print(json.dumps(row(place, algo, args, low, high)), flush=True)
        except BamTrainError as error:
            raise SystemExit(f"offline_benchmark: {error}") from error


if __name__ == "__main__":
    main()
