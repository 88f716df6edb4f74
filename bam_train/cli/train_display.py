"""The display of `bam-train` on standard error: a panel on a terminal, plain lines elsewhere, a summary at the end."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from bam_train.cli.console import count, drop, duration, make_console, number, percent, rich_text, say
from bam_train.errors import OutputError
from bam_train.files.log_lines import counted
from bam_train.files.place import with_addresses

if TYPE_CHECKING:
    from bam_train.evaluation import EvaluationReport
    from bam_train.settings import TrainSettings
    from bam_train.trainers.base import Progress, Statistics
    from bam_train.trainers.run_folder import RunFolder
    from bam_train.trainers.training_run import Outcome, Scores

LINE_EVERY = 1.0
"""Minimum seconds between two plain lines about training."""
UNKNOWN = "not known yet"
"""The time of training left, without evaluations, before it can be estimated."""


class MayClose:
    """A text stream that may be closed by its reader, as a pipe or terminal; later writes are then discarded."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write and flush, so that the buffer is always empty."""
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:
            drop(self._stream)
        return len(text)


class PlainDisplay:
    """One line for each evaluation and each note, and about one a second for training."""

    def __init__(self, title: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._title, self._clock = title, clock
        self._printed = float("-inf")

    def __enter__(self) -> PlainDisplay:
        self.note(self._title)
        return self

    def __exit__(self, *_: object) -> None:
        return

    def training(self, progress: Progress, statistics: Statistics, speed: float, left: float | None) -> None:
        """Print the statistics of training, unless the last line is less than a second old."""
        if self._clock() - self._printed < LINE_EVERY:
            return
        self._printed = self._clock()
        success = "" if statistics.success_rate is None else f"success {percent(statistics.success_rate)}  "
        rest = f"training left: {UNKNOWN}" if left is None else f"at most {duration(max(0.0, left))} of training left"
        what = f"{success}return {number(statistics.return_mean)}"
        self.note(f"{_steps(progress)}  {speed:,.0f} steps/s  {what}  {rest}")

    def evaluated(self, steps: int, report: EvaluationReport, best: bool) -> None:
        """Print the result of an evaluation."""
        success = "" if report.success_rate is None else f"success {percent(report.success_rate)}, "
        rest = f"return {number(report.return_mean)}, {report.length_mean:.0f} steps an episode"
        rest += f" ({counted(report.episodes, 'episode')}){', the best so far' if best else ''}"
        self.note(f"evaluation at {count(steps)} steps: {success}{rest}")

    def note(self, text: str) -> None:
        """Print a message."""
        say(text)


class LiveDisplay(PlainDisplay):
    """A panel that changes in place, below the lines about evaluations."""

    def __init__(self, title: str) -> None:
        super().__init__(title)
        from rich.live import Live

        self._console = make_console()
        self._live = Live(console=self._console, refresh_per_second=4, transient=True)

    def __enter__(self) -> LiveDisplay:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def training(self, progress: Progress, statistics: Statistics, speed: float, left: float | None) -> None:
        """Update the panel."""
        from rich.panel import Panel
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        columns = {
            "steps": _steps(progress),
            "speed": f"{speed:,.0f} steps/s",
            "success": percent(statistics.success_rate),
            "return": number(statistics.return_mean),
            "training left, at most": UNKNOWN if left is None else duration(max(0.0, left)),
        }
        figures = Table.grid(padding=(0, 3))
        figures.add_row(*columns, style="dim")
        figures.add_row(*columns.values())
        outer = Table.grid(expand=True)
        outer.add_row(ProgressBar(total=progress.total, completed=min(progress.steps, progress.total)))
        outer.add_row(figures)
        self._live.update(Panel(outer, title=rich_text(self._title), title_align="left"))

    def note(self, text: str) -> None:
        """Print a message above the panel."""
        self._console.print(rich_text(text), soft_wrap=True)


def _steps(progress: Progress) -> str:
    """The steps done, and those to be done while they are more: the last rollout is whole, and goes beyond them."""
    more = f" of {count(progress.total)}" if progress.steps < progress.total else ""
    return f"{count(progress.steps)}{more} steps"


REASONS = {
    "steps": "all steps done",
    "success": "success reached",
    "reward": "reward reached",
    "stopped": "stopped",
}


def summarise(settings: TrainSettings, outcome: Outcome, folder: RunFolder, seconds: float) -> None:
    """Draw the learning curve and print the outcome of the run, `seconds` [s] after the program started."""
    from bam_train.trainers.run_folder import draw_curve

    try:
        draw_curve(folder.records(), f"{settings.algo} on {settings.env}, seed {settings.seed}", folder.curve)
    except OutputError as error:
        say(f"no learning curve: {error}")
    say()
    end = f"{REASONS[outcome.reason]} at {count(outcome.steps)} steps, {duration(seconds)} in all"
    say(f"{settings.algo} on {settings.env}: {end}")
    if outcome.best is None and outcome.reason == "stopped":
        say("  best        none yet: stopped before the first evaluation; the checkpoint is the newest state")
    if outcome.checkpoint is not None and outcome.checkpoint.exists():
        if outcome.best is not None:
            say(f"  best        {_score_text(outcome.best)}")
        say(f"  checkpoint  {short_path(outcome.checkpoint)}")
    if outcome.last is not None:
        older = "" if outcome.last_steps == outcome.steps else f" (after {count(outcome.last_steps)} steps)"
        say(f"  last state  {short_path(outcome.last)}{older}")
    say(f"  run         {short_path(folder.path)}/: learning-curve.png, progress.jsonl, config.json, tensorboard/")


def _score_text(best: Scores) -> str:
    success, rate, interval = "", best.get("success_rate"), best.get("success_interval")
    if rate is not None:
        between = f" (95 %: {percent(interval[0])} to {percent(interval[1])})" if interval else ""
        success = f"success {percent(rate)}{between}, "
    episodes = f" over {counted(best['episodes'], 'episode')}" if best.get("episodes") is not None else ""
    return f"{success}return {number(best.get('return_mean'))}{episodes}, after {count(best['steps'])} steps"


def say_next(settings: TrainSettings, outcome: Outcome) -> None:
    """Print the size of the checkpoint, now that it is complete, and the commands that use what the run has left."""
    from bam_train.environments import is_batched, must_be_named

    commands = []
    usable = outcome.checkpoint or outcome.last
    named = f" --env {shlex.quote(settings.env)}" if must_be_named(settings.env) else ""
    if usable is not None:
        commands.append(f"bam-eval {short_path(usable)}{named}")
        if is_batched(settings.env) and outcome.shortfall is None:
            commands.append(f"bam-deploy {short_path(usable)}{named}")
    if outcome.reason == "stopped" and outcome.last is not None:
        commands.append(f"bam-train --resume {short_path(outcome.last)}{named}")
    if outcome.checkpoint is not None and outcome.checkpoint.exists():
        say(f"  size        {outcome.checkpoint.stat().st_size / 1000:,.0f} kB")
    for line in ["next:", *(f"  {command}" for command in commands)] if commands else []:
        say(line)


def short_path(path: Path) -> str:
    """The shortest form of the path for a shell in this folder."""
    return shlex.quote(with_addresses(str(path.resolve())).removeprefix(f"{Path.cwd()}{os.sep}"))
