"""Write episodes into a data set; what is there already stays as it is."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_envs.core.wording import brief
from bam_train.data.data_set import DataSet
from bam_train.data.file_pair import Columns, Head, kind_of
from bam_train.data.layout import BAM, DEFAULTS, INFO, NUMBERED, REPLACED, STATES, Files, WriterLock, file_name
from bam_train.data.mending import mend
from bam_train.data.recorded_episode import Array, DataSetInfo, Episode, Leaf, digest_of
from bam_train.environments import first_difference
from bam_train.errors import BadDataSet, OutputError, PlaceError
from bam_train.files.log_lines import counted
from bam_train.files.place import Place

if TYPE_CHECKING:
    from typing_extensions import Self

_OF_FILES = (".mcap", ".txt", ".json", ".csv", ".zip", ".parquet", ".h5", ".hdf5", ".gif", ".mp4", ".png", ".jpg")
"""Suffixes of files; no folder of such a name is made."""


class DataSetWriter:
    """Appends episodes to the data set at `place`, which is made if there is none; a context manager.

    A process that is killed loses the episodes that were not flushed, and never damages others.

    Args:
        place: The folder.
        info: What is equal for all episodes; it must be that of the episodes that are there.
        together: Whether all that is added counts at the end, or nothing: after an exception in the ``with`` block, or
            `undo`, the place is as it was. Else the episodes that are whole are kept.
        flush_episodes: Number of episodes that are kept in memory before they are written.
        flush_bytes: Size of episodes in memory [bytes] from which they are written earlier.

    Raises:
        BadDataSet: Another writer has it, it is damaged, or it holds episodes of another environment, other spaces,
            other units or another period.
    """

    def __init__(
        self,
        place: str | Path | Place,
        info: DataSetInfo,
        *,
        together: bool = False,
        flush_episodes: int = 50,
        flush_bytes: int = 2**26,
    ) -> None:
        import pyarrow  # noqa: F401 - it writes the episodes, and without it nothing must be made

        self._files, self.info = Files(place), info
        self._is_new = not self._files.root.exists()
        if self._is_new and (suffix := self._files.root.suffix.lower()) in _OF_FILES:
            raise BadDataSet(f"{place}: is named as a file, and a data set is a folder; leave {suffix} out")
        self._together, self._flush_episodes, self._flush_bytes = together, flush_episodes, flush_bytes
        self._observation, self._action = info.observation_leaves, info.action_leaves
        self._waiting: list[Columns] = []
        self._bytes = 0
        self._first, self._before = 0, dict[str, bytes | None]()
        """Number of the first file that can be taken back, and the content of the others as it was."""
        self._lock = WriterLock(self._files)
        try:
            self._open()
        except BaseException:
            self.undo()
            raise
        self._counted = self._head

    def _open(self) -> None:
        files = self._files
        if not files.exists(INFO):
            if any(files.numbers(kind) for kind in NUMBERED):
                raise files.damaged(f"{INFO} is missing")
            self._head, self._before = Head(self.info, {}), dict.fromkeys(REPLACED)
            files.write_json(BAM, self._head.own())
            self._head.write(files)
            return
        old = DataSet.open(files.text)
        require_same(files.text, old.info, self.info)
        try:
            stats = old.stats()
        except BadDataSet:
            stats = None
        if stats is None or any(files.exists(file_name(kind, old.next_file)) for kind in NUMBERED):
            if lost := mend(files).lost:  # else a writer was killed
                raise files.damaged(f"is damaged: {lost[0]}")
            old = DataSet.open(files.text)
            stats = old.stats()
        counts = (len(old), old.total_frames, old.next_file)
        self._head = Head(self.info, dict(old.extra), *counts, list(old.tasks), stats)
        if self._together:
            self._remember()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is not None and self._together:
            self.undo()
        else:
            self.close()

    def add(self, episode: Episode) -> int:
        """Add an episode, whose digest is filled in; returns its index. It is on the disk after the next flush.

        Raises:
            BadDataSet: Its arrays do not fit the spaces, each other, or the columns of earlier episodes.
        """
        columns = self._checked(episode)
        index = self._head.episodes + len(self._waiting)
        self._waiting.append(columns)
        self._bytes += sum(array.nbytes for array in columns.steps.values())
        if len(self._waiting) >= self._flush_episodes or self._bytes >= self._flush_bytes:
            self.flush()
        return index

    def _checked(self, episode: Episode) -> Columns:
        steps = len(episode.rewards)
        if not steps:
            raise BadDataSet(f"{self._files.text}: an episode without a step; leave it out")
        observed = {one.column: self._array(one, episode.observations, steps + 1) for one in self._observation}
        acted = {one.column: self._array(one, episode.actions, steps) for one in self._action}
        rewards = np.asarray(episode.rewards, np.float64)
        if rewards.shape != (steps,):
            raise BadDataSet(f"{self._files.text}: rewards: expected shape {(steps,)}, found {rewards.shape}")
        end = (bool(episode.terminated), bool(episode.truncated), episode.success)
        extra = {name: self._extra_column(name, values, steps) for name, values in episode.columns.items()}
        episode.digest = digest_of({**observed, **acted, "reward": rewards}, *end)
        return Columns.of(replace(episode, rewards=rewards, columns=extra), observed, acted)

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
        found = kind_of(array)
        taken = name.startswith(("observation.", "action", "next.", "bam")) and name not in STATES
        if "/" in name or name in DEFAULTS or taken or name in {one.column for one in self._observation}:
            raise BadDataSet(f"{self._files.text}: a column cannot be called {name!r}; choose another name")
        if array.shape[:1] != (steps,):
            raise BadDataSet(f"{self._files.text}: column {name}: expected {steps} steps, found shape {array.shape}")
        known = self._head.extra.setdefault(name, found)
        if known != found:
            raise BadDataSet(
                f"{self._files.text}: column {name} is {found['dtype']} of shape {found['shape']}, and that of earlier "
                f"episodes {known['dtype']} of {known['shape']}; give it another name"
            )
        return array

    def flush(self) -> None:
        """Write the episodes in memory: a copy, a data file, an episodes file, then, unless `together`, info.json.

        Raises:
            OutputError: Something cannot be written; the text says which episodes are kept.
        """
        if not self._waiting:
            return
        head = replace(self._head, tasks=[*self._head.tasks])
        if not self._together:
            self._remember()
        try:
            self._files.write_json(BAM, head.own())
            head.write_pair(self._files, self._waiting)
            if not self._together:
                head.write(self._files)
        except PlaceError as error:
            if self._together:
                raise
            with contextlib.suppress(PlaceError):
                self._take_back()
            kept, lost = (counted(one, "whole episode") for one in (self._head.episodes, len(self._waiting)))
            raise OutputError(f"{error}. Kept in {self._files.text}: {kept}; not written: {lost}") from error
        self._head, self._waiting, self._bytes = head, [], 0
        self._before = self._before if self._together else {}

    def commit(self) -> None:
        """Flush, and let what was added `together` count; until it is closed, `undo` takes it back."""
        self.flush()
        if self._together and self._counted is not self._head:
            self._head.write(self._files)
            self._counted = self._head

    def undo(self) -> None:
        """Take back what was added `together`, or since the last flush, and let others write.

        A data set that was made for it is removed.
        """
        if not self._lock.is_held:
            return
        try:
            if self._before:
                self._take_back()
        finally:
            self._lock.release()
        if self._before.get(INFO, b"") is None:
            self._files.remove_empty(is_new=self._is_new)

    def _remember(self) -> None:
        self._first = self._head.file
        self._before = {name: self._files.content(name) for name in REPLACED}

    def _take_back(self) -> None:
        added = [file_name(kind, number) for number in range(self._first, self._head.file + 1) for kind in NUMBERED]
        for name in (INFO, *added, *REPLACED):  # first what counts the others, and room is made before more is written
            content = self._before.get(name)
            if content is None:
                self._files.delete(name)
            elif content != self._files.content(name):
                self._files.write(name, content)

    def close(self) -> None:
        """Flush, and let others write."""
        if self._lock.is_held:
            try:
                self.commit()
            except BaseException:
                self.undo()
                raise
            self._lock.release()


def require_same(place: str, there: DataSetInfo, given: DataSetInfo, whose: str = "", remedy: str = "") -> None:
    """Refuse episodes that do not belong to those that are there.

    Args:
        place: The place of those.
        there: What is equal for them.
        given: What is equal for the others.
        whose: The others, by default the new episodes.
        remedy: What to do, by default to write them into another place.

    Raises:
        BadDataSet: Names the first thing that differs, and both values.
    """
    old, new = there.to_json(), given.to_json()
    for one in (old, new):  # a robot's limits may differ from those of its simulation
        rows = one["contract"].items()
        one["contract"] = {kind: {row.get("name"): row.get("unit") for row in group} for kind, group in rows}
    names = ("env", "env_kwargs", "observation_space", "action_space", "period", "contract")
    if found := first_difference(*((name, old[name], new[name]) for name in names)):
        what, theirs, ours = found
        text = f"{what} is {theirs} there, and {ours} of {whose or 'the new episodes'}"
        raise BadDataSet(f"{place}: {text}; {remedy or f'write {brief(given.env)} into another place'}")
