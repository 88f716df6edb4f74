"""``runs/<name>/``: the files of a run.

::

    config.json         all settings; `--config` reads it
    progress.jsonl      a JSON object per line: training statistics ("kind": "training") or an evaluation ("evaluation")
    outcome.json        of a run that is done: why it ended, its best evaluation, computer, versions and commit
    tensorboard/        event files
    last.zip            the newest checkpoint; `--resume` continues from it
    tracked.json        ids of the run in the trackers of `--track`
    learning-curve.png  return and success over steps
    traceback.txt       where the code of the environment failed, if it did

`Copies` stores the best checkpoint at an address too, such as a bucket, in case the computer is lost.
"""

import contextlib
import itertools
import json
import shutil
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bam_train.errors import OutputError
from bam_train.files.atomic_file import remove_orphans, replacing
from bam_train.files.place import Place

TRACKED = "tracked.json"
LEAST_FREE = 20_000_000
"""Minimum free bytes of the disk before training."""


class RunFolder:
    """The folder ``root/name`` of one run, or ``root/name-2``, ``-3``, … while the name is taken.

    The folder is new, unless `is_own` says of one that is there that the run goes on in it; temporary files of killed
    runs with the same name are removed. The constructor and every method raise OutputError if they cannot write.
    """

    def __init__(self, root: Path, name: str, is_own: Callable[[Path], bool] = lambda path: False) -> None:
        with writing(root):
            root.mkdir(parents=True, exist_ok=True)
            for number in itertools.count(1):
                self.path = root / (name if number == 1 else f"{name}-{number}")
                try:
                    self.path.mkdir()
                    break
                except FileExistsError:
                    for checkpoint in ("last.zip", "best.zip"):
                        remove_orphans(self.path / checkpoint)
                    if is_own(self.path):
                        break
        self.last = self.path / "last.zip"
        self.tensorboard = self.path / "tensorboard"
        self.curve = self.path / "learning-curve.png"
        self.followers: list[Callable[[Mapping[str, Any]], None]] = []  # get each record too
        self._progress = self.path / "progress.jsonl"

    def write_config(self, settings: Mapping[str, Any]) -> None:
        """Write ``config.json``."""
        self._write("config.json", settings)

    def add(self, record: Mapping[str, Any]) -> None:
        """Append one line to ``progress.jsonl``, and close the file."""
        for follow in self.followers:
            follow(record)
        with writing(self._progress), self._progress.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, allow_nan=False) + "\n")

    def records(self) -> list[dict[str, Any]]:
        """All records so far; see `read_records`."""
        return read_records(self._progress)

    @property
    def outcome(self) -> dict[str, Any] | None:
        """What `write_outcome` has written; None of a run that is not done."""
        return read_object(self.path / "outcome.json")

    def write_outcome(self, outcome: Mapping[str, Any]) -> None:
        """Write ``outcome.json``."""
        self._write("outcome.json", outcome)

    def _write(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file, whole or not at all."""
        with writing(self.path / name), replacing(self.path / name) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")

    def write_traceback(self, error: BaseException) -> str:
        """Write where an exception came from, for whoever corrects it; says so, or nothing if it cannot be written."""
        path = self.path / "traceback.txt"
        try:
            path.write_text("".join(traceback.format_exception(error)), encoding="utf-8")
        except OSError:
            return ""
        return f"; the traceback is in {path}"

    def remove_unfinished(self) -> None:
        """Remove temporary files of an interrupted save."""
        for path in self.path.glob(".*.tmp"):
            path.unlink(missing_ok=True)


def read_records(path: Path) -> list[dict[str, Any]]:
    """The records of a ``progress.jsonl``, without lines that were cut off, and steps that a resumed run repeated."""
    records: list[dict[str, Any]] = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        with contextlib.suppress(ValueError):
            record = json.loads(line)
            newest = [(one["steps"], one["kind"]) for one in records[-2:]]
            if newest and (record["steps"] < newest[-1][0] or (record["steps"], record["kind"]) in newest):
                records = [one for one in records if one["steps"] < record["steps"]]
            records.append(record)
    return records


def read_object(path: Path) -> dict[str, Any] | None:
    """The JSON object in a file; None if there is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Map failures to write `path` to `OutputError`."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error, "--runs") from error


def unwritable(path: Path, error: Exception, flag: str) -> OutputError:
    """The OutputError for `path`, chosen by `flag`, after the exception `error`."""
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    why = getattr(cause, "strerror", None) or cause
    if isinstance(cause, (NotADirectoryError, FileExistsError)):
        in_the_way = next((place for place in (path, *path.parents) if place.is_file()), None)
        why = f"{in_the_way or path} is a file, expected a folder"
    return OutputError(f"{path}: cannot be written: {why}. Choose another place with {flag}")


def require_room(path: Path, flag: str = "--runs", folder: Path | None = None) -> None:
    """Refuse, before training, a place that cannot be written or a full disk; leaves no file there."""
    folder = path if folder is None else folder
    existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            free = shutil.disk_usage(existing).free
    except OSError as error:
        raise unwritable(path, error, flag) from error
    if free < LEAST_FREE:
        found, expected = f"{free / 1e6:.1f} MB", f"{LEAST_FREE / 1e6:.0f} MB"
        raise OutputError(
            f"{path}: the disk has {found} free, expected at least {expected}. Choose another place with {flag}"
        )


def draw_curve(records: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """Draw return, and success if it is known, over steps into a PNG: training as lines, evaluations as dots.

    The losses too, if there are no training episodes because the run learns from a data set.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    losses = {name for record in records for name in record if name.startswith("loss/")}
    names = ["return_mean", *(sorted(losses) if all(record.get("episodes") == 0 for record in records[:1]) else [])]
    if any(record.get("success_rate") is not None for record in records):
        names.append("success_rate")
    figure = Figure(figsize=(8, 2.6 * len(names) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    styles: dict[str, dict[str, Any]] = {
        "training": {"linewidth": 1, "alpha": 0.7},
        "evaluation": {"marker": "o", "markersize": 4},
    }
    for axes, name in zip(plots, names, strict=True):
        for kind, style in styles.items():
            known = [record for record in records if record["kind"] == kind and record.get(name) is not None]
            if known:
                axes.plot([row["steps"] for row in known], [row[name] for row in known], label=kind, **style)
        axes.set_ylabel({"return_mean": "mean return", "success_rate": "success rate"}.get(name, name))
        if name == "success_rate":
            axes.set_ylim(-0.03, 1.03)
        axes.grid(alpha=0.3)
    plots[0].set_title(title)
    if plots[0].get_legend_handles_labels()[0]:
        plots[0].legend(loc="lower right")
    plots[-1].set_xlabel("steps")
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


class Copies:
    """A place to which checkpoints are copied.

    Args:
        url: Address of a `Place`: a file if it ends in ``.zip``, else a folder, such as ``s3://bucket/runs/``. Raises
            OutputError if it is malformed.
    """

    def __init__(self, url: str) -> None:
        if "://" not in url:
            raise OutputError(f"{url}: --copy-to expects an address, such as s3://bucket/runs/, or a file's: file:///…")
        self._place = Place(url)

    def copy(self, checkpoint: Path) -> None:
        """Copy a checkpoint there and overwrite an earlier copy; raises OutputError if that fails."""
        (self._place if self._place.suffix == ".zip" else self._place / checkpoint.name).write(checkpoint)


class TensorBoardFiles:
    """Writes numbers into a folder as TensorBoard's event files; a full disk ends that, and not the run."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(folder))
        self._hook = threading.excepthook
        threading.excepthook = self._thread_failed

    def write(self, numbers: Mapping[str, Any], step: int) -> None:
        """Write numbers at a step."""
        try:
            if self._writer is not None:
                for name, value in numbers.items():
                    self._writer.add_scalar(name, value, step)
                self._writer.flush()
        except OSError:
            self.close()

    def close(self) -> None:
        """Close the files."""
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.suppress(OSError):
                writer.close()
            threading.excepthook = self._hook

    def _thread_failed(self, failed: threading.ExceptHookArgs) -> None:
        """Hide the errors of TensorBoard's thread, which `write` gets too, from standard error."""
        if not (isinstance(failed.exc_value, OSError) and type(failed.thread).__module__.startswith("tensorboard.")):
            self._hook(failed)
