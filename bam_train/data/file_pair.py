"""One data file and the episodes file of the same number, which a flush writes together, and the copy of both."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bam_train.data import layout
from bam_train.data.arrow_columns import Arrow, to_arrow
from bam_train.data.layout import Files, file_name, json_bytes, parquet_bytes, row_digest, sealed, tasks_table
from bam_train.data.recorded_episode import Array, DataSetInfo, Episode, digest_of

_TAIL = struct.Struct("<I4s")  # how a Parquet file ends: length of its footer, magic
MAGIC = b"PAR1"
"""How a Parquet file begins and ends."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
MOST_IMAGES = 20
"""Pictures of one file that are looked at."""


@dataclass
class Columns:
    """An episode as columns."""

    episode: Episode
    steps: dict[str, Array]
    """Of each step, the further columns included. Shape: (T, ...)."""
    final: dict[str, Array]
    """The last observation. Shape: (1, ...)."""

    @classmethod
    def of(cls, episode: Episode, observed: Mapping[str, Array], acted: Mapping[str, Array]) -> Columns:
        """An episode with its observations, (T + 1, ...), and actions by column."""
        last = np.arange(len(episode)) == len(episode) - 1
        ends = [last, last & episode.terminated, last & episode.truncated, last & bool(episode.success)]
        steps = {name: values[:-1] for name, values in observed.items()} | dict(acted)
        steps |= dict(zip(layout.NEXT, [episode.rewards, *ends], strict=True)) | episode.columns
        return cls(episode, steps, {name: values[-1:] for name, values in observed.items()})

    @classmethod
    def read(cls, episode: Episode, info: DataSetInfo) -> Columns:
        """An episode as a reader gives it."""
        observed = {leaf.column: leaf.of(episode.observations) for leaf in info.observation_leaves}
        return cls.of(episode, observed, {leaf.column: leaf.of(episode.actions) for leaf in info.action_leaves})


@dataclass
class Head:
    """How far a data set is written: the content of its info.json, stats.json and tasks.parquet."""

    info: DataSetInfo
    extra: dict[str, dict[str, Any]]
    """Dtype and shape of each further column."""
    episodes: int = 0
    frames: int = 0
    file: int = 0
    """Number of the next file."""
    tasks: list[str] = field(default_factory=list)
    stats: dict[str, Any] = field(default_factory=dict)

    @property
    def _images(self) -> set[str]:
        return {leaf.column for leaf in self.info.observation_leaves if leaf.is_image}

    def task(self, episode: Episode) -> int:
        """Index of the episode's task, which is added if it is new."""
        task = str(episode.facts.get("task") or self.info.env)
        if task not in self.tasks:
            self.tasks.append(task)
        return self.tasks.index(task)

    def count(self, episode: Episode) -> None:
        """Count the next episode."""
        self.task(episode)
        self.episodes, self.frames = self.episodes + 1, self.frames + len(episode)

    def add_stats(self, episodes: Sequence[Columns]) -> None:
        """Add the steps of the episodes of a file to the statistics."""
        self.stats = add_stats(self.stats, [one.steps for one in episodes], self._images)

    def write_pair(self, files: Files, episodes: Sequence[Columns]) -> None:
        """Write the next copy, data file and episodes file; `write` makes them visible."""
        import pyarrow as pa

        tables, rows, images = [], [], self._images
        for one in episodes:
            for name, values in one.episode.columns.items():
                self.extra.setdefault(name, kind_of(values))
            steps = {name: to_arrow(values, is_image=name in images) for name, values in one.steps.items()}
            tables.append(pa.table(steps | self.places(one.episode)))
            rows.append(self._row(one))
            self.count(one.episode)
        self.add_stats(episodes)
        data = parquet_bytes(pa.concat_tables(tables, promote_options="default"), [len(table) for table in tables])
        heads = parquet_bytes(_table(rows, images))
        files.write(file_name(layout.COPIES, self.file), self.copy(data, heads).to_bytes())
        files.write(file_name(layout.DATA, self.file), data)
        files.write(file_name(layout.EPISODES, self.file), heads)
        self.file += 1

    def places(self, episode: Episode) -> dict[str, Arrow]:
        """The columns that LeRobot needs, of the next episode."""
        import pyarrow as pa

        index = np.arange(len(episode))
        columns = {
            "timestamp": (index / self.info.fps).astype(np.float32),
            "frame_index": index,
            "episode_index": np.full(len(episode), self.episodes),
            "index": self.frames + index,
            "task_index": np.full(len(episode), self.task(episode)),
        }
        return {name: pa.array(values) for name, values in columns.items()}

    def numbers(self, episode: Episode) -> dict[str, Any]:
        """What of the row of the next episode follows from the episodes before."""
        places = {"chunk_index": self.file // layout.CHUNK, "file_index": self.file % layout.CHUNK}
        return {
            "episode_index": self.episodes,
            "tasks": [self.tasks[self.task(episode)]],
            "length": len(episode),
            **{f"data/{name}": value for name, value in places.items()},
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + len(episode),
            **{f"meta/episodes/{name}": value for name, value in places.items()},
        }

    def _row(self, one: Columns) -> dict[str, Any]:
        episode = one.episode
        row = {
            **self.numbers(episode),
            "bam/digest": episode.digest,
            "bam/terminated": bool(episode.terminated),
            "bam/truncated": bool(episode.truncated),
            "bam/success": None if episode.success is None else bool(episode.success),
            "bam/return": float(np.sum(episode.rewards)),
            "bam/facts": json.dumps(episode.facts),
            "bam/columns": json.dumps(list(episode.columns)),
        }
        row[layout.EXTRA] = digest_of(episode.columns)
        return row | {layout.ROW: row_digest(row)} | {layout.FINAL + name: values for name, values in one.final.items()}

    def own(self) -> dict[str, Any]:
        """The content of bam.json."""
        return sealed({"format": layout.FORMAT, **self.info.to_json(), "columns": self.extra})

    def write(self, files: Files) -> None:
        """Replace tasks.parquet, stats.json and then info.json: from now on, readers see the episodes so far."""
        for name, content in self._others().items() if self.episodes else ():
            files.write(name, content)
        files.write_json(layout.INFO, self.content())

    def _others(self) -> dict[str, bytes]:
        return {layout.STATS: json_bytes(self.stats), layout.TASKS: parquet_bytes(tasks_table(self.tasks))}

    def copy(self, data: bytes, episodes: bytes) -> Copy:
        """The copy of a data file and its episodes file, the last that are counted."""
        return Copy.of(json_bytes(self.own()), data, episodes, self._others())

    def content(self) -> dict[str, Any]:
        """The content of info.json."""
        return {
            "codebase_version": layout.VERSION,
            "robot_type": self.info.robot or None,
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": layout.CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.info.fps,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": layout.DATA,
            "video_path": None,
            "features": self.features(),
        }

    def features(self) -> dict[str, dict[str, Any]]:
        """The columns as LeRobot describes them."""
        found = {}
        for leaf in self.info.observation_leaves + self.info.action_leaves:
            found[leaf.column] = self._feature(leaf.column, str(leaf.dtype), leaf.shape)
            if leaf.is_image:
                names = ["height", "width", "channels"]
                found[leaf.column] = {"dtype": "image", "shape": list(leaf.shape), "names": names}
        found |= {
            name: self._feature(name, "float64" if name == layout.NEXT[0] else "bool", ()) for name in layout.NEXT
        }
        texts = {"str": "string"}
        found |= {
            name: self._feature(name, texts.get(one["dtype"], one["dtype"]), one["shape"])
            for name, one in self.extra.items()
        }
        return found | {name: self._feature(name, dtype, ()) for name, dtype in layout.DEFAULTS.items()}

    def _feature(self, name: str, dtype: str, shape: Sequence[int]) -> dict[str, Any]:
        kind = {"observation.state": "observation", "raw_action": "action", "raw_command": "command"}.get(name, name)
        labels: Sequence[Mapping[str, Any]] = self.info.contract.get(kind, [])
        size = int(np.prod(shape))
        names = [str(one.get("name")) for one in labels] if len(labels) == size else None
        return {"dtype": dtype, "shape": [size], "names": names}


@dataclass(frozen=True)
class Copy:
    """What was written together."""

    bam: bytes
    """bam.json."""
    episodes: bytes
    """The episodes file."""
    footer: bytes
    """The end of the data file, which says where each column of it begins."""
    size: int
    """Of the data file, without its footer [bytes]."""
    data: str
    """SHA-256 of the data file."""
    others: dict[str, str]
    """SHA-256 of stats.json and tasks.parquet as they were then, by name."""

    @classmethod
    def of(cls, bam: bytes, data: bytes, episodes: bytes, others: Mapping[str, bytes]) -> Copy:
        """A copy of what these files hold."""
        size = len(data) - _TAIL.size - _TAIL.unpack(data[-_TAIL.size :])[0]
        return cls(bam, episodes, data[size:], size, sha256(data), {name: sha256(one) for name, one in others.items()})

    def to_bytes(self) -> bytes:
        """The zip, each member of which has a checksum."""
        buffer = io.BytesIO()
        facts = json.dumps({"size": self.size, "data": self.data, "others": self.others}).encode()
        members = {"bam.json": self.bam, "episodes.parquet": self.episodes, "footer": self.footer, "data.json": facts}
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, content in members.items():
                archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes | None) -> Copy | None:
        """The copy in a zip; None without one, or if it is damaged."""
        if content is None:
            return None
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                facts = json.loads(archive.read("data.json"))
                bam, episodes, footer = (archive.read(name) for name in ("bam.json", "episodes.parquet", "footer"))
            return cls(bam, episodes, footer, facts["size"], facts["data"], facts["others"])
        except (zipfile.BadZipFile, zlib.error, EOFError, *layout.UNREADABLE):
            return None

    def restored(self, data: bytes) -> bytes:
        """A damaged data file with its beginning and its end put back; what is cut off of its numbers is zero."""
        return (MAGIC + data[len(MAGIC) : self.size]).ljust(self.size, b"\0") + self.footer


def sha256(content: bytes) -> str:
    """Hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def kind_of(values: Array) -> dict[str, Any]:
    """Dtype and shape of a further column, as bam.json has them."""
    return {"dtype": "str" if values.dtype.kind in "UO" else str(values.dtype), "shape": list(values.shape[1:])}


def _table(rows: list[dict[str, Any]], images: set[str]) -> Arrow:
    import pyarrow as pa

    columns: dict[str, Any] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        if name.startswith(layout.FINAL):
            columns[name] = to_arrow(np.concatenate(values), is_image=name.removeprefix(layout.FINAL) in images)
        else:
            columns[name] = pa.array(values, pa.bool_() if name == "bam/success" else None)
    return pa.table(columns)


def add_stats(old: dict[str, Any], episodes: list[dict[str, Array]], images: set[str]) -> dict[str, Any]:
    """The statistics `old` with those of more episodes, given as columns."""
    stats = dict(old)
    for name in {name: None for columns in episodes for name in columns}:
        parts = [columns[name] for columns in episodes if name in columns]
        if parts[0].dtype.kind not in "UO":
            stats[name] = _together(old.get(name), _stats(parts, name in images))
    return stats


def _stats(parts: list[Array], is_image: bool) -> dict[str, Any]:
    """As LeRobot has them: lists; of pictures scaled to 0 to 1, one number a channel of shape (channels, 1, 1)."""
    count = sum(map(len, parts))
    if is_image:
        pictures = [picture for part in parts for picture in part[:: max(1, len(part) * len(parts) // MOST_IMAGES)]]
        values = np.concatenate([picture.reshape(-1, picture.shape[-1]) for picture in pictures]) / 255.0
    else:
        values = np.concatenate(parts).reshape(count, -1).astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    found |= dict(zip(QUANTILES, quantiles, strict=True))
    shape = (-1, 1, 1) if is_image else (-1,)
    return {**{key: one.reshape(shape).tolist() for key, one in found.items()}, "count": [count]}


def _together(old: dict[str, Any] | None, new: dict[str, Any]) -> dict[str, Any]:
    """Both; the quantiles are weighted means, as LeRobot's own."""
    if old is None:
        return new
    a, b = ({key: np.asarray(value, np.float64) for key, value in one.items()} for one in (old, new))
    share = b["count"][0] / (a["count"][0] + b["count"][0])
    both = {key: (1 - share) * a[key] + share * b[key] for key in ("mean", *QUANTILES)}
    variance = (1 - share) * a["std"] ** 2 + share * b["std"] ** 2 + share * (1 - share) * (a["mean"] - b["mean"]) ** 2
    both |= {"min": np.minimum(a["min"], b["min"]), "max": np.maximum(a["max"], b["max"]), "std": np.sqrt(variance)}
    return {key: value.tolist() for key, value in both.items()} | {"count": [int(a["count"][0] + b["count"][0])]}
