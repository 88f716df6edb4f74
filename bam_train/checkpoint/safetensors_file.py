"""The safetensors format in NumPy: 8 bytes of header length, a JSON header, then the raw arrays.

Nothing in such a file can be executed, so it is what weights, statistics and golden actions are kept in. The bytes
written are those that the `safetensors` library writes; see https://github.com/huggingface/safetensors#format.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bam_train.errors import FormatError

_DTYPES = {
    "F64": "<f8",
    "I64": "<i8",
    "U64": "<u8",
    "F32": "<f4",
    "I32": "<i4",
    "U32": "<u4",
    "F16": "<f2",
    "I16": "<i2",
    "U16": "<u2",
    "I8": "|i1",
    "U8": "|u1",
    "BOOL": "|b1",
}
_CODES = {np.dtype(text): code for code, text in _DTYPES.items()}
# The library lays arrays out by falling dtype, in this order, then by name.
_ORDER = ["U64", "I64", "F64", "F32", "U32", "I32", "F16", "U16", "I16", "I8", "U8", "BOOL"]
_HEADER_LIMIT = 2**23  # bytes; JSON takes many times as much once it is read


def dump(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Write arrays as one safetensors file.

    Args:
        arrays: Any shapes; dtypes bool, (u)int8-64, float16-64.

    Raises:
        FormatError: An array's dtype has no safetensors code.
    """
    plain = {name: np.asarray(array) for name, array in arrays.items()}
    codes = {name: _code(name, array.dtype) for name, array in plain.items()}
    header: dict[str, Any] = {}
    parts: list[bytes] = []
    offset = 0
    for name in sorted(plain, key=lambda name: (_ORDER.index(codes[name]), name)):
        part = plain[name].astype(_DTYPES[codes[name]], copy=False).tobytes()
        header[name] = {
            "dtype": codes[name],
            "shape": list(plain[name].shape),
            "data_offsets": [offset, offset + len(part)],
        }
        offset += len(part)
        parts.append(part)
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # the arrays start on a multiple of 8 bytes
    return b"".join([len(text).to_bytes(8, "little"), text, *parts])


def parse(data: bytes) -> dict[str, np.ndarray]:
    """Read a safetensors file; every array is a writable copy.

    Raises:
        FormatError: Not safetensors, truncated, or arrays that do not fill the file exactly.
    """
    header, body = _split(data)
    header.pop("__metadata__", None)
    spans = {name: _span(name, entry, len(body)) for name, entry in header.items()}
    _require_gapless([span[2:] for span in spans.values()], len(body))
    return {name: _array(name, body, *span) for name, span in spans.items()}


def _code(name: str, dtype: np.dtype[Any]) -> str:
    code = _CODES.get(dtype.newbyteorder("<"))
    if code is None:
        raise FormatError(f"array {name!r}: dtype {dtype} cannot be stored; expected bool, an integer or a float type")
    return code


def _split(data: bytes) -> tuple[dict[str, Any], memoryview]:
    size = int.from_bytes(data[:8], "little")
    if len(data) < 8 or size > min(_HEADER_LIMIT, len(data) - 8):
        raise FormatError(f"not a safetensors file: {len(data)} bytes, too short for its header")
    try:
        header = json.loads(data[8 : 8 + size])
    except (ValueError, RecursionError) as error:
        raise FormatError(f"not a safetensors file: its header is not JSON ({error})") from error
    if not isinstance(header, dict):
        raise FormatError(f"not a safetensors file: its header is a {type(header).__name__}, expected an object")
    return header, memoryview(data)[8 + size :]


def _span(name: str, entry: Any, size: int) -> tuple[np.dtype[Any], tuple[int, ...], int, int]:
    """Check one header entry and return its (dtype, shape, first byte, end byte)."""
    try:
        code, shape, (start, stop) = entry["dtype"], tuple(entry["shape"]), entry["data_offsets"]
    except (TypeError, KeyError, ValueError) as error:
        raise FormatError(f"array {name!r}: expected dtype, shape and data_offsets, found {entry!r}") from error
    if not isinstance(code, str) or code not in _DTYPES:
        raise FormatError(f"array {name!r}: dtype {code!r} is not known; expected one of {', '.join(_DTYPES)}")
    if not all(type(number) is int and number >= 0 for number in (*shape, start, stop)):
        raise FormatError(f"array {name!r}: shape and data_offsets must be whole numbers, found {entry!r}")
    dtype = np.dtype(_DTYPES[code])
    expected = math.prod(shape) * dtype.itemsize
    if stop > size or stop - start != expected:
        raise FormatError(
            f"array {name!r}: expected {expected} bytes within {size}, found data_offsets [{start}, {stop}]"
        )
    return dtype, shape, start, stop


def _array(
    name: str, body: memoryview, dtype: np.dtype[Any], shape: tuple[int, ...], start: int, stop: int
) -> np.ndarray:
    try:
        return np.array(np.frombuffer(body[start:stop], dtype).reshape(shape))
    except ValueError as error:  # more axes, or longer ones, than NumPy takes
        raise FormatError(f"array {name!r}: shape {shape} cannot be read ({error})") from error


def _require_gapless(spans: list[tuple[int, int]], size: int) -> None:
    end = 0
    for start, stop in sorted(spans):
        if start != end:
            raise FormatError(f"the arrays leave a gap or overlap at byte {end}")
        end = stop
    if end != size:
        raise FormatError(f"expected {end} bytes of arrays, found {size}")
