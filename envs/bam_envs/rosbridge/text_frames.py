"""WebSocket text frames at a client (RFC 6455, 5.2): whole messages, masked on their way out, bare on their way in.

Autobahn reads and writes every kind of frame, in several times the time, which a control loop waits for.
"""

from __future__ import annotations

import random
import struct

_WHOLE_TEXT = 0x81
_MASKED = 0x80
_TWO_BYTES, _EIGHT_BYTES = 126, 127
"""What stands where the size of a short text does, when that follows in so many bytes."""


def text_frame(payload: bytes) -> bytes:
    """The frame of a message.

    Args:
        payload: Text in UTF-8.
    """
    key = random.getrandbits(32).to_bytes(4, "big")  # against proxies that cache, not against eavesdroppers
    return _head(len(payload)) + key + _mask(payload, key)


def _head(size: int) -> bytes:
    if size < _TWO_BYTES:
        return struct.pack("!BB", _WHOLE_TEXT, _MASKED | size)
    if size < 2**16:
        return struct.pack("!BBH", _WHOLE_TEXT, _MASKED | _TWO_BYTES, size)
    return struct.pack("!BBQ", _WHOLE_TEXT, _MASKED | _EIGHT_BYTES, size)


def _mask(payload: bytes, key: bytes) -> bytes:
    """`payload` with the four bytes of `key` over and over; as two long integers, which is quick."""
    size = len(payload)
    keys = (key * (size // 4 + 1))[:size]
    return (int.from_bytes(payload, "big") ^ int.from_bytes(keys, "big")).to_bytes(size, "big")


def split_texts(data: bytes, most: int) -> tuple[list[bytes], bytes]:
    """The texts that `data` begins with, and the rest: from the first frame that is not a whole, short, bare text.

    Args:
        data: What came, from the beginning of a frame on.
        most: Longest text [bytes].
    """
    texts, at = [], 0
    while (place := _text_at(data, at)) is not None and place[1] - place[0] <= most:
        texts.append(data[place[0] : place[1]])
        at = place[1]
    return texts, data[at:]


def _text_at(data: bytes, at: int) -> tuple[int, int] | None:
    """Where the text begins and ends of the frame at `at`; None if there is no such frame."""
    if len(data) < at + 4 or data[at] != _WHOLE_TEXT:
        return None
    size, start = data[at + 1], at + 2
    if size == _TWO_BYTES:
        size, start = int.from_bytes(data[start : start + 2], "big"), start + 2
        if size < _TWO_BYTES:  # an error, which is told in Autobahn's words
            return None
    elif size > _TWO_BYTES:
        return None
    return (start, start + size) if start + size <= len(data) else None
