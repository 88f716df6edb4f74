"""``runs/<name>/``: what a run leaves behind to be looked at.

::

    config.json         every setting; `--config` reads it back
    progress.jsonl      a JSON object a line: how training goes ("kind": "training"), evaluations ("kind": "evaluation")
    tensorboard/        event files
    last.zip            the newest checkpoint; `--resume` goes on from it
    learning-curve.png  return and success over steps
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bam_train.errors import OutputError


class RunFolder:
    """The folder of one run; made new.

    Args:
        root: The folder that runs are kept in.
        name: What the run is called; ``-2``, ``-3``, … is added while the name is taken.

    Attributes:
        path: The folder.
    """

    def __init__(self, root: Path, name: str) -> None:
        self.path = _make_folder(root, name)
        self.last = self.path / "last.zip"
        self.tensorboard = self.path / "tensorboard"
        self.curve = self.path / "learning-curve.png"
        self._progress = self.path / "progress.jsonl"

    def write_config(self, settings: Mapping[str, Any]) -> None:
        """Write ``config.json``."""
        with _writing(self.path / "config.json"):
            (self.path / "config.json").write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")

    def add(self, record: Mapping[str, Any]) -> None:
        """Append one line to ``progress.jsonl``; whole when this returns."""
        with _writing(self._progress), self._progress.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, allow_nan=False) + "\n")

    def records(self) -> list[dict[str, Any]]:
        """All records so far."""
        if not self._progress.exists():
            return []
        return [json.loads(line) for line in self._progress.read_text(encoding="utf-8").splitlines()]


    def remove_unfinished(self) -> None:
        """Remove what an interrupted save left behind."""
        for path in self.path.glob(".*.tmp"):
            path.unlink(missing_ok=True)


class _writing:  # noqa: N801 - reads as `with _writing(path)`
    """Maps failures to write `path` to `OutputError`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, OSError) and not isinstance(error, OutputError):
            raise OutputError(f"{self.path}: cannot be written: {error.strerror or error}") from error


def _make_folder(root: Path, name: str) -> Path:
    """Make the first folder of name, name-2, name-3, … that is not there; two programs never get the same one."""
    with _writing(root):
        root.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        path = root / (name if number == 1 else f"{name}-{number}")
        try:
            with _writing(path):
                path.mkdir()
        except OutputError as error:
            if not isinstance(error.__cause__, FileExistsError):
                raise
            number += 1
            continue
        return path


def require_writable(path: Path, least: int = 20_000_000) -> None:
    """Find out before training whether a checkpoint can be written to `path`; missing folders are made.

    Args:
        path: Where the checkpoint will go.
        least: Free bytes that the disk must have.

    Raises:
        OutputError: It is a folder, the folder cannot be made or written to, or the disk is full.
    """
    remedy = "Choose another place with --out"
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file in it, such as --out {path / 'policy.zip'}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            free = shutil.disk_usage(path.parent).free
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}. {remedy}") from error
    if free < least:
        found, expected = f"{free / 1e6:.1f} MB", f"{least / 1e6:.0f} MB"
        raise OutputError(f"{path}: the disk has {found} free, expected at least {expected}. {remedy}")
