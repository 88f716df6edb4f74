"""The files of a data set, as LeRobot v3.0 lays them out, and what bam-train keeps beside them.

=======================================  =============================================================================
meta/info.json                           LeRobot's: features, rate, numbers of episodes and frames; written last
meta/bam.json                            `DataSetInfo`, and dtype and shape of the columns that are no part of spaces
meta/stats.json                          least, greatest, mean, deviation and quantiles of each column
meta/tasks.parquet                       sentence of each task
meta/episodes/chunk-000/file-000.parquet one row an episode; columns ``bam/...``: digest, end, facts, last observation
data/chunk-000/file-000.parquet          one row a step, one row group an episode
copies/chunk-000/file-000.zip            `Copy`: what makes bam.json and the two files of that number whole again
=======================================  =============================================================================

A flush adds one copy, one data file, then one episodes file of the same number, then replaces info.json. What info.json
does not count yet does not exist for readers.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
import json
import os
import re
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from bam_train.data.arrow_columns import Arrow
from bam_train.errors import BadDataSet, NoSuchPlace, PlaceError
from bam_train.files.atomic_file import LOCKS, lock
from bam_train.files.place import Place

LOCK, MENDING = "meta/.writer", "meta/.mending"
UNREADABLE = (OSError, ValueError, LookupError, TypeError, MemoryError, NotImplementedError, OverflowError)
"""What pyarrow and Pillow raise for damaged bytes."""
VERSION = "v3.0"
FORMAT = 1
"""Of bam.json."""
CHUNK = 1000
"""Files of a folder."""
INFO, BAM, STATS, TASKS = "meta/info.json", "meta/bam.json", "meta/stats.json", "meta/tasks.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
COPIES = "copies/chunk-{chunk_index:03d}/file-{file_index:03d}.zip"
NUMBERED, REPLACED = (DATA, EPISODES, COPIES), (INFO, BAM, STATS, TASKS)
"""What a flush adds, and what it replaces."""
DEFAULTS = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64"} | {
    "task_index": "int64"
}
"""Columns that LeRobot needs."""
STATES = STATE, STATE_ALONE = ("observation.state", "observation.environment_state")
"""What LeRobot's networks call a vector beside images, and one without any."""
NEXT = ("next.reward", "next.done", "next.terminated", "next.truncated", "next.success")
FINAL = "bam/final/"
"""Prefix of the columns of an episodes file with the last observation."""
LIGHT = (
    *("episode_index", "tasks", "length", "dataset_from_index", "data/chunk_index", "data/file_index"),
    *("bam/digest", "bam/terminated", "bam/truncated", "bam/success", "bam/return", "bam/facts", "bam/columns"),
)
"""Columns of an episodes file that are read when a data set is opened."""
EXTRA, ROW = "bam/extra", "bam/row"
"""Columns with the digests of the further columns of an episode, and of its row (`row_digest`); older data sets lack
both."""


class Files:
    """The files of one data set."""

    def __init__(self, place: str | Path | Place) -> None:
        self.root = Place(place)
        self.text = str(place)

    def exists(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return (self.root / name).exists()

    def require(self) -> None:
        """Raise BadDataSet unless a data set, or a part of one, is there; it names a bucket that is not there."""
        if self.exists(INFO):  # who may read objects of a bucket may not list them
            return
        remedy = "give a folder that bam-data wrote, or make one of recordings or Parquet rows: bam-data import PLACE "
        remedy += self.text
        if not self.root.is_dir():
            try:
                self.root.size()
            except NoSuchPlace as error:
                raise BadDataSet(str(error)) from error
            raise BadDataSet(f"{self.text}: is no data set but a file; {remedy}")
        if not any(self.exists(name) for name in (BAM, "meta/episodes", "data", "copies")):
            raise BadDataSet(f"{self.text}: is no data set: it has no {INFO}; {remedy}")

    def damaged(self, what: str) -> BadDataSet:
        """The error for `what` is not whole."""
        return BadDataSet(f"{self.text}: {what}; run bam-data check {self.text}")

    def content(self, name: str) -> bytes | None:
        """The bytes of a file; None if there is none."""
        try:
            return (self.root / name).read_bytes()
        except NoSuchPlace:
            return None

    def read_json(self, name: str) -> dict[str, Any]:
        """The content of a JSON file."""
        try:
            value = json.loads((self.root / name).read_bytes())
        except NoSuchPlace as error:
            raise self.damaged(f"{name} is missing") from error
        except PlaceError:
            raise
        except (OSError, ValueError) as error:
            raise self.damaged(f"{name} cannot be read: {error}") from error
        if not isinstance(value, dict):
            raise self.damaged(f"{name} is no JSON object")
        return value

    def write(self, name: str, content: bytes) -> None:
        """Replace a file."""
        (self.root / name).write(content)

    def write_json(self, name: str, value: dict[str, Any]) -> None:
        """Replace a JSON file."""
        self.write(name, json_bytes(value))

    def numbers(self, template: str) -> list[int]:
        """The numbers of the data files, episodes files or copies that are there."""
        folder = self.root / template.partition("/chunk")[0]
        chunks = [one for one in (folder.list() if folder.is_dir() else ()) if re.fullmatch(r"chunk-\d{3,}", one.name)]
        paths = [(chunk.name, file.name) for chunk in chunks for file in chunk.list()]
        kind = re.escape(template.rpartition(".")[2])
        found = [(chunk, re.fullmatch(rf"file-(\d{{3}})\.{kind}", file)) for chunk, file in paths]
        return sorted(int(chunk[6:]) * CHUNK + int(match[1]) for chunk, match in found if match)

    def copy_aside(self, name: str, folder: str) -> list[str]:
        """Copy a file, if it is there, into a folder of the data set, under the first free name; returns that name."""
        if not self.exists(name):
            return []
        target = f"{folder}/{name.replace('/', '-')}"
        copies = itertools.chain([target], (f"{target}.{k}" for k in itertools.count(2)))
        free = next(one for one in copies if not self.exists(one))
        self.write(free, (self.root / name).read_bytes())
        return [free]

    def delete(self, name: str) -> None:
        """Delete a file, if it is there."""
        if self.exists(name):
            (self.root / name).delete()

    def remove_empty(self, *, is_new: bool) -> None:
        """Remove the folders of a data set that has no file any more, and with `is_new` that of them all."""
        self.delete(LOCK)
        if (root := self.root.local) is not None:
            folders = [root / name for name in ("copies", "data", "meta/episodes", "meta")]
            for path in [*(chunk for one in folders for chunk in one.glob("chunk-*")), *folders, *[root] * is_new]:
                with contextlib.suppress(OSError):  # it is not there, or not empty
                    path.rmdir()

    def open_parquet(self, name: str, columns: Sequence[str] | None = None) -> Any:
        """A ``pyarrow.parquet.ParquetFile``, or the table of some of its columns.

        Raises:
            BadDataSet: The file is missing or damaged.
        """
        import pyarrow.parquet as pq

        try:
            place = self.root / name
            options = {"pre_buffer": place.local is None, "page_checksum_verification": True}  # few, large requests
            file = pq.ParquetFile(place.local or place.open_input(), **options)
            return file if columns is None else file.read(columns=list(columns))
        except FileNotFoundError as error:
            raise self.damaged(f"{name} is missing") from error
        except PlaceError:
            raise
        except UNREADABLE as error:
            why = str(error).partition("\n")[0].rstrip(".")
            raise self.damaged(f"{name} is damaged or no Parquet file: {why}") from error


class WriterLock:
    """The right to write a data set, which ends with the process; in a bucket, a note of who writes.

    Raises:
        BadDataSet: Somebody else has it, or the place cannot be written.
    """

    def __init__(self, files: Files) -> None:
        self._text, self._note = files.text, files.root / LOCK
        since = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
        me = f"process {os.getpid()} on {socket.gethostname()} since {since}"
        self._file: IO[str] | None = None
        if self._note.local is None:
            who = self._note.read_bytes().decode() if self._note.exists() else ""
            if who and _may_live(who):
                self._refuse(who, f". If that has ended: remove {self._note}")
            self._note.write(me.encode())
        else:
            self._file = self._locked(self._note.local)
            self._file.truncate(0)
            self._file.write(me)
            self._file.flush()
        self.is_held = True
        """Whether it has not been released."""

    def _locked(self, path: Path) -> IO[str]:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("a+")
        except (NotADirectoryError, FileExistsError) as error:
            raise BadDataSet(f"{self._text}: is a file, and a data set is a folder; choose another place") from error
        except OSError as error:
            raise BadDataSet(f"{self._text}: cannot be written: {error.strerror}; choose another place") from error
        try:
            lock(file, wait=False)
        except OSError:
            file.seek(0)
            who = file.read() or "another process"
            file.close()
            self._refuse(who)
        return file

    def _refuse(self, who: str, more: str = "") -> None:
        raise BadDataSet(
            f"{self._text}: is being written by {who}; wait for its end, or write into another place and use "
            f"bam-data merge{more}"
        )

    def release(self) -> None:
        """Let others write; idempotent."""
        if self.is_held and self._file is None:
            self._note.delete()
        elif self.is_held and self._file is not None:
            self._file.truncate(0)
            self._file.close()
        self.is_held = False


def _may_live(who: str) -> bool:
    """Whether a writer may still write; of one on another computer nobody knows."""
    _, process, _, host, *_ = [*who.split(), *[""] * 5]
    try:
        if LOCKS and host == socket.gethostname():
            os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (PermissionError, ValueError):
        pass
    return True


def parquet_bytes(table: Arrow, groups: Sequence[int] = ()) -> bytes:
    """A Parquet file; `groups` are the rows of each row group."""
    import pyarrow.parquet as pq

    texts = [field.name for field in table.schema if str(field.type) == "string"]
    buffer = io.BytesIO()
    options = {"compression": "snappy", "use_dictionary": texts}  # a dictionary of floats would merge kinds of NaN
    with pq.ParquetWriter(buffer, table.schema, write_page_checksum=True, **options) as writer:
        first = 0
        for rows in groups or [len(table)]:
            writer.write_table(table.slice(first, rows), row_group_size=max(rows, 1))
            first += rows
    return buffer.getvalue()


def json_bytes(value: Mapping[str, Any]) -> bytes:
    """The content of a JSON file."""
    return json.dumps(value, indent=2).encode()


def sealed(value: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON object with its own SHA-256 as its last value, ``digest``."""
    plain = {name: one for name, one in value.items() if name != "digest"}
    return {**plain, "digest": hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()}


def row_digest(row: Mapping[str, Any]) -> str:
    """SHA-256 of the values of a row of an episodes file that are read when a data set is opened."""
    return hashlib.sha256(json.dumps([row.get(name) for name in (*LIGHT, EXTRA)]).encode()).hexdigest()


def file_name(template: str, number: int) -> str:
    """Name of the data or episodes file with this number, counted from 0."""
    return template.format(chunk_index=number // CHUNK, file_index=number % CHUNK)


def tasks_table(tasks: list[str]) -> Arrow:
    """The table of tasks as pandas writes it: LeRobot takes the sentences from the index of its frame."""
    import pyarrow as pa

    def kind(name: str, pandas: str, numpy: str) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": pandas, "numpy_type": numpy, "metadata": None}

    columns = [kind("task_index", "int64", "int64"), kind("task", "unicode", "object")]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.3"}
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
