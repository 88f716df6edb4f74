"""`bam-compare`: compare algorithms or settings, each by its runs of several seeds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from bam_train.cli.console import percent, say, tell
from bam_train.cli.flags import File
from bam_train.cli.program import run_program

HELD = (0.93, 0.97)
"""Share of 95 % intervals that must hold the truth in the self-test."""
TRIED = (3, 5, 10)
"""Numbers of seeds of the self-test."""
BROKEN = 3
"""Exit status if a row breaks the rule of ``--fail-if``."""


@dataclass(frozen=True)
class CompareConfig:
    """Compare rows of runs, each a folder with a run a seed: interquartile means with 95 % intervals, steps and time.

    A folder is of bam-train, or has logs of stable-baselines3, rl-zoo3 or RLlib: Monitor, evaluations or TensorBoard
    files. Rows are compared with the first one. The last evaluation of a run counts.

    Examples:
      bam-compare runs/pick-ppo runs/pick-sac --report compare.html
      bam-compare runs/pick-ppo runs/pick-ppo-2 --fail-if worse:0.05
      bam-compare --self-test
    """

    folders: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FOLDER...")] = ()
    """A folder for each row, such as runs/pick-ppo of bam-train --seeds."""
    metric: Annotated[Literal["success", "return", "score"] | None, tyro.conf.arg(metavar="success|return|score")] = (
        None
    )
    """What is compared (default: success, if all runs know it, else return). The score, of runs of bam-train that are
    done, is higher the earlier a run has ended at its goal."""
    level: Annotated[float | None, tyro.conf.arg(metavar="X")] = None
    """Value of the metric to which steps and time are counted, such as 0.95 (default: the goal of the runs)."""
    format: Annotated[Literal["text", "md", "csv", "json"], tyro.conf.arg(metavar="text|md|csv|json")] = "text"
    """Form of the table on standard output."""
    report: File = None
    """Write a report with learning curves and performance profile into this .html file too."""
    fail_if: Annotated[str | None, tyro.conf.arg(metavar="RULE")] = None
    """Exit with status 3 if a row is worse than the first one, maybe-worse, or not-better; :MARGIN, as in worse:0.05,
    allows for a difference, in units of the metric."""
    self_test: bool = False
    """Compare nothing: measure how often the intervals hold the truth, in 2,000 draws of known distributions."""


def compare(config: CompareConfig) -> int:
    """Run the program with its parsed flags; returns the exit status."""
    if config.self_test:
        return _test()
    from bam_train.cli.experiments.comparison import RunComparison
    from bam_train.errors import SettingsError
    from bam_train.files.atomic_file import require_writable

    if not config.folders:
        raise SettingsError("FOLDER is missing: give a folder of runs for each row, such as runs/pick-ppo")
    report = None if config.report is None else require_writable(config.report)
    found = RunComparison([folder.expanduser() for folder in config.folders], config.metric, config.level)
    failures = [] if config.fail_if is None else found.failures(config.fail_if)
    tell(*found.text(config.format).split("\n"))
    if report is not None:
        found.report(report)
    for line in failures:
        say(f"bam-compare: {line}")
    return BROKEN if failures else 0


def _test() -> int:
    """Print which share of the intervals hold the truth; returns 1 if it is not near 95 %."""
    from bam_train.experiments.seed_statistics import coverage

    shares: list[float] = []
    for seeds in TRIED:
        held = coverage(seeds)
        shares += held.values()
        tell(f"{seeds} seeds: " + ", ".join(f"{name} {percent(share)}" for name, share in held.items()))
    low, high = min(shares), max(shares)
    mean = percent(sum(shares) / len(shares))
    tell(f"{mean} of the 95 % intervals hold the truth, {percent(low)} to {percent(high)}")
    return 0 if HELD[0] <= low and high <= HELD[1] else 1


main = partial(
    run_program, "bam-compare", "bam_train.cli.experiments.compare:CompareConfig", lambda config, _: compare(config)
)

if __name__ == "__main__":
    main()
