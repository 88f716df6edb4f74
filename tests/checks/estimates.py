"""Check the value estimates of ``bam-eval --data`` against simulation: 10 policies, 5 data sets, 50 pairs.

The policies are ten stages of one training run of bam/pick with PPO, from the first updates to the last. Each data set
has the noisy episodes of four of them, drawn anew. The truth is the success rate of 1,000 simulated episodes. Printed
for every pair: truth, estimate and 95 % interval; at the end, the share of intervals that cover the truth, and the rank
correlation (Spearman) of the estimates of each data set with the truth.
"""

import tempfile
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bam_train.cli.flags import Count, Seed
from bam_train.data import DataSet
from bam_train.data.record_dataset import RecordVectorDataset
from bam_train.environments import make_vector_env
from bam_train.estimation.data_evaluation import within_bounds
from bam_train.estimation.fitted_q import fit_q
from bam_train.estimation.steps import read_steps
from bam_train.evaluation import evaluate
from bam_train.trainers.resolve_settings import resolve
from bam_train.trainers.sb3.sb3_trainer import SB3Trainer
from tests.benchmarks import harness

ENV = "bam/pick-v0"
STAGES = (15_000, 40_000, 65_000, 80_000, 95_000, 110_000, 130_000, 160_000, 200_000, 240_000)
"""Steps after which a policy of the run is kept."""


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    sets: Count = 5
    """Data sets."""
    episodes: Count = 400
    """Episodes of each."""
    truth: Count = 1000
    """Simulated episodes of each policy."""
    seed: Seed = 0
    """Of training and the first data set."""


def train(seed):
    """The policies of a run at `STAGES`."""
    policies = []
    trainer = SB3Trainer.create(resolve({"env": ENV, "algo": "ppo", "seed": seed, "steps": STAGES[-1]}))
    with closing(trainer):
        for steps in STAGES:
            trainer.train(steps, lambda progress: True)
            policies.append(trainer.freeze())
    return policies


def record(place, policies, episodes, seed):
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


def ranks(values):
    return np.argsort(np.argsort(values)).astype(float)


def measure_estimates(flags):
    """Each data set and policy."""
    policies = train(flags.seed)
    truth = [evaluate(one, ENV, episodes=flags.truth, seed=5_000_000).success_rate or 0.0 for one in policies]
    yield f"truth {np.round(truth, 3).tolist()}"
    covered, correlations, widths = [], [], []
    for seed in range(flags.seed, flags.seed + flags.sets):
        with tempfile.TemporaryDirectory() as folder:
            data = record(Path(folder) / "data", policies, flags.episodes, seed)
            own = np.mean([bool(data.facts(i)["success"]) for i in range(len(data))])
            yield f"data set {seed}: {len(data)} episodes, {own:.1%} succeeded"
            values = []
            for number, policy in enumerate(policies):
                fitted = fit_q(read_steps(data, policy, range(len(data)), by_success=True))
                found = within_bounds(fitted.estimate(), by_success=True)
                low, high = found.interval
                covered.append(low <= truth[number] <= high)
                values.append(found.value)
                widths.append((high - low) / 2)
                text = f"truth {truth[number]:.3f}, estimate {found.value:.3f}, {low:.3f} to {high:.3f}"
                yield f"  policy {number}: {text}{'' if covered[-1] else '  missed'}"
        correlations.append(float(np.corrcoef(ranks(values), ranks(truth))[0, 1]))
        error = np.sqrt(np.mean((np.array(values) - truth) ** 2))
        yield f"  error {error:.3f}, rank correlation {correlations[-1]:.2f}"
    yield f"{sum(covered)} of {len(covered)} intervals cover the truth: {np.mean(covered):.1%}"
    yield f"mean half width {np.mean(widths):.3f}"
    yield f"rank correlation {min(correlations):.2f} to {max(correlations):.2f}, mean {np.mean(correlations):.2f}"
