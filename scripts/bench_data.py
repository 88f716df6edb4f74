"""Time data sets: each row says what was measured, the figure to reach, and whether it was.

CPU-seconds are of this process and its children; compare ratios, the times are this machine's, now.

Examples:
  python scripts/bench_data.py
  python scripts/bench_data.py --only collect
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy reads it

ROOT = Path(__file__).parents[1]
CHECKPOINT = ROOT / "checkpoints" / "pick-ppo.zip"


class Row(NamedTuple):
    """One figure."""

    what: str
    found: str
    goal: str
    reached: bool


def collect() -> Iterator[Row]:
    """Collecting with everything recorded, against the same environment and policy with nothing recorded."""
    from bam_envs.tasks.scripted import scripted_policy
    from bam_train.data.collect import collect as collecting
    from bam_train.environments import make_vector_env

    def alone(steps: int) -> float:
        policy = scripted_policy("bam/pick-v0")
        with closing(make_vector_env("bam/pick-v0", {}, 64)) as envs:
            observations, _ = envs.reset(seed=0)
            begun = time.process_time()
            for _ in range(steps):
                observations, *_ = envs.step(policy.act_batch(observations))
            return 64 * steps / (time.process_time() - begun)

    def recorded(episodes: int) -> float:
        with tempfile.TemporaryDirectory() as folder:
            begun = time.process_time()
            found = collecting(Path(folder) / "d", "scripted", "bam/pick-v0", episodes=episodes, num_envs=64)
            return found.steps / (time.process_time() - begun)

    alone(20)
    recorded(64)
    pairs = [(alone(200), recorded(300)) for _ in range(3)]
    own, all_ = (sorted(column)[1] for column in zip(*pairs, strict=True))
    found = f"{all_:,.0f} of {own:,.0f} steps a CPU-second: {all_ / own:.0%}"
    yield Row("collect bam/pick, 64 side by side", found, ">= 50 % of the environment's own", all_ >= 0.5 * own)


def tick() -> Iterator[Row]:
    """The recorder's share of a deployment's tick with --record PLACE, as the recording itself says."""
    import numpy as np

    from bam_train.recording.recording import Recording

    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "bam_train.cli.deploy",
            str(CHECKPOINT),
            "--episodes",
            "10",
            "--record",
            "data",
        ]
        paths = os.pathsep.join([str(ROOT), str(ROOT / "envs")])
        subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": paths}, check=True, capture_output=True)
        [path] = Path(folder, "recordings").glob("*.mcap")
        took = 1e6 * Recording.open(path).tables["/latency"].column("record")
    took = took[np.isfinite(took)]
    found = f"{np.median(took):.0f} us in the middle, {np.quantile(took, 0.9):.0f} us of nine in ten, {len(took)} ticks"
    yield Row("record a deployment's tick", found, "<= 30 us", bool(np.median(took) <= 30))


def batches() -> Iterator[Row]:
    """Batches of 256 transitions as our learners draw them, against d3rlpy's replay buffer with the same episodes."""
    import d3rlpy
    import torch

    from bam_train.data import DataSet
    from bam_train.data.collect import collect as collecting
    from bam_train.data.export import export
    from bam_train.trainers.offline.training_data import ActionCode, Normaliser, read_batch

    def rate(draw: Callable[[], object], count: int) -> float:
        draw()
        begun = time.process_time()
        for _ in range(count):
            draw()
        return count / (time.process_time() - begun)

    with tempfile.TemporaryDirectory() as folder:
        collecting(Path(folder) / "d", "scripted", "bam/pick-v0", episodes=200, num_envs=64)
        data = DataSet.open(Path(folder) / "d")
        export(data, "d3rlpy", Path(folder) / "d.h5")
        with open(Path(folder) / "d.h5", "rb") as file:
            theirs = d3rlpy.dataset.ReplayBuffer.load(file, d3rlpy.dataset.InfiniteBuffer())
        normaliser, code = Normaliser(data.info.observation_space), ActionCode(data.info.action_space)
        ours, _ = read_batch(data, range(len(data)), normaliser, code, fit=True)
        slow = rate(lambda: theirs.sample_transition_batch(256), 100)
        fast = rate(lambda: ours.rows(torch.randint(len(ours), (256,))), 2000)
    found = f"{fast:,.0f} a CPU-second, d3rlpy {slow:,.0f}: {fast / slow:.0f} times as many"
    yield Row("draw batches of 256 transitions", found, ">= 10 times d3rlpy", fast >= 10 * slow)


BENCHES: dict[str, Callable[[], Iterator[Row]]] = {"collect": collect, "batches": batches, "tick": tick}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=BENCHES, action="append", help="one of the rows; may be repeated")
    chosen = parser.parse_args().only or list(BENCHES)
    missed = 0
    for name in chosen:
        for row in BENCHES[name]():
            missed += not row.reached
            print(f"{row.what:36}{row.found:60}{row.goal:36}{'reached' if row.reached else 'NOT reached'}", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
