"""How long programs take to start: ``--help`` of each, and bam-deploy to its first action.

Each is run in turns with a bare ``python -c pass``, which says how slow the machine is now; the figures are medians.
"""

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

from tests.benchmarks import harness
from tests.benchmarks.harness import at_most, in_turns, number, program, ratio

PROGRAMS = ("train", "eval", "deploy", "envs")


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    checkpoint: Path = harness.PICK
    """What bam-deploy runs."""


def measure_help(flags):
    """Wall time of ``--help``."""
    commands = {"bare": [sys.executable, "-c", "pass"], **{name: program(name, "--help") for name in PROGRAMS}}
    runs = {name: partial(subprocess.run, one, capture_output=True, check=True) for name, one in commands.items()}
    times = in_turns(runs, flags.times(7), time.monotonic)
    for name in PROGRAMS:
        found = f"{median(times[name]):.3f} s, {ratio(times[name], times['bare']):.1f} x a bare python"
        yield at_most(f"bam-{name} --help", median(times[name]), 0.3, "s", found)


def measure_deploy(flags):
    """CPU time from the start of the process to its first action, as bam-deploy reports it."""
    command = program("deploy", flags.checkpoint, "--episodes", 1, "--fast", "--json")
    runs = [subprocess.run(command, capture_output=True, check=True).stdout for _ in range(flags.times(7))]
    found = median(json.loads(one)["startup_cpu_s"]["total"] for one in runs)
    yield at_most("bam-deploy, CPU time to its first action", found, 1.0, "s", f"{number(found)} s")
