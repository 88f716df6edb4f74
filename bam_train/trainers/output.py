"""Where a run's best checkpoint goes: never over somebody else's, and found writable before training begins."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bam_train.checkpoint import Checkpoint, next_free_path
from bam_train.errors import CheckpointError, OutputError
from bam_train.settings import TrainSettings, file_stem
from bam_train.trainers.resolve import CHANGEABLE
from bam_train.trainers.run import Best
from bam_train.trainers.run_folder import require_writable

NOTES = "bam/resume/notes.json"
FOLDER = Path("checkpoints")


@dataclass(frozen=True)
class Output:
    """Where the best checkpoint goes."""

    path: Path
    best: Best | None
    """What is there already, if it is of the same run and goes on being improved."""
    notices: tuple[str, ...] = ()
    """What the user should know about it."""


def choose_output(settings: TrainSettings, out: Path | None, force: bool, resumed: Checkpoint | None) -> Output:
    """Choose where the best checkpoint goes, and find out whether it can be written there.

    Args:
        settings: Of the run.
        out: What was asked for, if anything.
        force: Overwrite what is there.
        resumed: The checkpoint that the run goes on from; its own best goes on being improved in its place.

    Raises:
        OutputError: It cannot be written there.
    """
    own = None if resumed is None else _own_best(resumed, settings)
    usual = FOLDER / f"{file_stem(settings.env, settings.algo, settings.trainer)}.zip"
    wanted = (out or (own.path if own else usual)).expanduser()
    if wanted.suffix != ".zip" and not wanted.is_dir():
        raise OutputError(f"{wanted}: expected a file name that ends in .zip. Choose another one with --out")
    require_writable(wanted)
    if own is not None and wanted.resolve() == own.path:
        return Output(wanted, own.best)
    if force or not wanted.exists():
        return Output(wanted, None)
    free = next_free_path(wanted)
    return Output(free, None, (f"{wanted} exists: the checkpoint goes to {free} (--force overwrites)",))


def _own_best(resumed: Checkpoint, settings: TrainSettings) -> Output | None:
    """The best checkpoint of the same run, if it is still there."""
    noted: Any = resumed.json(NOTES).get("best") if resumed.has(NOTES) else None
    if noted is None:
        return None
    path = Path(noted["path"])
    try:
        there = Checkpoint.open(path).manifest
    except CheckpointError:
        return None
    if there.steps != noted["steps"] or _what(there.settings) != _what(resumed.manifest.settings):
        return None
    interval: Any = there.scores.get("success_interval")
    known = noted["steps"], noted["success_rate"], noted["return_mean"], interval and tuple(interval)
    return Output(path.resolve(), Best(*known, there.scores.get("episodes")))


def _what(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings that say what is learnt."""
    return {name: value for name, value in settings.items() if name not in CHANGEABLE}
