"""Evaluate checkpoints with disturbed robots, links and computers, and print a table in Markdown.

Each column has the same episodes: plain; with domain randomisation; with actions that reach the task two steps late,
like those of a slow policy; with commands that reach the robot two steps late; and with each link profile. The ratio to
the plain success rate is in brackets. With --guarded, the columns are the links behind the guards of a live robot, as
``bam-deploy --rehearse`` has them, and a link without delay first.
"""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import tyro

from bam_envs.core.location import SIMULATED
from bam_envs.core.registry import entry_of
from bam_envs.robots.linked import PROFILES
from bam_train.checkpoint import Checkpoint
from bam_train.cli.flags import Count
from bam_train.deploy.rehearsal import Rehearsal
from bam_train.errors import BamTrainError
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy
from tests.benchmarks.harness import CHECKPOINTS

SEED = 3_000_000
"""Seed of the first episode; neither training nor `bam-eval` uses it."""
NO_DELAY = {"command_delay": [0.0, 0.0], "state_delay": [0.0, 0.0]}
GUARDED = {"no delay": NO_DELAY, **{name: name for name in PROFILES}}
"""Links behind which the guards of a live robot are shown."""
STEPS = 2
"""Delay of late actions and commands [steps]."""


@dataclass(frozen=True, kw_only=True)
class Flags:
    checkpoints: tyro.conf.Positional[tuple[Path, ...]] = ()
    """By default those in checkpoints/ of robots."""
    episodes: Count = 300
    """Episodes in each column."""
    guarded: bool = False
    """Behind the guards of a live robot."""


def columns(period):
    """Arguments of the environment for each column of the table; `period` is the robot's [s]."""
    plain = dict(SIMULATED)
    late = {"command_delay": [STEPS * period] * 2, "state_delay": [0.0, 0.0]}
    return {
        "plain": plain,
        "randomised": {**plain, "randomize": True},
        "late actions": {**plain, "action_delay": STEPS},
        "late commands": {**plain, "link": late},
        **{name: {**plain, "link": name} for name in PROFILES},
        "randomised, wifi": {**plain, "randomize": True, "link": "wifi"},
    }


def row(path, episodes):
    """The success of one checkpoint in each column."""
    checkpoint = Checkpoint.open(path)
    manifest = checkpoint.manifest
    entry = entry_of(manifest.env)
    if entry is None:
        raise BamTrainError(f"{path}: {manifest.env} has no robot for a link; leave it out")
    policy, cells, plain = FrozenPolicy.from_checkpoint(checkpoint), [path.name], 0.0
    for name, options in columns(entry.period).items():
        report = evaluate(policy, manifest.env, {**manifest.env_kwargs, **options}, episodes=episodes, seed=SEED)
        rate = report.success_rate or 0.0
        plain = rate if name == "plain" else plain
        cells.append(f"{rate:.1%}" + (f" ({rate / plain:.3f})" if plain and name != "plain" else ""))
    return cells


def guarded_row(path, episodes):
    """The success of one checkpoint behind each link and the guards of a live robot."""
    checkpoint = Checkpoint.open(path)
    policy, cells = FrozenPolicy.from_checkpoint(checkpoint), [path.name]
    for link in GUARDED.values():
        with closing(Rehearsal(checkpoint, link)) as rehearsal:
            report = rehearsal.run(policy, episodes=episodes, seed=SEED, tell=lambda line: None)
        stopped = sum(record.end == "stopped" for record in report.records)
        successes = sum(record.success is True for record in report.records)
        cells.append(f"{successes / episodes:.1%} ({stopped / episodes:.1%})")
    return cells


def of_robots():
    """The committed checkpoints whose environment has a robot."""
    entries = (
        (path, entry_of(Checkpoint.open(path, members=False).manifest.env)) for path in CHECKPOINTS.glob("*.zip")
    )
    return sorted(path for path, entry in entries if entry is None or entry.has_robot)


def main(flags):
    """Print the table."""
    header = ["checkpoint", *(GUARDED if flags.guarded else columns(1.0))]
    print(f"| {' | '.join(header)} |\n| {' | '.join(['---'] * len(header))} |", flush=True)
    for path in flags.checkpoints or of_robots():
        cells = (guarded_row if flags.guarded else row)(path, flags.episodes)
        print(f"| {' | '.join(cells)} |", flush=True)
    return 0
