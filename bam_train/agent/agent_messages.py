"""The messages between the tick of a live agent and its front process, over a pair of sockets."""

import contextlib
import queue
import socket
import sys
import threading
from collections.abc import Callable
from typing import Any

import msgspec

from bam_train.agent.agent_options import AgentOptions

_KIND = socket.SOCK_SEQPACKET if sys.platform == "linux" else socket.SOCK_DGRAM  # each keeps messages apart
_LARGEST = 2**20  # [bytes]
_WAITING = 200  # messages that may be left out, above which they are


class Front(msgspec.Struct, frozen=True):
    """The agent as its front process needs to know it; the first message to that, on the bare socket."""

    env: str
    env_kwargs: dict[str, Any]
    agent: AgentOptions
    command_timeout: float
    """Time after which the robot rests without a command [s]."""

    def to_bytes(self) -> bytes:
        """The message as it is sent."""
        return msgspec.msgpack.encode(self, enc_hook=str)

    @classmethod
    def from_bytes(cls, data: bytes) -> "Front":
        """The message that was sent."""
        return msgspec.msgpack.decode(data, type=cls, dec_hook=lambda kind, text: kind(text))  # a Path


class Listening(msgspec.Struct, tag=True, frozen=True):
    """From the front process: clients can connect; or `error`."""

    port: int = 0
    error: str = ""


class Ask(msgspec.Struct, tag=True, frozen=True):
    """A request of a person; it gets an `Answer` with its number."""

    number: int
    op: str
    arguments: dict[str, Any]
    who: str
    address: str


class Answer(msgspec.Struct, tag=True, frozen=True):
    """What came of an `Ask`: a result, or an error with the name of its class."""

    number: int
    result: dict[str, Any] | None = None
    error: str = ""
    kind: str = ""


class RequestProgress(msgspec.Struct, tag=True, frozen=True):
    """News of an `Ask` that is not answered yet."""

    number: int
    text: str


class Halt(msgspec.Struct, tag=True, frozen=True):
    """Halt at once; with `stop`, the agent is paused too, for the reason `why`."""

    who: str
    address: str = ""
    stop: bool = False
    why: str = ""


class Drive(msgspec.Struct, tag=True, frozen=True):
    """A command of the person who has taken over. Shape: (m,), SI units."""

    command: list[float]
    driver: str


class Report(msgspec.Struct, tag=True, frozen=True):
    """The status of the agent, for everybody who looks."""

    status: dict[str, Any]


class Sent(msgspec.Struct, tag=True, frozen=True):
    """The command that was sent last. Shape: (m,)."""

    command: list[float]


class Rows(msgspec.Struct, tag=True, frozen=True):
    """Transitions, for a learner; see `bam_train.agent.transitions`."""

    event: dict[str, Any]


Message = Listening | Ask | Answer | RequestProgress | Halt | Drive | Report | Sent | Rows
_encoder, _decoder = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(Message)


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Two connected sockets that keep messages apart."""
    pair = socket.socketpair(socket.AF_UNIX, _KIND)
    for one in pair:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * _LARGEST)
    return pair


def adopted(descriptor: int) -> socket.socket:
    """The socket that a parent process left open."""
    return socket.socket(socket.AF_UNIX, _KIND, fileno=descriptor)


class Channel:
    """One end of the pair: a thread reads, another one writes, so that nobody waits for the other process.

    Args:
        end: The socket; closed by `close`.
        take: Called in the reading thread with each message; must return at once.
        lost: Called once in the reading thread when the other end is gone.
    """

    def __init__(self, end: socket.socket, take: Callable[[Any], None], lost: Callable[[], None]) -> None:
        self._end, self._take, self._lost = end, take, lost
        self._queue: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=run, name=f"bam-agent-{run.__name__.strip('_')}", daemon=True)
            for run in (self._read, self._write)
        ]

    def start(self) -> "Channel":
        """Start both threads."""
        for thread in self._threads:
            thread.start()
        return self

    def send(self, message: Message, *, can_wait: bool = True) -> None:
        """Send a message soon; one that cannot wait is left out while the other end does not read."""
        if can_wait or self._queue.qsize() < _WAITING:
            self._queue.put(_encoder.encode(message))

    def close(self) -> None:
        """Close the socket, and end the threads. Idempotent."""
        self._queue.put(None)
        with contextlib.suppress(OSError):
            self._end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(2.0)
        self._end.close()

    def _write(self) -> None:
        while (data := self._queue.get()) is not None:
            with contextlib.suppress(OSError):  # too large, or the other end is gone: then reading ends too
                self._end.send(data)

    def _read(self) -> None:
        while True:
            try:
                data = self._end.recv(2 * _LARGEST)
            except OSError:
                break
            if not data:
                break
            self._take(_decoder.decode(data))
        self._lost()
