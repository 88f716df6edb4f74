"""Train with presets, several seeds each, and write docs/presets.md: what they reach, and at what cost.

Every run is `bam-train` to its end, and what it trained is evaluated over fresh episodes, as `checks commands` does it.
The page is written after each run; a row takes the place of an earlier one of the same preset. Presets that need a data
set or a teacher are left out.

Examples:
  python -m tests.checks presets --list                               what the page has, and what it lacks
  python -m tests.checks presets --only Pendulum-v1-sac --seeds 0 1 2
  python -m tests.checks presets                                      those that the page lacks: hours
"""

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from bam_envs.core.errors import InvalidValue
from bam_envs.core.wording import did_you_mean
from bam_train.cli.console import number, percent
from bam_train.cli.flags import Count, Seed
from bam_train.experiments.seed_statistics import estimate
from bam_train.trainers.resolve_settings import PRESETS
from tests.benchmarks.harness import ROOT, made_row, rows_of_page, write_table
from tests.checks.commands import Result, run
from tests.checks.libraries import spread

PAGE = ROOT / "docs" / "presets.md"
ZOO = {
    "Acrobot-v1-ppo": -73.5,
    "CartPole-v1-a2c": 500.0,
    "CartPole-v1-dqn": 500.0,
    "CartPole-v1-ppo": 500.0,
    "LunarLander-v3-ppo": 242.1,  # of LunarLander-v2
    "MountainCarContinuous-v0-ppo": 88.3,
    "Pendulum-v1-ppo": -172.2,
    "Pendulum-v1-sac": -157.0,
}
"""Preset to the mean return of the same algorithm on the benchmark page of rl-baselines3-zoo, of one agent."""
HEADER = ("preset", "learnt", "score", "least", "rl-zoo3", "steps", "CPU time", "made")
HEAD = """# Presets measured

`bam-train` with a preset alone. Learnt is 90 % success in 500 fresh episodes, or the environment's threshold. The score
is the success or else the mean return, over seeds as [`bam-compare`](compare.md) has it, and the least one; rl-zoo3 has
one agent's. Steps of the checkpoint and CPU time are medians, with least and most. Written by `python -m tests.checks
presets`.

"""


def presets() -> dict[str, tuple[str, ...]]:
    """Name of each preset that needs nothing else, to its command."""
    found = {}
    for name in sorted(path.stem for path in PRESETS.glob("*.toml")):
        match = re.fullmatch(r"(.+?)(?:-(rllib|offline))?-(grasp-q|\w+)", name)
        assert match
        env, trainer, algo = match.groups()
        if trainer != "offline" and algo != "dagger":
            words = ["bam-train", "--env", env if re.search(r"-v\d", env) else f"bam/{env}", "--algo", algo]
            found[name] = (*words, *(["--trainer", trainer] if trainer else []))
    return found


def row(name: str, results: list[Result]) -> str:
    """A line of the table."""
    good = [one for one in results if one.steps]
    rates = [one.success for one in good if one.success is not None]
    values = rates or [one.reward for one in good if one.reward is not None]
    form, within = (percent, (0.0, 1.0)) if rates else (number, (-float("inf"), float("inf")))
    score, learnt = "-", sum(one.learnt == "yes" for one in results)
    if values:
        found = estimate(values, within)
        ends = "" if found.low is None or found.high is None else f" ({form(found.low)} to {form(found.high)})"
        score = form(found.value) + ends
    cells = [f"{learnt} of {len(results)}", score, form(min(values)) if values else "-", str(ZOO.get(name, "-"))]
    cells += [spread([one.steps for one in good], ""), spread([one.cpu for one in results], " s")]
    return made_row(name, *cells)


@dataclass(frozen=True)
class Flags:
    list: bool = False
    """Print the row of each preset, or its name alone, and run nothing."""
    only: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """These presets instead of those that the page lacks."""
    seeds: Annotated[tuple[Seed, ...], arg(metavar="N ...")] = (0, 1, 2)
    """Each is a run."""
    episodes: Count = 500
    """Fresh episodes of an evaluation."""
    folder: Annotated[Path | None, arg(metavar="DIR")] = None
    """Where a new folder with outputs and checkpoints is made; by default that of temporary files."""
    page: Annotated[Path, arg(metavar="FILE")] = PAGE
    """Where the table goes."""


def main(args: Flags) -> int:
    """Train and measure; 1 if a run did not learn."""
    known = presets()
    for name in args.only:
        if name not in known:
            raise InvalidValue(f"--only: there is no preset {name!r} to train with. {did_you_mean(name, known)}")
    rows = rows_of_page(args.page, lambda name, *_: name)
    if args.list:
        print(*(rows.get(name, name) for name in known), sep="\n")
        return 0
    if args.folder is not None:
        args.folder.mkdir(parents=True, exist_ok=True)
    folder, learnt = Path(tempfile.mkdtemp(prefix="check-presets-", dir=args.folder)).resolve(), True
    for name in args.only or [name for name in known if name not in rows]:
        results = []
        for seed in args.seeds:
            results.append(run(known[name], seed, folder / f"{name}-{seed}", args.episodes))
            rows[name] = row(name, results)
            write_table(args.page, HEAD, HEADER, [rows[one] for one in known if one in rows])
        print(rows[name], flush=True)
        learnt &= all(one.learnt == "yes" for one in results)
    return int(not learnt)
