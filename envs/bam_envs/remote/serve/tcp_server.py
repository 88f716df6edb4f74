"""TcpServer: an `EnvServer` for the clients of `TcpTransport`, with a thread for each connection."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections import Counter
from contextlib import suppress

from bam_envs.core.errors import BamEnvsError, LinkLost, ProtocolError, RemoteError
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.wire.tcp_wire import (
    FrameSocket,
    Greeting,
    Hello,
    Leave,
    Request,
    Step,
    action_size,
    encode,
    pack_result,
    refusal,
)
from bam_envs.remote.wire.transport import spec_to_json
from bam_envs.remote.wire.values import Tree
from bam_envs.ros.freshness import FreshnessCheck, Tag
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Caller
from bam_envs.rosbridge.places import places, who_leaves
from bam_envs.rosbridge.server.admission import listening_error
from bam_envs.rosbridge.tokens import Guesses, Role, Tokens

_LOG = logging.getLogger(__name__)
_POLL = 0.2  # time between two checks whether the server is closing [s]
_HELLO_TIMEOUT, _HELLO_LIMIT = 5.0, 65536  # limits on the first message of a client [s], [bytes]
_STRANGERS, _STRANGERS_OF_ONE = 64, 16
"""Most connections without a hello yet: in all, and of one address. The oldest is dropped for a new one."""
_ROOM = 2**20
"""Most data in a request beside an action [bytes]."""


class TcpServer:
    """Listens on one port. No misbehaving client affects the others or the environment.

    Args:
        server: The served environment.
        host: The interface; 127.0.0.1 is this computer only.
        port: 0 takes a free one.
        token: A secret that clients must show. Nothing is encrypted, so it can be read on the network.
        operator_token: A client that shows this one instead may take command from others.
        max_clients: Most clients that may be connected.
        patience: Longest time for the rest of a message, and for a client to take its answer [s].
    """

    def __init__(
        self,
        server: EnvServer,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        token: str | None = None,
        operator_token: str | None = None,
        max_clients: int = 64,
        patience: float = 10.0,
    ) -> None:
        self.server, self.host, self.port = server, host, port
        self.max_clients, self.patience = max_clients, patience
        self.most = _ROOM + 2 * action_size(server.spec())
        """Largest request [bytes]."""
        self._tokens, self._guesses = Tokens.of_clients(token, operator_token), Guesses()
        self.freshness = FreshnessCheck()
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._connections: dict[_Connection, None] = {}  # the oldest first

    @property
    def url(self) -> str:
        """Address for clients."""
        return f"tcp://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"

    def start(self) -> None:
        """Listen. Raises InvalidValue: the port is in use, or the address not of this computer."""
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            self._listener = socket.create_server((self.host, self.port), family=family, backlog=128)
        except OSError as error:
            raise listening_error(self.host, self.port, error) from error
        self.port = self._listener.getsockname()[1]
        self._listener.settimeout(_POLL)
        self._thread = threading.Thread(target=self._accept, args=(self._listener,), name="bam-tcp", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Drop every client and stop listening. Idempotent."""
        listener, self._listener = self._listener, None
        if listener is None or self._thread is None:
            return
        with suppress(OSError):  # wakes the thread on some systems; on others it polls
            listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        listener.close()
        with self._lock:
            connections = list(self._connections)
        for connection in connections:
            connection.drop()
        for connection in connections:
            connection.thread.join()

    def __enter__(self) -> TcpServer:
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
                self._begin(_Connection(self, sock, address[0], address[1]))
            except (OSError, RuntimeError) as error:  # it went away at once, or there is no room for another thread
                _LOG.warning("A client could not be served: %s", error)
                sock.close()

    def _begin(self, connection: _Connection) -> None:
        with self._lock:
            self._connections[connection] = None
            strangers = [one for one in self._connections if one.caller is None and not one.dropped]
            neighbours = [one for one in strangers if one.host == connection.host]
        # Silent connections must not keep others out: a new one is always accepted.
        if len(neighbours) > _STRANGERS_OF_ONE:
            neighbours[0].drop()
        elif len(strangers) > _STRANGERS:
            host, _ = Counter(one.host for one in strangers).most_common(1)[0]
            next(one for one in strangers if one.host == host).drop()
        try:
            connection.thread.start()
        except RuntimeError:
            with self._lock:
                del self._connections[connection]
            raise

    def admit(self, hello: Hello, connection: _Connection) -> None:
        """Admit a client, and drop its older connections; RemoteError if it is not allowed, or there is no room."""
        role = None
        if self._tokens.needed or (hello.token and self._tokens.exist):
            if not self._guesses.may_try(connection.host):
                raise RemoteError("Too many wrong tokens came from this address; try again in a second.")
            role = self._tokens.role([hello.token])
            if role is None:
                if hello.token:
                    self._guesses.wrong(connection.host)
                what = "wrong" if hello.token else "missing"
                raise RemoteError(f"The token is {what}; give the one that the server was started with (--token-file).")
        self.server.require_name(hello.env_id)
        with self._lock:
            older = [one for one in self._connections if one is not connection and one.session == hello.session]
            present = [one for one in self._connections if one.caller is not None and one not in older]
            connection.role, room = role, places(self.max_clients, role or "drive", self._tokens.roles)
            if len(present) >= room:
                leaves = who_leaves(connection, present)
                if leaves is None:
                    raise RemoteError(f"All {room} places for clients are taken; try again when one has left.")
                older.append(leaves)
            # An open connection is a sign of life of the system at its other end.
            name, operator = connection.client, role == "administer"
            connection.caller = Caller(name, name, operator=operator, silence=lambda: 0.0)
        for one in older:
            one.drop()
            self.server.leave(one.client)

    def forget(self, connection: _Connection) -> None:
        """Remove a connection that has ended."""
        self.server.leave(connection.client)
        with self._lock:
            self._connections.pop(connection, None)


class _Connection:
    """One client, with its thread."""

    def __init__(self, owner: TcpServer, sock: socket.socket, host: str, port: int) -> None:
        self.host, self.client, self.session = host, f"{host}:{port}", ""
        self.caller: Caller | None = None  # known after its admission
        self.role: Role | None = None  # of the token that it showed
        self.born, self.spoke = time.monotonic(), 0.0  # of its last request; 0 before
        self.dropped = False  # hung up; its thread has yet to end
        self._owner, self._frames = owner, FrameSocket(sock)
        self.thread = threading.Thread(target=self._run, name=f"bam-tcp {self.client}", daemon=True)

    def drop(self) -> None:
        self.dropped = True
        self._frames.hang_up()

    def _run(self) -> None:
        try:
            _, hello = self._frames.receive(time.monotonic() + _HELLO_TIMEOUT, _HELLO_LIMIT, kind=Greeting)
            self.client = f"{hello.name} ({self.client})"
            self._owner.admit(hello, self)
            self.session = hello.session
            self._send(encode([0, "ok", spec_to_json(self._owner.server.spec())]))
            while True:
                request = self._frames.receive(limit=self._owner.most, patience=self._owner.patience, kind=Request)
                self.spoke = time.monotonic()
                self._send(self._answer(request))
        except (ProtocolError, RemoteError) as error:
            with suppress(LinkLost):  # the client learns why the connection ends
                self._frames.send(encode(refusal(0, RemoteError(str(error)))), time.monotonic() + _POLL)
        except LinkLost:
            pass  # it went away
        finally:
            self._frames.close()
            self._owner.forget(self)

    def _send(self, frame: bytes) -> None:
        self._frames.send(frame, time.monotonic() + self._owner.patience)

    def _answer(self, request: Request) -> bytes:
        """The frame that answers `request`."""
        tag = request.tag
        try:
            self._owner.freshness.require(Tag(tag.session, tag.epoch, tag.sequence, tag.sent, tag.deadline))
            return encode([tag.sequence, "ok", self._do(request)])
        except BamEnvsError as error:
            return encode(refusal(tag.sequence, error))

    def _do(self, request: Request) -> Tree:
        server, deadline = self._owner.server, time.monotonic() + request.tag.lifetime
        if isinstance(request, Leave):
            return server.leave(self.client)
        if isinstance(request, Step):
            return pack_result(server.spec(), server.step(self.client, request.action, deadline=deadline))
        options, take, caller = request.options, request.take is True, self.caller or UNKNOWN_CALLER
        begun = server.reset(self.client, request.seed, options, take=take, deadline=deadline, caller=caller)
        return pack_result(server.spec(), begun)
