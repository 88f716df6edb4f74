"""What leaves the server: messages packed for those who asked for them, each way of packing done once."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bam_envs.rosbridge.encoding import encode_cbor, encode_json, encode_png
from bam_envs.rosbridge.fragments import split

_NUMBERS = itertools.count(1)
NEVER_SPLIT = 2**31
"""A fragment size beyond every message."""


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


def pack(message: Mapping[str, Any], wire: Wire, *, stream: str | None = None, kind: str | None = None) -> Packet:
    """A protocol message as frames.

    Args:
        message: With the field ``op``.
        wire: How.
        stream: See `Packet.stream`.
        kind: Type of the field ``msg``, for the typed arrays of CBOR.
    """
    if wire.compression == "cbor":
        return Packet((encode_cbor(message, kind),), text=False, stream=stream)
    text = encode_json(message)
    if wire.compression == "png":
        text = encode_json({"op": "png", "data": encode_png(text)})
    if len(text) <= wire.fragment_size:
        return Packet((text.encode("ascii"),), text=True, stream=stream)
    parts = split(text, wire.fragment_size, f"fragment:{next(_NUMBERS)}")
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
        """Packed for those who call the topic `name`, and want it like `wire`; the same one for all of them."""
        key = (name, wire.compression, wire.fragment_size)  # not `wire`: its hash is made in Python
        packet = self._packets.get(key)
        if packet is None:
            message = {"op": "publish", "topic": name, "msg": self.message}
            packet = self._packets[key] = pack(message, wire, stream=self.topic, kind=self.kind)
        return packet
