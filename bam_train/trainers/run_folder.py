"""``runs/<name>/``: what a run leaves behind to be looked at.

::

    config.json         every setting; `--config` reads it back
    progress.jsonl      a JSON object a line: how training goes ("kind": "training"), evaluations ("kind": "evaluation")
    tensorboard/        event files
    last.zip            the newest checkpoint; `--resume` goes on from it
    learning-curve.png  return and success over steps
"""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bam_train.atomic_file import remove_orphans
from bam_train.errors import OutputError

LEAST_FREE = 20_000_000
"""Bytes that a disk must have free before training."""


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
        """All records so far, but for lines that a full disk cut off."""
        if not self._progress.exists():
            return []
        records = []
        for line in self._progress.read_text(encoding="utf-8").splitlines():
            with contextlib.suppress(ValueError):
                records.append(json.loads(line))
        return records

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
            raise unwritable(self.path, error, "--runs") from error


def unwritable(path: Path, error: Exception, flag: str) -> OutputError:
    """The error for a file that cannot be written.

    Args:
        path: The file.
        error: What the system, or who wrote it, said.
        flag: What chooses another place.
    """
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    why = getattr(cause, "strerror", None) or cause
    if isinstance(cause, (NotADirectoryError, FileExistsError)):
        in_the_way = next((one for one in (path, *path.parents) if one.is_file()), None)
        why = f"{in_the_way or path} is a file, expected a folder"
    return OutputError(f"{path}: cannot be written: {why}. Choose another place with {flag}")


def _make_folder(root: Path, name: str) -> Path:
    """Make the first folder of name, name-2, name-3, … that is not there; two programs never get the same one.

    From those that are there, what killed runs left half written is removed.
    """
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
            for checkpoint in ("last.zip", "best.zip"):
                remove_orphans(path / checkpoint)
            number += 1
            continue
        return path


def require_writable(path: Path) -> None:
    """Find out before training whether a checkpoint can be written to `path`; nothing is left behind.

    Args:
        path: Where the checkpoint will go.

    Raises:
        OutputError: It is a folder, its folder cannot be written to, or the disk is full.
    """
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file in it, such as --out {path / 'policy.zip'}")
    _require_room(path, path.parent, "--out")


def require_room(root: Path) -> None:
    """Find out before training whether the folder that runs are kept in can be written to; it is not made yet.

    Raises:
        OutputError: It cannot be written to, or the disk is full.
    """
    _require_room(root, root, "--runs")


def _require_room(path: Path, folder: Path, flag: str) -> None:
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            free = shutil.disk_usage(there).free
    except OSError as error:
        raise unwritable(path, error, flag) from error
    if free < LEAST_FREE:
        found, expected = f"{free / 1e6:.1f} MB", f"{LEAST_FREE / 1e6:.0f} MB"
        raise OutputError(
            f"{path}: the disk has {found} free, expected at least {expected}. Choose another place with {flag}"
        )


def draw_curve(records: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """Draw return (and success, if the environment knows it) over steps into a PNG.

    Args:
        records: Those of ``progress.jsonl``; "training" ones make thin lines, "evaluation" ones dots.
        title: Heading.
        path: The picture.

    Raises:
        OutputError: It cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = ["return_mean"]
    if any(record.get("success_rate") is not None for record in records):
        names.append("success_rate")
    figure = Figure(figsize=(8, 2.6 * len(names) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(plots, names, strict=True):
        _draw(axes, records, name)
    plots[0].set_title(title)
    if plots[0].get_legend_handles_labels()[0]:
        plots[0].legend(loc="lower right")
    plots[-1].set_xlabel("steps")
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _draw(axes: Any, records: Sequence[dict[str, Any]], name: str) -> None:
    for kind, style in (("training", {"linewidth": 1, "alpha": 0.7}), ("evaluation", {"marker": "o", "markersize": 4})):
        rows = [(row["steps"], row[name]) for row in records if row["kind"] == kind and row.get(name) is not None]
        if rows:
            axes.plot(*zip(*rows, strict=True), label=kind, **style)
    axes.set_ylabel({"return_mean": "mean return", "success_rate": "success rate"}[name])
    if name == "success_rate":
        axes.set_ylim(-0.03, 1.03)
    axes.grid(alpha=0.3)
