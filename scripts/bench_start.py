"""How long programs take to start: ``--help`` of each (wall time), `bam-deploy` to its first action (CPU time).

Each is run in turns with a bare ``python -c pass``, which says how slow the machine is now; the figures are medians.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

PROGRAMS = ("train", "eval", "deploy", "envs")
HELP_TARGET, DEPLOY_TARGET = 0.3, 1.0
"""Seconds of wall time; seconds of CPU time."""
CHECKPOINT = Path(__file__).parent.parent / "checkpoints" / "pick-ppo.zip"


def main() -> int:
    """Read the options, run, print; 1 when a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7, help="how often each is run")
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help="what bam-deploy runs")
    options = parser.parse_args()
    if options.rounds < 1:
        parser.error("--rounds must be at least 1")
    times: dict[str, list[float]] = {name: [] for name in ("bare", *PROGRAMS, "first action")}
    for _ in range(options.rounds):
        times["bare"].append(wall([sys.executable, "-c", "pass"]))
        for name in PROGRAMS:
            times[name].append(wall([sys.executable, "-m", f"bam_train.cli.{name}", "--help"]))
        times["first action"].append(first_action(options.checkpoint))
    return report({name: median(values) for name, values in times.items()})


def wall(command: list[str]) -> float:
    """Wall time of a process [s]."""
    before = time.monotonic()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return time.monotonic() - before


def first_action(checkpoint: Path) -> float:
    """CPU time of `bam-deploy` from the start of its process to its first action [s], as it reports itself."""
    command = [sys.executable, "-m", "bam_train.cli.deploy", str(checkpoint), "--episodes", "1", "--fast", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout)["startup_cpu_s"]["total"])


def report(found: dict[str, float]) -> int:
    """Print the figures against their targets."""
    print(f"{'python -c pass':<24} {found['bare']:6.3f} s wall")
    met = True
    for name in PROGRAMS:
        met &= found[name] <= HELP_TARGET
        show(f"bam-{name} --help", found[name], HELP_TARGET, found["bare"])
    show("bam-deploy, first action", found["first action"], DEPLOY_TARGET, found["bare"])
    return 0 if met and found["first action"] <= DEPLOY_TARGET else 1


def show(name: str, seconds: float, target: float, bare: float) -> None:
    """One line."""
    verdict = "met" if seconds <= target else "MISSED"
    print(f"{name:<24} {seconds:6.3f} s, {seconds / bare:5.1f} x a bare python, target {target} s: {verdict}")


if __name__ == "__main__":
    sys.exit(main())
