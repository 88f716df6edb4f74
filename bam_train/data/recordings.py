"""Recordings of deployments (MCAP) as episodes of a data set."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bam_train.checkpoint.manifest import require_no_place
from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import DataSetWriter
from bam_train.data.episode import Array, DataSetInfo, Episode, joined, leaves_of
from bam_train.data.record_dataset import info_of
from bam_train.environments import make_env, must_be_named
from bam_train.errors import BadRecording
from bam_train.files.place import Place
from bam_train.recording.recording import Recording


def is_data_set(text: str) -> bool:
    """Whether a place for a recording is a data set: an address, a folder, or a name without a suffix."""
    place = Place(text)
    return place.local is None or text.endswith("/") or place.is_dir() or not (place.suffix or place.exists())


def info_of_recording(recording: Recording, env: str | None = None) -> DataSetInfo:
    """What all episodes of a recording have in common, by its metadata and its environment, which is made.

    Args:
        recording: The recording.
        env: Its environment where a module must be imported for it, ``some_module:Env-v0``.

    Raises:
        BadRecording: It does not say its environment, or that is another one.
    """
    named = recording.metadata.get("env", "")
    if not named or (env is not None and env.rpartition(":")[2] != named.rpartition(":")[2]):
        raise BadRecording(f"{recording.path}: is of {named or 'no named environment'}, not of {env}; give that one")
    if must_be_named(named) and env is None:
        raise BadRecording(f"{recording.path}: is of {named}, whose module is imported only if you add --env {named}")
    kwargs = json.loads(recording.metadata.get("env_kwargs", "{}"))
    try:
        require_no_place(kwargs)
    except ValueError as error:
        raise BadRecording(f"{recording.path}: {error}. Ask whoever made it") from error
    period = json.loads(recording.metadata.get("period_s", "null"))
    with closing(make_env(env or named, kwargs)) as made:
        return info_of(made, env or named, kwargs, period)


def add_recording(recording: Recording, place: str | Path | Place, info: DataSetInfo, **facts: Any) -> list[str]:
    """Add the episodes of a recording to a data set, but for those that it has already.

    Args:
        recording: The recording.
        place: The data set.
        info: What all its episodes have in common.
        facts: Further facts of every episode.

    Returns:
        A line for each episode that was added with a fault, or left out.
    """
    notes = []
    with DataSetWriter(place, info) as writer:
        data = DataSet.open(place)
        there = {(row.get("recording"), row.get("number")) for row in map(data.facts, range(len(data)))}
        for episode, note in episodes_of(recording, info):
            key = (episode.facts["recording"], episode.facts["number"])
            notes += [f"{recording.path}: episode {key[1]}: {note}"] if note else []
            if len(episode) and key not in there and "left out" not in note:
                writer.add(replace(episode, facts={**episode.facts, **facts}))
            elif key in there:
                notes.append(f"{recording.path}: episode {key[1]} is in {place} already")
    return notes


def episodes_of(recording: Recording, info: DataSetInfo) -> Iterator[tuple[Episode, str]]:
    """Each episode of a recording, and what is odd about it.

    A tick of a recording has the observation and the action that follows; the last one's action was never done. The
    command and the guard at a tick are those that led to it.
    """
    if not recording.ticks:
        return
    observed, [actions] = recording.arrays("observation"), recording.arrays("action").values()
    leaves = leaves_of(info.observation_space, "observation")
    pictures = _pictures(recording, [("/".join(map(str, one.path)), one.shape) for one in leaves if one.is_image])
    table, seed = recording.tables["/episode"], recording.seed
    for number, ticks in enumerate(recording.episodes()):
        first, last = ticks[0], ticks[-1]
        end = {name: bool(table.column(name)[last]) for name in ("terminated", "truncated")}
        success, note = table.column("success")[last], ""
        facts = {
            "recording": recording.path.name,
            "number": number,
            "seed": seed + number,
            "policy": recording.metadata.get("checkpoint_sha256", ""),
            "robot": recording.metadata.get("profile", ""),
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(table.times[first] / 1e9)),
        }
        if not any(end.values()):
            end["truncated"], facts["end"], note = True, "cut off", "it has no end, and is taken as truncated"
        parts: dict[str, Array] = {}
        for leaf in leaves:
            name = "/".join(map(str, leaf.path))
            source = pictures[name] if leaf.is_image else observed[name]
            parts[leaf.column] = source[first : last + 1]
            if leaf.is_image and not pictures[f"{name} is there"][first : last + 1].all():
                note = "left out: a picture is missing, which a slow disk costs"
        yield (
            Episode(
                joined(info.observation_space, parts, leaves),
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
