"""How long bam-train takes from process start to a policy that succeeds: wall time, memory and success over seeds.

Each seed is one process of ``bam-train --env ENV --algo ALGO --seed N``, then one of bam-eval on episodes it has never
seen. Run it on an idle machine; the median and the slowest seed are held against the goals.
"""

import json
import os
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

from bam_train.errors import SettingsError
from tests.benchmarks import harness
from tests.benchmarks.harness import at_least, at_most, program

GOALS = {"bam/pick": (60.0, 120.0, 0.99), "bam/reach": (30.0, 30.0, 0.99), "bam/pick-place": (360.0, 360.0, 0.95)}
"""Environment to median seconds, seconds of the slowest seed, success rate."""


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    env: Literal["bam/pick", "bam/reach", "bam/pick-place"] = "bam/pick"
    """Environment."""
    algo: str = "ppo"
    """Algorithm."""


def run(flags, seed, folder):
    """Train and evaluate one seed: seconds, steps, largest resident memory [MiB] and success rate."""
    out, output = folder / "policy.zip", folder / "output"
    command = ["train", "--env", flags.env, "--algo", flags.algo, "--seed", seed, "--out", out, "--runs", folder / "r"]
    begun = time.monotonic()
    with output.open("w") as file:
        process = subprocess.Popen(program(*command), stdout=file, stderr=file)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode, seconds = os.waitstatus_to_exitcode(status), time.monotonic() - begun
    if process.returncode:
        raise SettingsError(f"bam-train ended with {process.returncode}: {output.read_text()}")
    judge = program("eval", out, "--episodes", flags.times(200), "--json")
    judged = json.loads(subprocess.run(judge, capture_output=True, check=True).stdout)
    [progress] = (folder / "r").glob("*/progress.jsonl")
    steps = max(json.loads(row)["steps"] for row in progress.read_text().splitlines())
    return seconds, steps, usage.ru_maxrss / 1024, judged["success_rate"]


def measure_seeds(flags):
    """Each seed, then all of them against the goals."""
    results = []
    for seed in range(flags.times(5)):
        with tempfile.TemporaryDirectory() as folder:
            results.append(run(flags, seed, Path(folder)))
        seconds, steps, memory, success = results[-1]
        yield f"  seed {seed}: {seconds:6.1f} s, {steps:>9,} steps, {memory:5.0f} MiB, success {success:.1%}"
    seconds, _, memory, success = zip(*results, strict=True)
    middle, slowest, rate = GOALS[flags.env]
    yield at_most(f"{flags.env}, {flags.algo}: median time", median(seconds), middle, "s")
    yield at_most("slowest time", max(seconds), slowest, "s")
    yield at_least("median success", 100 * median(success), 100 * rate, "%")
    yield at_most("largest memory", max(memory), 1024, "MiB")
