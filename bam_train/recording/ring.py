"""A ring buffer of records in shared memory: one process writes without waiting, another one reads.

The memory begins with a head of 8 KiB (`_Head`); the rest is the ring. Each record is its size, a CRC-32 and its
bytes, padded to 8. The writer stores the bytes first and the new end afterwards; where the processor swaps the two, the
checksum shows it, and the reader looks again later.
"""

import ctypes
import mmap
import os
import struct
import tempfile
import zlib
from typing import Any

TICK, LAYOUT, EVENT, IMAGE, PIXELS = b"T", b"L", b"E", b"I", b"P"
"""Kinds of records, as their first byte."""
TIMES = struct.Struct("=qddB")
"""Following fields: wall clock [ns], monotonic clock [s], time since the command was sent [s], and the series."""
_RECORD = struct.Struct("=II")
_HEAD = 8192
_TEXT = 8000


class _Head(ctypes.Structure):
    _fields_ = (
        ("written", ctypes.c_uint64),  # bytes since the start
        ("read", ctypes.c_uint64),
        ("ready", ctypes.c_uint64),  # the reader has begun: a number that it gives
        ("closed", ctypes.c_uint64),  # the writer writes nothing more
        ("failed", ctypes.c_uint64),  # the reader reads nothing more
        ("reason", ctypes.c_char * _TEXT),
    )


def make_shared_file(size: int) -> int:
    """A file descriptor of memory for a ring of `size` bytes; it vanishes with the processes that have it."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("bam-recorder")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, _HEAD + size)
    os.set_inheritable(descriptor, True)
    return descriptor


class Ring:
    """One end of the ring in a file of `make_shared_file`."""

    def __init__(self, descriptor: int) -> None:
        now = {"flags": mmap.MAP_SHARED | mmap.MAP_POPULATE} if hasattr(mmap, "MAP_POPULATE") else {}
        self._map = mmap.mmap(descriptor, 0, **now)  # maps all pages now instead of at their first use in a tick
        self._head: Any = _Head.from_buffer(self._map)
        self._bytes = memoryview(self._map)[_HEAD:]
        self._size = len(self._bytes)

    def write(self, data: bytes) -> bool:
        """Append a record; False if the buffer is full, or the reader has failed."""
        size = (_RECORD.size + len(data) + 7) & ~7
        start = self._head.written
        if start + size - self._head.read > self._size or self._head.failed:
            return False
        self._put(start, _RECORD.pack(len(data), zlib.crc32(data)) + data)
        self._head.written = start + size
        return True

    @property
    def room(self) -> int:
        """Free space [bytes]."""
        return self._size - int(self._head.written - self._head.read)

    def read(self) -> bytes | None:
        """The next record; None if there is none yet."""
        start = self._head.read
        if start == self._head.written:
            return None
        size, checksum = _RECORD.unpack(self._get(start, _RECORD.size))
        data = self._get(start + _RECORD.size, size) if size < self._size else b""
        if zlib.crc32(data) != checksum or len(data) != size:
            return None
        self._head.read = start + ((_RECORD.size + size + 7) & ~7)
        return data

    def begin(self, number: int = 1) -> None:
        """The reader's first act, once it can take records; `number`, not 0, is what `ready` says from then on."""
        self._head.ready = number

    def close(self) -> None:
        """Called by the writer at its end."""
        self._head.closed = 1

    @property
    def ready(self) -> int:
        """The number that the reader has begun with; 0 before."""
        return int(self._head.ready)

    @property
    def closed(self) -> bool:
        """Whether the writer has closed it."""
        return bool(self._head.closed)

    def fail(self, reason: str) -> None:
        """Called by the reader if it cannot continue, with the cause."""
        self._head.reason = reason.encode(errors="replace")[: _TEXT - 1]
        self._head.failed = 1

    @property
    def failure(self) -> str:
        """Cause of a failure of the reader; "" for none."""
        return self._head.reason.decode(errors="replace") if self._head.failed else ""

    def _put(self, position: int, data: bytes) -> None:
        start = position % self._size
        first = min(len(data), self._size - start)
        self._bytes[start : start + first] = data[:first]
        if first < len(data):
            self._bytes[: len(data) - first] = data[first:]

    def _get(self, position: int, size: int) -> bytes:
        start = position % self._size
        first = min(size, self._size - start)
        return bytes(self._bytes[start : start + first]) + bytes(self._bytes[: size - first])
