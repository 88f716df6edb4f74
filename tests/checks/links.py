"""Evaluate checkpoints behind imperfect links and the guards of a live robot, and print a table in Markdown.

Each column has the same episodes, as ``bam-deploy --rehearse`` plays them: with a link without delay, and with each
profile. In brackets is the share of the episodes that a guard stopped.
"""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import tyro

from bam_envs.core.registry import entry_of
from bam_envs.robots.linked import PROFILES
from bam_train.checkpoint import Checkpoint
from bam_train.cli.flags import Count
from bam_train.deploy.rehearsal import Rehearsal
from bam_train.policy import FrozenPolicy
from tests.benchmarks.harness import CHECKPOINTS, table_row

SEED = 3_000_000
"""Seed of the first episode; neither training nor `bam-eval` uses it."""
NO_DELAY = {"command_delay": [0.0, 0.0], "state_delay": [0.0, 0.0]}
LINKS = {"no delay": NO_DELAY, **{name: name for name in PROFILES}}


@dataclass(frozen=True, kw_only=True)
class Flags:
    checkpoints: tyro.conf.Positional[tuple[Path, ...]] = ()
    """By default those in checkpoints/ of robots."""
    episodes: Count = 100
    """Episodes in each column."""


def cells(path, episodes):
    """The success of one checkpoint behind each link."""
    checkpoint = Checkpoint.open(path)
    policy = FrozenPolicy.from_checkpoint(checkpoint)
    yield path.name
    for link in LINKS.values():
        with closing(Rehearsal(checkpoint, link)) as rehearsal:
            report = rehearsal.run(policy, episodes=episodes, seed=SEED, tell=lambda line: None)
        stopped = sum(record.end == "stopped" for record in report.records)
        successes = sum(record.success is True for record in report.records)
        yield f"{successes / episodes:.1%} ({stopped / episodes:.1%})"


def of_robots():
    """The committed checkpoints whose environment has a robot."""
    entries = {path: entry_of(Checkpoint.open(path, members=False).manifest.env) for path in CHECKPOINTS.glob("*.zip")}
    return sorted(path for path, entry in entries.items() if entry is None or entry.has_robot)


def main(flags):
    """Print the table."""
    print(table_row("checkpoint", *LINKS), table_row("---", *["---"] * len(LINKS)), sep="\n", flush=True)
    for path in flags.checkpoints or of_robots():
        print(table_row(*cells(path, flags.episodes)), flush=True)
    return 0
