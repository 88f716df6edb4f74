"""Check the value estimates of ``bam-eval --data`` against simulation: 10 policies, 5 data sets, 50 pairs.

The policies are ten stages of one training run of bam/pick with PPO, from the first updates to the last. Each data set
has the noisy episodes of four of them, drawn anew. The truth is the success rate of 1,000 simulated episodes. Printed
for every pair: truth, estimate and 95 % interval; at the end, the share of intervals that cover the truth, and the rank
correlation (Spearman) of the estimates of each data set with the truth.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_train.data import DataSet
from bam_train.data.record_dataset import RecordVectorDataset
from bam_train.environments import make_vector_env
from bam_train.estimation.data_evaluation import within_bounds
from bam_train.estimation.fitted_q import fit_q
from bam_train.estimation.steps import read_steps
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy
from bam_train.trainers.resolve_settings import resolve
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer

ENV = "bam/pick-v0"
STAGES = (15_000, 40_000, 65_000, 80_000, 95_000, 110_000, 130_000, 160_000, 200_000, 240_000)
"""Steps after which a policy of the run is kept."""


def train(seed: int) -> list[FrozenPolicy]:
    """The policies of a run at `STAGES`."""
    policies: list[FrozenPolicy] = []
    trainer = SB3Trainer.create(resolve({"env": ENV, "algo": "ppo", "seed": seed, "steps": STAGES[-1]}))
    with closing(trainer):
        for steps in STAGES:
            trainer.train(steps, lambda progress: True)
            policies.append(trainer.freeze())
    return policies


def record(place: Path, policies: list[FrozenPolicy], episodes: int, seed: int) -> DataSet:
    """A data set of four of the policies, with noise and random actions."""
    rng = np.random.default_rng(seed)
    chosen = [policies[i] for i in rng.choice(len(policies), 4, replace=False)]
    noise, random, quarters = rng.uniform(0.2, 0.4), rng.uniform(0.05, 0.2), np.arange(episodes) % 4
    envs = RecordVectorDataset(
        make_vector_env(ENV, None, episodes), place, facts={"noise": noise}, keep=lambda number, _: number < episodes
    )
    with closing(envs):
        observations, _ = envs.reset(seed=7_000_000 + 10_000 * seed)
        running = np.ones(episodes, bool)
        while running.any():
            actions = np.select(
                [quarters[:, None] == k for k in range(4)], [one.act_batch(observations) for one in chosen]
            )
            actions = actions + noise * rng.standard_normal(actions.shape)
            drawn = rng.random(episodes) < random
            actions[drawn] = rng.uniform(-1, 1, actions[drawn].shape)
            observations, _, terminated, truncated, _ = envs.step(np.clip(actions, -1, 1).astype(np.float32))
            running &= ~(terminated | truncated)
    return DataSet.open(place)


def ranks(values: Any) -> NDArray[np.float64]:
    return np.argsort(np.argsort(values)).astype(float)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=5, help="data sets (default 5)")
    parser.add_argument("--episodes", type=int, default=400, help="episodes of each (default 400)")
    parser.add_argument("--truth", type=int, default=1000, help="simulated episodes of each policy (default 1000)")
    parser.add_argument("--seed", type=int, default=0, help="of training and the first data set (default 0)")
    parser.add_argument("--json", type=Path, help="write the pairs to this file")
    arguments = parser.parse_args()
    began = time.process_time()
    policies = train(arguments.seed)
    truth = [evaluate(one, ENV, episodes=arguments.truth, seed=5_000_000).success_rate or 0.0 for one in policies]
    print("truth", np.round(truth, 3).tolist(), f"{time.process_time() - began:.0f} CPU-s", flush=True)
    covered, correlations, pairs = [], [], []
    for seed in range(arguments.seed, arguments.seed + arguments.sets):
        with tempfile.TemporaryDirectory() as folder:
            data = record(Path(folder) / "data", policies, arguments.episodes, seed)
            own = np.mean([bool(data.facts(i)["success"]) for i in range(len(data))])
            print(f"data set {seed}: {len(data)} episodes, {own:.1%} succeeded", flush=True)
            values = []
            for number, policy in enumerate(policies):
                fitted = fit_q(read_steps(data, policy, range(len(data)), by_success=True))
                found = within_bounds(fitted.estimate(), by_success=True)
                low, high = found.interval
                covered.append(low <= truth[number] <= high)
                values.append(found.value)
                pairs.append({"set": seed, "policy": number, "truth": truth[number], **found.to_json()})
                line = (
                    f"  policy {number}: truth {truth[number]:.3f}, estimate {found.value:.3f}, {low:.3f} to {high:.3f}"
                )
                print(line + ("" if covered[-1] else "  missed"), flush=True)
        correlations.append(float(np.corrcoef(ranks(values), ranks(truth))[0, 1]))
        errors = np.array(values) - truth
        print(f"  error {np.sqrt(np.mean(errors**2)):.3f}, rank correlation {correlations[-1]:.2f}", flush=True)
    print(f"{sum(covered)} of {len(covered)} intervals cover the truth: {np.mean(covered):.1%}")
    print("mean half width", round(float(np.mean([(one["interval"][1] - one["interval"][0]) / 2 for one in pairs])), 3))
    print(f"rank correlation {min(correlations):.2f} to {max(correlations):.2f}, mean {np.mean(correlations):.2f}")
    print(f"{time.process_time() - began:.0f} CPU-s")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(pairs))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
