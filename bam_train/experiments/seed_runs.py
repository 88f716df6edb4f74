"""One run a seed: their folders, and their processes, here or on a Ray cluster.

::

    runs/pick-ppo/config.json    the settings of all the runs, without a seed: by them a later call finds the folder
                  outcome.json   which checkpoint is the best one, and where it was copied
                  seed-0/        a run's folder, with best.zip and log.txt, what its process has printed
                  seed-1/ ...

A seed whose folder has an ``outcome.json`` is done; one that has a ``last.zip`` goes on from it.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from bam_train.errors import SettingsError
from bam_train.files.atomic_file import locked
from bam_train.settings import TrainSettings, file_stem
from bam_train.signals import await_end, start_child
from bam_train.trainers.run_folder import RunFolder, read_object

MOST_SEEDS = 1000
POLL = 0.2
"""Seconds between two looks at the runs."""
WHERE = ("seed", "threads", "address")
"""Settings by which the runs of one folder may differ: they do not change what is learnt from a seed."""
CALL = "bam_train.cli.train:train_seed"
"""What trains one seed: the folder is its argument, the settings are the line on its standard input."""


def read_seeds(text: str) -> list[int]:
    """Seeds, in their order, from text such as ``0..4``, ``0,3,7`` or ``0..2,10..12``; raises SettingsError."""
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"(\d{1,15})(?:\.\.(\d{1,15}))?", part.strip())
        if match is None:
            raise SettingsError(f"--seeds: expected whole numbers from 0, such as 0..4 or 0,3,7, found {text!r}")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise SettingsError(f"--seeds {text}: {first} is above {last}; give {last}..{first}")
        if len(seeds) + last - first >= MOST_SEEDS:
            raise SettingsError(f"--seeds {text}: expected at most {MOST_SEEDS:,} seeds")
        seeds += range(first, last + 1)
    twice = [seed for seed, number in Counter(seeds).items() if number > 1]
    if twice:
        raise SettingsError(f"--seeds {text}: {twice[0]} is in it twice; give each seed once")
    return sorted(seeds)


@contextlib.contextmanager
def group_folder(runs: Path, settings: TrainSettings) -> Iterator[tuple[RunFolder, int | None]]:
    """The folder of the runs with these settings, which no other call uses within the ``with`` block, and its lock.

    Raises:
        OutputError: Another call trains in it, or processes of a killed one still save.
    """
    what = what_is_learnt(settings)
    stem = file_stem(settings.env, settings.algo, settings.trainer, settings.env_kwargs)
    folder = RunFolder(runs, stem, lambda path: read_object(path / "config.json") == what)
    folder.write_config(what)
    with locked(folder.path) as lock:
        yield folder, lock


def what_is_learnt(settings: TrainSettings) -> dict[str, Any]:
    """The settings as JSON has them, without `WHERE`."""
    what: dict[str, Any] = json.loads(json.dumps(settings.to_mapping()))
    return {name: value for name, value in what.items() if name not in WHERE}


# Processes


class News(NamedTuple):
    """What has become of a run since the last look."""

    records: list[dict[str, Any]]
    """New lines of its ``progress.jsonl``."""
    status: int | None = None
    """Its exit status, once it has ended."""
    said: str = ""
    """Its last line, once it has ended."""


class SeedProcess:
    """The process that trains one seed.

    Args:
        settings: Of the run, with its seed.
        folder: The run's folder, which exists; by default a temporary one, as on the nodes of a cluster.
        files: The run's folder so far, from `packed`, for a temporary one.
        lock: Descriptor of the lock of `group_folder`.
    """

    def __init__(
        self, settings: dict[str, Any], folder: Path | None = None, files: bytes = b"", lock: int | None = None
    ) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="bam-seed-")) if folder is None else folder
        if files:
            unpack(files, self.folder)
        self._progress, self._log = self.folder / "progress.jsonl", self.folder / "log.txt"
        self._read = self._progress.stat().st_size if self._progress.exists() else 0
        with self._log.open("ab") as log:
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": log, "stderr": log}
            self._process = start_child(
                CALL, str(self.folder), **pipes, pass_fds=[] if lock is None else [lock], text=True
            )
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):  # it has ended, and its status says why
                self._process.stdin.write(json.dumps(settings) + "\n")
                self._process.stdin.flush()

    def news(self) -> News:
        """New records, and how it ended."""
        status, records = self._process.poll(), []
        with contextlib.suppress(FileNotFoundError), self._progress.open("rb") as file:
            if os.fstat(file.fileno()).st_size < self._read:
                self._read = 0  # begun anew
            file.seek(self._read)
            for line in file:
                if line.endswith(b"\n"):
                    self._read += len(line)
                    with contextlib.suppress(ValueError):
                        records.append(json.loads(line))
        if status is None:
            return News(records)
        lines = self._log.read_text(encoding="utf-8", errors="replace").split("\n")
        said = next((line for line in reversed(lines) if line.strip()), "")
        by = f"its process was ended by {signal.Signals(-status).name}" if status < 0 else ""
        return News(records, status, by or said.removeprefix("bam-train: "))

    def stop(self) -> None:
        """Let it save and end; the second time, quit at once."""
        self._process.terminate()

    def kill(self) -> None:
        """Let it quit at once, and wait for its end."""
        self._process.terminate()
        await_end(self._process)

    def packed(self) -> bytes:
        """The run's folder as a zip; a temporary folder is removed."""
        content = pack(self.folder)
        shutil.rmtree(self.folder, ignore_errors=True)
        return content


def pack(folder: Path) -> bytes:
    """The files of a folder as a zip."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for path in (one for one in sorted(folder.rglob("*")) if one.is_file()):
            archive.write(path, path.relative_to(folder))
    return content.getvalue()


def unpack(content: bytes, folder: Path) -> None:
    """Write the files of `pack`."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(folder)


class ClusterSeed:
    """A `SeedProcess` on a node of the Ray cluster that this process has joined, for which it asks for CPUs and GPUs.

    The run's folder goes there when it is begun and comes back when it has ended; if the node dies, it does not.
    """

    def __init__(self, settings: dict[str, Any], folder: Path, cpus: int, gpus: int = 0) -> None:
        import ray

        self._folder = folder
        self._actor = ray.remote(num_cpus=cpus, num_gpus=gpus)(SeedProcess).remote(settings, None, pack(folder))
        self._asked, self._is_there = self._actor.news.remote(), False

    def news(self) -> News:
        """New records, and how it ended."""
        import ray

        if not ray.wait([self._asked], timeout=0)[0]:
            return News([])
        try:
            news: News = ray.get(self._asked)
            self._is_there = True
            if news.status is None:
                self._asked = self._actor.news.remote()
            else:
                unpack(ray.get(self._actor.packed.remote()), self._folder)
                self.kill()
        except ray.exceptions.RayError as error:
            return News([], 1, f"its computer was lost: {str(error).strip().partition(chr(10))[0]}")
        return news

    def stop(self) -> None:
        """Let it save and end; a run that no computer has begun is given up."""
        if self._is_there:
            self._actor.stop.remote()
        else:
            self.kill()

    def kill(self) -> None:
        """End it at once."""
        import ray

        ray.kill(self._actor)


# All of them


@dataclass
class SeedRun:
    """One seed, as it is displayed."""

    settings: TrainSettings
    """With the seed."""
    folder: RunFolder
    lock: int | None = None
    """Descriptor of the lock of the folder, which its process gets."""
    of: str = ""
    """Whose seed it is, where there are several: `` of trial 3``."""
    state: str = "waiting"
    """``waiting``, ``training``, ``stopped``, ``failed`` or ``done``."""
    steps: int = 0
    success: float | None = None
    """Success rate of the last evaluation; None as long as there is none."""
    returns: float | None = None
    left: float | None = None
    """Longest time that it may still train [s]."""
    why: str = ""
    """Why it has ended."""
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    """Their records."""
    is_wanted: bool = True
    """If it is not, it is told to save and end."""
    told: bool = False
    """Whether it was told so."""

    @classmethod
    def there(cls, folder: Path, settings: TrainSettings, seed: int, lock: int | None, of: str = "") -> SeedRun:
        """The run of a seed in the folder of several, as far as it has come."""
        run = cls(replace(settings, seed=seed), RunFolder(folder, f"seed-{seed}", lambda path: True), lock, of)
        run.take(run.folder.records())
        if run.folder.outcome is not None:
            run.end(0, "")
        return run

    @property
    def name(self) -> str:
        """Its seed, and whose it is."""
        return f"{self.settings.seed}{self.of}"

    def take(self, records: Sequence[dict[str, Any]]) -> None:
        """Take over what the records say."""
        for record in records:
            self.steps = record["steps"]
            if record["kind"] == "evaluation":
                self.evaluations = [*(one for one in self.evaluations if one["steps"] < self.steps), record]
                self.success, self.returns = record.get("success_rate"), record.get("return_mean")
            if speed := record.get("steps_per_second"):
                self.left = max(0.0, (self.settings.steps - self.steps) / speed)

    def end(self, status: int, said: str) -> None:
        """Take over how its process has ended."""
        outcome = self.folder.outcome
        if outcome is not None:
            self.state, self.why = "done", outcome["reason"]
        else:
            self.state, self.why = ("stopped", "") if self.told and status in (130, 143) else ("failed", said)
        self.left = None


def run_seeds(
    following: Callable[[], SeedRun | None],
    start: Callable[[SeedRun], SeedProcess | ClusterSeed],
    jobs: int,
    stopped: Callable[[], bool],
    show: Callable[[], None],
) -> None:
    """Train runs, `jobs` at once, until there is no `following` one; once `stopped`, those that train save and end.

    An exception, such as that of a second signal, kills them.
    """
    running: list[tuple[SeedRun, SeedProcess | ClusterSeed]] = []
    try:
        while True:
            while len(running) < jobs and not stopped() and (run := following()) is not None:
                running.append((run, start(run)))
                run.state = "training"
            if not running:
                return
            for run, process in list(running):
                if not run.told and (stopped() or not run.is_wanted):
                    run.told = True
                    process.stop()
                news = process.news()
                run.take(news.records)
                if news.status is not None:
                    running.remove((run, process))
                    run.end(news.status, news.said)
            show()
            if running:
                time.sleep(POLL)
    finally:
        for _, process in running:
            process.kill()


def needs(settings: TrainSettings) -> dict[str, int]:
    """The resources of a run, as Ray names them."""
    runners = getattr(settings, "num_env_runners", 0) + getattr(settings, "num_learners", 0)
    return {"CPU": settings.threads + runners, "GPU": int(settings.device.startswith("cuda"))}


def at_once(needed: Mapping[str, int], nodes: Sequence[Mapping[str, float]]) -> int:
    """How many runs fit side by side on computers with these resources."""
    return sum(int(min(node.get(name, 0) // number for name, number in needed.items() if number)) for node in nodes)
