"""The path of a run's best checkpoint, which overwrites no other run's and is known to be writable before training."""

import itertools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.manifest import AGAIN
from bam_train.errors import CheckpointError, OutputError
from bam_train.files.atomic_file import remove_orphans
from bam_train.settings import TrainSettings, file_stem, read_config
from bam_train.trainers.resolve_settings import CHANGEABLE
from bam_train.trainers.run_folder import require_room
from bam_train.trainers.training_run import Scores

NOTES = "bam/resume/notes.json"
FOLDER = Path("checkpoints")


@dataclass(frozen=True)
class Output:
    """The destination of the best checkpoint."""

    path: Path
    best: Scores | None
    """The evaluation of the existing file, if it is the best of the same run so far."""
    notices: tuple[str, ...] = ()
    """Messages for the user."""


def choose_output(settings: TrainSettings, out: Path | None, force: bool, resumed: Checkpoint | None) -> Output:
    """Choose the path of the best checkpoint: `out` if it is given; an existing file is overwritten only with `force`.

    A run that continues from `resumed` keeps its path. Temporary files of killed runs are removed.
    """
    earlier = None if resumed is None else _earlier_best(resumed)
    usual = FOLDER / f"{file_stem(settings.env, settings.algo, settings.trainer, settings.env_kwargs)}.zip"
    wanted = (out or (earlier.path if earlier else usual)).expanduser()
    require_output(wanted)
    remove_orphans(wanted.resolve())
    if earlier is not None and wanted.resolve() == earlier.path:
        return Output(wanted, earlier.best)
    if force or not wanted.exists():
        return Output(wanted, None)
    numbered = (wanted.with_name(f"{wanted.stem}-{number}.zip") for number in itertools.count(2))
    free = next(path for path in numbered if not os.path.lexists(path))
    return Output(free, None, (f"{wanted} exists: the checkpoint goes to {free} (--force overwrites)",))


def require_output(path: Path) -> None:
    """Raise OutputError unless a checkpoint can be written to `path`."""
    path = path.expanduser()
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file in it, such as --out {path / 'policy.zip'}")
    if path.suffix != ".zip":
        raise OutputError(f"{path}: expected a file name that ends in .zip. Choose another one with --out")
    require_room(path, "--out", path.parent)


class _Noted(Struct):
    steps: int
    path: str


class _Notes(Struct):
    best: _Noted | None = None


def _earlier_best(resumed: Checkpoint) -> Output | None:
    """The best checkpoint of the same run, if it still exists and was made on this computer."""
    try:
        noted = msgspec.convert(resumed.json(NOTES), _Notes).best if resumed.has(NOTES) else None
    except msgspec.ValidationError as error:
        raise CheckpointError(resumed.path, f"{NOTES}: {error}. {AGAIN}", member=NOTES) from error
    if noted is None:
        return None
    path, learnt = Path(noted.path), _learnt(resumed.manifest.settings)
    try:
        # An untrusted file may note any path: it counts only in the folder of a run with the same settings.
        config = resumed.path.parent / "config.json"
        if noted.path != str(resumed.path.resolve()) and _learnt(read_config(config)) != learnt:
            return None
        best = Checkpoint.open(path).manifest
    except (CheckpointError, ValueError):  # no settings there, or an invalid path, such as one with a null byte
        return None
    if best.steps != noted.steps or _learnt(best.settings) != learnt:
        return None
    return Output(path.resolve(), {**best.scores, "steps": best.steps})


def _learnt(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings that determine what is learnt."""
    return {name: value for name, value in settings.items() if name not in CHANGEABLE}
