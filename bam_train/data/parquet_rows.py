"""Plain Parquet files with one row a step as episodes of a data set.

They have the columns ``eps_id``, ``obs``, ``actions`` (in the environment's action space), ``rewards``, ``new_obs``,
``terminateds`` and ``truncateds``; others are ignored. The rows of an episode follow each other, also from one file to
the next; an episode ends where it terminates, is truncated, or another ``eps_id`` begins.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from itertools import groupby, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from bam_envs.core.registry import resolve_id
from bam_envs.core.wording import brief
from bam_train.data.arrow_columns import Arrow
from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import DataSetWriter
from bam_train.data.episode import Array, DataSetInfo, Episode, digest_of, leaves_of
from bam_train.data.layout import INFO, Files
from bam_train.data.record_dataset import info_of
from bam_train.data.selection import same_place
from bam_train.environments import make_env, require_env_kwargs
from bam_train.errors import BadDataSet
from bam_train.files.place import Place

COLUMNS = ("eps_id", "obs", "actions", "rewards", "new_obs", "terminateds", "truncateds")
"""Columns that every file must have."""

_ROWS = 2_000
"""Rows that are read together."""


def is_rows(source: str | Path) -> bool:
    """Whether `source` is a folder or a Parquet file, and no recording."""
    return Place(source).suffix == ".parquet" or Place(source).is_dir()


def info_of_env(source: Path, env: str | None, env_kwargs: Mapping[str, Any]) -> DataSetInfo:
    """What all episodes of rows have in common, by their environment, which is made.

    Raises:
        BadDataSet: No environment is given, or one whose observations or actions are several arrays.
    """
    if env is None:
        raise BadDataSet(f"{source}: Parquet rows do not name their environment; add --env ENV")
    env = resolve_id(env)
    require_env_kwargs(env, env_kwargs)
    with closing(make_env(env, dict(env_kwargs))) as made:
        info = info_of(made, env, env_kwargs)
    for kind, space in (("observation", info.observation_space), ("action", info.action_space)):
        if space.shape is None:
            what = f"the {kind} space of {env} is {brief(space)}"
            raise BadDataSet(f"{source}: Parquet rows have one array a step, and {what}; record it with RecordDataset")
    return info


def add_rows(source: Path, place: str | Path, info: DataSetInfo, **facts: Any) -> list[str]:
    """Add the episodes of rows to a data set, but for those that it has already; nothing unless all rows are whole.

    Args:
        source: A folder, with the folders in it, or a file.
        place: The data set.
        info: What all its episodes have in common.
        facts: Further facts of every episode.

    Returns:
        What was left out or cut off, a line each.

    Raises:
        BadDataSet: The rows are not whole, or do not fit the environment.
    """
    if Files(source).exists(INFO):
        raise BadDataSet(f"{source}: is a data set already; add it with bam-data merge {source} --out {place}")
    if same_place(source, place):
        raise BadDataSet(f"{source}: is read and cannot be written too; choose another PLACE")
    cut_off = sum("end" in episode.facts for episode in episodes_of(source, info))
    left_out = 0
    with DataSetWriter(place, info) as writer:
        there = Counter(DataSet.open(place).digests)
        for episode in episodes_of(source, info):
            if there[episode.digest]:
                there[episode.digest] -= 1
                left_out += 1
            else:
                writer.add(replace(episode, facts={**episode.facts, **facts}))
    notes = {"have no end, and are taken as truncated": cut_off, f"are in {place} already, and are left out": left_out}
    return [f"{source}: episodes that {what}: {number}" for what, number in notes.items() if number]


def episodes_of(source: Path, info: DataSetInfo) -> Iterator[Episode]:
    """Each episode of rows, with its digest.

    Raises:
        BadDataSet: There are no rows, a column or a value is missing, not finite or of another shape or kind than the
            environment's, or the rows of an episode do not follow each other.
    """
    [observed], [acted] = leaves_of(info.observation_space, "observation"), leaves_of(info.action_space, "action")
    number, cut_off = -1, set()
    for (number, eps_id), parts in groupby(_parts(source, info), itemgetter(0, 1)):
        pieces = [part[2] for part in parts]
        rows = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
        where = f"{source}: episode {eps_id!r} of the rows"
        differ = rows["obs"][1:] != rows["new_obs"][:-1]
        gaps = np.flatnonzero(differ.any(axis=tuple(range(1, differ.ndim))))
        if len(gaps) or eps_id in cut_off:
            what = f"new_obs of its step {gaps[0]} is not obs of the next" if len(gaps) else "others are in between"
            raise BadDataSet(f"{where}: {what}; put its rows in order, and give each unbroken part its own eps_id")
        terminated, truncated = bool(rows["terminateds"][-1]), bool(rows["truncateds"][-1])
        facts = {"recording": Place(source).name, "number": number, "eps_id": str(eps_id)}
        if not (terminated or truncated):
            truncated, facts["end"] = True, "cut off"
            cut_off.add(eps_id)
        observations = np.concatenate([rows["obs"], rows["new_obs"][-1:]])
        arrays = {observed.column: observations, acted.column: rows["actions"], "reward": rows["rewards"]}
        digest = digest_of(arrays, terminated, truncated, None)
        yield Episode(observations, rows["actions"], rows["rewards"], terminated, truncated, facts=facts, digest=digest)
    if number < 0:
        raise BadDataSet(f"{source}: has no rows")


def _parts(source: Path, info: DataSetInfo) -> Iterator[tuple[int, Any, dict[str, Array]]]:
    """Rows of one episode that are read together: its number, its ``eps_id``, and columns (rows, ...)."""
    [observed], [acted] = leaves_of(info.observation_space, "observation"), leaves_of(info.action_space, "action")
    kinds: dict[str, tuple[tuple[int, ...], Any]] = dict.fromkeys(("obs", "new_obs"), (observed.shape, observed.dtype))
    kinds |= {"actions": (acted.shape, acted.dtype), "rewards": ((), np.float64)}
    kinds |= dict.fromkeys(("terminateds", "truncateds"), ((), np.bool_))
    number, name, is_over = -1, None, True
    for batch in _batches(source):
        rows = {column: _array(f"{source}: {column}", batch.column(column), *kind) for column, kind in kinds.items()}
        ids, ends = batch.column("eps_id").to_pylist(), rows["terminateds"] | rows["truncateds"]
        begins = [k for k in range(1, len(ids)) if ends[k - 1] or ids[k] != ids[k - 1]]
        for start, stop in pairwise([0, *begins, len(ids)]):
            number += int(is_over or ids[start] != name)
            name, is_over = ids[start], ends[stop - 1]
            yield number, name, {column: values[start:stop] for column, values in rows.items()}


def _batches(source: Path) -> Iterator[Arrow]:
    """The rows of all files, some at a time."""
    files = _files(Place(source))
    if not files:
        raise BadDataSet(f"{source}: has no .parquet file in it")
    for file in files:
        yield from _batches_of(file)


def _batches_of(file: Place) -> Iterator[Arrow]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(file.local or file.open_input()) as opened:
            names = opened.schema_arrow.names
            if missing := [name for name in COLUMNS if name not in names]:
                raise BadDataSet(f"{file}: lacks the column {', '.join(missing)}; it has {', '.join(names)}")
            yield from (batch for batch in opened.iter_batches(_ROWS, columns=list(COLUMNS)) if len(batch))
    except (OSError, pa.ArrowInvalid) as error:
        raise BadDataSet(f"{file}: cannot be read as Parquet: {' '.join(str(error).split())}") from error


def _files(place: Place) -> list[Place]:
    """The Parquet files in a folder and its folders, by name, without hidden ones; a file itself."""
    if not place.is_dir():
        return [place] if place.suffix == ".parquet" else []
    return [file for one in place.list() if not one.name.startswith((".", "_")) for file in _files(one)]


def _array(name: str, column: Arrow, shape: tuple[int, ...], dtype: Any) -> Array:
    """A column of numbers, tensors, or (nested) lists of numbers as one array (rows, *shape)."""
    import pyarrow as pa
    import pyarrow.compute as pc

    found: list[int] | None = []
    if isinstance(column, pa.FixedShapeTensorArray):
        found, column = list(column.type.shape), pa.array(column.to_numpy_ndarray().reshape(-1))
    while found is not None and (pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)):
        lengths = pc.unique(pc.list_value_length(column)).to_pylist()
        found = [*found, *lengths] if len(lengths) == 1 and None not in lengths else None
        column = column.flatten()
    if found is None or tuple(found) != shape:
        text = "rows of different lengths" if found is None else f"shape {tuple(found)}"
        raise BadDataSet(f"{name}: expected rows of shape {shape}, found {text}")
    array: Array = column.to_numpy(zero_copy_only=False).reshape(-1, *shape)
    if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
        raise BadDataSet(f"{name}: expected finite numbers, found others or rows without one; record it again")
    exact = array.astype(dtype)
    if exact.dtype.kind != "f" and not np.array_equal(exact, array):
        raise BadDataSet(f"{name}: expected {exact.dtype} numbers, found {array.dtype} that are none; record it again")
    return exact
