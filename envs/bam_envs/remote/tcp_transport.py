"""TcpTransport: an environment of ``bam-serve --tcp PORT``, for a network where rosbridge is too slow."""

import os
import socket
import threading
import time
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer, ProtocolError, RemoteError
from bam_envs.remote.wire.tcp_wire import (
    ForeignPeer,
    FrameSocket,
    Hello,
    Leave,
    Request,
    Reset,
    Step,
    TagMessage,
    content_of,
    encode,
    pack_action,
    read_result,
)
from bam_envs.remote.wire.transport import EnvSpecMessage, Info, Seed, plain_seed, spec_from_json, spec_to_json
from bam_envs.remote.wire.values import Tree, plain_info
from bam_envs.ros.freshness import Tagger
from bam_envs.rosbridge.endpoint import Endpoint

_LEAVE_TIMEOUT = 1.0  # [s]; a server that is gone must not delay `close`


class TcpTransport:
    """Carries an environment over TCP. One request at a time; `close` may be called from any thread.

    A link that dropped stays down until the next `reset`, and nothing is ever sent twice.

    Args:
        url: ``tcp://host:port``.
        env_id: The requested environment; "" for the one that is served.
        timeout: Longest time for a request [s].
        connect_timeout: Longest time to connect [s].
        token: The server's shared secret, if it has one. Nothing is encrypted.
        name: The name of this client, shown to others; computer and process by default.
        take: Take command from the client that has it.

    Raises:
        InvalidValue: `url` is not such a URL.
    """

    def __init__(
        self,
        url: str,
        *,
        env_id: str = "",
        timeout: float = 30.0,
        connect_timeout: float = 3.0,
        token: str | None = None,
        name: str | None = None,
        take: bool = False,
    ) -> None:
        self.endpoint = Endpoint(url, None, token, connect_timeout, timeout)
        self.url, self.env_id, self.timeout, self.take = url, env_id, timeout, take
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
            (host or "").encode("idna")
        except ValueError as error:  # brackets, the port, or a name that cannot be looked up
            raise InvalidValue(f"{url!r} is not a TCP address: {error}.") from error
        if parts.scheme != "tcp" or not host or not port or parts.path.strip("/"):
            raise InvalidValue(f"A TCP address is tcp://host:port, such as tcp://10.0.0.5:5555, not {url!r}.")
        self._host, self._port = host, port
        self._name = name
        self._tagger, self._epoch = Tagger(), 0
        self._lock = threading.Lock()
        self._frames: FrameSocket | None = None
        self._pid = 0
        self._spec: EnvSpecMessage | None = None
        self._closed = False

    def connect(self) -> EnvSpecMessage:
        """Open the link and read the description. Raises NoServer without a usable server, or if it refuses."""
        with self._lock:
            return self._connected()

    def reset(self, seed: Seed = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; reconnects if the link dropped."""
        plain = plain_seed(seed)
        with self._lock:
            spec = self._connected()
            tag = self._tag(self.timeout)
            tree = self._ask(Reset(tag, plain, None if options is None else plain_info(options), self.take))
            return self._result(spec, tree, 2)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info)."""
        with self._lock:
            if self._spec is None or not self._is_up():
                why = "this transport is closed" if self._closed else "the link is down"
                raise LinkLost(f"{self.url}: {why}, and nothing was sent. Call reset() to connect again.")
            packed = pack_action(self._spec, action)
            return self._result(self._spec, self._ask(Step(self._tag(self.timeout), packed)), 5)

    def close(self) -> None:
        """Release the environment and drop the link; a request that is under way ends with `LinkLost`."""
        self._closed = True
        if self._lock.acquire(blocking=False):
            try:
                if self._is_up():
                    with suppress(LinkLost, ProtocolError, RemoteError):  # the server notices that a link is gone
                        self._ask(Leave(self._tag(min(self.timeout, _LEAVE_TIMEOUT))))
                self._drop()
            finally:
                self._lock.release()
        elif (frames := self._frames) is not None and self._pid == os.getpid():
            frames.hang_up()  # the thread of the request closes it

    def _is_up(self) -> bool:
        return self._frames is not None and self._pid == os.getpid()

    def _connected(self) -> EnvSpecMessage:
        """Connect if the link is down; returns the description of the environment."""
        if self._spec is not None and not self._closed and self._is_up():
            return self._spec
        if self._frames is not None and not self._closed:  # after a fork: the link and the session are the parent's
            self._frames.abandon()
            self._frames, self._tagger, self._epoch = None, Tagger(), 0
        try:
            self._require_open()
            spec = self._open()
            if self._spec is not None and spec_to_json(self._spec) != spec_to_json(spec):
                raise ProtocolError(f"{self.url}: it serves another environment than before: {spec.env_id}.")
            self._require_open()  # another thread may have closed it meanwhile
        except BaseException as error:
            self._drop()
            if isinstance(error, LinkLost):
                self._require_open()
            raise
        self._spec = spec
        return spec

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost(f"{self.url}: this transport is closed; make a new one.")

    def _open(self) -> EnvSpecMessage:
        deadline = time.monotonic() + self.endpoint.connect_timeout
        start = f"bam-serve --env {self.env_id or 'bam/pick'} --tcp"
        try:
            self._frames = FrameSocket(_dial(self._host, self._port, deadline))
        except OSError as error:
            if isinstance(error, ConnectionRefusedError):
                reason = "nothing listens there (is the port open?)"
            elif isinstance(error, TimeoutError):
                limit = f"{self.endpoint.connect_timeout:g} s"
                reason = f"no answer within {limit} (is the address right, and no firewall between?)"
            elif isinstance(error, socket.gaierror):
                reason = f"no computer is known by the name {self._host!r}"
            else:
                reason = error.strerror or str(error)
            raise NoServer(self.url, f"{reason}. Start one: {start} {self._port}") from error
        self._pid, self._epoch = os.getpid(), self._epoch + 1
        name = self._name or f"{socket.gethostname()}:{self._pid}"
        hello = Hello(self._tagger.session, self._epoch, name, self.endpoint.token or "", self.env_id)
        try:
            self._frames.send(encode(["hello", hello]), deadline)
            return spec_from_json(content_of(self._frames.receive(deadline), 0))
        except (ForeignPeer, RemoteError) as error:
            raise NoServer(self.url, f"{error}") from error
        except (LinkLost, ProtocolError) as error:
            remedy = f"If it is rosbridge, use ws://; else start one at a free port: {start} PORT"
            raise NoServer(self.url, f"not a bam-serve TCP server: {error}. {remedy}") from error

    def _tag(self, limit: float) -> TagMessage:
        tag = self._tagger.next(self._epoch, limit)
        return TagMessage(tag.session, tag.epoch, tag.sequence, tag.sent, tag.deadline)

    def _ask(self, request: Request) -> Tree:
        """Send a request and return the content of its answer; after any other outcome the link is down."""
        frames, limit = self._frames, request.tag.lifetime
        if frames is None:
            raise LinkLost(f"{self.url}: the link is down.")
        parts = encode(request)
        deadline = time.monotonic() + limit
        try:
            frames.send(parts, deadline)
            return content_of(frames.receive(deadline), request.tag.sequence)
        except RemoteError:
            raise
        except LinkLost as error:
            self._drop()
            reason = str(error)
            if self._closed:
                reason = "this transport was closed meanwhile"
            elif time.monotonic() >= deadline:
                reason = f"no answer to {type(request).__name__.lower()} within {limit:g} s"
            raise LinkLost(f"{self.url}: {reason}.") from error
        except BaseException:  # even Ctrl-C: a late answer would be taken for that of the next request
            self._drop()
            raise
        finally:
            if self._closed:  # by another thread, which only hung up
                self._drop()

    def _result(self, spec: EnvSpecMessage, tree: Tree, size: int) -> tuple[Any, ...]:
        try:
            return read_result(spec, tree, size)
        except ProtocolError as error:
            raise ProtocolError(f"{self.url}: {error}") from error

    def _drop(self) -> None:
        frames, self._frames = self._frames, None
        if frames is not None and self._pid == os.getpid():
            frames.close()


def _dial(host: str, port: int, deadline: float) -> socket.socket:
    """A socket that is connected before `deadline` to one of the addresses of the name."""
    refusal = OSError("it has no address")
    for *_, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        try:
            return socket.create_connection((str(address[0]), int(address[1])), max(0.01, deadline - time.monotonic()))
        except OSError as error:  # noqa: PERF203 - the next address may answer
            refusal = error
    raise refusal
