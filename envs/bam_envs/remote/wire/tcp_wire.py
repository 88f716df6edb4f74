"""The protocol of the TCP transport: messages, and the frames that carry them.

Each message is one frame: the mark ``bam``, the version of this protocol (1 byte), the size of the rest (4 bytes,
big-endian), and the message as MessagePack. An array in it is an extension of code 1, a scalar of NumPy one of code 2;
its content is the MessagePack of [dtype, shape, bytes].

=========================================  ====================================================
message                                    content of the answer
=========================================  ====================================================
["hello", tag, name, token, env_id, end]   the description of the environment
["reset", tag, seed, options, take]        [observation, info]
["step", tag, action]                      [observation, reward, terminated, truncated, info]
["leave", tag]                             None
=========================================  ====================================================

`tag` is a `Tag` as text. An answer is [number of the request, "ok", content] or [number, kind of the error, its text];
number 0 says why the connection ends. With a batch of environments, each value has one entry for each environment.

`encode` and `decode` are pure; `FrameSocket` owns the socket.
"""

import math
import socket
import struct
import time
from contextlib import suppress
from functools import cache
from typing import Any

import msgspec
import numpy as np
from msgspec.msgpack import Ext

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NotInCommand, ProtocolError, RemoteError
from bam_envs.core.wording import brief
from bam_envs.remote.wire.transport import EnvSpecMessage
from bam_envs.remote.wire.values import Tree, number_dtype, pack

MAX_FRAME = 256 * 1024 * 1024
"""Largest message [bytes]."""
_PREFIX = struct.Struct("!3sBI")
_MARK, _VERSION = b"bam", 2
_ARRAY, _SCALAR = 1, 2
_KEEPALIVE = {"TCP_KEEPIDLE": 4, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3}
"""A computer that silently vanished is noticed after 10 s."""


class TcpRequest(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag=str.lower):
    """A message of a client."""

    tag: str
    """The text of its `Tag`."""


class Hello(TcpRequest, frozen=True):
    """The first message of a connection."""

    name: str
    """The client's name, shown to other clients."""
    token: str
    """The shared secret, or ""."""
    env_id: str
    """The requested environment; "" for any."""
    end: str = "\r\n\r\n"
    """The blank line makes a server of HTTP answer at once."""


class Reset(TcpRequest, frozen=True):
    """Begin an episode, and, with `take`, take command from the client that has it."""

    seed: Any
    options: Any
    take: Any


class Step(TcpRequest, frozen=True):
    """Perform an action."""

    action: Any


class Leave(TcpRequest, frozen=True):
    """Release the environment."""


AfterHello = Reset | Step | Leave
"""The messages after the first."""
_EXPECTED = {Hello: "a hello", AfterHello: "a request"}


def refusal(sequence: int, error: BamEnvsError) -> Tree:
    """The answer to a request that failed."""
    text = str(error).encode(errors="replace").decode()  # halves of surrogate pairs cannot be sent
    return [sequence, "NotInCommand" if isinstance(error, NotInCommand) else "RemoteError", text]


def content_of(answer: Tree, sequence: int) -> Tree:
    """The content of the `answer` to request number `sequence`; raises the error of a `refusal`."""
    try:
        number, kind, content = msgspec.convert(answer, tuple[int, str, Any])
    except msgspec.ValidationError:
        number, kind, content = -1, "", None
    if number != sequence and (number or kind == "ok"):
        raise ProtocolError(f"Expected the answer to request {sequence}, found {brief(answer)}.")
    if kind == "ok":
        return content
    raise (NotInCommand if kind == "NotInCommand" else RemoteError)(str(content))


def pack_action(spec: EnvSpecMessage, action: Any) -> Tree:
    """The tree of an action. Raises InvalidValue if it does not fit."""
    if not spec.vector:
        return pack(spec.action_space, action, "action")
    each = enumerate(spec.each(action))
    return _one_array([pack(spec.action_space, one, f"action of environment {i}") for i, one in each])


def pack_result(spec: EnvSpecMessage, result: tuple[Any, ...]) -> Tree:
    """The tree of a result of `EnvServer`."""
    observation, *rest = result
    return [_one_array(observation) if spec.vector else observation, *rest]


def read_result(spec: EnvSpecMessage, tree: Tree, size: int) -> tuple[Any, ...]:
    """The result of `size` values that `pack_result` encoded. Raises ProtocolError for anything else."""
    if not isinstance(tree, list) or len(tree) != size:
        raise ProtocolError(f"Expected a result of {size} values, found {brief(tree)}.")
    for column in tree if spec.vector else ():
        many = isinstance(column, list) or (isinstance(column, np.ndarray) and column.ndim > 0)
        if not many or len(column) != spec.num_envs:
            raise ProtocolError(f"Expected one value for each of {spec.num_envs} environments, found {brief(column)}.")
    try:
        result: tuple[Any, ...] = spec.exact(tree)
        return result
    except InvalidValue as error:
        raise ProtocolError(str(error)) from error


def _one_array(trees: list[Tree]) -> Tree:
    """Arrays of one shape as one array, which is faster than many; other trees as they are."""
    return np.stack(trees) if isinstance(trees[0], np.ndarray) else trees


def encode(message: Any) -> bytearray:
    """The frame of a message. Raises ProtocolError if it cannot be sent, or is larger than `MAX_FRAME`."""
    frame = bytearray(_PREFIX.size)
    try:
        _ENCODER.encode_into(message, frame, _PREFIX.size)
    except (ValueError, OverflowError, RecursionError) as error:
        raise ProtocolError(f"A message cannot be sent: {str(error).rstrip('.')}.") from error
    size = len(frame) - _PREFIX.size
    if size > MAX_FRAME:
        raise ProtocolError(f"A message of {size} bytes is too large; {MAX_FRAME} are allowed.")
    _PREFIX.pack_into(frame, 0, _MARK, _VERSION, size)
    return frame


def _extension(value: Any) -> Ext:
    if not isinstance(value, (np.ndarray, np.generic)):
        raise ProtocolError(f"{brief(value)} cannot be sent.")
    content = msgspec.msgpack.encode((value.dtype.str, value.shape, np.ascontiguousarray(value).data))
    return Ext(_ARRAY if isinstance(value, np.ndarray) else _SCALAR, content)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_extension)
_CONTENT = msgspec.msgpack.Decoder(tuple[str, list[int], memoryview])


def size_of(prefix: bytes | bytearray, limit: int = MAX_FRAME) -> int:
    """Size of the message behind a prefix. ProtocolError for another protocol, or a size above `limit` [bytes]."""
    mark, version, size = _PREFIX.unpack(prefix)
    if mark != _MARK:
        raise ProtocolError(f"it says {bytes(prefix)!r}")
    if version != _VERSION:
        there = f"version {version} of the protocol there, {_VERSION} here"
        raise ProtocolError(f"{there}; install one bam-train on both sides")
    if size > limit:
        raise ProtocolError(f"A message of {size} bytes is too large; {limit} are allowed.")
    return int(size)


def decode(data: bytes | bytearray, kind: Any = Any) -> Any:
    """The message of the type `kind` in a frame without its prefix. Raises ProtocolError if it is damaged.

    Its arrays may be views of `data`, and are to be written to if that is.
    """
    try:
        return _decoder(kind).decode(data)
    except msgspec.ValidationError as error:
        raise ProtocolError(f"Expected {_EXPECTED.get(kind, 'a message')}: {error}.") from error
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
        raise ProtocolError(f"A message is damaged: {error}.") from error


@cache
def _decoder(kind: Any) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(kind, ext_hook=_restored)


def _restored(code: int, data: memoryview) -> Any:
    dtype, shape, content = _CONTENT.decode(data)
    array = np.frombuffer(content, number_dtype(dtype)).reshape(shape)
    return array[()] if code == _SCALAR else array if array.flags.aligned else array.copy()


class FrameSocket:
    """Sends and receives frames over a connected socket, which it closes. One thread for each direction."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):  # not every system has this setting
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._socket = sock

    def send(self, frame: bytes | bytearray, deadline: float = math.inf) -> None:
        """Send a frame before `deadline` [s, monotonic]. Raises LinkLost if the other end is gone or does not read."""
        try:
            self._set_timeout(deadline)
            self._socket.sendall(frame)  # the timeout is for the whole frame
        except OSError as error:
            raise LinkLost(error.strerror or str(error)) from error

    def receive(
        self, deadline: float = math.inf, limit: int = MAX_FRAME, patience: float = math.inf, kind: Any = Any
    ) -> Any:
        """Receive a message before `deadline` [s, monotonic].

        Args:
            deadline: See above.
            limit: Its largest size [bytes].
            patience: Longest time from the first byte of prefix or message to its last [s].
            kind: Its type.

        Raises:
            LinkLost: The other end is gone, or silent.
            ProtocolError: It sent something else, or too much.
        """
        try:
            size = size_of(self._read(_PREFIX.size, deadline, patience), limit)
            data = self._read(size, min(deadline, time.monotonic() + patience))
        except OSError as error:
            raise LinkLost(error.strerror or str(error)) from error
        return decode(data, kind)

    def _read(self, size: int, deadline: float, patience: float = math.inf) -> bytearray:
        data, filled = bytearray(size), 0
        while filled < size:
            self._set_timeout(deadline)
            count = self._socket.recv_into(memoryview(data)[filled:])
            if not count:
                raise ConnectionResetError("the other end closed the connection")
            if not filled:
                deadline = min(deadline, time.monotonic() + patience)
            filled += count
        return data

    def _set_timeout(self, deadline: float) -> None:
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("timed out")
        self._socket.settimeout(left if left < math.inf else None)

    def hang_up(self) -> None:
        """End the connection; a thread that waits for a frame gets `LinkLost`. Idempotent, thread-safe."""
        with suppress(OSError):  # it was closed before, by either end
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self, *, ends: bool = True) -> None:
        """Close the socket, in the thread that uses it, because its number may be reused at once.

        With `ends` False the connection stays up: a child closes the copy of its parent's socket so.
        """
        if ends:
            self.hang_up()
        self._socket.close()
