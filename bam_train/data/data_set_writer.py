"""Write episodes into a data set; what is there already stays as it is."""

from __future__ import annotations

import json
import os
import socket
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_envs.core.wording import brief
from bam_train.data.arrow_columns import feature_of, to_arrow
from bam_train.data.data_set import DataSet
from bam_train.data.episode import Array, DataSetInfo, Episode, Leaf, digest_of, leaves_of
from bam_train.data.layout import (
    BAM,
    CHUNK,
    DATA,
    DEFAULTS,
    EPISODES,
    FINAL,
    FORMAT,
    INFO,
    NEXT,
    STATS,
    TASKS,
    VERSION,
    Files,
    file_name,
    tasks_table,
)
from bam_train.data.statistics import add_stats
from bam_train.environments import first_difference, short_json
from bam_train.errors import BadDataSet
from bam_train.place import Place

if TYPE_CHECKING:
    from typing_extensions import Self

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

LOCK = "meta/.writer"
ELSEWHERE = "wait for its end, or write into another place and use bam-data merge"


class DataSetWriter:
    """Appends episodes to the data set at `place`, which is made if there is none; a context manager.

    Args:
        place: The folder.
        info: What is equal for all episodes; it must be that of the episodes that are there.
        flush_episodes: Number of episodes that are kept in memory before they are written.
        flush_bytes: Size of episodes in memory [bytes] from which they are written earlier.

    Raises:
        BadDataSet: Another writer has it, or it holds episodes of another environment, other spaces or another period.
    """

    def __init__(
        self, place: str | Path | Place, info: DataSetInfo, *, flush_episodes: int = 50, flush_bytes: int = 2**26
    ) -> None:
        self._files, self.info = Files(place), info
        self._flush_episodes, self._flush_bytes = flush_episodes, flush_bytes
        self._observation, self._action = (
            leaves_of(info.observation_space, "observation"),
            leaves_of(info.action_space, "action"),
        )
        self._waiting: list[tuple[Episode, dict[str, Array], dict[str, Array]]] = []
        """Each episode, the columns of its steps, and its last observation by column."""
        self._bytes = 0
        self._lock = self._locked()
        try:
            self._open()
        except BaseException:
            self._unlock()
            raise

    def _open(self) -> None:
        self._extra: dict[str, dict[str, Any]] = {}
        self._features: dict[str, Any] = {}
        self._episodes = self._frames = self._file = 0
        self._tasks: list[str] = []
        self._stats: dict[str, Any] = {}
        if not self._files.exists(INFO):
            self._write_bam()
            self._write_info()
            return
        old = DataSet.open(self._files.text)
        require_same(self._files.text, old.info, self.info)
        self._extra, self._features = dict(old.extra), dict(old.features)
        self._episodes, self._frames, self._file = len(old), old.total_frames, old.next_file
        self._tasks = list(old.tasks)
        self._stats = self._files.read_json(STATS) if self._files.exists(STATS) else {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def add(self, episode: Episode) -> int:
        """Add an episode, whose digest is filled in; returns its index. It is on the disk after the next flush.

        Raises:
            BadDataSet: Its arrays do not fit the spaces, each other, or the columns of earlier episodes.
        """
        columns, final = self._checked(episode)
        index = self._episodes + len(self._waiting)
        self._waiting.append((episode, columns, final))
        self._bytes += sum(array.nbytes for array in columns.values())
        if len(self._waiting) >= self._flush_episodes or self._bytes >= self._flush_bytes:
            self.flush()
        return index

    def _checked(self, episode: Episode) -> tuple[dict[str, Array], dict[str, Array]]:
        steps = len(episode.rewards)
        if not steps:
            raise BadDataSet(f"{self._files.text}: an episode without a step; leave it out")
        observed = {one.column: self._array(one, episode.observations, steps + 1) for one in self._observation}
        acted = {one.column: self._array(one, episode.actions, steps) for one in self._action}
        rewards = np.asarray(episode.rewards, np.float64)
        end = (episode.terminated, episode.truncated, episode.success)
        episode.digest = digest_of({**observed, **acted, "reward": rewards}, *end)
        extra = {name: self._extra_column(name, values, steps) for name, values in episode.columns.items()}
        last = np.zeros(steps, bool)
        last[-1] = True
        ends = [last, last & episode.terminated, last & episode.truncated, last & bool(episode.success)]
        columns = {name: values[:-1] for name, values in observed.items()} | acted
        columns |= dict(zip(NEXT, [rewards, *ends], strict=True)) | extra
        return columns, {name: values[-1:] for name, values in observed.items()}

    def _array(self, leaf: Leaf, values: Any, count: int) -> Array:
        try:
            array = np.asarray(leaf.of(values))
        except (KeyError, IndexError, TypeError) as error:
            raise BadDataSet(f"{self._files.text}: the episode has no {leaf.column}") from error
        if array.shape != (count, *leaf.shape):
            wanted = (count, *leaf.shape)
            raise BadDataSet(f"{self._files.text}: {leaf.column}: expected shape {wanted}, found {array.shape}")
        if array.dtype != leaf.dtype:
            if not np.can_cast(array.dtype, leaf.dtype, "same_kind"):
                raise BadDataSet(f"{self._files.text}: {leaf.column}: expected {leaf.dtype}, found {array.dtype}")
            array = array.astype(leaf.dtype)
        return array

    def _extra_column(self, name: str, values: Any, steps: int) -> Array:
        array = np.asarray(values)
        kind = "str" if array.dtype.kind in "UO" else str(array.dtype)
        found = {"dtype": kind, "shape": list(array.shape[1:])}
        if "/" in name or name in DEFAULTS or name.startswith(("observation.", "action", "next.", "bam")):
            raise BadDataSet(f"{self._files.text}: a column cannot be called {name!r}; choose another name")
        if array.shape[:1] != (steps,):
            raise BadDataSet(f"{self._files.text}: column {name}: expected {steps} steps, found shape {array.shape}")
        known = self._extra.setdefault(name, found)
        if known != found:
            raise BadDataSet(
                f"{self._files.text}: column {name} is {found['dtype']} of shape {found['shape']}, and that of earlier "
                f"episodes {known['dtype']} of {known['shape']}; give it another name"
            )
        return array

    def flush(self) -> None:
        """Write the episodes in memory: a data file, an episodes file, then info.json."""
        if not self._waiting:
            return
        import pyarrow as pa

        waiting = self._waiting
        tables, rows, frames = [], [], self._frames
        names = list(dict.fromkeys(name for _, columns, _ in waiting for name in columns))
        is_image = {leaf.column: leaf.is_image for leaf in self._observation}
        for number, (episode, columns, final) in enumerate(waiting, self._episodes):
            task = self._task(episode)
            steps = len(episode.rewards)
            table = {name: to_arrow(values, is_image=is_image.get(name, False)) for name, values in columns.items()}
            table |= self._default_columns(number, task, frames, steps)
            tables.append(pa.table(table))
            rows.append(self._row(number, episode, final, frames, steps, list(episode.columns)))
            frames += steps
        for name in names:
            values = next(columns[name] for _, columns, _ in waiting if name in columns)
            self._features.setdefault(name, feature_of(values, self._names(name), is_image=is_image.get(name, False)))
        self._write_bam()
        lengths = [len(table) for table in tables]
        self._files.write_table(
            file_name(DATA, self._file), pa.concat_tables(tables, promote_options="default"), lengths
        )
        self._files.write_table(TASKS, tasks_table(self._tasks))
        self._files.write_table(file_name(EPISODES, self._file), _episode_table(rows, is_image))
        self._stats = add_stats(self._stats, [columns for _, columns, _ in waiting], is_image)
        self._files.write_json(STATS, self._stats)
        self._episodes, self._frames, self._file = self._episodes + len(waiting), frames, self._file + 1
        self._write_info()
        self._waiting, self._bytes = [], 0

    def _task(self, episode: Episode) -> int:
        task = str(episode.facts.get("task") or self.info.env)
        if task not in self._tasks:
            self._tasks.append(task)
        return self._tasks.index(task)

    def _default_columns(self, number: int, task: int, frames: int, steps: int) -> dict[str, Any]:
        import pyarrow as pa

        index = np.arange(steps)
        columns = {
            "timestamp": (index / self.info.fps).astype(np.float32),
            "frame_index": index,
            "episode_index": np.full(steps, number),
            "index": frames + index,
            "task_index": np.full(steps, task),
        }
        return {name: pa.array(values) for name, values in columns.items()}

    def _row(
        self, number: int, episode: Episode, final: dict[str, Array], frames: int, steps: int, names: list[str]
    ) -> dict[str, Any]:
        places = {"chunk_index": self._file // CHUNK, "file_index": self._file % CHUNK}
        return {
            "episode_index": number,
            "tasks": [self._tasks[self._task(episode)]],
            "length": steps,
            **{f"data/{name}": value for name, value in places.items()},
            "dataset_from_index": frames,
            "dataset_to_index": frames + steps,
            **{f"meta/episodes/{name}": value for name, value in places.items()},
            "bam/digest": episode.digest,
            "bam/terminated": bool(episode.terminated),
            "bam/truncated": bool(episode.truncated),
            "bam/success": None if episode.success is None else bool(episode.success),
            "bam/return": float(np.sum(episode.rewards)),
            "bam/facts": json.dumps(episode.facts),
            "bam/columns": json.dumps(names),
            **{FINAL + name: values for name, values in final.items()},
        }

    def _names(self, column: str) -> list[str] | None:
        kind = {"observation.state": "observation", "action": "action", "command": "command"}.get(column)
        labels = self.info.contract.get(kind or "", [])
        return [str(one.get("name")) for one in labels] or None

    def _write_bam(self) -> None:
        self._files.write_json(BAM, {"format": FORMAT, **self.info.to_json(), "columns": self._extra})

    def _write_info(self) -> None:
        """Replace info.json: from now on, readers see the new episodes."""
        scalars = {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in DEFAULTS.items()}
        content = {
            "codebase_version": VERSION,
            "robot_type": self.info.robot or None,
            "total_episodes": self._episodes,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.info.fps,
            "splits": {"train": f"0:{self._episodes}"},
            "data_path": DATA,
            "video_path": None,
            "features": {**self._features, **scalars},
        }
        self._files.write_json(INFO, content)

    def close(self) -> None:
        """Flush, and let others write."""
        if self._lock is None:
            return
        try:
            self.flush()
        finally:
            self._unlock()

    def _locked(self) -> Any:
        path = self._files.root.local and self._files.root.local / LOCK
        if path is None:
            return self._noted()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("a+")
        except OSError as error:
            raise BadDataSet(
                f"{self._files.text}: cannot be written: {error.strerror}; choose another place"
            ) from error
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            who = file.read() or "another process"
            file.close()
            raise BadDataSet(f"{self._files.text}: is being written by {who}; {ELSEWHERE}") from error
        file.truncate(0)
        file.write(_writer())
        file.flush()
        return file

    def _noted(self) -> Place:
        """The lock in a bucket, which has none of its own: a note of who writes; nobody's if its process has ended."""
        note = self._files.root / LOCK
        who = note.read_bytes().decode() if note.exists() else ""
        if who and _is_alive(who):
            raise BadDataSet(
                f"{self._files.text}: is being written by {who}; {ELSEWHERE}. If that has ended: remove {note}"
            )
        note.write_bytes(_writer().encode())
        return note

    def _unlock(self) -> None:
        if isinstance(self._lock, Place):
            self._lock.delete()
        elif self._lock is not None:
            self._lock.truncate(0)
            self._lock.close()
        self._lock = None


def _is_alive(who: str) -> bool:
    """Whether a writer may still write; of one on another computer nobody knows."""
    _, process, _, host, *_ = [*who.split(), *[""] * 5]
    try:
        if fcntl is not None and host == socket.gethostname():
            os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (PermissionError, ValueError):
        pass
    return True


def _writer() -> str:
    """Who writes, and since when."""
    since = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    return f"process {os.getpid()} on {socket.gethostname()} since {since}"


def require_same(place: str, there: DataSetInfo, given: DataSetInfo) -> None:
    """Refuse episodes that do not belong to those that are there.

    Raises:
        BadDataSet: Names the first thing that differs, and both values.
    """
    old, new = there.to_json(), given.to_json()
    for name in ("env", "env_kwargs", "observation_space", "action_space", "period", "contract", "robot"):
        difference = first_difference(old[name], new[name], name)
        if difference is not None:
            what, theirs, ours = difference
            raise BadDataSet(
                f"{place}: {what} is {short_json(theirs)} there, and {short_json(ours)} of the new episodes; "
                f"write {brief(given.env)} into another place"
            )


def _episode_table(rows: list[dict[str, Any]], is_image: dict[str, bool]) -> Any:
    import pyarrow as pa

    columns: dict[str, Any] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        if name.startswith(FINAL):
            columns[name] = to_arrow(np.concatenate(values), is_image=is_image[name.removeprefix(FINAL)])
        else:
            columns[name] = pa.array(values, pa.bool_() if name == "bam/success" else None)
    return pa.table(columns)
