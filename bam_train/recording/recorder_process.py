"""The process that writes a recording: it reads records from the ring, encodes them and flushes them to the disk.

It completes the file when the deployment closes the ring, and also when the deployment's process has ended. If this
process is killed, at most the messages since the last poll are lost: the messages of each poll are appended as a small
chunk, and every `_SETTLE` seconds one compressed chunk with an index replaces the small chunks.
"""

import base64
import json
import os
import struct
import sys
import time
import zlib
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, Message, Schema
from mcap.writer import CompressionType, Writer

from bam_train.recording.ring import EVENT, IMAGE, LAYOUT, PIXELS, TICK, TIMES, Ring
from bam_train.signals import SIGNALS, ignore

_POLL = 0.02
"""Time between two polls of the ring [s]."""
_SETTLE = 0.5
"""Time between two chunks with an index, which are synced to the disk [s]; a power cut may cost twice that."""
_SENT = ("/command", "/status")
"""Topics whose time is that of sending the command."""
_GUARDED = ("/status", "/sent")
"""Topics that name a guard; the tick has its index in the list."""
_NUMBER, _TEXT, _WHOLE = {"type": "number"}, {"type": "string"}, {"type": "integer"}
_STAMP = {"type": "object", "properties": {"sec": _WHOLE, "nsec": _WHOLE}}
_IMAGE = {"timestamp": _STAMP, "frame_id": _TEXT, "data": {"type": "string", "contentEncoding": "base64"}}
_SIZE = {"width": _WHOLE, "height": _WHOLE, "step": _WHOLE}
_KNOWN = {
    "foxglove.Log": dict.fromkeys(("message", "name", "file"), _TEXT)
    | {"timestamp": _STAMP, "level": _WHOLE, "line": _WHOLE},
    "foxglove.CompressedImage": {**_IMAGE, "format": _TEXT},
    "foxglove.RawImage": {**_IMAGE, **_SIZE, "encoding": _TEXT},
}
"""Properties of Foxglove's own schemas."""
_encode = msgspec.json.Encoder().encode  # NaN and infinity become null


class RecordingFile:
    """The MCAP file, with its channels and layouts."""

    def __init__(self, head: dict[str, Any]) -> None:
        self.file = _new_file(head["paths"])
        self._writer = Writer(self.file, chunk_size=2**62, compression=CompressionType.ZSTD)  # `settle` ends chunks
        self._writer.start(profile="", library="bam-train")
        self._guards: list[str] = head["guards"]
        self._layouts: dict[int, dict[str, list[list[str]]]] = {}
        """For each series: topic -> [group, name] or [name] of each number."""
        self._channels: dict[str, int] = {}
        self._sequences: Counter[int] = Counter()
        self._new = RecordBuilder()
        """Messages since the last poll of the ring."""
        self._begin = self._end = self.file.tell()  # of the small chunks
        self._metadata("deployment", {key: _text(value) for key, value in head["metadata"].items()})

    def add(self, record: bytes) -> None:
        """Encode a record of the ring."""
        kind, (wall, monotonic, ago, series) = record[:1], TIMES.unpack_from(record, 1)
        data = record[1 + TIMES.size :]
        stamp = {"sec": wall // 10**9, "nsec": wall % 10**9}
        if kind == TICK:
            self._tick(series, wall, monotonic, ago, data)
        elif kind == LAYOUT:
            self._declare(series, json.loads(data))
        elif kind == EVENT:
            message = {"timestamp": stamp, "level": data[0], "message": data[1:].decode(), "name": "bam-deploy"}
            self._known("/events", "foxglove.Log", wall, {**message, "file": "", "line": 0})
        else:
            head, _, image = data.partition(b"\n")
            name, *facts = json.loads(head)
            content = {"timestamp": stamp, "frame_id": name, "data": base64.b64encode(image).decode()}
            if kind == IMAGE:
                content["format"] = facts[0]
                self._known(f"/camera/{name}", "foxglove.CompressedImage", wall, content)
            elif kind == PIXELS:
                height, width, channels = facts
                content |= {"width": width, "height": height, "step": width * channels}
                content["encoding"] = {1: "mono8", 3: "rgb8", 4: "rgba8"}[channels]
                self._known(f"/pixels/{name}", "foxglove.RawImage", wall, content)

    def _declare(self, series: int, content: dict[str, Any]) -> None:
        if content["extra"]:
            self._metadata("layout", content["extra"])
        layout = {topic: [name.split(".", 1) for name in names] for topic, names in content["layout"].items()}
        self._layouts[series] = layout
        for topic, names in layout.items():
            if topic not in self._channels:
                properties: dict[str, Any] = nested([(["t"], _NUMBER), *((name, _NUMBER) for name in names)])
                if topic in _GUARDED:
                    properties["guard"] = _TEXT
                for name, part in properties.items():
                    if "type" not in part:
                        properties[name] = {"type": "object", "properties": part}
                self._register(topic, f"bam{topic.replace('/', '.')}", properties)

    def _metadata(self, name: str, content: dict[str, str]) -> None:
        self.settle()
        self._writer.add_metadata(name, content)
        self._begin = self._end = self.file.tell()

    def _register(self, topic: str, name: str, properties: dict[str, Any]) -> None:
        content = json.dumps({"title": name, "type": "object", "properties": properties}).encode()
        schema = self._writer.register_schema(name, "jsonschema", content)
        self._channels[topic] = channel = self._writer.register_channel(topic, "json", schema)
        Schema(id=schema, data=content, encoding="jsonschema", name=name).write(self._new)
        Channel(id=channel, topic=topic, message_encoding="json", metadata={}, schema_id=schema).write(self._new)

    def _tick(self, series: int, wall: int, monotonic: float, ago: float, data: bytes) -> None:
        numbers = iter(struct.unpack(f"={len(data) // 8}d", data))
        for topic, names in self._layouts[series].items():
            late = ago if topic in _SENT else 0.0
            message = nested([(["t"], monotonic - late), *((name, next(numbers)) for name in names)])
            if topic in _GUARDED:
                message["guard"] = self._guards[int(message["guard"])]
            self._message(topic, wall - int(1e9 * late), message, self._sequences[series])
        self._sequences[series] += 1

    def _known(self, topic: str, schema: str, wall: int, content: dict[str, Any]) -> None:
        if topic not in self._channels:
            self._register(topic, schema, _KNOWN[schema])
        self._message(topic, wall, content)

    def _message(self, topic: str, wall: int, content: dict[str, Any], sequence: int = 0) -> None:
        data, channel = _encode(content), self._channels[topic]
        self._writer.add_message(channel, wall, data, wall, sequence)
        Message(channel, wall, data, wall, sequence).write(self._new)

    def save(self) -> None:
        """Append the new messages as a small chunk, so that a kill of this process does not lose them."""
        if not self._new.count:
            return
        data: bytes = self._new.end()  # type: ignore[no-untyped-call]
        record = RecordBuilder()
        Chunk("", data, 0, 0, zlib.crc32(data), len(data)).write(record)
        self.file.seek(self._end)
        self.file.write(record.end())  # type: ignore[no-untyped-call]
        self.file.flush()
        self._end = self.file.tell()
        self.file.seek(self._begin)

    def settle(self) -> None:
        """Replace the small chunks by one chunk, and sync it to the disk."""
        self._new.end()  # type: ignore[no-untyped-call]
        self.file.seek(self._begin)
        self._writer.flush()  # type: ignore[no-untyped-call]
        self.file.truncate()
        os.fsync(self.file.fileno())
        self._begin = self._end = self.file.tell()

    def close(self) -> None:
        """End the file with its summary."""
        self.settle()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self.file.flush()
        os.fsync(self.file.fileno())
        self.file.close()


def _new_file(paths: list[str]) -> BinaryIO:
    """Make the first of these files that is not there yet: choosing it and making it are one step."""
    for path in paths[:-1]:
        with suppress(FileExistsError):
            return open(path, "xb")
    return open(paths[-1], "xb")


def _text(value: str) -> str:
    """The text without characters that UTF-8 cannot encode, such as those of file names in other encodings."""
    return value.encode(errors="replace").decode()


def nested(values: list[tuple[list[str], Any]]) -> dict[str, Any]:
    """``[(["a"], 1), (["b", "c"], 2)]`` as ``{"a": 1, "b": {"c": 2}}``."""
    table: dict[str, Any] = {}
    for name, value in values:
        (table if len(name) == 1 else table.setdefault(name[0], {}))[name[-1]] = value
    return table


def drain(ring: Ring, file: RecordingFile, parent: int) -> None:
    """Write the records of the ring into the file until the ring is closed, or the process `parent` has ended."""
    settled = time.monotonic()
    while True:
        over = ring.closed or os.getppid() != parent  # checked first, so that earlier records are still read
        while (record := ring.read()) is not None:
            file.add(record)
        if over:
            return
        file.save()
        if time.monotonic() - settled > _SETTLE:
            settled = time.monotonic()
            file.settle()
        time.sleep(_POLL)


def main() -> None:
    """Take the descriptor of the ring and the deployment's process number from the command line."""
    ignore(*SIGNALS)  # the deployment ends this process by closing the ring
    with suppress(OSError):
        os.nice(5)
    ring, parent = Ring(int(sys.argv[1])), int(sys.argv[2])
    head = json.loads(ring.read() or b"{}")
    made = last = head["paths"][-1]
    try:
        Path(last).parent.mkdir(parents=True, exist_ok=True)
        file = RecordingFile(head)
        made = file.file.name
        ring.begin(1 + head["paths"].index(made))
        drain(ring, file, parent)
        file.close()
        return
    except OSError as error:
        remedy = "; nothing is recorded from now on" if ring.ready else ". Choose another file"
        why = f"cannot be written: {error.strerror or error}{remedy}"
        if isinstance(error, FileExistsError) and error.filename == last:
            what = "a folder" if Path(last).is_dir() else "a recording"
            why = f"{what} is there already. Choose another file"
        ring.fail(f"{made}: {why}")
    os._exit(1)  # skips Python's attempt to write its buffer again
