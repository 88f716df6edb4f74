"""What leaves the server: messages packed for those who want them, and what waits for a client that reads slowly."""

from __future__ import annotations

import itertools
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bam_envs.rosbridge.encoding import dump_json, encode_cbor, encode_png
from bam_envs.rosbridge.fragments import split

_NUMBERS = itertools.count(1)
NEVER_SPLIT = 2**31
"""A fragment size above that of every message."""


@dataclass(frozen=True)
class Wire:
    """How a client wants a message packed."""

    compression: str = "none"
    """One of `encoding.COMPRESSIONS`."""
    fragment_size: int = NEVER_SPLIT
    """Most characters of a message in one frame; CBOR is never split."""


@dataclass(frozen=True)
class Packet:
    """The WebSocket frames of one message."""

    frames: tuple[bytes, ...]
    """What each holds."""
    text: bool
    """Whether they are text frames."""
    stream: str | None = None
    """What it belongs to, if a newer one of the same may take its place; None for what must arrive."""

    @property
    def size(self) -> int:
        """Bytes of all frames."""
        return sum(map(len, self.frames))


def pack(
    message: Mapping[str, Any], wire: Wire | None = None, *, stream: str | None = None, kind: str | None = None
) -> Packet:
    """A protocol message as frames.

    Args:
        message: With the field ``op``.
        wire: How; None: as JSON in one frame.
        stream: See `Packet.stream`.
        kind: Type of the field ``msg``, for the typed arrays of CBOR.
    """
    wire = wire or Wire()
    if wire.compression == "cbor":
        return Packet((encode_cbor(message, kind),), text=False, stream=stream)
    text = dump_json(message)
    if wire.compression == "png":
        text = dump_json({"op": "png", "data": encode_png(text)})
    whole = len(text) <= wire.fragment_size
    parts = [text] if whole else split(text, wire.fragment_size, f"fragment:{next(_NUMBERS)}")
    return Packet(tuple(part.encode("ascii") for part in parts), text=True, stream=stream)


class Publication:
    """One message on a topic, on its way to any number of subscribers.

    Args:
        topic: Name, with a leading slash.
        kind: Normal name of its type.
        message: Checked and complete.
    """

    def __init__(self, topic: str, kind: str, message: Mapping[str, Any]) -> None:
        self.topic, self.kind, self.message = topic, kind, message
        self._packets: dict[tuple[str, str, int], Packet] = {}

    def packet(self, name: str, wire: Wire) -> Packet:
        """Packed for those who call the topic `name` and want it like `wire`; made once for all of them."""
        key = (name, wire.compression, wire.fragment_size)  # not `wire`: its hash is made in Python
        packet = self._packets.get(key)
        if packet is None:
            message = {"op": "publish", "topic": name, "msg": self.message}
            packet = self._packets[key] = pack(message, wire, stream=self.topic, kind=self.kind)
        return packet


class Outbox:
    """A queue for one client that drops the oldest message of a topic for a newer one, and nothing else.

    Args:
        most_bytes: Most bytes that wait; one message more, of whatever size, is taken when less than that waits.
        most_of_a_stream: Most messages of one topic, unless the client asked for fewer.
    """

    def __init__(self, most_bytes: int, most_of_a_stream: int) -> None:
        self.size = 0
        """Bytes that wait."""
        self.dropped = 0
        """Messages that were dropped for newer ones."""
        self._most_bytes, self._most_of_a_stream = most_bytes, most_of_a_stream
        self._packets: deque[Packet] = deque()
        self._waiting: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._packets)

    def add(self, packet: Packet, keep: int = 0) -> bool:
        """Queue a packet.

        Args:
            packet: What waits from now on.
            keep: Most packets of the same stream that may wait; 0 for the usual number.

        Returns:
            False if there is no room for one that must arrive.
        """
        if packet.stream is not None:
            most = min(keep or self._most_of_a_stream, self._most_of_a_stream)
            while self._waiting[packet.stream] >= most and self._drop(packet.stream):
                pass
        while self.size >= self._most_bytes and self._drop(None):
            pass
        if self.size >= self._most_bytes:
            return packet.stream is not None
        self._packets.append(packet)
        self._count(packet, 1)
        return True

    def pop(self) -> Packet:
        """The oldest packet; there must be one."""
        packet = self._packets.popleft()
        self._count(packet, -1)
        return packet

    def _drop(self, stream: str | None) -> bool:
        """Drop the oldest packet of a stream, or of any; False if there is none."""
        for place, packet in enumerate(self._packets):
            if packet.stream is not None and stream in (None, packet.stream):
                del self._packets[place]
                self._count(packet, -1)
                self.dropped += 1
                return True
        return False

    def _count(self, packet: Packet, change: int) -> None:
        self.size += change * packet.size
        if packet.stream is not None:
            self._waiting[packet.stream] += change
            if not self._waiting[packet.stream]:
                del self._waiting[packet.stream]
