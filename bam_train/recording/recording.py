"""Read a recording; one that was cut off or damaged is read up to that place."""

import json
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from numpy.typing import NDArray
from zstandard import ZstdError

from bam_envs.core.robot import RobotSpec, RobotState
from bam_train.errors import FormatError

Array = NDArray[np.float64]
TICKS = ("/state", "/truth", "/command", "/observation", "/action", "/status", "/latency", "/episode")
"""Topics with one message for each tick; the first three need a robot."""
_ALWAYS = ("/action", "/status", "/latency", "/episode")
"""Topics that every deployment has."""
_Rows: TypeAlias = dict[str, list[tuple[int, dict[str, Any]]]]
"""Topic to time [ns] and content of each message."""
_MAX_CHUNK = 2**28  # of an unpacked chunk [bytes]; a camera's largest picture is far smaller
_LENGTH = (LookupError, OverflowError, EOFError, MemoryError)
DAMAGE = (McapError, ZstdError, msgspec.MsgspecError, struct.error, ValueError, *_LENGTH)
_FOREIGN = (msgspec.MsgspecError, ValueError, LookupError, TypeError, OverflowError, RecursionError)
"""Exceptions for messages with unexpected content."""
_decode = msgspec.json.Decoder().decode
DIGEST = 12
"""Characters of a digest in texts for people, and so in events."""
_ACTS = re.compile(rf"\b([0-9a-f]{{{DIGEST}}}) acts\b")
"""In the event in which a live agent says which version acts from the next tick on."""


@dataclass
class Table:
    """The messages of one topic, one for each tick."""

    names: tuple[str, ...]
    """Name of each number, such as ``joint_position.elbow_joint``."""
    numbers: Array
    """NaN for a number that was not finite. Shape: (ticks, k)."""
    times: NDArray[np.int64]
    """Wall clock [ns]. Shape: (ticks,)."""

    def column(self, name: str) -> Array:
        """The numbers called `name`. Shape: (ticks,)."""
        return self.numbers[:, self.names.index(name)]


@dataclass(frozen=True)
class Event:
    """An action of the operator, or a message to the operator."""

    time: int
    """Wall clock [ns]."""
    level: int
    text: str


@dataclass
class Recording:
    """A recording of `bam-deploy` or `bam-agent`; `open` reads it."""

    path: Path
    metadata: dict[str, str] = field(default_factory=dict)
    """Description of the deployment; see `bam_train.deploy.flight.deployment_facts`."""
    kinds: dict[str, dict[str, list[Any]]] = field(default_factory=dict)
    """Dtype and shape of each array of ``truth``, ``observation`` and ``action``."""
    units: dict[str, dict[str, str]] = field(default_factory=dict)
    """Topic to the unit of each number by name, 1 for none; empty in recordings of earlier versions."""
    tables: dict[str, Table] = field(default_factory=dict)
    """Topic to its numbers; all have the same number of ticks."""
    guards: list[str] = field(default_factory=list)
    """The guard that changed the command that led to each tick; "" for none."""
    events: list[Event] = field(default_factory=list)
    complete: bool = False
    """Whether the recorder completed the file; else it was cut off or damaged."""

    @classmethod
    def open(cls, path: str | Path) -> "Recording":
        """Read a recording up to its end, or to the place where it is cut off or damaged; without its pictures.

        Raises:
            FormatError: There is no such file, or it is not a recording.
        """
        recording = cls(Path(path).expanduser())
        rows: _Rows = {topic: [] for topic in TICKS}
        try:
            for record in recording._records():
                recording._take(rows, record)
        except FormatError:
            raise
        except _FOREIGN:
            pass  # what was read so far is the recording
        if not all(rows[topic] for topic in _ALWAYS):
            rows.clear()  # not one whole tick
        if not recording.metadata and not rows:
            text = "not a recording. Give a .mcap file that bam-deploy or bam-agent wrote"
            raise FormatError(f"{path}: {text}; bam-data import takes a bag of ROS 2 too")
        try:
            recording._fill({topic: messages for topic, messages in rows.items() if messages})
        except (TypeError, ValueError, AttributeError) as error:
            raise FormatError(f"{path}: its numbers cannot be read: {error}. Get the file again") from error
        return recording

    def pictures(self, topic: str | None = None) -> Iterator[tuple[str, int, dict[str, Any]]]:
        """Topic, time [ns] and message of each picture, of cameras and of observations; or only those of `topic`."""
        for record in self._records():
            if isinstance(record, tuple):
                channel, message = record
                if channel.startswith(("/camera/", "/pixels/")) and topic in (None, channel):
                    yield channel, message.log_time, _decode(message.data)

    def _records(self) -> Iterator[McapRecord | tuple[str, Message]]:
        """The records up to the end or the damage, with each message beside its topic."""
        topics: dict[int, str] = {}
        try:
            with self.path.open("rb") as file:
                limit = max(1, self.path.stat().st_size)
                for record in StreamReader(file, emit_chunks=True, record_size_limit=limit).records:
                    for part in _unpacked(record):
                        if isinstance(part, Channel):
                            topics[part.id] = part.topic
                        yield (topics[part.channel_id], part) if isinstance(part, Message) else part
        except OSError as error:
            why = error.strerror or error
            raise FormatError(
                f"{self.path}: cannot be read: {why}. Give a .mcap file of bam-deploy or bam-agent"
            ) from error
        except DAMAGE:
            return  # what was read so far is the recording

    def _take(self, rows: _Rows, record: McapRecord | tuple[str, Message]) -> None:
        if isinstance(record, Metadata) and record.name == "deployment":
            self.metadata = dict(record.metadata)
        elif isinstance(record, Metadata) and record.name == "layout":
            layout = {kind: json.loads(text) for kind, text in record.metadata.items()}
            self.units = {topic: dict(units) for topic, units in dict(layout.pop("units", {})).items()}
            self.kinds = layout
        elif isinstance(record, Footer):
            self.complete = True
        if not isinstance(record, tuple):
            return
        topic, message = record
        if topic in rows:
            rows[topic].append((message.log_time, _decode(message.data)))
        elif topic == "/events":
            content = _decode(message.data)
            self.events.append(Event(message.log_time, int(content["level"]), str(content["message"])))

    def _fill(self, rows: _Rows) -> None:
        ticks = min(map(len, rows.values()), default=0)  # the last tick may be incomplete
        self.guards = [str(content.pop("guard", "")) for _, content in rows.get("/status", [])[:ticks]]
        for topic, messages in rows.items():
            flat = [_flat(content) for _, content in messages[:ticks]]
            names = tuple(flat[0]) if flat else ()
            table = [[np.nan if (x := row.get(name)) is None else x for name in names] for row in flat]
            times = np.array([time for time, _ in messages[:ticks]], dtype=np.int64)
            self.tables[topic] = Table(names, np.array(table, dtype=np.float64).reshape(ticks, len(names)), times)

    @property
    def ticks(self) -> int:
        """Number of whole ticks."""
        return len(self.guards)

    def seed(self, number: int) -> int | None:
        """Seed of an episode, counted from 0; None if the metadata has none. Raises FormatError if it is no number."""
        text = self.metadata.get("seed")
        if text is not None and not text.isdecimal():
            raise FormatError(f"{self.path}: its metadata says seed {text!r}, which is no number. Get the file again")
        return None if text is None else int(text) + number

    def policies(self) -> list[str]:
        """The first `DIGEST` characters of the digest of the policy that acted at each tick; "" if that is unknown."""
        times = self.tables["/episode"].times if self.ticks else np.array([])
        acts = [self.metadata.get("checkpoint_sha256", "")[:DIGEST]] * self.ticks
        for event in self.events:
            if (found := _ACTS.search(event.text)) is not None:  # of a live agent
                first = int(np.searchsorted(times, event.time))
                acts[first:] = [found[1]] * (self.ticks - first)
        return acts

    def episodes(self) -> list[range]:
        """The ticks of each episode; the first one of each is the reset."""
        if not self.ticks:
            return []
        starts = np.flatnonzero(self.tables["/episode"].column("step") == 0).tolist()
        return [range(start, end) for start, end in zip(starts, [*starts[1:], self.ticks], strict=True)]

    def latencies(self) -> dict[str, Array]:
        """Times of the stages of each tick [s] by name; NaN where not known, and at the first tick of an episode.

        There the step is the reset, which may be the way to a start pose, and the policy acts for the first time.
        """
        if not self.ticks:
            return {}
        table, is_first = self.tables["/latency"], self.tables["/episode"].column("step") == 0
        return {name: np.where(is_first, np.nan, table.column(name)) for name in table.names[1:]}

    def arrays(self, kind: str) -> dict[str, NDArray[Any]]:
        """The arrays of ``"observation"``, ``"action"`` or ``"truth"``, (ticks, ...) each; "" names a single one."""
        table = self.tables.get(f"/{kind}")
        try:
            return {} if table is None else _split(table.numbers[:, 1:], self.kinds.get(kind, {}))
        except (TypeError, ValueError) as error:
            raise FormatError(f"{self.path}: its arrays cannot be read: {error}. Get the file again") from error

    def states(self, spec: RobotSpec) -> list[RobotState]:
        """The state at each tick, of a robot with this spec.

        Raises:
            FormatError: The recording lacks a signal of the spec.
        """
        state, command, known = self._table("/state"), self._table("/command"), self.arrays("truth")
        try:
            signals = {
                signal.name: np.stack([state.column(f"{signal.name}.{label}") for label in signal.labels], axis=1)
                for signal in spec.signals
            }
            commands = np.stack([command.column(label) for label in spec.command.labels], axis=1)
        except ValueError as error:
            raise FormatError(f"{self.path}: another robot than {spec.name} was recorded: {error}") from error
        stamps = state.column("stamp")
        return [
            RobotState(
                {name: values[k : k + 1] for name, values in signals.items()},
                stamps[k : k + 1],
                commands[k : k + 1],
                {name: values[k : k + 1] for name, values in known.items()},
            )
            for k in range(self.ticks)
        ]

    def _table(self, topic: str) -> Table:
        if topic not in self.tables:
            raise FormatError(f"{self.path}: no robot was recorded: there is no {topic} in it")
        return self.tables[topic]


def _unpacked(record: McapRecord) -> list[McapRecord]:
    if not isinstance(record, Chunk):
        return [record]
    if record.uncompressed_size > _MAX_CHUNK:
        raise ValueError("the chunk is too large")
    return breakup_chunk(record, validate_crc=True)


def _flat(content: dict[str, Any]) -> dict[str, Any]:
    """``{"a": 1, "b": {"c": 2}}`` as ``{"a": 1, "b.c": 2}``."""
    flat: dict[str, Any] = {}
    for name, value in content.items():
        flat |= {f"{name}.{key}": part for key, part in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def _split(numbers: Array, kinds: dict[str, list[Any]]) -> dict[str, NDArray[Any]]:
    """Split numbers (ticks, k) into the recorded arrays."""
    arrays, at = {}, 0
    for name, (dtype, *shape) in kinds.items():
        size = int(np.prod(shape))
        arrays[name] = numbers[:, at : at + size].astype(np.dtype(dtype)).reshape(len(numbers), *shape)
        at += size
    return arrays
