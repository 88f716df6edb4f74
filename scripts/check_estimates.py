"""Check the value estimates of ``bam-eval --data`` against simulation: 10 policies, 5 data sets, 50 pairs.

The policies are the shipped one of bam/pick with errors: a cube that seems to lie elsewhere, and motions that are too
small. Each data set has the episodes of eight noisy policies around them. The truth is the success rate of 1,000
simulated episodes. Printed for every pair: truth, estimate and 95 % interval; at the end, the share of intervals that
cover the truth, and Spearman's rank correlation of the estimates of each data set with the truth.
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

ENV = "bam/pick-v0"
BASE = Path(__file__).resolve().parents[1] / "checkpoints" / "pick-ppo.zip"
ERRORS = np.array(
    [
        *((0, 0, 0, 1), (0.018, 0.006, 0, 1), (0, -0.02, 0, 1), (0, -0.024, 0, 1), (0.026, 0, 0, 1)),
        *((0, 0, 0, 0.5), (0, 0, 0, 0.42), (0.022, -0.012, 0, 1), (0, 0, 0.032, 1), (0, 0, -0.02, 1)),
    ]
)
"""Of the ten policies: where the cube seems to be, x, y, z [m], and the share of each motion that is made."""
_COLUMNS = ((-8, 0, 0.2), (-7, 1, 0.25), (-5, 0, 0.1), (-4, 1, 0.1), (-3, 2, 0.1))
"""Columns of the observation with the cube's place: column, axis, unit [m]."""


class Wrong:
    """The shipped policy with errors (4,), or with one error for each environment (n, 4)."""

    recurrent = False
    _base = FrozenPolicy.load(BASE)

    def __init__(self, errors: NDArray[np.float64]) -> None:
        self._errors = np.atleast_2d(errors)

    def reset(self, env_ids: Any = None) -> None:
        """Nothing: it has no memory."""

    def act(self, observation: Any) -> Any:
        """The action for one observation."""
        return self.act_batch(observation[None])[0]

    def act_batch(self, observations: Any) -> Any:
        """Actions for several."""
        seen = np.array(observations)
        for column, axis, unit in _COLUMNS:
            seen[:, column] = np.clip(seen[:, column] + self._errors[:, axis] / unit, -2, 2)
        actions = np.clip(self._base.act_batch(seen), -1, 1)
        actions[:, :4] *= self._errors[:, 3:]
        return actions.astype(np.float32)


def record(place: Path, episodes: int, seed: int) -> DataSet:
    """A data set of eight noisy policies around those that are evaluated."""
    rng = np.random.default_rng(seed)
    errors = ERRORS[rng.integers(len(ERRORS), size=8)] * np.append(rng.uniform(0.5, 1.2, (8, 3)), np.ones((8, 1)), 1)
    errors[:, 3] = np.minimum(1, errors[:, 3] * rng.uniform(0.9, 1.3, 8))
    policy, noise, random = Wrong(np.resize(errors, (episodes, 4))), rng.uniform(0.2, 0.4), rng.uniform(0.05, 0.2)
    envs = RecordVectorDataset(
        make_vector_env(ENV, None, episodes), place, facts={"noise": noise}, keep=lambda number, _: number < episodes
    )
    with closing(envs):
        observations, _ = envs.reset(seed=7_000_000 + 10_000 * seed)
        running = np.ones(episodes, bool)
        while running.any():
            actions = policy.act_batch(observations)
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
    parser.add_argument("--seed", type=int, default=0, help="seed of the first data set (default 0)")
    parser.add_argument("--json", type=Path, help="write the pairs to this file")
    arguments = parser.parse_args()
    began = time.process_time()
    policies = [Wrong(one) for one in ERRORS]
    truth = [evaluate(one, ENV, episodes=arguments.truth, seed=5_000_000).success_rate or 0.0 for one in policies]
    print("truth", np.round(truth, 3).tolist(), f"{time.process_time() - began:.0f} CPU-s", flush=True)
    covered, correlations, pairs = [], [], []
    for seed in range(arguments.seed, arguments.seed + arguments.sets):
        with tempfile.TemporaryDirectory() as folder:
            data = record(Path(folder) / "data", arguments.episodes, seed)
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
