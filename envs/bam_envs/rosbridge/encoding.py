"""What a WebSocket frame of rosbridge holds: strict JSON, CBOR, JSON inside a PNG, fragments of any of the texts."""

from __future__ import annotations

import base64
import json
import math
import struct
import sys
import zlib
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cbor2

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.ros.interfaces import Field, describe, normal_name, variants
from bam_envs.rosbridge.bounds import require_bounded

COMPRESSIONS = ("none", "png", "cbor")
"""How a message may be packed for a subscriber."""
LONGEST_ID = 256
"""Most characters of an id: it is kept, and said again, for as long as what it names is unfinished."""
LARGEST_ID = 2**53
"""Largest id that is a number: what every JSON reader holds exactly."""
_MOST_FRAGMENTS = 10_000
"""Of one outgoing message: a smaller fragment size would cost more than it carries."""

_EMPTY = 100
"""About what a fragment without any text costs [bytes]."""

# RFC 8746: tag of a little-endian typed array, with the type code of `array`.
_TYPED = {
    "int8": (72, "b"),
    "int16": (77, "h"),
    "int32": (78, "i"),
    "int64": (79, "q"),
    "uint16": (69, "H"),
    "uint32": (70, "I"),
    "uint64": (71, "Q"),
    "float32": (85, "f"),
    "float64": (86, "d"),
}


def decode_frame(data: str | bytes) -> dict[str, Any]:
    """The message in one frame: a JSON object, alone and bounded (`bounds`). A binary frame holds the same in UTF-8.

    NaN and infinities are read, so that what refuses them can say in which message and field they were.

    Raises:
        ProtocolError: Not one JSON object, too much in it, too deeply nested.
    """
    value = _decode_json(data.encode(errors="surrogatepass") if isinstance(data, str) else data)
    if not isinstance(value, dict):
        raise ProtocolError(f"Message: expected an object, found {describe(value)}.")
    return value


def encode_json(message: Mapping[str, Any]) -> str:
    """A message as JSON in ASCII; `bytes` in it as base64. It must be finite."""
    return _ENCODER.encode(message)


def encode_png(text: str) -> str:
    """ASCII `text` as the pixels of an RGB image, filled up with line ends: a PNG as base64."""
    pixels = math.ceil(len(text) / 3)
    width = max(1, math.isqrt(pixels))
    height = max(1, math.ceil(pixels / width))
    raw = text.encode("ascii").ljust(3 * width * height, b"\n")
    rows = b"".join(b"\0" + raw[start : start + 3 * width] for start in range(0, len(raw), 3 * width))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = _chunk(b"IHDR", head) + _chunk(b"IDAT", zlib.compress(rows)) + _chunk(b"IEND", b"")
    return base64.b64encode(b"\x89PNG\r\n\x1a\n" + chunks).decode("ascii")


def encode_cbor(message: Mapping[str, Any], kind: str | None = None) -> bytes:
    """A message as CBOR. The lists of numbers in ``msg``, of type `kind`, travel as typed arrays (RFC 8746)."""
    if kind is not None:
        message = {**message, "msg": _typed(normal_name(kind), message["msg"])}
    return cbor2.dumps(message)


def split(text: str, size: int, name: str) -> list[str]:
    """`text` as messages ``fragment`` with `size` characters of it in each; `text` itself if it is short enough."""
    if len(text) <= size:
        return [text]
    size = max(size, math.ceil(len(text) / _MOST_FRAGMENTS))
    starts = range(0, len(text), size)
    return [
        encode_json({"op": "fragment", "id": name, "data": text[at : at + size], "num": num, "total": len(starts)})
        for num, at in enumerate(starts)
    ]


@dataclass
class _Parts:
    total: int
    deadline: float
    texts: dict[int, str] = field(default_factory=dict)
    size: int = 0
    """Bytes: a text that is not ASCII takes up to four for a character."""


class Fragments:
    """Puts the fragments of one connection together again, in whatever order they come.

    Args:
        max_size: Most bytes that all unfinished messages may hold together.
        lifetime: How long a message may stay unfinished [s].
        max_messages: Most unfinished messages.
    """

    def __init__(self, max_size: int, lifetime: float = 10.0, max_messages: int = 16) -> None:
        self.max_size, self.lifetime, self.max_messages = max_size, lifetime, max_messages
        self._unfinished: dict[str | int, _Parts] = {}

    @property
    def size(self) -> int:
        """What the unfinished messages hold [bytes]."""
        return sum(parts.size for parts in self._unfinished.values())

    def clear(self) -> None:
        """Give all of them up."""
        self._unfinished.clear()

    @property
    def deadline(self) -> float | None:
        """When the first unfinished message is given up [s], clock of the caller; None if there is none."""
        return min((parts.deadline for parts in self._unfinished.values()), default=None)

    def add(self, message: Mapping[str, Any], now: float) -> str | None:
        """Take a message ``fragment``; returns the whole text when it was the last one missing.

        Raises:
            ProtocolError: It does not fit; what there was of its message is given up.
        """
        name = _fragment_id(message.get("id"))
        try:
            return self._add(name, message, now)
        except ProtocolError:
            self._unfinished.pop(name, None)
            raise

    def expire(self, now: float) -> list[str | int]:
        """Give up what is too old; returns the ids."""
        late = [name for name, parts in self._unfinished.items() if parts.deadline <= now]
        for name in late:
            del self._unfinished[name]
        return late

    def _add(self, name: str | int, message: Mapping[str, Any], now: float) -> str | None:
        num, total = _count(message, "num"), _count(message, "total")
        data = message.get("data")
        if not isinstance(data, str):
            raise ProtocolError(f"fragment.data: expected a text, found {describe(data)}.")
        parts = self._unfinished.get(name) or self._begin(name, total, now)
        if total != parts.total or not num < total or parts.texts.get(num, data) != data:
            raise ProtocolError(f"Fragment {num} of {total} of {name!r} does not fit the ones before it.")
        if num not in parts.texts:
            parts.texts[num] = data
            # An empty fragment costs memory too.
            parts.size += len(data) * (1 if data.isascii() else 4) + _EMPTY
            self._require_room()
        if len(parts.texts) < total:
            return None
        del self._unfinished[name]
        return "".join(parts.texts[place] for place in range(total))

    def _begin(self, name: str | int, total: int, now: float) -> _Parts:
        if len(self._unfinished) >= self.max_messages:
            raise ProtocolError(f"Fragments of {self.max_messages} messages are unfinished; send one to its end first.")
        return self._unfinished.setdefault(name, _Parts(total, now + self.lifetime))

    def _require_room(self) -> None:
        if self.size > self.max_size:
            raise ProtocolError(f"Fragments: expected at most {self.max_size} bytes, found {self.size}.")


def _fragment_id(name: object) -> str | int:
    if isinstance(name, bool) or not isinstance(name, (str, int)):
        raise ProtocolError(f"fragment.id: expected a text, found {describe(name)}.")
    if isinstance(name, str) and len(name) > LONGEST_ID:
        raise ProtocolError(f"fragment.id: expected at most {LONGEST_ID} characters, found {len(name)}.")
    if isinstance(name, int) and abs(name) > LARGEST_ID:
        raise ProtocolError(f"fragment.id: expected an integer of 53 bits, found {describe(name)}.")
    return name


def _count(message: Mapping[str, Any], name: str) -> int:
    value = message.get(name)
    # The Python servers send the total as a float with a fraction: 8.52 for 8 fragments.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 2**31:
        raise ProtocolError(f"fragment.{name}: expected a number >= 0, found {describe(value)}.")
    return int(value)


_ENCODER = json.JSONEncoder(
    separators=(",", ":"), allow_nan=False, check_circular=False, default=lambda value: _base64(value)
)
_DECODER = json.JSONDecoder()


def _base64(value: object) -> str:
    if not isinstance(value, bytes):
        raise InvalidValue(f"Message: expected plain values, found {describe(value)}.")
    return base64.b64encode(value).decode("ascii")


def _utf8(data: bytes) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise ProtocolError(f"Message: expected text in UTF-8: {error.reason} at byte {error.start}.") from None


def _decode_json(data: bytes) -> Any:
    require_bounded(data)
    text = _utf8(data)
    start = _skip(text, 0)
    try:
        value, end = _DECODER.raw_decode(text, start)
    except RecursionError:
        raise ProtocolError("Message: too deeply nested.") from None
    except ValueError as error:  # JSONDecodeError, and Python's own limit for the digits of an integer
        raise ProtocolError(f"Message: expected JSON: {error}.") from None
    if _skip(text, end) < len(text):
        raise ProtocolError("Message: expected one in a frame, found more behind it.")
    return value


def _skip(text: str, at: int) -> int:
    while at < len(text) and text[at] in " \t\r\n":
        at += 1
    return at


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def _typed(kind: str, message: Mapping[str, Any]) -> dict[str, Any]:
    fields = {one.name: one for spelling in variants(kind) for one in spelling}
    return {name: _typed_field(fields[name], value) if name in fields else value for name, value in message.items()}


def _typed_field(one: Field, value: Any) -> Any:
    if isinstance(value, list) and one.type in _TYPED:
        tag, code = _TYPED[one.type]
        numbers = array(code, value)
        if sys.byteorder == "big":
            numbers.byteswap()
        return cbor2.CBORTag(tag, numbers.tobytes())
    if isinstance(value, list):
        return [_typed(one.type, item) if isinstance(item, dict) else item for item in value]
    return _typed(one.type, value) if isinstance(value, dict) else value
