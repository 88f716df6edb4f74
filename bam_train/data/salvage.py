"""What the files of one number still say: with their copy, and column by column where one of them is damaged."""

from __future__ import annotations

import io
import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bam_train.data import layout
from bam_train.data.arrow_columns import Arrow
from bam_train.data.data_set import DataSet
from bam_train.data.file_pair import MAGIC, Copy, sha256
from bam_train.data.layout import Files, file_name, row_digest
from bam_train.data.recorded_episode import Episode

_ENDS = ("bam/terminated", "bam/truncated", "bam/success")


@dataclass
class Pair:
    """A data file and the episodes file of the same number, as far as they can be read."""

    number: int
    episodes: list[Episode] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    """Of each episode, as in the episodes file; what that does not say any more is put together."""
    places: list[Arrow] = field(default_factory=list)
    """Of each episode, the table of those columns of its steps that follow from others, as far as they can be read."""
    lost: list[tuple[dict[str, Any], str]] = field(default_factory=list)
    """As much of an episode's row as is known, and what of the episode is lost: "" for all of it."""
    damaged: list[str] = field(default_factory=list)
    """Which of its files are not as they were written, one line each."""
    exact: dict[str, bytes] = field(default_factory=dict)
    """Content of files as it was written, to be put back."""
    copy: Copy | None = None
    is_as_written: bool = False
    """Whether both files, with those of `exact`, are byte for byte what they were."""
    is_complete: bool = True
    """Whether it has a data file, and an episodes file or a copy of that."""

    @property
    def same(self) -> tuple[tuple[str, str], ...]:
        """What is equal of another pair with the same episodes."""
        return tuple((row["bam/digest"], row["bam/facts"]) for row in self.rows)


def read_pair(files: Files, data: DataSet, number: int) -> Pair:
    """What the files of this number say; `data` knows the columns."""
    names = [file_name(kind, number) for kind in (layout.DATA, layout.EPISODES, layout.COPIES)]
    steps, heads, zipped = map(files.content, names)
    copy, contents = Copy.from_bytes(zipped), [(steps, heads)]
    if copy is not None:
        restored = None if steps is None else copy.restored(steps)
        contents = [(restored, copy.episodes), (steps, copy.episodes), (steps, heads)]
    readings = (_read(data, number, *content) for content in contents)
    pair, whole = next(readings), contents[0][0]
    if copy is not None and whole is not None and sha256(whole) == copy.data:
        right = {names[0]: (whole, steps), names[1]: (copy.episodes, heads)}
        pair.exact = {name: one for name, (one, found) in right.items() if one != found}
        pair.damaged, pair.is_as_written = [f"{name} is not as it was written" for name in pair.exact], True
    else:  # the copy may be of other files
        pair = min([pair, *readings], key=lambda one: (len(one.lost), -len(one.episodes)))
    pair.copy, pair.is_complete = copy, steps is not None and (heads is not None or copy is not None)
    if zipped is not None and copy is None:
        pair.damaged.append(f"{names[2]} is not as it was written")
    missing = [name for name, content in zip(names, (steps, heads), strict=False) if content is None]
    pair.damaged = [line for line in pair.damaged if line.partition(" is ")[0] not in missing]
    pair.damaged += [f"{name} is missing" for name in missing]
    return pair


class _Table:
    """A Parquet file, columns of which may be damaged."""

    def __init__(self, content: bytes | None) -> None:
        import pyarrow.parquet as pq

        self.lengths: list[int] = []
        """Rows of each row group; none if nothing can be read."""
        self.is_whole = (content or b"").startswith(MAGIC)
        try:
            self._file = pq.ParquetFile(io.BytesIO(content or b""), page_checksum_verification=True)
            groups = range(self._file.metadata.num_row_groups)
            self._names = list(self._file.schema_arrow.names)
            self.lengths = [self._file.metadata.row_group(group).num_rows for group in groups]
        except layout.UNREADABLE:
            self.is_whole = False

    def read(self, group: int) -> Arrow:
        """The columns of a row group that can be read, as a table."""
        import pyarrow as pa

        try:
            return self._file.read_row_group(group)
        except layout.UNREADABLE:
            self.is_whole = False
        found: dict[str, Arrow] = {}
        for name in self._names:
            try:
                column = self._file.read_row_group(group, columns=[name]).column(name)
            except layout.UNREADABLE:
                continue
            found |= {name: column} if len(column) == self.lengths[group] else {}
        return pa.table(found)


def _read(data: DataSet, number: int, steps: bytes | None, heads: bytes | None) -> Pair:
    """The episodes that the contents of a data file and of an episodes file say."""
    pair, table, head = Pair(number), _Table(steps), _Table(heads)
    groups, last = [table.read(group) for group in range(len(table.lengths))], None
    rows: list[dict[str, Any]] = [{} for _ in groups]
    if head.lengths:
        last = head.read(0)
        light = [name for name in last.column_names if not name.startswith(layout.FINAL)]
        rows = last.select(light).to_pylist() or [{} for _ in range(head.lengths[0])]
    used: set[int] = set()
    for place, row in enumerate(rows):
        length, final = row.get("length"), None if last is None else last.slice(place, 1)
        fits = [group for group, rows_there in enumerate(table.lengths) if rows_there == length or group == place]
        for group in sorted({*fits} - used, key=lambda group: group != place):  # its own place first
            if found := _episode(data, row, groups[group], final):
                used.add(group)
                episode, whole_row, lost = found
                pair.episodes.append(episode)
                pair.rows.append(whole_row)
                derived = [name for name in (*layout.DEFAULTS, *layout.NEXT[1:]) if name in groups[group].column_names]
                pair.places.append(groups[group].select(derived))
                pair.lost += [(whole_row, lost)] if lost else []
                break
        else:
            pair.lost.append((row, ""))
    if not rows and (steps or heads):
        pair.lost.append(({}, ""))
    names = (file_name(layout.DATA, number), file_name(layout.EPISODES, number))
    pair.damaged = [f"{name} is damaged" for name, one in zip(names, (table, head), strict=True) if not one.is_whole]
    return pair


def _episode(
    data: DataSet, row: dict[str, Any], steps: Arrow, last: Arrow | None
) -> tuple[Episode, dict[str, Any], str] | None:
    """An episode of its row and its steps, as far as these can be read: with its full row, and what of it is lost.

    None if they do not belong together, or observations, actions or rewards are damaged.
    """
    observed, acted = ([leaf.column for leaf in one] for one in (data.info.observation_leaves, data.info.action_leaves))
    if not {*observed, *acted, layout.NEXT[0]} <= {*steps.column_names} or not len(steps):
        return None
    known, lost = dict(row), []
    if {*layout.LIGHT} <= row.keys() and row_digest(row) != row.get(layout.ROW, row_digest(row)):
        # One of its values is wrong.
        known = {name: row[name] for name in ("episode_index", "bam/digest", *_ENDS)}
    here = [name for name in data.extra if name in steps.column_names and not steps[name].null_count]
    own = json.loads(known.get("bam/columns", json.dumps(here)))
    gone = [name for name in own if name not in here]
    facts = json.loads(known.get("bam/facts", "{}"))
    ends = _ends(known, steps)
    if "bam/facts" not in known:
        lost.append("facts")
    if gone:
        lost.append(f"column {', '.join(gone)}")
    digests = {"bam/digest": known.get("bam/digest"), layout.EXTRA: None if gone else known.get(layout.EXTRA)}
    if last is None or not {layout.FINAL + name for name in observed} <= {*last.column_names}:
        # Learners take no value after a terminated episode; any other one ends before its last step.
        lost.append("last observation" if ends[0][0] else "last step")
        digests["bam/digest"] = None
        last = steps.slice(len(steps) - 1).select(observed).rename_columns([layout.FINAL + name for name in observed])
        if not ends[0][0]:
            steps, ends = steps.slice(0, len(steps) - 1), [[False], [True], ends[2][:1]]
    number = steps["episode_index"][0].as_py() if "episode_index" in steps.column_names and len(steps) else None
    if digests["bam/digest"] is None:
        if not len(steps) or number != known.get("episode_index", number):
            return None
        ends = [one[:1] for one in ends]
    kept = [name for name in own if name not in gone]
    tries = [(kept, digests[layout.EXTRA], "")] + ([([], None, "further columns")] if digests[layout.EXTRA] else [])
    for (names, extra, missing), end in itertools.product(tries, itertools.product(*ends)):
        full = {"episode_index": number, **known, **digests, layout.EXTRA: extra, **dict(zip(_ENDS, end, strict=True))}
        now = " and ".join(filter(None, [*lost, missing]))
        ever = " and ".join(filter(None, [str(facts.get("lost", "")), now]))  # with what was given up before
        told = facts | ({"lost": ever} if ever else {})
        full |= {"bam/facts": json.dumps(told), "bam/columns": json.dumps(names)}
        try:
            found = data.read(full, steps.drop_columns([one for one in here if one not in names]), last)
        except layout.UNREADABLE:
            continue
        return found, full | {"bam/digest": found.digest}, now
    return None


def _ends(row: Mapping[str, Any], steps: Arrow) -> list[list[bool | None]]:
    """Values of `_ENDS`, the likeliest first; one alone where the row says it."""
    said = {name: bool(steps[name][-1].as_py()) for name in layout.NEXT if name in steps.column_names}
    measured = steps["info.is_success"][-1].as_py() if "info.is_success" in steps.column_names else None
    success = True if said.get("next.success") else None if measured is None or math.isnan(measured) else False
    guesses: list[list[bool | None]] = [[said.get("next.terminated", False), True, False]]
    guesses += [[said.get("next.truncated", not guesses[0][0]), True, False], [success, True, False, None]]
    return [
        [row[name]] if name in row else list(dict.fromkeys(guess)) for name, guess in zip(_ENDS, guesses, strict=True)
    ]
