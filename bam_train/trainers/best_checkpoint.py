"""The place of a run's best checkpoint: it overwrites no other run's, and can be written before training begins."""

import itertools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from bam_train.atomic_file import remove_orphans
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.manifest import AGAIN
from bam_train.errors import AlteredCheckpoint, CheckpointError, OutputError
from bam_train.settings import TrainSettings, file_stem, read_config
from bam_train.trainers.resolve_settings import CHANGEABLE
from bam_train.trainers.run_folder import require_room
from bam_train.trainers.training_run import Scores

NOTES = "bam/resume/notes.json"
FOLDER = Path("checkpoints")


@dataclass(frozen=True)
class Output:
    """Where the best checkpoint goes."""

    path: Path
    best: Scores | None
    """The evaluation of the file that is there already, if it is of the same run and will be improved."""
    notices: tuple[str, ...] = ()
    """Messages for the user."""


def choose_output(settings: TrainSettings, out: Path | None, force: bool, resumed: Checkpoint | None) -> Output:
    """Choose where the best checkpoint goes: to `out` if it is given, and over what is there if `force` says so.

    The best of the run that `resumed` continues keeps its place. What killed runs left half written is removed.
    """
    own = None if resumed is None else _own_best(resumed)
    usual = FOLDER / f"{file_stem(settings.env, settings.algo, settings.trainer)}.zip"
    wanted = (out or (own.path if own else usual)).expanduser()
    if wanted.is_dir():
        raise OutputError(
            f"{wanted}: is a folder; give the name of a file in it, such as --out {wanted / 'policy.zip'}"
        )
    if wanted.suffix != ".zip":
        raise OutputError(f"{wanted}: expected a file name that ends in .zip. Choose another one with --out")
    require_room(wanted, "--out", wanted.parent)
    remove_orphans(wanted.resolve())
    if own is not None and wanted.resolve() == own.path:
        return Output(wanted, own.best)
    if force or not wanted.exists():
        return Output(wanted, None)
    numbered = (wanted.with_name(f"{wanted.stem}-{number}.zip") for number in itertools.count(2))
    free = next(path for path in numbered if not os.path.lexists(path))
    return Output(free, None, (f"{wanted} exists: the checkpoint goes to {free} (--force overwrites)",))


class _Noted(Struct):
    steps: int
    path: str


class _Notes(Struct):
    best: _Noted | None = None


def _own_best(resumed: Checkpoint) -> Output | None:
    """The best checkpoint of the same run, if it is still there and this computer made it."""
    try:
        noted = msgspec.convert(resumed.json(NOTES), _Notes).best if resumed.has(NOTES) else None
    except msgspec.ValidationError as error:
        raise AlteredCheckpoint(resumed.path, NOTES, f"{NOTES}: {error}. {AGAIN}") from error
    if noted is None:
        return None
    path, learnt = Path(noted.path), _what(resumed.manifest.settings)
    try:
        # An untrusted file may note any path: it counts only in a folder where a run of the same settings made it.
        config = resumed.path.parent / "config.json"
        if noted.path != str(resumed.path.resolve()) and _what(read_config(config)) != learnt:
            return None
        there = Checkpoint.open(path).manifest
    except (CheckpointError, ValueError):  # no settings there; a path that is none, such as one with a null byte
        return None
    if there.steps != noted.steps or _what(there.settings) != learnt:
        return None
    return Output(path.resolve(), {**there.scores, "steps": there.steps})


def _what(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings that say what is learnt."""
    return {name: value for name, value in settings.items() if name not in CHANGEABLE}
