"""Evaluate the committed checkpoints and write the table in ``checkpoints/README.md``.

Command, seed and steps come from each checkpoint's manifest, wall time from the run that made it (`--runs`) or, without
that, from the table as it is; the success rates are measured here, over episodes that neither training nor its
evaluations have seen. The first one is that of ``bam-eval CHECKPOINT --episodes 1000``: a policy that was trained with
randomised physics, late actions or a link is evaluated with them. The second one is without them;
``scripts/evaluate_links.py`` evaluates all with them. Where there is a training and a test split, it is the test split
that counts, and each picture of it counts once.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.registry import entry_of
from bam_train.checkpoint import Checkpoint, Manifest
from bam_train.cli.console import duration
from bam_train.env_location import SIMULATED
from bam_train.environments import held_out
from bam_train.errors import BamTrainError
from bam_train.evaluation import FIRST_SEED, EvaluationReport, evaluate
from bam_train.policy import FrozenPolicy
from bam_train.settings import differences, file_stem
from bam_train.trainers.resolve_settings import resolve

FOLDER = Path(__file__).resolve().parents[1] / "checkpoints"
HEADER = ("checkpoint", "command", "seed", "steps", "wall time", "success", "plain", "size")
FLAGS = (
    *("steps", "seed", "num_envs", "device", "threads", "start", "until_success", "eval_every", "eval_episodes"),
    *("num_env_runners", "num_learners", "num_gpus", "address", "data"),
)
"""Settings that have a flag of their own."""
_TABLE = re.compile(r"(<!-- generated -->\n).*?(<!-- /generated -->)", re.DOTALL)


def command(manifest: Manifest, name: str) -> str:
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
    if name != f"{file_stem(manifest.env, manifest.algorithm, manifest.trainer)}.zip":
        words += ["--out", f"checkpoints/{name}"]
    return shlex.join(words)


def _words(setting: str, value: Any) -> list[str]:
    text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
    if setting in FLAGS:
        return [f"--{setting.replace('_', '-')}", text]
    return ["--set", f"{setting.removeprefix('hyperparameters.')}={text}"]


def wall_time(manifest: Manifest, runs: Path) -> str | None:
    """Wall time of the run up to the evaluation that kept this checkpoint, if the run's folder is still there."""
    wanted = {"steps": manifest.steps, "return_mean": manifest.scores.get("return_mean")}
    for path in sorted(runs.glob("*/progress.jsonl")):
        for record in _evaluations(path):
            if all(record.get(name) == value for name, value in wanted.items()):
                return duration(record["seconds"])
    return None


def _evaluations(path: Path) -> Iterator[dict[str, Any]]:
    for line in path.read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        if record["kind"] == "evaluation":
            yield record


def old_wall_times(text: str) -> dict[tuple[str, ...], str]:
    """(checkpoint, command, seed, steps) of each row of the table as it is, to its wall time."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    place = HEADER.index("wall time")
    return {tuple(row[:place]): row[place] for row in rows if len(row) > place}


def row(path: Path, episodes: int, runs: Path, known: dict[tuple[str, ...], str]) -> list[str]:
    """One line of the table."""
    checkpoint = Checkpoint.open(path)
    manifest = checkpoint.manifest
    policy = FrozenPolicy.from_checkpoint(checkpoint)
    rates: list[str] = []
    for asked in ({}, SIMULATED):
        kwargs = held_out(manifest.env, manifest.env_kwargs, {} if entry_of(manifest.env) is None else asked)
        if not rates or any(manifest.env_kwargs.get(name) for name in SIMULATED):
            rates.append(success(evaluate(policy, manifest.env, kwargs, episodes=episodes, seed=FIRST_SEED)))
    rates += [""] if len(rates) == 1 else []
    made = [f"`{command(manifest, path.name)}`", str(manifest.seed), f"{manifest.steps:,}"]
    first = [f"[{path.name}]({path.name})", *made]
    seconds = wall_time(manifest, runs) or known.get(tuple(first), "not recorded")
    return [*first, seconds, *rates, f"{path.stat().st_size / 1000:.0f} kB"]


def success(report: EvaluationReport) -> str:
    """The success rate and its 95 % interval, and how many episodes there are if fewer than asked for."""
    if report.success_rate is None or report.success_interval is None:
        return "not reported"
    low, high = report.success_interval
    of_all = "" if report.starts is None else f" of all {report.episodes}"
    return f"{report.success_rate:.1%}{of_all} ({low:.1%} to {high:.1%})"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="*", type=Path, help="default: every .zip in checkpoints/")
    parser.add_argument("--episodes", type=int, default=1000, help="episodes each (default 1000)")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where the runs' folders are (default runs)")
    parser.add_argument("--page", type=Path, default=FOLDER / "README.md", help="default checkpoints/README.md")
    arguments = parser.parse_args()
    text = arguments.page.read_text(encoding="utf-8")
    known = old_wall_times(text)
    lines = [list(HEADER), ["---"] * len(HEADER)]
    try:
        for path in arguments.checkpoints or sorted(FOLDER.glob("*.zip")):
            lines.append(row(path, arguments.episodes, arguments.runs, known))
            print("  ".join(lines[-1]), flush=True)
    except (BamTrainError, BamEnvsError) as error:
        parser.error(str(error))
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    arguments.page.write_text(_TABLE.sub(lambda match: f"{match[1]}\n{table}\n\n{match[2]}", text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
