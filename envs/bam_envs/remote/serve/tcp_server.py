"""TcpServer: an `EnvServer` for the clients of `TcpTransport`, with a thread for each connection."""

from __future__ import annotations

import logging
import socket
import threading
import time
from contextlib import suppress
from typing import Any

from gymnasium import spaces

from bam_envs.core.errors import BamEnvsError, LinkLost, ProtocolError, RemoteError
from bam_envs.core.wording import brief
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.wire.tcp_wire import (
    AfterHello,
    FrameSocket,
    Hello,
    Leave,
    Step,
    TcpRequest,
    encode,
    pack_result,
    refusal,
)
from bam_envs.remote.wire.transport import spec_to_json
from bam_envs.remote.wire.values import Tree
from bam_envs.ros.freshness import FreshnessCheck, Tag, read_tag
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Caller
from bam_envs.rosbridge.server.admission import listening_error
from bam_envs.rosbridge.tokens import Guesses, Role, Tokens, places, who_leaves

_LOG = logging.getLogger(__name__)
_POLL = 0.2  # time between two checks whether the server is closing [s]
_HELLO_TIMEOUT, _HELLO_LIMIT = 5.0, 65536  # limits on the first message of a client [s], [bytes]
_STRANGERS = 64  # most connections without a hello yet
_ROOM = 2**20
"""Most data in a request beside an action [bytes]."""
_ANY_LENGTH = 2**22
"""Assumed size of an action of any length [bytes]."""


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
        spec = server.spec()
        try:
            action_size = 8 * spaces.flatdim(spec.action_space) * spec.num_envs
        except (NotImplementedError, ValueError):
            action_size = _ANY_LENGTH
        self.most = _ROOM + 2 * action_size
        """Largest request [bytes]."""
        self.tokens, self.guesses = Tokens.of_clients(token, operator_token), Guesses()
        self.freshness = FreshnessCheck()
        self.lock = threading.Lock()
        self.connections: dict[_Connection, None] = {}
        """The open ones, the oldest first; to be used with `lock`."""
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None

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
        with self.lock:
            connections = list(self.connections)
        for connection in connections:
            connection.hang_up()
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
        with self.lock:
            strangers = [one for one in self.connections if one.caller is None and not one.dropped]
            # Silent connections must not keep others out: a new one is always accepted.
            leaves = who_leaves(connection, strangers) if len(strangers) >= _STRANGERS else None
            connection.thread.start()
            self.connections[connection] = None
        if leaves is not None:
            leaves.hang_up()


class _Connection(FrameSocket):
    """One client, with its thread."""

    def __init__(self, owner: TcpServer, sock: socket.socket, host: str, port: int) -> None:
        super().__init__(sock)
        self.host, self.client, self.session = host, f"{host}:{port}", ""
        self.caller: Caller | None = None  # known after its admission
        self.role: Role | None = None  # of the token that it showed
        self.born, self.spoke = time.monotonic(), 0.0  # of its last request; 0 before
        self.dropped = False  # hung up; its thread has yet to end
        self._owner = owner
        self.thread = threading.Thread(target=self._run, name=f"bam-tcp {self.client}", daemon=True)

    def hang_up(self) -> None:
        """See `FrameSocket`."""
        self.dropped = True
        super().hang_up()

    def _run(self) -> None:
        owner = self._owner
        try:
            hello = self.receive(time.monotonic() + _HELLO_TIMEOUT, _HELLO_LIMIT, kind=Hello)
            tag = _tag_of(hello)
            self._admit(hello, tag)
            self._reply(encode([tag.sequence, "ok", spec_to_json(owner.server.spec())]))
            while True:
                request = self.receive(limit=owner.most, patience=owner.patience, kind=AfterHello)
                self.spoke = time.monotonic()
                self._reply(self._answer(request))
        except (ProtocolError, RemoteError) as error:
            with suppress(LinkLost):  # the client learns why the connection ends
                self.send(encode(refusal(0, error)), time.monotonic() + _POLL)
        except LinkLost:
            pass  # it went away
        finally:
            self.close()
            owner.server.leave(self.client)
            with owner.lock:
                owner.connections.pop(self, None)

    def _reply(self, frame: bytearray) -> None:
        self.send(frame, time.monotonic() + self._owner.patience)

    def _admit(self, hello: Hello, tag: Tag) -> None:
        """Admit this client, and drop its older connections; RemoteError if it is not allowed, or there is no room."""
        owner = self._owner
        tokens, role = owner.tokens, None
        if tokens.needed or (hello.token and tokens.exist):
            if not owner.guesses.may_try(self.host):
                raise RemoteError("Too many wrong tokens came from this address; try again in a second.")
            role = tokens.role([hello.token])
            if role is None:
                if hello.token:
                    owner.guesses.wrong(self.host)
                what = "wrong" if hello.token else "missing"
                raise RemoteError(f"The token is {what}; give the one that the server was started with (--token-file).")
        owner.server.require_name(hello.env_id)
        with owner.lock:
            known = [one for one in owner.connections if one.caller is not None and not one.dropped]
            leaving = [one for one in known if one.session == tag.session]
            present = [one for one in known if one not in leaving]
            self.role, room = role, places(owner.max_clients, role or "drive", tokens.roles)
            if len(present) >= room:
                leaves = who_leaves(self, present)
                if leaves is None:
                    raise RemoteError(f"All {room} places for clients are taken; try again when one has left.")
                leaving.append(leaves)
            self.client, self.session = f"{hello.name} ({self.client})", tag.session
            # An open connection is a sign of life of the system at its other end.
            self.caller = Caller(self.client, self.client, operator=role == "administer", silence=lambda: 0.0)
        for one in leaving:
            one.hang_up()
            owner.server.leave(one.client)

    def _answer(self, request: TcpRequest) -> bytearray:
        tag = _tag_of(request)
        try:
            self._owner.freshness.require(tag)
            return encode([tag.sequence, "ok", self._do(request, time.monotonic() + tag.deadline - tag.sent)])
        except BamEnvsError as error:
            return encode(refusal(tag.sequence, error))

    def _do(self, request: Any, deadline: float) -> Tree:
        server = self._owner.server
        if isinstance(request, Leave):
            return server.leave(self.client)
        if isinstance(request, Step):
            return pack_result(server.spec(), server.step(self.client, request.action, deadline=deadline))
        take, caller = request.take is True, self.caller or UNKNOWN_CALLER
        begun = server.reset(self.client, request.seed, request.options, take=take, deadline=deadline, caller=caller)
        return pack_result(server.spec(), begun)


def _tag_of(request: TcpRequest) -> Tag:
    tag = read_tag(request.tag)
    if tag is None:
        raise ProtocolError(f"Expected the tag of a request, found {brief(request.tag)}.")
    return tag
