"""Read a data set: its episodes as they were recorded, one file in memory at a time."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.spaces import indexed, mapped
from bam_train.data import layout
from bam_train.data.arrow_columns import from_arrow
from bam_train.data.file_pair import Copy, Head, sha256
from bam_train.data.layout import Files, file_name, row_digest, sealed
from bam_train.data.recorded_episode import Array, DataSetInfo, Episode, Transitions, Values, digest_of, nested
from bam_train.environments import first_difference
from bam_train.errors import BadDataSet, PlaceError
from bam_train.files.place import Place

MOST_BYTES = 2**24
"""Bytes of a file that are in memory together, unless one episode has more."""


class DataSet:
    """The episodes at a place; `open` reads it. Others may append to it meanwhile: the episodes here stay the same."""

    def __init__(self, files: Files, info: DataSetInfo, head: Mapping[str, Any], columns: Mapping[str, Any]) -> None:
        self._files, self.info = files, info
        self.extra: dict[str, dict[str, Any]] = dict(columns)
        """Dtype and shape of each further column."""
        self.features = {name: one for name, one in head["features"].items() if name not in layout.DEFAULTS}
        """Columns of the steps, as LeRobot describes them."""
        self.total_frames = int(head["total_frames"])
        self._observation, self._action = info.observation_leaves, info.action_leaves
        self._rows = self._read_rows(int(head["total_episodes"]))

    @property
    def place(self) -> str:
        """Where it is, as it was given."""
        return self._files.text

    @classmethod
    def open(cls, place: str | Path | Place) -> DataSet:
        """Open the data set at `place`.

        Raises:
            BadDataSet: There is none, a file of it is missing or damaged, or a newer bam-train wrote it.
        """
        files = Files(place)
        files.require()
        head = files.read_json(layout.INFO)
        if not files.exists(layout.BAM) and not files.numbers(layout.COPIES):
            raise BadDataSet(f"{place}: has no {layout.BAM}, so its environment is unknown; bam-train did not write it")
        own = files.read_json(layout.BAM)
        if not isinstance(own.get("format"), int) or own["format"] > layout.FORMAT:
            raise BadDataSet(
                f"{place}: has format {own.get('format')}; this bam-train reads up to {layout.FORMAT}. Update it"
            )
        if sealed(own)["digest"] != own.get("digest", sealed(own)["digest"]):  # older ones have none
            raise files.damaged(f"{layout.BAM} is not as it was written")
        try:
            data = cls(files, DataSetInfo.from_json(own), head, own["columns"])
            data._require_true(head)
        except BadDataSet:
            raise
        except (KeyError, TypeError, ValueError, BamEnvsError) as error:
            raise files.damaged(f"{layout.BAM} or {layout.INFO} is damaged: {error!r}") from error
        return data

    def _require_true(self, head: Mapping[str, Any]) -> None:
        """Refuse an info.json that says something else than bam.json and the episodes."""
        frames = sum(row["length"] for row in self._rows)
        truth = Head(self.info, self.extra, len(self._rows), frames).content()
        said = {name: head.get(name) for name in ("fps", "total_episodes", "total_frames")}
        new = self.extra.keys() - head["features"].keys()  # columns of a writer that has not counted them yet
        said["features"] = {name: head["features"].get(name) for name in truth["features"].keys() - new}
        for name, one in said.items():
            true = {key: truth[name][key] for key in one} if isinstance(one, dict) else truth[name]
            if found := first_difference((name, one, true)):
                what, wrong, right = found
                raise self._files.damaged(f"{layout.INFO}: {what} is {wrong}, expected {right}")

    def _read_rows(self, count: int) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        number = 0
        while len(rows) < count:
            name = file_name(layout.EPISODES, number)
            table = self._files.open_parquet(name, (*layout.LIGHT, layout.EXTRA, layout.ROW))
            found = table.to_pylist()
            if {*layout.LIGHT} - {*table.column_names} or any(
                row_digest(row) != row.get(layout.ROW, row_digest(row)) for row in found
            ):
                raise self._files.damaged(f"{name} is not as it was written")
            rows += found
            number += 1
        if [row["episode_index"] for row in rows] != list(range(len(rows))):
            raise self._files.damaged("its episodes are not numbered from 0 on")
        self.next_file = number
        return rows[:count]

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def digests(self) -> list[str]:
        """SHA-256 of every episode."""
        return [row["bam/digest"] for row in self._rows]

    @property
    def digest(self) -> str:
        """SHA-256 of the digests of all episodes."""
        return hashlib.sha256("\n".join(self.digests).encode()).hexdigest()

    @property
    def tasks(self) -> list[str]:
        """The sentences of the tasks, in the order of their indices."""
        return list(dict.fromkeys(task for row in self._rows for task in row["tasks"]))

    def facts(self, index: int) -> dict[str, Any]:
        """Facts of an episode without its numbers, with its length, return, success and end."""
        row = self._rows[self._index(index)]
        ends = {name: row[f"bam/{name}"] for name in ("success", "terminated", "truncated")}
        return {**json.loads(row["bam/facts"]), "length": row["length"], "return": row["bam/return"], **ends}

    def columns_of(self, index: int) -> list[str]:
        """Names of the further columns of an episode, without reading it."""
        return list(json.loads(self._rows[self._index(index)]["bam/columns"]))

    def stats(self) -> dict[str, Any]:
        """Least, greatest, mean, deviation and quantiles of each column, as LeRobot has them.

        Raises:
            BadDataSet: They are not those of its steps.
        """
        if not self.next_file:
            return {}
        copy = Copy.from_bytes(self._files.content(file_name(layout.COPIES, self.next_file - 1)))
        with contextlib.suppress(*layout.UNREADABLE):
            content = self._files.content(layout.STATS) or b""
            stats: dict[str, Any] = json.loads(content)
            if stats["next.reward"]["count"] == [self.total_frames] and (
                not copy or copy.others[layout.STATS] == sha256(content)
            ):
                return stats
        raise self._files.damaged(f"{layout.STATS} is not that of its steps")

    def _index(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.place}: has {len(self)} episodes, and there is no episode {index}")
        return index % len(self)

    def __getitem__(self, index: int) -> Episode:
        return next(self.episodes([index]))

    def __iter__(self) -> Iterator[Episode]:
        return self.episodes()

    def episodes(self, indices: Sequence[int] | None = None) -> Iterator[Episode]:
        """The episodes, or those of `indices` in this order; neighbours are read together.

        Raises:
            BadDataSet: A file is missing, or does not hold the numbers that were written.
            IndexError: There is no such episode.
        """
        wanted = range(len(self)) if indices is None else [self._index(int(index)) for index in indices]
        start = 0
        while start < len(wanted):
            number = self._file_of(wanted[start])
            end = start + 1
            while end < len(wanted) and self._file_of(wanted[end]) == number:
                end += 1
            yield from self._of_file(number, wanted[start:end])
            start = end

    def _file_of(self, index: int) -> int:
        row = self._rows[index]
        return int(row["data/chunk_index"]) * layout.CHUNK + int(row["data/file_index"])

    def _of_file(self, number: int, indices: Sequence[int]) -> Iterator[Episode]:
        name = file_name(layout.DATA, number)
        try:
            data = self._files.open_parquet(name)
            last = self._files.open_parquet(
                file_name(layout.EPISODES, number),
                ["episode_index", *(layout.FINAL + leaf.column for leaf in self._observation)],
            )
            first = last["episode_index"][0].as_py()
            batch: list[int] = []
            size = 0
            for place, index in enumerate(indices):
                batch.append(index)
                size += data.metadata.row_group(index - first).total_byte_size
                if size >= MOST_BYTES or place == len(indices) - 1:
                    table = data.read_row_groups([one - first for one in batch])
                    yield from self._of_table(name, table, last, first, batch)
                    batch, size = [], 0
        except (PlaceError, BadDataSet):
            raise
        except layout.UNREADABLE as error:
            why = str(error).partition("\n")[0]
            raise self._files.damaged(f"{name} is damaged: {why}") from error

    def _of_table(self, name: str, table: Any, last: Any, first: int, indices: list[int]) -> Iterator[Episode]:
        start = 0
        for index in indices:
            length = self._rows[index]["length"]
            steps = table.slice(start, length)
            start += length
            try:
                numbers = np.unique(steps["episode_index"].to_numpy()).tolist()
                if len(steps) != length or numbers != [index]:
                    raise ValueError(f"its place has {len(steps)} steps of episodes {numbers}")
                if missing := {*layout.DEFAULTS, *layout.NEXT} - {*steps.column_names}:
                    raise ValueError(f"it has no column {min(missing)}")
                yield self.read(self._rows[index], steps, last.slice(index - first, 1))
            except layout.UNREADABLE as error:
                raise self._files.damaged(f"{name}: episode {index} is damaged: {error}") from error

    def read(self, row: Mapping[str, Any], steps: Any, final: Any) -> Episode:
        """An episode of its rows in the files: that of the episodes, those of its steps, and its last observation.

        Digests that the row lacks are not compared.

        Raises:
            ValueError: They are not the numbers that were written.
            KeyError: A column is missing.
        """
        arrays = {}
        for leaf in self._observation:
            parts = (steps[leaf.column], final[layout.FINAL + leaf.column])
            arrays[leaf.column] = np.concatenate([from_arrow(one, leaf.shape, leaf.dtype) for one in parts])
        arrays |= {leaf.column: from_arrow(steps[leaf.column], leaf.shape, leaf.dtype) for leaf in self._action}
        rewards = from_arrow(steps["next.reward"], (), np.dtype(np.float64))
        end = (row["bam/terminated"], row["bam/truncated"], row["bam/success"])
        digest = digest_of({**arrays, "reward": rewards}, *end)
        columns = self._columns(row, steps, [*arrays, *layout.NEXT, *layout.DEFAULTS])
        own = {name: columns[name] for name in json.loads(row["bam/columns"])}
        pairs = ((digest, row["bam/digest"]), (row.get(layout.EXTRA) and digest_of(own), row.get(layout.EXTRA)))
        if any(found != written for found, written in pairs if written is not None):
            raise ValueError("its numbers are not those that were written")
        return Episode(
            nested(self.info.observation_space, arrays, self._observation),
            nested(self.info.action_space, arrays, self._action),
            rewards,
            *end,
            columns=columns,
            facts=json.loads(row["bam/facts"]),
            digest=digest,
        )

    def _columns(self, row: Mapping[str, Any], steps: Any, others: list[str]) -> dict[str, Array]:
        """The further columns of an episode, and those that somebody added to the files."""
        own = json.loads(row["bam/columns"])
        names = [name for name in steps.column_names if name not in others and (name in own or name not in self.extra)]
        found = {}
        for name in names:
            known = self.extra.get(name)
            found[name] = from_arrow(steps[name], None if known is None else tuple(known["shape"]))
        return found

    def transitions(self, indices: Sequence[int] | None = None) -> Transitions:
        """All steps of the episodes, or of those of `indices`, in memory."""
        wanted = range(len(self)) if indices is None else [self._index(int(index)) for index in indices]
        episodes = list(self.episodes(wanted))
        terminals = [
            np.arange(len(one)) == len(one) - 1 if one.terminated else np.zeros(len(one), bool) for one in episodes
        ]
        before = [indexed(one.observations, slice(-1)) for one in episodes]
        after = [indexed(one.observations, slice(1, None)) for one in episodes]
        counts = [len(one) for one in episodes]
        if not episodes:
            raise BadDataSet(f"{self.place}: has no episodes yet; record some first")
        return Transitions(
            _concatenated(before),
            _concatenated([one.actions for one in episodes]),
            np.concatenate([one.rewards for one in episodes]),
            _concatenated(after),
            np.concatenate(terminals),
            np.repeat(np.asarray(wanted, np.int64), counts),
        )


def _concatenated(each: Sequence[Values]) -> Values:
    return mapped(lambda *arrays: np.concatenate(arrays), *each)
