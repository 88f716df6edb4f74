"""TcpServer: an `EnvServer` for the clients of `TcpTransport`, with a thread for each connection."""

from __future__ import annotations

import hmac
import logging
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from bam_envs.bridge.freshness import FreshnessCheck, Tag
from bam_envs.errors import BamEnvsError, InvalidValue, LinkLost, ProtocolError, RemoteError
from bam_envs.serve.env_server import EnvServer
from bam_envs.transports.frames import FrameSocket, encode
from bam_envs.transports.tcp_messages import Hello, Request, SpecCodec, read_hello, read_request, refusal
from bam_envs.transports.trees import spec_to_json
from bam_envs.transports.values import Tree

if TYPE_CHECKING:
    from typing_extensions import Self

_LOG = logging.getLogger(__name__)
_POLL = 0.2  # seconds between two looks at whether the server is closing
_HELLO_TIMEOUT, _HELLO_LIMIT = 5.0, 65536  # [s], [bytes]: all that a stranger gets


class TcpServer:
    """Listens on one port. Whatever a client sends or leaves undone, the others and the environment do not notice.

    Args:
        server: What is served.
        host: The interface; 127.0.0.1 is this computer alone.
        port: 0 for any that is free.
        token: A secret that clients must know. Nothing is encrypted: it keeps strangers out, not those who listen in.
        max_clients: How many may be connected.
        patience: Longest time for the rest of a message, and for a client to take its answer [s].
    """

    def __init__(
        self,
        server: EnvServer,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        token: str | None = None,
        max_clients: int = 64,
        patience: float = 10.0,
    ) -> None:
        self.server, self.host, self.port = server, host, port
        self.token, self.max_clients, self.patience = token, max_clients, patience
        self.codec = SpecCodec(server.spec())
        self.freshness = FreshnessCheck()
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._connections: set[_Connection] = set()

    @property
    def url(self) -> str:
        """What clients connect to."""
        return f"tcp://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"

    def start(self) -> None:
        """Listen.

        Raises:
            InvalidValue: The port is in use, or the address not of this computer.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            self._listener = socket.create_server((self.host, self.port), family=family, backlog=128)
        except OSError as error:
            raise InvalidValue(
                f"Cannot listen on {self.host} port {self.port}: {error.strerror or error}. "
                f"Give another port; 0 takes any that is free."
            ) from error
        self.port = self._listener.getsockname()[1]
        self._listener.settimeout(_POLL)
        self._thread = threading.Thread(target=self._accept, args=(self._listener,), name="bam-tcp", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Drop every client and stop listening. As often as one likes."""
        listener, self._listener = self._listener, None
        if listener is None or self._thread is None:
            return
        with suppress(OSError):  # wakes the thread on some systems; on others it looks up by itself
            listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        listener.close()
        with self._lock:
            connections = list(self._connections)
        for connection in connections:
            connection.drop()
        for connection in connections:
            connection.join()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _accept(self, listener: socket.socket) -> None:
        while self._listener is listener:
            try:
                sock, address = listener.accept()
            except TimeoutError:
                continue
            except OSError as error:  # such as no file descriptors left; clients that leave give some back
                if self._listener is listener:
                    _LOG.warning("A client could not be accepted: %s", error)
                    time.sleep(_POLL)
                continue
            try:
                self._begin(_Connection(self, sock, f"{address[0]}:{address[1]}"))
            except (OSError, RuntimeError) as error:  # it went away at once, or there is no room for another thread
                _LOG.warning("A client could not be served: %s", error)
                sock.close()

    def _begin(self, connection: _Connection) -> None:
        with self._lock:
            room = len(self._connections) < self.max_clients
            if room:
                self._connections.add(connection)
        if room:
            self._start(connection)
        else:
            connection.refuse(f"All {self.max_clients} places for clients are taken; try again when one has left.")

    def _start(self, connection: _Connection) -> None:
        try:
            connection.start()
        except RuntimeError:
            with self._lock:
                self._connections.discard(connection)
            raise

    def admit(self, hello: Hello, connection: _Connection) -> None:
        """Let a client in; its own older connections are dropped.

        Raises:
            RemoteError: It does not know the token, or wants another environment.
        """
        shown = hello.token.encode(errors="surrogatepass")  # a stranger may send anything
        if self.token is not None and not hmac.compare_digest(shown, self.token.encode()):
            what = "wrong" if hello.token else "missing"
            raise RemoteError(f"The token is {what}; give the one that the server was started with (--token-file).")
        self.server.require_name(hello.env_id)
        with self._lock:
            older = [one for one in self._connections if one is not connection and one.session == hello.session]
        for one in older:
            one.drop()
            self.server.leave(one.client)

    def forget(self, connection: _Connection) -> None:
        """A connection has ended."""
        self.server.leave(connection.client)
        with self._lock:
            self._connections.discard(connection)


class _Connection:
    """One client, in a thread of its own."""

    def __init__(self, owner: TcpServer, sock: socket.socket, address: str) -> None:
        self.client, self.session = address, ""
        self._owner, self._frames = owner, FrameSocket(sock)
        self._answered: tuple[Tag, list[bytes | memoryview]] | None = None
        self._thread = threading.Thread(target=self._run, name=f"bam-tcp {address}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def drop(self) -> None:
        self._frames.close()

    def join(self) -> None:
        self._thread.join()

    def refuse(self, text: str) -> None:
        """Say why, and hang up."""
        with suppress(LinkLost):
            self._frames.send(encode(refusal(0, RemoteError(text))), time.monotonic() + _POLL)
        self.drop()

    def _run(self) -> None:
        try:
            self._greet()
            while True:
                tree = self._frames.receive(patience=self._owner.patience)
                self._send(self._answer(read_request(tree)))
        except (ProtocolError, RemoteError) as error:
            self.refuse(str(error))
        except LinkLost:
            pass  # it went away
        finally:
            self.drop()
            self._owner.forget(self)

    def _greet(self) -> None:
        hello = read_hello(self._frames.receive(time.monotonic() + _HELLO_TIMEOUT, _HELLO_LIMIT))
        self._owner.admit(hello, self)
        self.session, self.client = hello.session, f"{hello.name} ({self.client})"
        self._send(encode([0, "ok", spec_to_json(self._owner.server.spec())]))

    def _send(self, parts: list[bytes | memoryview]) -> None:
        self._frames.send(parts, time.monotonic() + self._owner.patience)

    def _answer(self, request: Request) -> list[bytes | memoryview]:
        """The frame that answers `request`; one that came before gets the answer of before, and nothing moves."""
        if self._answered is not None and _same(self._answered[0], request.tag):
            return self._answered[1]
        try:
            self._owner.freshness.require(request.tag)
            parts = encode([request.tag.sequence, "ok", self._do(request)])
        except BamEnvsError as error:
            parts = encode(refusal(request.tag.sequence, error))
        self._answered = (request.tag, parts)
        return parts

    def _do(self, request: Request) -> Tree:
        deadline = time.monotonic() + request.tag.deadline - request.tag.sent
        return _ACTIONS[request.kind](self, request, deadline)

    def _reset(self, request: Request, deadline: float) -> Tree:
        seed, options, take = request.values
        server, codec = self._owner.server, self._owner.codec
        return codec.pack_result(server.reset(self.client, seed, options, take=take is True, deadline=deadline))

    def _step(self, request: Request, deadline: float) -> Tree:
        server, codec = self._owner.server, self._owner.codec
        action = codec.unpack_action(request.values[0])
        return codec.pack_result(server.step(self.client, action, deadline=deadline))

    def _leave(self, request: Request, deadline: float) -> Tree:
        self._owner.server.leave(self.client)


_ACTIONS: dict[str, Callable[[_Connection, Request, float], Tree]] = {
    "reset": _Connection._reset,
    "step": _Connection._step,
    "leave": _Connection._leave,
}


def _same(one: Tag, other: Tag) -> bool:
    return (one.session, one.epoch, one.sequence) == (other.session, other.epoch, other.sequence)
