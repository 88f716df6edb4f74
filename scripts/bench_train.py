"""How long `bam-train` takes from process start to a policy that succeeds: wall time, memory and success over seeds.

Each seed is one process of `bam-train --env ENV --algo ALGO --seed N`, then one of `bam-eval` on episodes it has never
seen. Run it on an idle machine; the median and the slowest seed are held against the targets.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

TARGETS: dict[str, tuple[float, float, float]] = {
    "bam/pick": (60.0, 120.0, 0.99),
    "bam/reach": (30.0, 30.0, 0.99),
    "bam/pick-place": (360.0, 360.0, 0.95),
}
"""Environment to median seconds, seconds of the slowest seed, success rate."""
MEMORY_TARGET = 1024.0
"""Resident memory of `bam-train` at its largest [MiB]."""


@dataclass(frozen=True)
class Result:
    """What one seed came to."""

    seed: int
    seconds: float
    steps: int
    memory: float
    """Largest resident memory [MiB]."""
    success: float


def main() -> int:
    """Read the options, run, print; 1 when a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="bam/pick", choices=sorted(TARGETS), help="environment")
    parser.add_argument("--algo", default="ppo", help="algorithm")
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds, from 0")
    parser.add_argument("--episodes", type=int, default=200, help="fresh episodes that judge each seed")
    options = parser.parse_args()
    if min(options.seeds, options.episodes) < 1:
        parser.error("every number must be at least 1")
    results = []
    for seed in range(options.seeds):
        results.append(run(options.env, options.algo, seed, options.episodes))
        print(line(results[-1]), flush=True)
    return report(options.env, results)


def run(env: str, algo: str, seed: int, episodes: int) -> Result:
    """Train and evaluate one seed in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "policy.zip"
        command = ["--env", env, "--algo", algo, "--seed", str(seed), "--out", str(out), "--runs", f"{folder}/runs"]
        before = time.monotonic()
        memory = peak_memory(program("train"), command)
        seconds = time.monotonic() - before
        judged = subprocess.run(
            [*program("eval"), str(out), "--episodes", str(episodes), "--json"],
            capture_output=True,
            text=True,
            check=True,
        )
        found: dict[str, Any] = json.loads(judged.stdout)
        progress = (Path(folder) / "runs").glob("*/progress.jsonl")
        steps = max(json.loads(row)["steps"] for path in progress for row in path.read_text().splitlines())
        return Result(seed, seconds, steps, memory, found["success_rate"])


def program(name: str) -> list[str]:
    """The command of one of our programs, in this Python."""
    return [sys.executable, "-m", f"bam_train.cli.{name}"]


def peak_memory(command: list[str], arguments: list[str]) -> float:
    """Run a program to its end; its largest resident memory [MiB].

    Raises:
        SystemExit: It failed; with what it said.
    """
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen([*command, *arguments], stdout=output, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            output.seek(0)
            raise SystemExit(f"{' '.join([*command, *arguments])} ended with {process.returncode}:\n{output.read()}")
    return usage.ru_maxrss / (1024.0 if sys.platform.startswith("linux") else 1024.0**2)


def line(result: Result) -> str:
    """One seed in one line."""
    return (
        f"seed {result.seed}: {result.seconds:6.1f} s, {result.steps:>9,} steps, {result.memory:5.0f} MiB, "
        f"success {100 * result.success:.1f} %"
    )


def report(env: str, results: list[Result]) -> int:
    """Print the figures against their targets."""
    middle, slowest, success = TARGETS[env]
    seconds = [result.seconds for result in results]
    rate = 100 * median(result.success for result in results)
    met = [
        held("median time", median(seconds), middle, "s", median(seconds) <= middle),
        held("slowest time", max(seconds), slowest, "s", max(seconds) <= slowest),
        held("median success", rate, 100 * success, "%", rate >= 100 * success),
    ]
    memory = max(result.memory for result in results)
    met.append(held("largest memory", memory, MEMORY_TARGET, "MiB", memory <= MEMORY_TARGET))
    return 0 if all(met) else 1


def held(name: str, found: float, target: float, unit: str, met: bool) -> bool:
    """Print a figure against its target; whether it is met."""
    verdict = "met" if met else "MISSED"
    print(f"{name:<15} {found:8.1f} {unit:<4} target {target:7.1f}  ratio {found / target:5.2f}  {verdict}")
    return met


if __name__ == "__main__":
    sys.exit(main())
