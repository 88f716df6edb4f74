"""What `bam-train` says at the end: how it went, where everything is, what to run next."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from bam_train.cli.console import count, duration, number, percent, say
from bam_train.errors import OutputError

if TYPE_CHECKING:
    from bam_train.settings import TrainSettings
    from bam_train.trainers.run import Outcome
    from bam_train.trainers.run_folder import RunFolder

_REASONS = {"steps": "all steps done", "success": "success reached", "stopped": "stopped"}


def summarise(settings: TrainSettings, outcome: Outcome, folder: RunFolder, seconds: float) -> None:
    """Draw the learning curve and say how the run went.

    Args:
        settings: Of the run.
        outcome: How it ended.
        folder: Its files.
        seconds: Wall time since the program started [s].
    """
    _draw(settings, folder)
    say()
    end = f"{_REASONS[outcome.reason]} at {count(outcome.steps)} steps, {duration(seconds)} in all"
    say(f"{settings.algo} on {settings.env}: {end}")
    for name, text in _rows(outcome, folder):
        say(f"  {name:<12}{text}")
    commands = _next_commands(settings, outcome)
    for line in ["next:", *(f"  {command}" for command in commands)] if commands else []:
        say(line)


def _rows(outcome: Outcome, folder: RunFolder) -> list[tuple[str, str]]:
    rows = []
    if outcome.best is None and outcome.reason == "stopped":
        rows.append(("best", "none yet: stopped before the first evaluation; the checkpoint is the newest state"))
    if outcome.checkpoint is not None and outcome.checkpoint.exists():
        if outcome.best is not None:
            rows.append(("best", _score_text(outcome)))
        size = outcome.checkpoint.stat().st_size / 1000
        rows.append(("checkpoint", f"{_short(outcome.checkpoint)} ({size:,.0f} kB)"))
    if outcome.last is not None:
        older = "" if outcome.last_steps == outcome.steps else f" (after {count(outcome.last_steps)} steps)"
        rows.append(("last state", f"{_short(outcome.last)}{older}"))
    rows.append(("run", f"{_short(folder.path)}/: learning-curve.png, progress.jsonl, config.json, tensorboard/"))
    return rows


def _score_text(outcome: Outcome) -> str:
    best = outcome.best
    if best is None:
        return "-"
    success = ""
    if best.success_rate is not None:
        interval = best.success_interval
        between = f" (95 %: {percent(interval[0])} to {percent(interval[1])})" if interval else ""
        success = f"success {percent(best.success_rate)}{between}, "
    episodes = "" if best.episodes is None else f" over {best.episodes} episodes"
    return f"{success}return {number(best.return_mean)}{episodes}, after {count(best.steps)} steps"


def _next_commands(settings: TrainSettings, outcome: Outcome) -> list[str]:
    from bam_train.environments import is_batched, must_be_named

    commands = []
    usable = outcome.checkpoint or outcome.last
    named = f" --env {shlex.quote(settings.env)}" if must_be_named(settings.env) else ""
    if usable is not None:
        commands.append(f"bam-eval {_short(usable)}{named}")
        if is_batched(settings.env):
            commands.append(f"bam-deploy {_short(usable)}{named}")
    if outcome.reason == "stopped" and outcome.last is not None:
        commands.append(f"bam-train --resume {_short(outcome.last)}{named}")
    return commands


def _short(path: Path) -> str:
    """As short as it can be typed here."""
    absolute, here = path.resolve(), Path.cwd()
    return shlex.quote(str(absolute.relative_to(here) if absolute.is_relative_to(here) else absolute))


def _draw(settings: TrainSettings, folder: RunFolder) -> None:
    from bam_train.trainers.curve import draw_curve

    try:
        draw_curve(folder.records(), f"{settings.algo} on {settings.env}, seed {settings.seed}", folder.curve)
    except OutputError as error:
        say(f"no learning curve: {error}")
