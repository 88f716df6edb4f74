"""MCAP with the topics of a deployment's recording, for Foxglove and `bam-replay`; see `bam_train.recording.recorder`.

A tick has the observation, the action that it led to, and reward, end and command of the step before, as in a
recording. An episode of T steps has T + 1 ticks; the last action is null, or 0 where actions are whole numbers.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from bam_train.data.data_set import DataSet
from bam_train.data.recorded_episode import Array, DataSetInfo, Episode
from bam_train.recording.recorder import number_kinds, number_names
from bam_train.recording.recorder_process import RecordingFile
from bam_train.recording.ring import EVENT, LAYOUT, PIXELS, TICK, TIMES

_PAUSE = 1.0
"""Time between two episodes [s]."""
_SETTLE = 20
"""Episodes of a chunk."""
_END = ("episode", "step", "reward", "terminated", "truncated", "success")


def write(data: DataSet, indices: Sequence[int], path: Path) -> str:
    """Write the file. Episodes follow each other, also where they were recorded side by side."""
    metadata = {
        "env": data.info.env,
        "env_kwargs": json.dumps(data.info.env_kwargs),
        "period_s": json.dumps(data.info.period),
        "robot": data.info.robot,
        "data_set": json.dumps({"info": data.info.to_json(), "digest": data.digest}),
    }
    guards = [""]
    file = RecordingFile({"paths": [str(path)], "metadata": metadata, "guards": guards})
    now = 0.0
    for number, episode in enumerate(data.episodes(indices)):
        times = _times(data.info, episode, now)
        now = times[-1] + _PAUSE
        _add(file, data.info, number, episode, times, guards)
        if number % _SETTLE == _SETTLE - 1:
            file.settle()
    file.close()
    return f"bam-replay {path}  # or open it in Foxglove"


def _times(info: DataSetInfo, episode: Episode, now: float) -> Array:
    """Wall clock of each observation [s]; where they were recorded faster than the task runs, a period between them."""
    steps, recorded = len(episode), episode.columns.get("time")
    ticks = info.period * np.arange(steps + 1)
    begin = now
    if recorded is not None and np.isfinite(recorded).all():
        begin = max(now, float(recorded[0]))
        if recorded[-1] - recorded[0] > 0.5 * ticks[-2]:
            ticks[:-1] = recorded - recorded[0]
            ticks[-1] = ticks[-2] + info.period
    elif "date" in episode.facts:
        begin = max(now, datetime.fromisoformat(str(episode.facts["date"]).replace("Z", "+00:00")).timestamp())
    return np.asarray(begin + ticks)


def _add(
    file: RecordingFile, info: DataSetInfo, number: int, episode: Episode, times: Array, guards: list[str]
) -> None:
    steps = len(episode)
    observation = info.observation_leaves
    pictures = {leaf.column: leaf.of(episode.observations) for leaf in observation if leaf.is_image}
    observed = {_name(leaf): leaf.of(episode.observations) for leaf in observation if not leaf.is_image}
    acted = {_name(leaf): leaf.of(episode.actions) for leaf in info.action_leaves}
    unknown = np.nan if all(values.dtype.kind == "f" for values in acted.values()) else 0
    tables = {"/observation": _flat(observed, steps + 1), "/action": _later(_flat(acted, steps), 0, 1, unknown)}
    if "command" in episode.columns:
        tables["/command"] = _later(_flat({"": episode.columns["command"]}, steps), 1, 0)
    numbers = {name: values for name, values in episode.columns.items() if _is_number(name, values)}
    if numbers:
        tables["/columns"] = _later(_flat(numbers, steps), 0, 1)
    tables["/status"] = _later(_status(episode, guards), 1, 0, 0)
    tables["/latency"] = np.zeros((steps + 1, 0))
    tables["/episode"] = _ends(number, episode)
    commands = {"": episode.columns.get("command", np.zeros((1, 0)))}
    layout = {"/status": ["code", "guard"], "/latency": [], "/episode": list(_END)}
    for kind, arrays in (("observation", observed), ("action", acted), ("command", commands), ("columns", numbers)):
        given = [str(one["name"]) for one in info.contract.get(kind) or ()]
        layout[f"/{kind}"] = number_names(arrays, given)
    extra = {kind: number_kinds(of) for kind, of in (("observation", observed), ("action", acted))}
    declared = {"layout": {topic: layout[topic] for topic in tables}, "extra": extra if number == 0 else {}}
    _record(file, LAYOUT, times[0], json.dumps(declared).encode())
    text = f"episode {number + 1} begins: {json.dumps(episode.facts)}"
    _record(file, EVENT, times[0], bytes([2]) + text.encode(errors="replace"))
    rows = np.concatenate(list(tables.values()), axis=1)
    for tick, row in enumerate(rows):
        _record(file, TICK, times[tick], row.astype("=f8").tobytes())
        for name, values in pictures.items():
            head = [name.removeprefix("observation.images."), *values.shape[1:]]
            _record(file, PIXELS, times[tick], json.dumps(head).encode() + b"\n" + values[tick].tobytes())


def _record(file: RecordingFile, kind: bytes, time: float, data: bytes) -> None:
    file.add(kind + TIMES.pack(round(time * 1e9), time, 0.0, 0) + data)


def _name(leaf: Any) -> str:
    return ".".join(map(str, leaf.path))


def _is_number(name: str, values: Array) -> bool:
    return name not in ("command", "time") and values.dtype.kind in "fiub" and values[0].size <= 32


def _flat(arrays: dict[str, Array], count: int) -> Array:
    """Shape: (count, numbers)."""
    flat = [np.asarray(values, np.float64).reshape(count, -1) for values in arrays.values()]
    return np.concatenate([np.zeros((count, 0)), *flat], axis=1)


def _later(rows: Array, before: int, after: int, unknown: float = np.nan) -> Array:
    """With rows of `unknown` before and after."""
    return np.pad(rows, ((before, after), (0, 0)), constant_values=unknown)


def _status(episode: Episode, guards: list[str]) -> Array:
    titles = episode.columns.get("guard", np.full(len(episode), ""))
    guards += [title for title in dict.fromkeys(map(str, titles)) if title not in guards]
    places = np.array([guards.index(str(title)) for title in titles], np.float64)
    return np.stack([(places > 0).astype(np.float64), places], axis=1)


def _ends(number: int, episode: Episode) -> Array:
    steps = len(episode)
    table = np.zeros((steps + 1, len(_END)))
    table[:, 0], table[:, 1], table[1:, 2] = number, np.arange(steps + 1), episode.rewards
    table[-1, 3:5] = episode.terminated, episode.truncated
    table[:, 5] = np.nan
    table[-1, 5] = np.nan if episode.success is None else episode.success
    return table
