"""Typed arrays in CBOR (RFC 8746) as NumPy arrays."""

from __future__ import annotations

from typing import Any

import cbor2
import numpy as np

from bam_envs.core.errors import ProtocolError

# Tags 64-71, unsigned; 72-79, signed; 80-86, floating point: each first big-endian, then little-endian, by size. 68 is
# "clamped" bytes, 76 is reserved, and 83 and 87 are quadruple precision, which NumPy does not have everywhere.
_NAMES = {
    **dict(zip(range(64, 72), ("u1", ">u2", ">u4", ">u8", "u1", "<u2", "<u4", "<u8"), strict=True)),
    **dict(zip((72, 73, 74, 75, 77, 78, 79), ("i1", ">i2", ">i4", ">i8", "<i2", "<i4", "<i8"), strict=True)),
    **dict(zip((80, 81, 82, 84, 85, 86), (">f2", ">f4", ">f8", "<f2", "<f4", "<f8"), strict=True)),
}
_DTYPES = {tag: np.dtype(name) for tag, name in _NAMES.items()}


def decode_cbor(frame: bytes) -> dict[str, Any]:
    """A message in CBOR; typed arrays in it become read-only arrays, shape (n,), in the byte order of this machine.

    Raises:
        ProtocolError: It is not CBOR, not an object, or has a tag that is no typed array.
    """
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
    return _array(value) if isinstance(value, cbor2.CBORTag) else value


def _array(tag: cbor2.CBORTag) -> np.ndarray[tuple[int], np.dtype[Any]]:
    dtype = _DTYPES.get(tag.tag)
    if dtype is None or not isinstance(tag.value, bytes):
        raise ProtocolError(f"CBOR tag {tag.tag} on a {type(tag.value).__name__}: expected a typed array, 64 to 86")
    if len(tag.value) % dtype.itemsize:
        raise ProtocolError(
            f"CBOR tag {tag.tag}: expected a multiple of {dtype.itemsize} bytes, found {len(tag.value)}"
        )
    array = np.frombuffer(tag.value, dtype)
    return array if dtype.isnative else array.astype(dtype.newbyteorder("="))
