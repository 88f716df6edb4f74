"""Merge, split and filter data sets: episodes keep their numbers, digests, facts and order."""

from __future__ import annotations

import contextlib
import hashlib
import json
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bam_envs.core.wording import did_you_mean
from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import DataSetWriter, require_same
from bam_train.errors import BadDataSet, SettingsError

_Sources = Sequence[tuple[DataSet, Sequence[int]]]
"""Data sets, and the indices of some of their episodes."""
_SIGNS: dict[str, Callable[[Any, Any], bool]] = {
    "!=": operator.ne,
    ">=": operator.ge,
    "<=": operator.le,
    "=": operator.eq,
    ">": operator.gt,
    "<": operator.lt,
    "~": lambda found, wanted: str(wanted) in str(found),
}


def merge(sets: Sequence[DataSet], out: str | Path) -> tuple[int, int]:
    """Add the episodes of all `sets`, one set after the other, to the data set at `out`.

    Returns:
        How many were added, and how many were left out because they are there already.

    Raises:
        BadDataSet: Two are of different environments, spaces, units or periods.
        OutputError: `out` cannot be written. After any exception, it is as it was.
    """
    for one in sets[1:]:
        require_same(sets[0].place, sets[0].info, one.info, one.place, f"merge {one.place} into another place")
    return _copy({out: [(one, range(len(one))) for one in sets]})[0]


def choose(data: DataSet, conditions: Sequence[str]) -> list[int]:
    """Indices of the episodes for which all conditions hold, such as ``success=true`` and ``return>=10``.

    A condition names a fact of the episode, ``index``, ``digest``, ``length``, ``return``, ``success``, ``terminated``
    or ``truncated``; then comes = != > >= < <= or ~ (contains), and a value. A fact that is missing fits only !=.

    Raises:
        SettingsError: A condition cannot be read, no episode has the fact, its value is of another kind, or nothing
            fits.
    """
    rows = [{**data.facts(i), "index": i, "digest": digest} for i, digest in enumerate(data.digests)]
    known = {name for row in rows for name in row}
    kept = list(range(len(rows)))
    for condition in conditions:
        found = re.fullmatch(r"([\w.-]+?)\s*(!=|>=|<=|=|>|<|~)\s*(.*)", condition.strip())
        if found is None:
            raise SettingsError(f"--where: expected NAME=VALUE, NAME>VALUE or the like, found {condition!r}")
        name, sign, text = found.groups()
        if name not in known and rows:
            raise SettingsError(f"--where: no episode of {data.place} has {name!r}. {did_you_mean(name, known)}")
        kept = [i for i in kept if _holds(name, rows[i].get(name), sign, text)]
    if conditions and not kept:
        raise SettingsError(
            f"--where: none of the {len(rows)} episodes of {data.place} fits {' and '.join(conditions)}"
        )
    return kept


def _holds(name: str, found: Any, sign: str, text: str) -> bool:
    if found is None and text not in ("null", "None"):
        return sign == "!="
    wanted: Any = text
    if isinstance(found, (bool, int, float)) and sign != "~":
        kind, values = ("true or false", (True, False)) if isinstance(found, bool) else ("a number", None)
        try:
            wanted = json.loads(text.replace("None", "null"))
        except ValueError:
            wanted = text
        if wanted is not None and (wanted not in values if values else not isinstance(wanted, (int, float))):
            raise SettingsError(f"--where: {name} is {kind}, found {text!r}")
    elif not isinstance(found, str):
        with contextlib.suppress(ValueError):
            wanted = json.loads(text.replace("None", "null"))
    try:
        return _SIGNS[sign](found, wanted)
    except TypeError as error:
        raise SettingsError(f"--where: {found!r} cannot be compared with {text!r} by {sign}") from error


def copy_episodes(data: DataSet, parts: Mapping[str, Sequence[int]]) -> list[tuple[int, int]]:
    """Add the episodes of these indices of `data` to the data set at each place; returns for each as `merge`.

    Raises:
        BadDataSet: One of the places does not take them.
        OutputError: One cannot be written. After any exception, all places are as they were.
    """
    return _copy({out: [(data, indices)] for out, indices in parts.items()})


def split(data: DataSet, share: float, by: str | None = None) -> tuple[list[int], list[int]]:
    """Indices of two parts, the first with about `share` of the episodes.

    An episode's part follows from its digest alone: it stays the same when episodes are added, merged or filtered, and
    two copies of an episode are never in different parts. With `by`, episodes with the same value of that fact, such
    as ``policy`` or ``group``, stay together.

    Raises:
        SettingsError: An episode lacks the fact.
    """
    parts: tuple[list[int], list[int]] = ([], [])
    for index, digest in enumerate(data.digests):
        if by is not None:
            facts = data.facts(index)
            if by not in facts:
                raise SettingsError(f"--by: episode {index} of {data.place} has no {by!r}. {did_you_mean(by, facts)}")
            digest = hashlib.sha256(json.dumps(facts[by]).encode()).hexdigest()
        parts[int(digest[:13], 16) >= share * 16**13].append(index)
    return parts


def _copy(parts: Mapping[Any, _Sources]) -> list[tuple[int, int]]:
    """Add episodes of other data sets to each place, to all of them or to none; returns for each as `merge`."""
    for out, (one, _) in [(out, source) for out, sources in parts.items() for source in sources]:
        a, b = Path(one.place).expanduser(), Path(out).expanduser()
        if one.place == str(out) or (a.exists() and b.exists() and a.samefile(b)):
            raise BadDataSet(f"{out}: is read and cannot be written too; choose another place")
    with contextlib.ExitStack() as stack:
        writers = [
            stack.enter_context(DataSetWriter(out, sources[0][0].info, together=True)) for out, sources in parts.items()
        ]
        added = [_add(writer, out, sources) for writer, (out, sources) in zip(writers, parts.items(), strict=True)]
        for writer in writers:
            writer.commit()
    return added


def _add(writer: DataSetWriter, out: str | Path, sources: _Sources) -> tuple[int, int]:
    added, there = 0, set(DataSet.open(out).digests)
    for data, indices in sources:
        for episode in data.episodes([i for i in indices if data.digests[i] not in there]):
            if episode.digest not in there:
                there.add(episode.digest)
                writer.add(episode)
                added += 1
    return added, sum(len(indices) for _, indices in sources) - added
