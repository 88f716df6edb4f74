"""Look through a data set: what is whole, and what is not; and make it whole again without losing a whole episode."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bam_envs.core.errors import BamEnvsError
from bam_train.data.data_set import DataSet
from bam_train.data.episode import DataSetInfo, Episode
from bam_train.data.file_pair import Columns, Head
from bam_train.data.layout import (
    BAM,
    DATA,
    EPISODES,
    FINAL,
    INFO,
    STATS,
    TASKS,
    Files,
    file_name,
    tasks_table,
)
from bam_train.data.statistics import stats_of
from bam_train.errors import BadDataSet, PlaceError

ASIDE = "damaged"
"""Folder of a data set for files that are not whole."""


@dataclass
class Found:
    """What `look` found in a data set."""

    episodes: int = 0
    """Whole episodes, those that were not counted yet included."""
    frames: int = 0
    problems: list[str] = field(default_factory=list)
    """What is not whole, one line each."""
    notes: list[str] = field(default_factory=list)
    """What is odd and stays as it is, one line each."""
    prefix: int = 0
    """Number of the first file from which on something is not whole."""

    @property
    def is_whole(self) -> bool:
        """Whether there is nothing to mend."""
        return not self.problems


class _Reader:
    """Reads the files of a data set without info.json."""

    def __init__(self, files: Files) -> None:
        self.files = files
        try:
            own = files.read_json(BAM)
            self.info, self.extra = DataSetInfo.from_json(own), dict(own["columns"])
        except (KeyError, TypeError, ValueError, BamEnvsError) as error:
            why = error if isinstance(error, BadDataSet) else f"{files.text}: {BAM} is damaged: {error!r}"
            raise BadDataSet(f"{why}; nothing can be mended without it. Get this file from a copy") from error
        self.data = DataSet(files, self.info, {"features": {}, "total_frames": 0, "total_episodes": 0}, self.extra)

    def numbers(self) -> list[int]:
        """The numbers of the files that are there."""
        return sorted({*self.files.numbers(DATA), *self.files.numbers(EPISODES)})

    def pair(self, number: int, found: Found) -> Iterator[tuple[dict[str, Any], Episode]]:
        """The whole episodes of the two files with this number, and their rows; others are problems."""
        name = file_name(DATA, number)
        try:
            names = self.files.open_parquet(file_name(EPISODES, number)).schema_arrow.names
            rows = self.files.open_parquet(file_name(EPISODES, number), names)
            data = self.files.open_parquet(name)
        except BadDataSet as error:
            found.problems.append(str(error).partition("; run bam-data")[0].removeprefix(f"{self.files.text}: "))
            return
        groups = range(data.metadata.num_row_groups)
        sizes = [data.metadata.row_group(group).num_rows for group in groups]
        used: set[int] = set()
        for place in range(len(rows)):
            final = rows.slice(place, 1)
            row = final.drop_columns([one for one in rows.column_names if one.startswith(FINAL)]).to_pylist()[0]
            for group in (place, *groups):  # its own place first
                if group not in groups or sizes[group] != row["length"] or group in used:
                    continue
                try:
                    episode = self.data.read(row, data.read_row_group(group), final)
                except PlaceError:
                    raise
                except (OSError, ValueError, KeyError):
                    continue
                used.add(group)
                yield row, episode
                break
            else:
                found.problems.append(f"{name}: episode {row['episode_index']} is not as it was written")


def look(files: Files) -> Found:
    """Read every file of a data set and compare each episode with its digest.

    Raises:
        BadDataSet: There is no data set, or bam.json is not whole.
    """
    reader, found = _Reader(files), Found()
    try:
        counted = int(files.read_json(INFO)["total_episodes"])
    except (BadDataSet, KeyError, TypeError, ValueError):
        counted = None
        found.problems.append(f"{INFO} is missing or damaged")
    known, is_prefix = {*Head(reader.info, reader.extra).features()}, True
    for place, number in enumerate(reader.numbers()):
        before = len(found.problems)
        if place != number:
            found.problems.append(f"{file_name(DATA, place)} is missing")
        count, name = 0, file_name(EPISODES, number)
        for row, episode in reader.pair(number, found):
            if (row["episode_index"], row["dataset_from_index"]) != (found.episodes, found.frames):
                found.problems.append(f"{name}: episode {row['episode_index']} is out of place")
            found.notes += _odd(row["episode_index"], episode)
            new = [column for column in episode.columns if column not in known]
            found.notes += [f"column {column} is not described in {BAM}; it is kept" for column in new]
            known |= {*new}
            found.episodes, found.frames, count = found.episodes + 1, found.frames + len(episode), count + 1
        if counted is not None and count and found.episodes > counted and len(found.problems) == before:
            found.problems.append(f"{name}: its {count} episodes are not counted yet")
        is_prefix = is_prefix and len(found.problems) == before
        found.prefix += is_prefix
    if counted is not None and counted > found.episodes and not found.problems:
        found.problems.append(f"{INFO} counts {counted} episodes, and there are {found.episodes}")
    return found


def _odd(index: int, episode: Episode) -> list[str]:
    notes = []
    values = {"observations": episode.observations, "actions": episode.actions, "rewards": episode.rewards}
    for name, value in values.items():
        arrays = [value] if isinstance(value, np.ndarray) else _arrays(value)
        if any(array.dtype.kind == "f" and not np.isfinite(array).all() for array in arrays):
            notes.append(f"episode {index}: its {name} have NaN or infinity; learners refuse it")
    if not (episode.terminated or episode.truncated):
        notes.append(f"episode {index} has no end; learners take it as truncated")
    return notes


def _arrays(values: Any) -> list[Any]:
    parts = values.values() if isinstance(values, dict) else values
    return [array for one in parts for array in ([one] if isinstance(one, np.ndarray) else _arrays(one))]


def mend(files: Files) -> Found:
    """Make a data set whole, with every whole episode that is in its files; the caller has the lock.

    Files that are not whole are copied to the folder `ASIDE` first. A kill in between leaves what can be mended again.
    """
    found = look(files)
    if found.is_whole:
        return found
    reader = _Reader(files)
    head = Head(reader.info, reader.extra)
    last: list[Any] = []
    for number in reader.numbers():
        if number == found.prefix:
            head.write(files)  # readers see the whole files alone until the rest is in place
        damage = Found()
        pairs = list(reader.pair(number, damage))
        if number < found.prefix:
            head.pass_by([episode for _, episode in pairs])
            continue
        if damage.problems:
            for template in (DATA, EPISODES):
                files.copy_aside(file_name(template, number), ASIDE)
        same = [(row["bam/digest"], row["bam/facts"]) for row, _ in pairs]
        if pairs and same != last:  # else it was moved by a mending that was killed
            head.write_pair(files, [Columns.read(one, reader.info) for _, one in pairs])
        last = same
        if number >= head.file:
            files.delete(file_name(EPISODES, number))
            files.delete(file_name(DATA, number))
    files.write_table(TASKS, tasks_table(head.tasks))
    head.write_columns(files)
    head.write(files)
    files.delete(STATS)
    stats_of(files, DataSet.open(files.text))
    return found
