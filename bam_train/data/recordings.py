"""Recordings of deployments (MCAP), and plain Parquet files with one row a step, as episodes of a data set."""

from __future__ import annotations

import base64
import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bam_envs.core.registry import resolve_id
from bam_envs.core.wording import brief
from bam_train.checkpoint.manifest import require_no_place
from bam_train.data.arrow_columns import Arrow
from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import DataSetWriter, require_same
from bam_train.data.layout import INFO, Files
from bam_train.data.record_dataset import info_of
from bam_train.data.recorded_episode import Array, DataSetInfo, Episode, digest_of, nested
from bam_train.environments import make_env, must_be_named, require_env_kwargs
from bam_train.errors import BadDataSet, FormatError
from bam_train.files.place import Place, local_path
from bam_train.recording.recording import DIGEST, Recording

BAG = "metadata.yaml"
"""What the folder of a bag of ROS has."""
_CUT, _NO_END = "cut off", "it has no end, and is taken as truncated"


def is_rows(source: Path) -> bool:
    """Whether it is a Parquet file or a folder, and neither a recording nor a bag."""
    return source.suffix == ".parquet" or (Place(source).is_dir() and not (source / BAG).is_file())


def is_data_set(text: str) -> bool:
    """Whether a place for a recording is a data set: an address, a folder, or a name without a suffix."""
    place = Place(text)
    return place.local is None or text.endswith("/") or place.is_dir() or not (place.suffix or place.exists())


def require_addable(place: str | Path | Place, info: DataSetInfo) -> None:
    """Refuse a data set that is there and damaged, or has episodes that differ in `info`; raises BadDataSet."""
    files = Files(place)
    if files.exists(INFO):
        require_same(files.text, DataSet.open(files.text).info, info)


def info_of_recording(recording: Recording, env: str | None = None) -> DataSetInfo:
    """What all episodes of a recording have in common, by its metadata and its environment, which is made.

    Args:
        recording: The recording.
        env: Its environment where a module must be imported for it, ``some_module:Env-v0``.

    Raises:
        FormatError: It does not say its environment, or that is another one.
    """
    named = recording.metadata.get("env", "")
    if not named or (env is not None and env.rpartition(":")[2] != named.rpartition(":")[2]):
        raise FormatError(f"{recording.path}: is of {named or 'no named environment'}, not of {env}; give that one")
    if must_be_named(named) and env is None:
        raise FormatError(f"{recording.path}: is of {named}, whose module is imported only if you add --env {named}")
    kwargs = json.loads(recording.metadata.get("env_kwargs", "{}"))
    try:
        require_no_place(kwargs)
    except ValueError as error:
        raise FormatError(f"{recording.path}: {error}. Ask whoever made it") from error
    period = json.loads(recording.metadata.get("period_s", "null"))
    with closing(make_env(env or named, kwargs)) as made:
        return info_of(made, env or named, kwargs, period)


def info_of_rows(source: Path, env: str | None, env_kwargs: Mapping[str, Any]) -> DataSetInfo:
    """What all episodes of Parquet rows have in common, by their environment, which is made.

    Raises:
        BadDataSet: It is a data set; no environment is given, or one whose observations or actions are several arrays.
    """
    if Files(source).exists(INFO):
        raise BadDataSet(f"{source}: is a data set already; add it to another one with bam-data merge")
    if env is None:
        raise BadDataSet(f"{source}: Parquet rows do not name their environment; add --env ENV")
    env = resolve_id(env)
    require_env_kwargs(env, env_kwargs)
    with closing(make_env(env, dict(env_kwargs))) as made:
        info = info_of(made, env, env_kwargs)
    if info.observation_space.shape is None or info.action_space.shape is None:
        what = f"the spaces of {env} are {brief(info.observation_space)} and {brief(info.action_space)}"
        raise BadDataSet(f"{source}: Parquet rows have one array a step, and {what}; record it with RecordDataset")
    return info


def add_recording(recording: Recording, place: str | Path | Place, info: DataSetInfo) -> tuple[int, list[str]]:
    """Add the episodes of a recording to a data set, as `add_episodes`."""
    return add_episodes(recording.path, episodes_of(recording, info), place, info)


def add_episodes(
    source: Path,
    episodes: Iterable[tuple[Episode, str]],
    place: str | Path | Place,
    info: DataSetInfo,
    *,
    again: bool = False,
    **facts: Any,
) -> tuple[int, list[str]]:
    """Add the episodes of a recording or of rows to a data set, but for those that it has already.

    Where there is none to add, or after an exception, the place is as it was.

    An episode of rows is there already if the data set has one with the same steps and end, with rewards as float32,
    which rows keep.

    Args:
        source: The recording or the rows.
        episodes: What `episodes_of` or `episodes_of_rows` gives.
        place: The data set.
        info: What all its episodes have in common.
        again: Whether to add those too that it has already.
        facts: Further facts of every episode.

    Returns:
        How many of its episodes are in the data set now, and a line for each reason for which episodes were added with
        a fault, or left out.
    """
    notes: dict[str, list[int]] = {}
    count = 0
    with DataSetWriter(place, info, together=True) as writer:
        data = DataSet.open(place)
        known = [data.facts(i) for i in range(len(data))]
        there: Counter[Any] = Counter((row.get("recording"), row.get("number")) for row in known)
        if is_rows(source):
            episodes = list(episodes)
            lengths = {len(episode) for episode, _ in episodes}
            alike = [i for i, row in enumerate(known) if row["length"] in lengths]
            there = Counter(_in_rows(episode, info) for episode in data.episodes(alike))
        for episode, note in episodes:
            note = note if len(episode) else "left out: it has no step"
            key = _in_rows(episode, info) if is_rows(source) else (episode.facts["recording"], episode.facts["number"])
            is_there, there[key] = not again and there[key] > 0, there[key] - 1
            repeated = f"is in {place} already; bam-data import --again adds it all the same" if is_there else ""
            for text in (note, repeated):
                notes.setdefault(text, []).append(episode.facts["number"])
            is_whole = "left out" not in note
            count += is_whole
            if is_whole and not is_there:
                writer.add(replace(episode, facts={**episode.facts, **facts}))
        if not count:
            writer.undo()
    more = {text: f" and {len(numbers) - 1} more" if len(numbers) > 1 else "" for text, numbers in notes.items()}
    return count, [f"{source}: episode {numbers[0]}{more[text]}: {text}" for text, numbers in notes.items() if text]


def episodes_of(recording: Recording, info: DataSetInfo) -> Iterator[tuple[Episode, str]]:
    """Each episode of a recording, and what is odd about it.

    A tick of a recording has the observation and the action that follows; the last one's action was never done. The
    command and the guard at a tick are those that led to it.
    """
    if not recording.ticks:
        return
    observed, [actions] = recording.arrays("observation"), recording.arrays("action").values()
    leaves = info.observation_leaves
    pictures = _pictures(recording, [("/".join(map(str, one.path)), one.shape) for one in leaves if one.is_image])
    table, acted = recording.tables["/episode"], recording.policies()
    own = recording.metadata.get("checkpoint_sha256", "")
    for number, ticks in enumerate(recording.episodes()):
        first, last = ticks[0], ticks[-1]
        end = {name: bool(table.column(name)[last]) for name in ("terminated", "truncated")}
        success, note = table.column("success")[last], ""
        facts = {
            "recording": recording.path.name,
            "number": number,
            "policy": ", ".join(
                dict.fromkeys(own if own[:DIGEST] == name else name for name in acted[first : last + 1])
            ),
            "robot": recording.metadata.get("profile", ""),
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(table.times[first] / 1e9)),
        }
        if (seed := recording.seed(number)) is not None:
            facts["seed"] = seed
        if not any(end.values()):
            end["truncated"], facts["end"], note = True, _CUT, _NO_END
        parts: dict[str, Array] = {}
        for leaf in leaves:
            name = "/".join(map(str, leaf.path))
            source = pictures[name] if leaf.is_image else observed[name]
            parts[leaf.column] = source[first : last + 1]
            if leaf.is_image and not pictures[f"{name} is there"][first : last + 1].all():
                note = "left out: a picture is missing, which a slow disk costs"
        yield (
            Episode(
                nested(info.observation_space, parts, leaves),
                actions[first:last].reshape(last - first, *(info.action_space.shape or ())),
                table.column("reward")[first + 1 : last + 1],
                end["terminated"],
                end["truncated"],
                None if np.isnan(success) else bool(success),
                _columns(recording, first, last),
                facts,
            ),
            note,
        )


def _in_rows(episode: Episode, info: DataSetInfo) -> str:
    """Digest of what Parquet rows keep of an episode."""
    parts = ((info.observation_leaves, episode.observations), (info.action_leaves, episode.actions))
    arrays = {leaf.column: np.asarray(leaf.of(values)) for leaves, values in parts for leaf in leaves}
    return digest_of(
        {**arrays, "reward": episode.rewards.astype(np.float32)}, bool(episode.terminated), bool(episode.truncated)
    )


def episodes_of_rows(source: Path, info: DataSetInfo) -> Iterator[tuple[Episode, str]]:
    """Each episode of a Parquet file or a folder of them, and what is odd about it.

    The rows of an episode follow each other, also from one file to the next; it ends where it terminates, is truncated,
    or another ``eps_id`` begins.

    Raises:
        BadDataSet: There are no rows, a column or a value is missing, not finite or of another shape or kind than the
            environment's, or the rows of an episode do not follow each other.
    """
    [observed], [acted] = info.observation_leaves, info.action_leaves
    kinds: dict[str, tuple[tuple[int, ...], Any]] = dict.fromkeys(("obs", "new_obs"), (observed.shape, observed.dtype))
    kinds |= {"actions": (acted.shape, acted.dtype), "rewards": ((), np.float64)}
    kinds |= dict.fromkeys(("terminateds", "truncateds"), ((), np.bool_))
    table = _rows(source, ["eps_id", *kinds])
    rows = {name: _numbers(f"{source}: {name}", table[name].combine_chunks(), *kind) for name, kind in kinds.items()}
    ids, ends = table["eps_id"].to_pylist(), rows["terminateds"] | rows["truncateds"]
    starts = [0, *(k for k in range(1, len(ids)) if ends[k - 1] or ids[k] != ids[k - 1]), len(ids)]
    cut_off: set[Any] = set()
    for number, (start, stop) in enumerate(pairwise(starts)):
        observations = np.concatenate([rows["obs"][start:stop], rows["new_obs"][stop - 1 : stop]])
        if ids[start] in cut_off or (observations[1:] != rows["new_obs"][start:stop]).any():
            what = f"the rows of episode {ids[start]!r} do not follow each other, or some are missing"
            raise BadDataSet(f"{source}: {what}; sort them, and give each unbroken part an eps_id of its own")
        end = bool(rows["terminateds"][stop - 1]), bool(rows["truncateds"][stop - 1] or not ends[stop - 1])
        facts = {"recording": Place(source).name, "number": number, "eps_id": str(ids[start])}
        if not ends[stop - 1]:
            facts["end"] = _CUT
            cut_off.add(ids[start])
        actions, rewards = rows["actions"][start:stop], rows["rewards"][start:stop]
        episode = Episode(observations, actions, rewards, *end, facts=facts)
        yield episode, "" if ends[stop - 1] else _NO_END


def _rows(source: Path, columns: list[str]) -> Arrow:
    """The table of these columns."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        files = pq.ParquetDataset(local_path(source))
        if missing := [name for name in columns if name not in files.schema.names]:
            text = f"lacks the column {', '.join(missing)}; it has {', '.join(files.schema.names) or 'none'}"
            raise BadDataSet(f"{source}: {text}")
        table = files.read(columns)
    except (OSError, pa.ArrowInvalid) as error:
        raise BadDataSet(
            f"{source}: cannot be read as Parquet: {' '.join(str(error).split())}. Give files of Parquet alone"
        ) from error
    if not len(table):
        raise BadDataSet(f"{source}: has no rows")
    return table


def _numbers(name: str, column: Arrow, shape: tuple[int, ...], dtype: Any) -> Array:
    """A column of numbers, tensors, or (nested) lists of numbers as one array (rows, *shape)."""
    import pyarrow as pa
    import pyarrow.compute as pc

    found: list[Any] = []
    if isinstance(column, pa.FixedShapeTensorArray):
        found, column = list(column.type.shape), column.storage.flatten()
    while pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        lengths = pc.unique(pc.list_value_length(column)).to_pylist()
        found.append(lengths[0] if len(lengths) == 1 else "different lengths")
        column = column.flatten()
    if tuple(found) != shape:
        raise BadDataSet(f"{name}: expected rows of shape {shape}, found {tuple(found)}")
    array: Array = column.to_numpy(zero_copy_only=False).reshape(-1, *shape)
    if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
        raise BadDataSet(f"{name}: expected finite numbers, found others or rows without one; record it again")
    exact = array.astype(dtype)
    if exact.dtype.kind != "f" and not np.array_equal(exact, array):
        raise BadDataSet(f"{name}: expected {exact.dtype} numbers, found {array.dtype} that are none; record it again")
    return exact


def _columns(recording: Recording, first: int, last: int) -> dict[str, Array]:
    columns = {"time": recording.tables["/episode"].times[first:last] / 1e9}
    columns["guard"] = np.array(recording.guards[first + 1 : last + 1], object)
    if "/state" in recording.tables:
        columns["stamp"] = recording.tables["/state"].column("stamp")[first:last]
    if "/command" in recording.tables:
        command = recording.tables["/command"]
        kept = [k for k, name in enumerate(command.names) if name != "t"]
        columns["command"] = command.numbers[first + 1 : last + 1][:, kept]
    return columns


def _pictures(recording: Recording, wanted: list[tuple[str, tuple[int, ...]]]) -> dict[str, Array]:
    """The pictures of observations by name, and whether each is there."""
    found: dict[str, Array] = {}
    times = recording.tables["/episode"].times
    for name, shape in wanted:
        pixels, there = np.zeros((recording.ticks, *shape), np.uint8), np.zeros(recording.ticks, bool)
        for _, wall, content in recording.pictures(f"/pixels/env_obs/{name}".rstrip("/")):
            tick = int(np.searchsorted(times, wall, "right")) - 1
            if 0 <= tick < recording.ticks:
                pixels[tick] = np.frombuffer(base64.b64decode(content["data"]), np.uint8).reshape(shape)
                there[tick] = True
        found |= {name: pixels, f"{name} is there": there}
    return found
