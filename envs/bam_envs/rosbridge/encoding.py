"""Contents of rosbridge frames: JSON, CBOR with typed arrays (RFC 8746), JSON inside a PNG, fragments."""

import base64
import json
import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cbor2
import numpy as np

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.core.wording import brief
from bam_envs.ros.interfaces import MAX_DEPTH, Field, normal_name, require_plain, variants

COMPRESSIONS = ("none", "png", "cbor")  # encodings of a message for a subscriber
MOST_ITEMS = 100_000  # values in one JSON message of a client: lists, objects, and each value in them
MOST_ITEMS_OF_A_SERVER = 4_000_000  # the same for messages of a server: an image may come as a list of numbers
_NOT_BRACKETS = bytes(set(range(256)) - set(b'"[]{}'))
_ONE_KIND = bytes.maketrans(b"{}", b"[]")
_LONGEST_ID = 256  # most characters of an id, which is kept and repeated until its operation ends
_LARGEST_ID = 2**53  # largest numeric id that every JSON reader holds exactly
_MOST_FRAGMENTS = 10_000  # of one outgoing message: smaller fragments would cost more than they carry
_EMPTY = 100  # approximate cost of a fragment without text [bytes]
_MOST_UNFINISHED = 16  # messages of one connection that may be incomplete at the same time
Id = str | int | None  # a client's id of an operation; None without one


def _dtype(tag: int) -> np.dtype[Any]:
    """The dtype of a typed array of RFC 8746; its tag has bits for floating point, signed, little-endian and size."""
    kind = "f" if tag & 16 else "i" if tag & 8 else "u"
    size = (2 if tag & 16 else 1) << (tag & 3)
    return np.dtype(f"{'<' if tag & 4 else '>'}{kind}{size}")


# 76 is reserved; 83 and 87 are quadruple precision, which NumPy does not have everywhere.
_DTYPES = {tag: _dtype(tag) for tag in range(64, 88) if tag not in (76, 83, 87)}
_TYPED = {_DTYPES[tag].name: (tag, _DTYPES[tag]) for tag in (69, 70, 71, 72, 77, 78, 79, 85, 86)}

# ---- decoding


def decode_frame(data: str | bytes) -> dict[str, Any]:
    """The message in a frame of a client: one JSON object, alone and bounded, in UTF-8."""
    # NaN and infinities are read, so that a later check can name their message and field.
    return _object(data, MOST_ITEMS, _STRICT)


def decode_server_frame(data: bytes) -> dict[str, Any]:
    """The message in a frame of a server, in JSON or CBOR; NaN and Infinity, which some servers send, become None."""
    # An object in CBOR begins with a byte from 0x80 to 0xbf, and no text in UTF-8 does.
    return decode_cbor(data) if b"\x80" <= data[:1] <= b"\xbf" else _object(data, MOST_ITEMS_OF_A_SERVER, _PATIENT)


def load_json(text: object, what: str, most_items: int = MOST_ITEMS_OF_A_SERVER) -> dict[str, Any]:
    """The object in the JSON `text`, with finite numbers and at most `most_items` values; errors name it `what`."""
    if not isinstance(text, str):
        raise ProtocolError(f"{what} must be a string with a JSON object, not {type(text).__name__}.")
    try:
        return _object(text, most_items, _FINITE)
    except ProtocolError as error:
        reason = str(error).removeprefix("Message: ").rstrip(".")
        raise ProtocolError(f"{what} must be a JSON object: {reason}.") from error


def _object(data: str | bytes, most_items: int, decoder: json.JSONDecoder) -> dict[str, Any]:
    data = data.encode(errors="surrogatepass") if isinstance(data, str) else data
    # A message that would be too much work is refused before it is parsed, by a few fast passes over its bytes.
    openings = data.count(b"[") + data.count(b"{")
    if openings + data.count(b",") > most_items:  # commas and brackets in texts count too
        raise ProtocolError(f"Message: expected at most {most_items} values, found more.")
    if openings > MAX_DEPTH and _is_deep(data):
        raise ProtocolError(f"Message: expected at most {MAX_DEPTH} lists and objects in one another, found more.")
    try:
        value = decoder.decode(data.decode())
    except UnicodeDecodeError as error:
        raise ProtocolError(f"Message: expected text in UTF-8: {error.reason} at byte {error.start}.") from None
    except ValueError as error:  # JSONDecodeError, and Python's own limit for the digits of an integer
        if str(error).startswith("Extra data"):
            raise ProtocolError("Message: expected one in a frame, found more after it.") from None
        raise ProtocolError(f"Message: expected JSON: {error}.") from None
    if not isinstance(value, dict):
        raise ProtocolError(f"Message: expected an object, found {brief(value)}.")
    return value


def _is_deep(data: bytes) -> bool:
    if b"\\" in data:
        data = data.replace(b"\\\\", b"").replace(b'\\"', b"")
    outside = b"".join(
        data.translate(_ONE_KIND, _NOT_BRACKETS).split(b'"')[::2]
    )  # every second part is inside a string
    for _ in range(MAX_DEPTH):  # each pass removes the innermost pairs
        outside = outside.replace(b"[]", b"")
    return b"[" in outside


def decode_cbor(frame: bytes) -> dict[str, Any]:
    """A message in CBOR; typed arrays become read-only arrays, shape (n,), in the byte order of this machine."""
    try:
        # cbor2 5 and 6 give a tag hook different arguments, so the tags are replaced afterwards.
        message = _untag(cbor2.loads(frame))
    except (cbor2.CBORDecodeError, ValueError, RecursionError) as error:
        raise ProtocolError(f"expected CBOR, found {frame[:20]!r}: {error}") from error
    if not isinstance(message, dict):
        raise ProtocolError(f"expected an object in CBOR, found a {type(message).__name__}")
    return message


def _untag(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _untag(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_untag(part) for part in value]
    if not isinstance(value, cbor2.CBORTag):
        return value
    dtype = _DTYPES.get(value.tag)
    if dtype is None or not isinstance(value.value, bytes):
        raise ProtocolError(f"CBOR tag {value.tag} on a {type(value.value).__name__}: expected a typed array, 64 to 86")
    if len(value.value) % dtype.itemsize:
        size = len(value.value)
        raise ProtocolError(f"CBOR tag {value.tag}: expected a multiple of {dtype.itemsize} bytes, found {size}")
    array = np.frombuffer(value.value, dtype)
    return array if dtype.isnative else array.astype(dtype.newbyteorder("="))


# ---- encoding


def dump_json(value: Any, what: str = "message") -> str:
    """`value` as JSON in ASCII, `bytes` as base64; `InvalidValue` names any value in `what` that is not plain."""
    try:
        return _ENCODER.encode(value)
    except (TypeError, ValueError, RecursionError) as error:
        require_plain(value, what)
        raise InvalidValue(f"{what}: expected plain values, found something else: {error}.") from error


def encode_png(text: str) -> str:
    """ASCII `text` as the pixels of an RGB image, padded with line ends: a PNG as base64."""
    pixels = math.ceil(len(text) / 3)
    width = max(1, math.isqrt(pixels))
    height = max(1, math.ceil(pixels / width))
    raw = text.encode("ascii").ljust(3 * width * height, b"\n")
    rows = b"".join(b"\0" + raw[start : start + 3 * width] for start in range(0, len(raw), 3 * width))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = _chunk(b"IHDR", head) + _chunk(b"IDAT", zlib.compress(rows)) + _chunk(b"IEND", b"")
    return base64.b64encode(b"\x89PNG\r\n\x1a\n" + chunks).decode("ascii")


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def encode_cbor(message: Mapping[str, Any], kind: str | None = None) -> bytes:
    """A message as CBOR. The lists of numbers in ``msg``, of type `kind`, become typed arrays."""
    if kind is not None:
        message = {**message, "msg": _typed(normal_name(kind), message["msg"])}
    return cbor2.dumps(message)


def _typed(kind: str, message: Mapping[str, Any]) -> dict[str, Any]:
    fields = {one.name: one for spelling in variants(kind) for one in spelling}
    return {name: _typed_field(fields[name], value) if name in fields else value for name, value in message.items()}


def _typed_field(one: Field, value: Any) -> Any:
    if isinstance(value, list) and one.type in _TYPED:
        tag, dtype = _TYPED[one.type]
        return cbor2.CBORTag(tag, np.array(value, dtype).tobytes())
    if isinstance(value, list):
        return [_typed(one.type, item) if isinstance(item, dict) else item for item in value]
    return _typed(one.type, value) if isinstance(value, dict) else value


def _plain(value: object) -> str | dict[Any, Any]:
    if isinstance(value, Mapping):  # such as the messages of roslibpy, which are no dicts
        return dict(value)
    if not isinstance(value, bytes):
        raise TypeError(f"{type(value).__name__} is not plain")
    return base64.b64encode(value).decode("ascii")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number


# ---- messages in fragments


def split(text: str, size: int, name: str) -> list[str]:
    """`text` as messages ``fragment`` of `size` characters each; `text` itself if it is short enough."""
    if len(text) <= size:
        return [text]
    size = max(size, math.ceil(len(text) / _MOST_FRAGMENTS))
    starts = range(0, len(text), size)
    return [
        dump_json({"op": "fragment", "id": name, "data": text[at : at + size], "num": num, "total": len(starts)})
        for num, at in enumerate(starts)
    ]


def read_id(message: Mapping[str, Any], where: str = "id") -> Id:
    """The id of a message, a text or an integer; None without one. `ProtocolError` if it is too long to be kept."""
    value = message.get("id")
    if isinstance(value, bool) or not (value is None or isinstance(value, (str, int))):
        raise ProtocolError(f"{where}: expected a text or an integer, found {brief(value)}.")
    if isinstance(value, str) and len(value) > _LONGEST_ID:
        raise ProtocolError(f"{where}: expected at most {_LONGEST_ID} characters, found {len(value)}.")
    if isinstance(value, int) and abs(value) > _LARGEST_ID:
        raise ProtocolError(f"{where}: expected an integer of 53 bits, found {brief(value)}.")
    return value


@dataclass
class _Parts:
    total: int
    deadline: float
    texts: dict[int, str] = field(default_factory=dict)
    size: int = 0  # [bytes]; up to four for a character that is not ASCII


class Fragments:
    """Joins the fragments of one connection, in any order: `max_size` bytes at most, each message in `lifetime` [s]."""

    def __init__(self, max_size: int, lifetime: float = 10.0) -> None:
        self.max_size, self.lifetime = max_size, lifetime
        self._unfinished: dict[Id, _Parts] = {}

    @property
    def size(self) -> int:
        """Size of the unfinished messages [bytes]."""
        return sum(parts.size for parts in self._unfinished.values())

    def clear(self) -> None:
        """Discard all unfinished messages."""
        self._unfinished.clear()

    @property
    def deadline(self) -> float:
        """When the first unfinished message expires [s], clock of the caller; infinite if there is none."""
        return min((parts.deadline for parts in self._unfinished.values()), default=math.inf)

    def add(self, message: Mapping[str, Any], now: float) -> str | None:
        """Take a message ``fragment``; returns the whole text if it was the last one missing.

        `ProtocolError` for one that does not fit; the other fragments of its message are discarded.
        """
        name = read_id(message, "fragment.id")
        if name is None:
            raise ProtocolError("fragment.id: expected a text or an integer, found None.")
        try:
            return self._add(name, message, now)
        except ProtocolError:
            self._unfinished.pop(name, None)
            raise

    def expire(self, now: float) -> list[Id]:
        """Discard the messages that are too old; returns their ids."""
        late = [name for name, parts in self._unfinished.items() if parts.deadline <= now]
        for name in late:
            del self._unfinished[name]
        return late

    def _add(self, name: Id, message: Mapping[str, Any], now: float) -> str | None:
        num, total = _count(message, "num"), _count(message, "total")
        data = message.get("data")
        if not isinstance(data, str):
            raise ProtocolError(f"fragment.data: expected a text, found {brief(data)}.")
        if name not in self._unfinished and len(self._unfinished) >= _MOST_UNFINISHED:
            raise ProtocolError(f"Fragments of {_MOST_UNFINISHED} messages are unfinished; send one to its end first.")
        parts = self._unfinished.setdefault(name, _Parts(total, now + self.lifetime))
        if total != parts.total or not num < total or parts.texts.get(num, data) != data:
            raise ProtocolError(f"Fragment {num} of {total} of {name!r} does not fit the ones before it.")
        if num not in parts.texts:
            parts.texts[num] = data
            # An empty fragment costs memory too.
            parts.size += len(data) * (1 if data.isascii() else 4) + _EMPTY
            if self.size > self.max_size:
                raise ProtocolError(f"Fragments: expected at most {self.max_size} bytes, found {self.size}.")
        if len(parts.texts) < total:
            return None
        del self._unfinished[name]
        return "".join(parts.texts[place] for place in range(total))


def _count(message: Mapping[str, Any], name: str) -> int:
    value = message.get(name)
    # The Python servers send the total as a float with a fraction: 8.52 for 8 fragments.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 2**31:
        raise ProtocolError(f"fragment.{name}: expected a number >= 0, found {brief(value)}.")
    return int(value)


_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False, check_circular=False, default=_plain)
# json.loads and json.dumps with options would create one for each message.
_STRICT, _PATIENT = json.JSONDecoder(), json.JSONDecoder(parse_constant=lambda _: None)
_FINITE = json.JSONDecoder(parse_constant=_finite, parse_float=_finite)
