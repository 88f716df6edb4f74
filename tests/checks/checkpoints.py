"""Evaluate the committed checkpoints and write the table in ``checkpoints/README.md``.

Command, seed and steps come from each checkpoint's manifest, wall time from the run that made it (`--runs`) or, without
that, from the table as it is; the success rates are measured here, over episodes that neither training nor its
evaluations have seen. The first one is that of ``bam-eval CHECKPOINT --episodes 1000``: a policy that was trained with
randomised physics, late actions or a link is evaluated with them. The second one is without them. Where there is a
training and a test split, it is the test split that counts, and each image of it counts once.
"""

import json
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import tyro

from bam_envs.core.location import SIMULATED
from bam_envs.core.registry import entry_of
from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import duration
from bam_train.cli.flags import Count
from bam_train.environments import held_out
from bam_train.evaluation import FIRST_SEED, evaluate
from bam_train.policy import FrozenPolicy
from bam_train.settings import differences, file_stem
from bam_train.trainers.resolve_settings import resolve
from tests.benchmarks.harness import CHECKPOINTS, table_row

HEADER = ("checkpoint", "command", "seed", "steps", "wall time", "success", "plain", "size")
FLAGS = (
    *("steps", "seed", "num_envs", "device", "threads", "start", "until_success", "eval_every", "eval_episodes"),
    *("num_env_runners", "num_learners", "num_gpus", "address", "data"),
)
"""Settings that have a flag of their own."""
_TABLE = re.compile(r"(<!-- generated -->\n).*?(<!-- /generated -->)", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Flags:
    checkpoints: tyro.conf.Positional[tuple[Path, ...]] = ()
    """By default every .zip in checkpoints/."""
    episodes: Count = 1000
    """Episodes each."""
    runs: Path = Path("runs")
    """Where the runs' folders are."""
    page: Path = CHECKPOINTS / "README.md"
    """The page with the table."""


def command(manifest, name):
    """What trains this checkpoint again: the preset, and what the run had otherwise."""
    if manifest.trainer == "script":
        script = f"scripts/{manifest.algorithm.replace('-', '_')}.py"
        return shlex.join(["python", script, "--checkpoint", f"checkpoints/{name}"])
    own = manifest.settings
    env = manifest.env.rpartition("-v")[0] if manifest.env.startswith("bam/") else manifest.env
    words = ["bam-train", "--env", env, "--algo", manifest.algorithm]
    if manifest.trainer not in ("sb3", "imitation", "bandit"):
        words += ["--trainer", manifest.trainer]
    asked = {"env": manifest.env, "algo": manifest.algorithm, "trainer": manifest.trainer}
    if own.get("teacher"):
        asked["teacher"] = own["teacher"]
        words += ["--teacher", own["teacher"]]
    for setting, value, _ in differences(own, resolve(asked).to_mapping()):
        words += _words(setting, value)
    if name != f"{file_stem(manifest.env, manifest.algorithm, manifest.trainer, manifest.env_kwargs)}.zip":
        words += ["--out", f"checkpoints/{name}"]
    return shlex.join(words)


def _words(setting, value):
    text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
    if setting in FLAGS:
        return [f"--{setting.replace('_', '-')}", text]
    return ["--set", f"{setting.removeprefix('hyperparameters.')}={text}"]


def wall_time(manifest, runs):
    """Wall time of the run up to the evaluation that kept this checkpoint, if the run's folder is still there."""
    wanted = {"steps": manifest.steps, "return_mean": manifest.scores.get("return_mean")}
    for path in sorted(runs.glob("*/progress.jsonl")):
        for record in _evaluations(path):
            if all(record.get(name) == value for name, value in wanted.items()):
                return duration(record["seconds"])
    return None


def _evaluations(path):
    for line in path.read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        if record["kind"] == "evaluation":
            yield record


def old_wall_times(text):
    """(checkpoint, command, seed, steps) of each row of the table as it is, to its wall time."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    place = HEADER.index("wall time")
    return {tuple(row[:place]): row[place] for row in rows if len(row) > place}


def row(path, episodes, runs, known):
    """One line of the table."""
    checkpoint = Checkpoint.open(path)
    manifest = checkpoint.manifest
    policy = FrozenPolicy.from_checkpoint(checkpoint)
    rates = []
    for asked in ({}, SIMULATED):
        kwargs = held_out(manifest.env, manifest.env_kwargs, {} if entry_of(manifest.env) is None else asked)
        if not rates or any(manifest.env_kwargs.get(name) for name in SIMULATED):
            rates.append(success(evaluate(policy, manifest.env, kwargs, episodes=episodes, seed=FIRST_SEED)))
    rates += [""] if len(rates) == 1 else []
    made = [f"`{command(manifest, path.name)}`", str(manifest.seed), f"{manifest.steps:,}"]
    first = [f"[{path.name}]({path.name})", *made]
    seconds = wall_time(manifest, runs) or known.get(tuple(first), "not recorded")
    return [*first, seconds, *rates, f"{path.stat().st_size / 1000:.0f} kB"]


def success(report):
    """The success rate and its 95 % interval, and how many episodes there are if fewer than asked for."""
    if report.success_rate is None or report.success_interval is None:
        return "not reported"
    low, high = report.success_interval
    of_all = "" if report.starts is None else f" of all {report.episodes}"
    return f"{report.success_rate:.1%}{of_all} ({low:.1%} to {high:.1%})"


def main(flags):
    """Print the rows and write the table."""
    text = flags.page.read_text(encoding="utf-8")
    known, lines = old_wall_times(text), [list(HEADER), ["---"] * len(HEADER)]
    for path in flags.checkpoints or sorted(CHECKPOINTS.glob("*.zip")):
        lines.append(row(path, flags.episodes, flags.runs, known))
        print("  ".join(lines[-1]), flush=True)
    table = "\n".join(table_row(*cells) for cells in lines)
    flags.page.write_text(_TABLE.sub(lambda match: f"{match[1]}\n{table}\n\n{match[2]}", text), encoding="utf-8")
    return 0
