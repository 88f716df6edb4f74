"""The protocol of the TCP transport: messages, and the frames that carry them.

Each message is one frame:

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

===================================  ====================================================
message                              content of the answer
===================================  ====================================================
["hello", {session, epoch, …}]       the description of the environment
["reset", tag, seed, options, take]  [observation, info]
["step", tag, action]                [observation, reward, terminated, truncated, info]
["leave", tag]                       None
===================================  ====================================================

An answer is [number of the request, "ok", content] or [number, kind of the error, its text]. With a batch of
environments, each value has one entry for each environment.

`encode` and `decode` are pure; `FrameSocket` owns the socket.
"""

import math
import socket
import struct
import time
from contextlib import suppress
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from gymnasium import spaces
from msgspec.msgpack import Ext
from numpy.typing import NDArray

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NotInCommand, ProtocolError, RemoteError
from bam_envs.core.wording import brief
from bam_envs.remote.wire.transport import EnvSpecMessage
from bam_envs.remote.wire.values import Tree, exact, number_dtype, pack

MARK, VERSION = b"bam", 1
MAX_FRAME = 256 * 1024 * 1024
"""Largest frame [bytes]."""
_PREFIX = struct.Struct("!3sBII")
_ALIGN = 16
_ARRAY, _SCALAR = 1, 2
_MAX_HEADER, _MAX_DIMENSIONS = 2**24, 32
_KEEPALIVE = {"TCP_KEEPIDLE": 4, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3}
"""A computer that silently vanished is noticed after 10 s."""


class Hello(msgspec.Struct, frozen=True):
    """The first message of a client."""

    session: Annotated[str, msgspec.Meta(min_length=1)]
    """Identifies one client from its start to its end."""
    epoch: int
    """Number of the client's connection."""
    name: str
    """Its name, shown to other clients."""
    token: str
    """The shared secret, or ""."""
    env_id: str
    """The requested environment; "" for any."""
    end: str = "\r\n\r\n"
    """The blank line makes a server of HTTP answer at once."""


class TagMessage(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A `Tag` without a signature: sender, time and deadline of a request."""

    session: str
    epoch: int
    sequence: int
    sent: float
    deadline: float

    def __post_init__(self) -> None:
        if not 0 <= self.lifetime < math.inf:
            raise ValueError("Expected a deadline after the time of sending")

    @property
    def lifetime(self) -> float:
        """Time from its sending to its deadline [s]."""
        return self.deadline - self.sent


class Reset(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="reset"):
    """Request: begin an episode, and, with `take`, take command from the client that has it."""

    tag: TagMessage
    seed: Any
    options: Any
    take: Any


class Step(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="step"):
    """Request: perform an action."""

    tag: TagMessage
    action: Any


class Leave(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="leave"):
    """Request: release the environment."""

    tag: TagMessage


Request = Reset | Step | Leave
"""A message after the hello."""
Greeting = tuple[Literal["hello"], Hello]
"""The first message."""
_Answer = tuple[int, str, Any]


def refusal(sequence: int, error: BamEnvsError) -> Tree:
    """The answer to a request that failed."""
    text = str(error).encode(errors="replace").decode()  # halves of surrogate pairs cannot be sent
    return [sequence, "NotInCommand" if isinstance(error, NotInCommand) else "RemoteError", text]


def content_of(answer: Tree, sequence: int) -> Tree:
    """The content of the `answer` to request number `sequence`; raises the error of a `refusal`."""
    try:
        number, kind, content = msgspec.convert(answer, _Answer)
    except msgspec.ValidationError:
        number, kind, content = -1, "", None
    if number != sequence:
        raise ProtocolError(f"Expected the answer to request {sequence}, found {brief(answer)}.")
    if kind == "ok":
        return content
    raise (NotInCommand if kind == "NotInCommand" else RemoteError)(str(content))


def action_size(spec: EnvSpecMessage) -> int:
    """Approximate maximum size of the actions of all environments [bytes]."""
    try:
        return 8 * spaces.flatdim(spec.action_space) * spec.num_envs
    except (NotImplementedError, ValueError):  # sequences may be of any length
        return 2**22


def pack_action(spec: EnvSpecMessage, action: Any) -> Tree:
    """The tree of an action. Raises InvalidValue if it does not fit."""
    return _pack_each(spec, spec.action_space, spec.each(action), "action")


def pack_result(spec: EnvSpecMessage, result: tuple[Any, ...]) -> Tree:
    """(observation, …, info) as a list."""
    observation, *between, info = result
    space = spec.observation_space
    if spec.vector:
        final = [{**one, "final_obs": pack(space, one["final_obs"])} if "final_obs" in one else one for one in info]
        return [_pack_each(spec, space, observation, "observation"), *between, final]
    return [pack(space, observation, "observation"), *between, info]


def _pack_each(spec: EnvSpecMessage, space: spaces.Space[Any], values: Any, name: str) -> Tree:
    """The tree of a value, or of one for each environment; those of a Box are one array, which is faster than many."""
    if not spec.vector:
        return pack(space, values[0], name)
    trees = [pack(space, one, f"{name} of environment {i}") for i, one in enumerate(values)]
    return np.stack(trees) if isinstance(space, spaces.Box) else trees


def read_result(spec: EnvSpecMessage, tree: Tree, size: int) -> tuple[Any, ...]:
    """The result of `size` values that `pack_result` encoded. Raises ProtocolError for anything else."""
    if not isinstance(tree, list) or len(tree) != size:
        raise ProtocolError(f"Expected a result of {size} values, found {brief(tree)}.")
    for column in tree if spec.vector else ():
        if not isinstance(column, list) and not (isinstance(column, np.ndarray) and column.ndim):
            raise ProtocolError(f"Expected a list with one value for each environment, found {brief(column)}.")
        if len(column) != spec.num_envs:
            raise ProtocolError(f"Expected values of {spec.num_envs} environments, found {brief(column)}.")
    each, space = [], spec.observation_space
    try:
        for i, (observation, *ends, info) in enumerate(spec.split(tree)):
            if spec.vector and isinstance(info, dict) and "final_obs" in info:
                info = {**info, "final_obs": exact(space, info["final_obs"])}
            where = f" of environment {i}" if spec.vector else ""
            each.append((exact(space, observation, f"observation{where}"), *ends, info))
    except InvalidValue as error:
        raise ProtocolError(str(error)) from error
    result: tuple[Any, ...] = spec.joined(each)
    return result


class ForeignPeer(ProtocolError):  # noqa: N818 - named for the peer
    """The other end speaks another protocol; the text names it where it can be recognised."""


def encode(message: Tree) -> bytes:
    """The frame of a message. Raises ProtocolError if it cannot be sent, or is larger than `MAX_FRAME`."""
    arrays: list[bytes | memoryview] = []
    size = 0

    def add(value: Any) -> Ext:
        """The placeholder of `value` in the header; arrays go into the body."""
        nonlocal size
        if isinstance(value, np.generic):
            return Ext(_SCALAR, msgspec.msgpack.encode([value.dtype.str, value.tobytes()]))
        if not isinstance(value, np.ndarray):
            raise ProtocolError(f"{brief(value)} cannot be sent.")
        content = msgspec.msgpack.encode([value.dtype.str, value.shape, size])
        if value.size:
            padding = -value.nbytes % _ALIGN
            arrays.extend([value.reshape(-1).view(np.uint8).data, bytes(padding)])
            size += value.nbytes + padding
        return Ext(_ARRAY, content)

    try:
        header = msgspec.msgpack.encode(message, enc_hook=add)
    except (ValueError, OverflowError, RecursionError) as error:
        raise ProtocolError(f"A message cannot be sent: {str(error).rstrip('.')}.") from error
    if len(header) + size > MAX_FRAME:
        raise ProtocolError(f"A message of {len(header) + size} bytes is too large; {MAX_FRAME} are allowed.")
    return b"".join([_PREFIX.pack(MARK, VERSION, len(header), size), header, *arrays])


def read_prefix(prefix: bytes | bytearray) -> tuple[int, int]:
    """Sizes of header and body; raises `ForeignPeer` if the other end speaks another protocol or another version."""
    mark, version, header, body = _PREFIX.unpack(prefix)
    if mark != MARK:
        hint = "; rosbridge servers have ws:// URLs" if bytes(prefix).startswith((b"HTTP", b"<")) else ""
        raise ForeignPeer(f"not a bam-serve TCP server: it says {bytes(prefix)!r}{hint}")
    if version != VERSION:
        raise ForeignPeer(
            f"version {version} of the protocol there, {VERSION} here; install one bam-train on both sides"
        )
    return header, body


def decode(header: bytes | memoryview, body: NDArray[np.uint8], kind: Any = Any) -> Any:
    """The message of the type `kind` in a frame; its arrays are views of `body`. Raises ProtocolError if damaged."""

    def restore(code: int, data: memoryview) -> Any:
        if code == _SCALAR:
            dtype, raw = msgspec.msgpack.decode(data)
            return np.frombuffer(raw, number_dtype(dtype))[0]
        dtype, shape, start = msgspec.msgpack.decode(data)
        if len(shape) > _MAX_DIMENSIONS:
            raise ValueError(f"an array has at most {_MAX_DIMENSIONS} dimensions, not {len(shape)}")
        numbers = number_dtype(dtype)
        stop = start + math.prod(shape) * numbers.itemsize
        return body[start:stop].view(numbers).reshape(shape)

    try:
        return msgspec.msgpack.decode(header, type=kind, ext_hook=restore)
    except msgspec.ValidationError as error:
        raise ProtocolError(f"Expected {_EXPECTED.get(kind, 'a message')}: {error}.") from error
    except (msgspec.MsgspecError, ValueError, TypeError, IndexError, OverflowError, RecursionError) as error:
        raise ProtocolError(f"A message is damaged: {error}.") from error


_EXPECTED = {Greeting: "a hello", Request: "a request"}


class FrameSocket:
    """Sends and receives frames over a connected socket, which it closes. One thread for each direction."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):  # not every system has this setting
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._socket = sock

    def send(self, frame: bytes, deadline: float = math.inf) -> None:
        """Send a frame before `deadline` [s, monotonic]. Raises LinkLost if the other end is gone or does not read."""
        try:
            self._set_timeout(deadline)
            self._socket.sendall(frame)  # the timeout is for the whole frame
        except OSError as error:
            raise LinkLost(error.strerror or str(error)) from error

    def receive(
        self, deadline: float = math.inf, limit: int = MAX_FRAME, patience: float = math.inf, kind: Any = Any
    ) -> Any:
        """Receive a frame before `deadline` [s, monotonic].

        Args:
            deadline: See above.
            limit: Largest frame [bytes].
            patience: Longest time from its first byte to its last [s].
            kind: Type of its message.

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
            # The body is aligned for arrays of every dtype.
            start = -(buffer.ctypes.data + header) % _ALIGN
            view = buffer.data[start : start + header + body]
            self._fill(view, min(deadline, time.monotonic() + patience))
        except OSError as error:
            raise LinkLost(error.strerror or str(error)) from error
        return decode(view[:header], buffer[start + header : start + header + body], kind)

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
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("timed out")
        self._socket.settimeout(left if left < math.inf else None)

    def abandon(self) -> None:
        """Close the child's copy after a fork; the connection of the parent stays up."""
        self._socket.close()

    def hang_up(self) -> None:
        """End the connection; a thread that waits for a frame gets `LinkLost`. Idempotent, thread-safe."""
        with suppress(OSError):  # it was closed before, by either end
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End the connection, in the thread that uses it: its file descriptor may be reused at once."""
        self.hang_up()
        self._socket.close()
