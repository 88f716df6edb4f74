"""Frames of the TCP transport: a MessagePack header and the arrays behind it, as they lie in memory.

============  =====  ========================================================================
part          bytes  what
============  =====  ========================================================================
mark          3      ``bam``
version       1      of this table
header size   4      big-endian
body size     4      big-endian
header        any    MessagePack of a tree; an array in it is its dtype, shape and place in the body
body          any    the arrays, each at a multiple of 16
============  =====  ========================================================================

`encode` and `read_prefix` and `decode` are pure; `FrameSocket` owns the socket.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import LinkLost, ProtocolError
from bam_envs.remote.transports.trees import plain_dtype
from bam_envs.remote.transports.values import Tree, shown

MARK, VERSION = b"bam", 1
MAX_FRAME = 256 * 1024 * 1024
"""Largest frame [bytes]."""
_PREFIX = struct.Struct("!3sBII")
_ALIGN = 16
_ARRAY, _SCALAR = 1, 2
_MAX_HEADER, _MAX_DIMENSIONS = 2**24, 32
_KEEPALIVE = {"TCP_KEEPIDLE": 4, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3}
"""A computer that vanished without a word is noticed after 10 s."""
_MOST_PARTS = 512  # below IOV_MAX of every system
_SMALL = 32768  # bytes that are copied together quicker than listed


class ForeignPeer(ProtocolError):  # noqa: N818 - reads as what was found
    """The other end speaks something else; the text says what, as far as one can tell."""


def encode(tree: Tree) -> list[bytes | memoryview]:
    """The parts of a frame, to be sent one after the other; arrays are not copied.

    Raises:
        ProtocolError: The frame would be larger than `MAX_FRAME`, or something in it cannot be sent.
    """
    body = _Body()
    try:
        header = msgpack.packb(tree, default=body.add, unicode_errors="surrogatepass")
    except ValueError as error:  # too deep
        raise ProtocolError(f"A message cannot be sent: {str(error).rstrip('.')}.") from error
    if len(header) + body.size > MAX_FRAME:
        raise ProtocolError(f"A message of {len(header) + body.size} bytes is too large; {MAX_FRAME} are allowed.")
    parts = [_PREFIX.pack(MARK, VERSION, len(header), body.size), header, *body.parts]
    return [b"".join(parts)] if body.size <= _SMALL else parts


class _Body:
    """Collects the arrays of a tree."""

    def __init__(self) -> None:
        self.parts: list[bytes | memoryview] = []
        self.size = 0

    def add(self, value: Any) -> msgpack.ExtType:
        """What stands for `value` in the header."""
        if isinstance(value, np.generic):
            return msgpack.ExtType(_SCALAR, msgpack.packb([value.dtype.str, value.tobytes()]))
        if not isinstance(value, np.ndarray):
            raise ProtocolError(f"{shown(value)} cannot be sent.")  # also an int beyond 64 bits
        content = msgpack.packb([value.dtype.str, value.shape, self.size])
        if value.size:
            self.parts.append(value.reshape(-1).view(np.uint8).data)
            padding = -value.nbytes % _ALIGN
            if padding:
                self.parts.append(bytes(padding))
            self.size += value.nbytes + padding
        return msgpack.ExtType(_ARRAY, content)


def read_prefix(prefix: bytes | bytearray) -> tuple[int, int]:
    """Sizes of header and body.

    Raises:
        ForeignPeer: The other end speaks another protocol, or another version of this.
    """
    mark, version, header, body = _PREFIX.unpack(prefix)
    if mark != MARK:
        hint = "; rosbridge servers have ws:// URLs" if bytes(prefix).startswith((b"HTTP", b"<")) else ""
        raise ForeignPeer(f"not a bam-serve TCP server: it says {bytes(prefix)!r}{hint}")
    if version != VERSION:
        raise ForeignPeer(
            f"version {version} of the protocol there, {VERSION} here; install one bam-train on both sides"
        )
    return header, body


def decode(header: bytes | memoryview, body: NDArray[np.uint8]) -> Tree:
    """The tree of a frame; its arrays lie in `body`.

    Raises:
        ProtocolError: It is damaged.
    """

    def restore(code: int, data: bytes) -> Any:
        if code == _SCALAR:
            dtype, raw = msgpack.unpackb(data)
            return np.frombuffer(raw, plain_dtype(dtype))[0]
        dtype, shape, start = msgpack.unpackb(data)
        if len(shape) > _MAX_DIMENSIONS:
            raise ValueError(f"an array has at most {_MAX_DIMENSIONS} dimensions, not {len(shape)}")
        kind = plain_dtype(dtype)
        stop = start + math.prod(shape) * kind.itemsize
        return body[start:stop].view(kind).reshape(shape)

    try:
        return msgpack.unpackb(header, ext_hook=restore, unicode_errors="surrogatepass")
    except (ValueError, TypeError, IndexError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise ProtocolError(f"A message is damaged: {error}.") from error


class FrameSocket:
    """Sends and receives frames over a connected socket, each within a deadline. One thread at a time for each way.

    Args:
        sock: It is closed with this.
    """

    def __init__(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):  # not every system lets one say how soon
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._socket = sock

    def send(self, parts: list[bytes | memoryview], deadline: float = math.inf) -> None:
        """Send a frame of `encode` before `deadline` [s, monotonic].

        Raises:
            LinkLost: The other end is gone, or takes nothing.
        """
        try:
            while parts:
                self._set_timeout(deadline)
                sent = self._socket.sendmsg(parts[:_MOST_PARTS])
                parts = _rest(parts, sent)
        except OSError as error:
            raise LinkLost(_lost(error)) from error

    def receive(self, deadline: float = math.inf, limit: int = MAX_FRAME, patience: float = math.inf) -> Tree:
        """Receive a frame before `deadline` [s, monotonic].

        Args:
            deadline: See above.
            limit: Largest frame [bytes].
            patience: Longest time from its first byte to its last [s].

        Raises:
            LinkLost: The other end is gone, or silent.
            ProtocolError: It sent something else, or too much.
        """
        prefix = bytearray(_PREFIX.size)
        try:
            self._fill(memoryview(prefix), deadline, patience)
            header, body = read_prefix(prefix)
            if header + body > limit:
                raise ProtocolError(f"A message of {header + body} bytes is too large; {limit} are allowed.")
            if header > _MAX_HEADER:
                raise ProtocolError(f"A header of {header} bytes is too large; {_MAX_HEADER} are allowed.")
            buffer = np.empty(header + body + _ALIGN, np.uint8)
            # The body begins where arrays of all kinds may begin.
            start = -(buffer.ctypes.data + header) % _ALIGN
            view = buffer.data[start : start + header + body]
            self._fill(view, min(deadline, time.monotonic() + patience))
        except OSError as error:
            raise LinkLost(_lost(error)) from error
        return decode(view[:header], buffer[start + header : start + header + body])

    def _fill(self, view: memoryview, deadline: float, patience: float = math.inf) -> None:
        filled = 0
        while filled < len(view):
            self._set_timeout(deadline)
            count = self._socket.recv_into(view[filled:])
            if not count:
                raise ConnectionResetError("the other end closed the connection")
            if not filled:
                deadline = min(deadline, time.monotonic() + patience)
            filled += count

    def _set_timeout(self, deadline: float) -> None:
        if deadline == math.inf:
            self._socket.settimeout(None)
            return
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("timed out")
        self._socket.settimeout(left)

    def abandon(self) -> None:
        """Forget the socket after a fork: it is the parent's, whose link stays up."""
        self._socket.close()

    def close(self) -> None:
        """Close it; a thread that waits for a frame gets `LinkLost`. As often as one likes, from any thread."""
        with suppress(OSError):  # it was closed before, by either end
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _rest(parts: list[bytes | memoryview], sent: int) -> list[bytes | memoryview]:
    """What is left of `parts` after `sent` bytes."""
    for i, part in enumerate(parts):
        if sent < len(part):
            return [memoryview(part)[sent:], *parts[i + 1 :]]
        sent -= len(part)
    return []


def _lost(error: OSError) -> str:
    return error.strerror or str(error)
