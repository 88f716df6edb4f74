"""The files of a data set, as LeRobot v3.0 lays them out, and what bam-train keeps beside them.

=======================================  =============================================================================
meta/info.json                           LeRobot's: features, rate, numbers of episodes and frames; written last
meta/bam.json                            `DataSetInfo`, and dtype and shape of the columns that are no part of spaces
meta/stats.json                          least, greatest, mean, deviation and quantiles of each column
meta/tasks.parquet                       sentence of each task
meta/episodes/chunk-000/file-000.parquet one row an episode; columns ``bam/...``: digest, end, facts, last observation
data/chunk-000/file-000.parquet          one row a step, one row group an episode
=======================================  =============================================================================

A flush adds one data file, then one episodes file of the same number, then replaces info.json. What info.json does not
count yet does not exist for readers.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bam_train.data.arrow_columns import Arrow
from bam_train.errors import BadDataSet, PlaceError
from bam_train.place import Place

VERSION = "v3.0"
FORMAT = 1
"""Of bam.json."""
CHUNK = 1000
"""Files of a folder."""
INFO, BAM, STATS, TASKS = "meta/info.json", "meta/bam.json", "meta/stats.json", "meta/tasks.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DEFAULTS = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64"} | {
    "task_index": "int64"
}
"""Columns that LeRobot needs."""
NEXT = ("next.reward", "next.done", "next.terminated", "next.truncated", "next.success")
FINAL = "bam/final/"
"""Prefix of the columns of an episodes file with the last observation."""
LIGHT = (
    *("episode_index", "tasks", "length", "dataset_from_index", "data/chunk_index", "data/file_index"),
    *("bam/digest", "bam/terminated", "bam/truncated", "bam/success", "bam/return", "bam/facts", "bam/columns"),
)
"""Columns of an episodes file that are read when a data set is opened."""


class Files:
    """The files of one data set."""

    def __init__(self, place: str | Path | Place) -> None:
        self.root = Place(place)
        self.text = str(place)

    def exists(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return (self.root / name).exists()

    def read_json(self, name: str) -> dict[str, Any]:
        """The content of a JSON file."""
        try:
            value = json.loads((self.root / name).read_bytes())
        except FileNotFoundError as error:
            raise BadDataSet(f"{self.text}: {name} is missing; copy the folder again, whole") from error
        except PlaceError:
            raise
        except (OSError, ValueError) as error:
            raise BadDataSet(f"{self.text}: {name} cannot be read: {error}; run bam-data check {self.text}") from error
        if not isinstance(value, dict):
            raise BadDataSet(f"{self.text}: {name} is no JSON object; run bam-data check {self.text}")
        return value

    def write_json(self, name: str, value: dict[str, Any]) -> None:
        """Replace a JSON file."""
        with (self.root / name).replacing() as path:
            path.write_text(json.dumps(value, indent=2))

    def write_table(self, name: str, table: Arrow, groups: list[int] | None = None) -> None:
        """Replace a Parquet file; `groups` are the rows of each row group."""
        import pyarrow.parquet as pq

        texts = [field.name for field in table.schema if str(field.type) == "string"]
        options = {"compression": "snappy", "use_dictionary": texts}  # a dictionary of floats would merge kinds of NaN
        with (self.root / name).replacing() as path, pq.ParquetWriter(path, table.schema, **options) as writer:
            first = 0
            for rows in groups or [len(table)]:
                writer.write_table(table.slice(first, rows), row_group_size=max(rows, 1))
                first += rows

    def open_parquet(self, name: str) -> Any:
        """A ``pyarrow.parquet.ParquetFile``."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            file = self.root / name
            return pq.ParquetFile(file.local or file.open_input(), pre_buffer=file.local is None)  # few, large requests
        except FileNotFoundError as error:
            raise BadDataSet(f"{self.text}: {name} is missing; run bam-data check {self.text}") from error
        except PlaceError:
            raise
        except (OSError, pa.ArrowInvalid) as error:
            why = str(error).partition("\n")[0]
            raise BadDataSet(
                f"{self.text}: {name} is truncated or no Parquet file: {why}; run bam-data check {self.text}"
            ) from error


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
