"""TcpTransport: an environment of ``bam-serve --tcp PORT``, for a network where rosbridge is too slow."""

import os
import socket
import threading
import time
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer, ProtocolError, RemoteError
from bam_envs.core.location import NO_CREDENTIALS, Credentials, serving
from bam_envs.remote.wire.tcp_wire import (
    FrameSocket,
    Hello,
    Leave,
    Reset,
    Step,
    TcpRequest,
    content_of,
    encode,
    pack_action,
    read_result,
)
from bam_envs.remote.wire.transport import EnvSpecMessage, Info, Seed, plain_seed, spec_from_json, spec_to_json
from bam_envs.remote.wire.values import Tree, plain_info
from bam_envs.ros.freshness import Tagger
from bam_envs.rosbridge.dialing import no_connection
from bam_envs.rosbridge.endpoint import Address, Endpoint

_LEAVE_TIMEOUT = 1.0  # [s]; a server that is gone must not delay `close`


class TcpTransport:
    """Carries an environment over TCP. One request at a time; `close` may be called from any thread.

    A link that dropped stays down until the next `reset`, and nothing is ever sent twice.

    Args:
        url: ``tcp://host:port``.
        env_id: The requested environment; "" for the one that is served.
        timeout: Longest time for a request [s].
        connect_timeout: Longest time to connect [s].
        credentials: The file of the server's token. Nothing is encrypted.
        token: The server's shared secret, if it has one and it is not in a file.
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
        credentials: Credentials = NO_CREDENTIALS,
        token: str | None = None,
        name: str | None = None,
        take: bool = False,
    ) -> None:
        self.endpoint = Endpoint(url, credentials, token, connect_timeout, timeout)
        self.url, self.env_id, self.timeout, self.take = url, env_id, timeout, take
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
            (host or "").encode("idna")
        except ValueError as error:  # brackets, the port, or a name that cannot be looked up
            raise InvalidValue(f"{url!r} is not a TCP address: {error}.") from error
        if parts.scheme != "tcp" or not host or not port or parts.path.strip("/"):
            raise InvalidValue(f"A TCP address is tcp://host:port, such as tcp://10.0.0.5:5555, not {url!r}.")
        self._address, self._name = Address(host, port, False, ""), name
        self._tagger, self._epoch, self._pid = Tagger(), 0, 0
        self._lock = threading.Lock()
        self._frames: FrameSocket | None = None
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
            self._connected()
            given = None if options is None else plain_info(options)
            begun: tuple[Any, Any] = self._ask(Reset, self.timeout, plain, given, self.take, size=2)
            return begun

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info)."""
        with self._lock:
            if self._spec is None or not self._is_up():
                why = "this transport is closed" if self._closed else "the link is down"
                raise LinkLost(f"{self.url}: {why}, and nothing was sent. Call reset() to connect again.")
            packed = pack_action(self._spec, action)
            stepped: tuple[Any, Any, Any, Any, Any] = self._ask(Step, self.timeout, packed, size=5)
            return stepped

    def close(self) -> None:
        """Release the environment and drop the link; a request that is under way ends with `LinkLost`."""
        self._closed = True
        if self._lock.acquire(blocking=False):
            try:
                if self._is_up():
                    with suppress(LinkLost, ProtocolError, RemoteError):  # the server notices that a link is gone
                        self._ask(Leave, min(self.timeout, _LEAVE_TIMEOUT))
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
            self._frames.close(ends=False)
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
        limit, start = self.endpoint.connect_timeout, f"Start one: {serving(self.env_id or 'ENV')} --tcp"
        deadline = time.monotonic() + limit
        try:
            self._frames = FrameSocket(_dial(self._address, deadline))
        except OSError as error:
            reason = no_connection(self._address, error, limit, f"{start} {self._address.port}")
            raise NoServer(self.url, reason) from error
        self._pid, self._epoch = os.getpid(), self._epoch + 1
        name = self._name or f"{socket.gethostname()}:{self._pid}"
        try:
            content = name, self.endpoint.token or "", self.env_id
            return spec_from_json(self._exchange(self._frames, Hello, deadline, *content))
        except RemoteError as error:
            raise NoServer(self.url, str(error)) from error
        except (LinkLost, ProtocolError) as error:
            remedy = f"If it is rosbridge, use ws://. {start} PORT, at a free port."
            raise NoServer(self.url, f"no usable bam-serve TCP server: {error}. {remedy}") from error

    def _exchange(self, frames: FrameSocket, kind: type[TcpRequest], deadline: float, *content: Any) -> Tree:
        """Send a request and return the content of its answer, which must come before `deadline` [s, monotonic]."""
        tag = self._tagger.next(self._epoch, deadline - time.monotonic())
        frames.send(encode(kind(tag.to_text(), *content)), deadline)
        return content_of(frames.receive(deadline), tag.sequence)

    def _ask(self, kind: type[TcpRequest], limit: float, *content: Any, size: int = 0) -> Any:
        """As `_exchange`, within `limit` [s]; reads a result of `size` values. On any other error the link drops."""
        if self._frames is None or self._spec is None:
            raise LinkLost(f"{self.url}: the link is down.")
        deadline = time.monotonic() + limit
        try:
            answer = self._exchange(self._frames, kind, deadline, *content)
            return read_result(self._spec, answer, size) if size else answer
        except RemoteError:
            raise
        except BaseException as error:  # even Ctrl-C: a late answer would be taken for that of the next request
            self._drop()
            if not isinstance(error, (LinkLost, ProtocolError)):
                raise
            reason = str(error).rstrip(".")
            if self._closed:
                reason = "this transport was closed meanwhile"
            elif isinstance(error, LinkLost) and time.monotonic() >= deadline:
                reason = f"no answer to {kind.__name__.lower()} within {limit:g} s"
            raise type(error)(f"{self.url}: {reason}.") from error
        finally:
            if self._closed:  # by another thread, which only hung up
                self._drop()

    def _drop(self) -> None:
        frames, self._frames = self._frames, None
        if frames is not None and self._pid == os.getpid():
            frames.close()


def _dial(address: Address, deadline: float) -> socket.socket:
    """A socket that is connected before `deadline` [s, monotonic] to one of the IP addresses of a host."""
    refusal = OSError("the name has no address")
    for *_, found in socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM):
        try:
            return socket.create_connection((str(found[0]), int(found[1])), max(0.01, deadline - time.monotonic()))
        except OSError as error:  # noqa: PERF203 - the next address may answer
            refusal = error
    raise refusal
