"""Look through a data set: what is whole, and what is not; and make it whole again without losing a whole episode.

What is lost, as no file says it any more, is given up with the user's consent alone.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.spaces import leaves_by_path
from bam_train.data import layout
from bam_train.data.arrow_columns import to_arrow
from bam_train.data.data_set import DataSet
from bam_train.data.file_pair import Columns, Copy, Head, sha256
from bam_train.data.layout import Files, file_name, sealed, tasks_table
from bam_train.data.recorded_episode import DataSetInfo, Episode
from bam_train.data.salvage import Pair, read_pair
from bam_train.environments import first_difference
from bam_train.errors import BadDataSet

ASIDE = "damaged"
"""Folder of a data set for files that are not whole."""


@dataclass
class Found:
    """What `look` found in a data set, and what `mend` did."""

    episodes: int = 0
    """Episodes of which nothing is lost, or something; those that were not counted yet included."""
    frames: int = 0
    problems: list[str] = field(default_factory=list)
    """What is not whole, one line each."""
    lost: list[str] = field(default_factory=list)
    """What no file says any more, one line each."""
    notes: list[str] = field(default_factory=list)
    """What is odd and stays as it is, one line each."""
    set_aside: list[str] = field(default_factory=list)
    """Files that were not whole, where mending has put them."""
    has_copies: bool = True
    """Whether all of it has copies; what an older bam-train wrote has none until `mend` makes them."""

    @property
    def is_whole(self) -> bool:
        """Whether there is nothing to mend."""
        return not self.problems and not self.lost


class _Reader:
    """Reads the files of a data set without info.json."""

    def __init__(self, files: Files) -> None:
        self.files = files
        self.numbers = sorted({number for kind in layout.NUMBERED for number in files.numbers(kind)})
        self.is_cut_off = files.exists(layout.MENDING)
        """Whether a mending was cut off, which has left some episodes twice."""
        own, self.problems = self._bam_json()
        try:
            self.info, self.extra = DataSetInfo.from_json(own), dict(own["columns"])
        except (KeyError, TypeError, ValueError, BamEnvsError) as error:
            raise _hopeless(files, f"{layout.BAM} is damaged: {error!r}") from error
        self.is_sealed = "digest" in own
        self.data = DataSet(files, self.info, {"features": {}, "total_frames": 0, "total_episodes": 0}, self.extra)

    def _bam_json(self) -> tuple[dict[str, Any], list[str]]:
        """The content of bam.json, and what is wrong with the file."""
        own: dict[str, Any] = {}
        try:
            own = self.files.read_json(layout.BAM)
            if own.get("digest") == sealed(own)["digest"]:
                return own, []
            why = f"{layout.BAM} is not as it was written"
        except BadDataSet as error:
            why = str(error).partition("; run bam-data")[0].removeprefix(f"{self.files.text}: ")
        for number in reversed(self.files.numbers(layout.COPIES)):
            if copy := self.copy(number):
                return json.loads(copy.bam), [why]
        if not own or "digest" in own:
            raise _hopeless(self.files, why)
        return own, []  # an older bam-train wrote it

    def copy(self, number: int) -> Copy | None:
        """The copy of this number; None without one that is whole."""
        return Copy.from_bytes(self.files.content(file_name(layout.COPIES, number)))

    def pairs(self) -> Iterator[Pair]:
        """What the files say, number by number."""
        seen = set[Any]()
        for number in self.numbers:
            pair = read_pair(self.files, self.data, number)
            if self.is_cut_off and pair.episodes and pair.same in seen:
                pair = Pair(number, damaged=[f"{file_name(layout.DATA, number)} is twice there"])
            seen.add(pair.same)
            yield pair


def _hopeless(files: Files, why: str) -> BadDataSet:
    return BadDataSet(f"{files.text}: {why}; nothing can be mended without it. Get this file from a copy")


def look(files: Files) -> Found:
    """Read every file of a data set, and compare it with its copy and each episode with its digest.

    Raises:
        BadDataSet: Nothing says any more what the data set is of.
    """
    return _look(_Reader(files))[0]


def _look(reader: _Reader) -> tuple[Found, set[int]]:
    """What there is, and the numbers of files that a writer had not completed when it was killed."""
    files, found, left_over = reader.files, Found(), set[int]()
    found.problems += reader.problems
    head = Head(reader.info, reader.extra)
    found.problems += ["a mending was cut off"] if reader.is_cut_off else []
    said = _said(files, reader)
    counted = said.get("total_episodes") if _counts(said) else None
    last = reader.copy(reader.numbers[-1]) if reader.numbers else None
    known, whole = {*head.features()}, set[Any]()
    lost: list[tuple[str, dict[str, Any], str]] = []
    given_up: list[tuple[str, dict[str, Any], str]] = []
    for pair in reader.pairs():
        name, before = file_name(layout.DATA, pair.number), len(found.problems)
        if pair.number > head.file and not reader.is_cut_off:
            found.problems.append(f"{file_name(layout.DATA, head.file)} is missing")
            first = next(
                (row for row in [*pair.rows, *(row for row, _ in pair.lost)] if "dataset_from_index" in row), {}
            )
            gone = range(head.episodes, first.get("episode_index", head.episodes))
            lost += [(file_name(layout.DATA, head.file), {"episode_index": index}, "") for index in gone]
            head.episodes, head.frames = max(gone.start, gone.stop), first.get("dataset_from_index", head.frames)
        head.file = pair.number
        if pair.lost and not pair.is_complete and counted is not None and head.episodes >= counted:
            found.problems.append(f"{name}: was not complete when its writer was killed")
            left_over.add(pair.number)
            head.file += 1
            continue
        lost += [(name, row, what) for row, what in pair.lost]
        found.has_copies &= pair.copy is not None
        columns = [Columns.read(episode, reader.info) for episode in pair.episodes]
        if last is None and not pair.lost:
            head.add_stats(columns)
        found.problems += _problems(pair, columns, head)
        for row, one in zip(pair.rows, columns, strict=True):
            found.notes += _odd(row["episode_index"], one.episode)
            if "lost" in one.episode.facts and row not in (other for other, _ in pair.lost):
                given_up.append((name, row, one.episode.facts["lost"]))
            new = [column for column in one.episode.columns if column not in known]
            found.notes += [f"column {column} is not described in {layout.BAM}; it is kept" for column in new]
            known |= {*new}
            whole.add((row["bam/digest"], row["bam/facts"]))
            found.episodes, found.frames = found.episodes + 1, found.frames + len(one.episode)
        if counted is not None and columns and head.episodes > counted and len(found.problems) == before:
            found.problems.append(
                f"{file_name(layout.EPISODES, pair.number)}: its {len(columns)} episodes are not counted yet"
            )
    if counted is not None and counted > head.episodes and not reader.is_cut_off:
        lost += [("no file", {"episode_index": index}, "") for index in range(head.episodes, counted)]
    lost = [one for one in lost if (one[1].get("bam/digest"), one[1].get("bam/facts")) not in whole or one[2]]
    found.lost = [*_lines(lost)]
    found.notes += [f"given up before: {line}" for line in _lines(given_up)]
    if found.is_whole:
        found.problems += _differences(files, head, said, last)
    return found, left_over


def _said(files: Files, reader: _Reader) -> dict[str, Any]:
    """The content of info.json; {} if that is missing or damaged.

    Raises:
        BadDataSet: It says something else than a bam.json of an older bam-train, which has no digest.
    """
    try:
        said = files.read_json(layout.INFO)
    except BadDataSet:
        return {}
    own = Head(reader.info, reader.extra).content()
    features: dict[str, Any] = said["features"] if isinstance(said.get("features"), dict) else {}
    pairs = [("fps", own["fps"], said.get("fps"))]
    pairs += [(name, one, features[name]) for name, one in own["features"].items() if name in features]
    if not reader.is_sealed and (found := first_difference(*pairs)):
        what, one, other = found
        text = f"{what} is {one} in {layout.BAM} and {other} in {layout.INFO}"
        raise BadDataSet(f"{files.text}: {text}: one of them is damaged. Get both files from a copy")
    return said


def _counts(said: dict[str, Any]) -> bool:
    """Whether an info.json agrees with itself about the number of episodes; somebody may have split them."""
    with contextlib.suppress(ValueError, TypeError, AttributeError):
        ends = [int(part.partition(":")[2]) for part in said["splits"].values()] if said.get("splits") else []
        return max(ends, default=-1) == said.get("total_episodes")
    return False


def _problems(pair: Pair, columns: list[Columns], head: Head) -> Iterator[str]:
    """What is wrong with the files of a number, and where their episodes stand; these are counted in `head`."""
    import pyarrow as pa

    yield from pair.damaged
    name, described = file_name(layout.DATA, pair.number), {*head.features()}
    is_foreign = any(column not in described for one in columns for column in one.episode.columns)
    if pair.copy is not None and not (pair.is_as_written or pair.lost or pair.damaged or is_foreign):
        yield f"{name} is not as it was written"
    misplaced = []
    for row, places, one in zip(pair.rows, pair.places, columns, strict=True):
        right = head.numbers(one.episode)
        is_right = all(row.get(key) == value for key, value in right.items())
        if is_right and not pair.is_as_written:
            derived = {key: to_arrow(one.steps[key]) for key in layout.NEXT[1:]}
            is_right = places.equals(pa.table(head.places(one.episode) | derived))
        misplaced += [] if is_right else [(name, row, "place")]
        head.count(one.episode)
    if not (pair.damaged or pair.lost):
        yield from (f"{line} is not right" for line in _lines(misplaced))
    gone = [row for row, what in pair.lost if not what]
    head.episodes, head.frames = head.episodes + len(gone), head.frames + sum(row.get("length") or 0 for row in gone)
    head.file += 1


def _differences(files: Files, head: Head, said: dict[str, Any], last: Copy | None) -> Iterator[str]:
    """What info.json, tasks.parquet and stats.json say that is not true."""
    if not said:
        yield f"{layout.INFO} is missing or damaged"
    right = head.content()
    for key, value in right.items() if said else ():
        there = value if key == "splits" and _counts(said) else said.get(key)
        if key == "features" and isinstance(there, dict):
            there = {name: there.get(name) for name in value}
        if found := first_difference((key, there, value)):
            what, wrong, true = found
            yield f"{layout.INFO}: {what} is {wrong}, expected {true}"
    if not head.file:
        return
    for name, is_right in ((layout.TASKS, _has_tasks), (layout.STATS, _has_stats)):
        content = files.content(name) or b""
        if not (is_right(content, head) if last is None else sha256(content) == last.others[name]):
            yield f"{name} is not that of the episodes"


def _has_tasks(content: bytes, head: Head) -> bool:
    import pyarrow.parquet as pq

    with contextlib.suppress(*layout.UNREADABLE):
        return bool(pq.read_table(io.BytesIO(content)).equals(tasks_table(head.tasks), check_metadata=True))
    return False


def _has_stats(content: bytes, head: Head) -> bool:
    """Whether statistics without a digest are right; quantiles depend on how the steps came together."""
    with contextlib.suppress(*layout.UNREADABLE, AttributeError):
        found, right = json.loads(content), head.stats
        return found.keys() == right.keys() and all(
            np.allclose(found[name][key], one[key], rtol=1e-6, equal_nan=True)
            for name, one in right.items()
            for key in one.keys() & found[name].keys()
            if not key.startswith("q")
        )
    return False


def _odd(index: int, episode: Episode) -> list[str]:
    notes = []
    values = {"observations": episode.observations, "actions": episode.actions, "rewards": episode.rewards}
    for name, value in values.items():
        if any(array.dtype.kind == "f" and not np.isfinite(array).all() for _, array in leaves_by_path(value)):
            notes.append(f"episode {index}: its {name} have NaN or infinity; learners refuse it")
    if not (episode.terminated or episode.truncated):
        notes.append(f"episode {index} has no end; learners take it as truncated")
    return notes


def _lines(episodes: Iterable[tuple[str, dict[str, Any], str]]) -> Iterator[str]:
    """One line for all episodes of a file of which the same is to be said."""
    for (name, what), group in itertools.groupby(episodes, key=lambda one: (one[0], one[2])):
        indices: list[Any] = [row.get("episode_index") for _, row, _ in group]
        parts = [f"the {what} of" if what else ""]
        if None in indices:
            parts.append("its episodes")
        elif len(indices) == 1:
            parts.append(f"episode {indices[0]}")
        else:
            is_run = indices == [*range(indices[0], indices[0] + len(indices))]
            parts.append("episodes " + (f"{indices[0]} to {indices[-1]}" if is_run else ", ".join(map(str, indices))))
        yield f"{name}: {' '.join(filter(None, parts))}"


def mend(files: Files, *, accept_loss: bool = False) -> Found:
    """Make a data set whole, with every whole episode that is in its files; the caller has the lock.

    What cannot be put back as it was written is copied to the folder `ASIDE` first. A kill in between leaves all that
    can be mended.

    Args:
        files: Those of the data set.
        accept_loss: Whether to go on although something is lost; else nothing is changed then.
    """
    reader = _Reader(files)
    found, left_over = _look(reader)
    if (found.is_whole and found.has_copies) or (found.lost and not accept_loss):
        return found
    head, is_hidden = Head(reader.info, reader.extra), False
    files.write(layout.MENDING, b"")
    for pair in reader.pairs():
        for name, content in pair.exact.items():
            files.write(name, content)
        copy_line = file_name(layout.COPIES, pair.number)
        pair.damaged = [] if pair.is_as_written else [one for one in pair.damaged if not one.startswith(copy_line)]
        columns, ahead = [Columns.read(one, reader.info) for one in pair.episodes], replace(head, tasks=[*head.tasks])
        if pair.number == head.file and columns and not pair.lost and not [*_problems(pair, columns, ahead)]:
            head = ahead
            head.add_stats(columns)
            if pair.copy is None:
                _write_copy(files, head)
            continue
        if not is_hidden:
            is_hidden = True
            head.write(files)  # readers see the whole files alone until the rest is in place
        if pair.lost or not pair.is_as_written:
            for kind in (layout.DATA, layout.EPISODES):
                found.set_aside += files.copy_aside(file_name(kind, pair.number), ASIDE)
        if columns and pair.number not in left_over:
            head.write_pair(files, columns)
    for number, kind in itertools.product(reversed(reader.numbers), layout.NUMBERED):
        if number >= head.file:
            files.delete(file_name(kind, number))
    files.write_json(layout.BAM, head.own())
    for name in (layout.TASKS, layout.STATS) if not head.episodes else ():
        files.delete(name)
    head.write(files)
    if head.file:
        _write_copy(files, head)  # with the digest of these statistics
    files.delete(layout.MENDING)
    return found


def _write_copy(files: Files, head: Head) -> None:
    """Write the copy of the last file that `head` counts."""
    data, episodes = (files.content(file_name(kind, head.file - 1)) for kind in (layout.DATA, layout.EPISODES))
    files.write(file_name(layout.COPIES, head.file - 1), head.copy(data or b"", episodes or b"").to_bytes())
