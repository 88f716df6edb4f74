"""One WebSocket connection of a client, from its handshake to its end. Everything here runs on the network thread.

A connection is never reopened: messages that it had not sent cannot reach the server over the next one.
"""

import asyncio
import contextlib
import logging
import math
import socket
import ssl
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import broadcast
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.protocol import State

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NoServer, ProtocolError, RemoteError
from bam_envs.rosbridge.encoding import Fragments, decode_server_frame, dump_json
from bam_envs.rosbridge.endpoint import Address, Endpoint

_LOG = logging.getLogger(__name__)
_QUIET = logging.getLogger(f"{__name__}.websockets")
_QUIET.setLevel(logging.CRITICAL)  # a link itself reports in one line why it ended or did not open
_CLOSE_WITHIN = 1.0  # longest time for a closing handshake [s]
_CLOCK_PROBES = 3
_LOOK = 0.5  # time between two checks of a connection whose silence is no loss [s]
_PINGS = 5  # pings to a server before its silence is a loss
_MOST_UNSENT = 1024 * 1024  # bytes that may wait for the server to read before sending fails
_MOST_PASSED_OVER = 20  # meaningless messages of one connection, after which it is closed
_TOO_LARGE = 1009  # WebSocket's close code for a message above the limit
_DEAD_NODE = "context is invalid"  # answer of rosbridge_suite to every request after its node has shut down
_HOST_MISMATCH = (62, 64)  # X509_V_ERR_HOSTNAME_MISMATCH, X509_V_ERR_IP_ADDRESS_MISMATCH


def bare_reason(url: str, error: BamEnvsError) -> str:
    """The text of `error` without the address and the full stop, for a text that begins with the address."""
    return str(error).removeprefix(f"{url}: ").rstrip(".")


class Connection:
    """Connection number `epoch` of a link; `max_message` and `lost_after` are the link's.

    `on_message` takes each message that is not an answer: publish, call_service, status. `on_end` is called once, at
    the end of the connection, before pending answers get the error.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        epoch: int,
        max_message: int,
        lost_after: float,
        on_message: Callable[["Connection", dict[str, Any]], None],
        on_end: Callable[["Connection", BamEnvsError], None],
    ) -> None:
        self.url, self.epoch = endpoint.address.url, epoch
        self.error: BamEnvsError | None = None  # why it ended; None before
        self.ended = asyncio.Event()
        self.announced: dict[str, str] = {}  # declarations sent on it: id of the declaration -> its frame
        self.ros: str | None = None  # as in `RosbridgeLink`; both are known once it is open
        self.clock_offset: float | None = None  # to within half a round trip
        self._endpoint, self._max_message, self._lost_after = endpoint, max_message, lost_after
        self._on_message, self._on_end = on_message, on_end
        self._heard_at = time.monotonic()  # when the server last gave a sign of life [s]
        self._socket: ClientConnection | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._ready = False  # whether the server has answered a request
        self._pending: dict[str, Future[dict[str, Any]]] = {}
        self._fragments = Fragments(max_message)
        self._passed_over = 0

    # ---- opening

    async def open(self, timeout: float) -> None:
        """Connect, and check that a rosbridge server answers, all within `timeout` [s].

        `NoServer` gives the reason; its cause is a `ConnectionRefusedError` if the server may still be starting.
        """
        deadline = time.monotonic() + timeout
        self._socket = await open_socket(self._endpoint, timeout, self._max_message)
        self._heard_at = time.monotonic()
        loop = asyncio.get_running_loop()
        self._tasks = [loop.create_task(work(self._socket)) for work in (self._read, self._watch)]
        try:
            await asyncio.wait_for(self._probe(), deadline - time.monotonic())
            self._ready = True
        except asyncio.TimeoutError as error:
            raise NoServer(
                self.url,
                f"a WebSocket server that answers no rosbridge request within {timeout:.1f} s. "
                "Is it a rosbridge server, and is its ROS node alive?",
            ) from error
        finally:
            if not self._ready:
                self.drop(LinkLost(f"{self.url}: no answer."))

    async def _probe(self) -> None:
        best = math.inf
        for probe in range(_CLOCK_PROBES):
            asked = time.time()
            server_time = await self._ask_time(f"ready:{self.epoch}:{probe}")
            trip = time.time() - asked
            for ros, seconds, nanoseconds in (("ros2", "sec", "nanosec"), ("ros1", "secs", "nsecs")):
                whole, rest = server_time.get(seconds), server_time.get(nanoseconds)
                if isinstance(whole, int) and isinstance(rest, int) and trip < best:
                    best, self.ros, self.clock_offset = trip, ros, asked + trip / 2 - whole - rest * 1e-9
            if self.ros is None:
                return

    async def _ask_time(self, identity: str) -> Mapping[str, Any]:
        # Any answer will do, even that there is no such service: it shows that the server's node works.
        request = {"op": "call_service", "id": identity, "service": "/rosapi/get_time", "type": "rosapi/GetTime"}
        answer: Future[dict[str, Any]] = Future()
        try:
            self.ask(identity, dump_json({**request, "args": {}}), answer)
            values = (await asyncio.wrap_future(answer)).get("values")
        except RemoteError:
            return {}
        except NoServer:
            raise
        except LinkLost as error:
            reason = bare_reason(self.url, error).removeprefix("the link dropped: ")
            raise NoServer(self.url, f"closed the connection before it answered a request: {reason}.") from error
        if isinstance(values, str) and _DEAD_NODE in values:
            raise NoServer(self.url, f"its ROS node has ended and its socket has not ({values}). Restart the bridge.")
        server_time = values.get("time") if isinstance(values, Mapping) else None
        return server_time if isinstance(server_time, Mapping) else {}

    # ---- sending

    @property
    def is_open(self) -> bool:
        """Whether a message can be sent. Thread-safe."""
        return self.error is None and self._socket is not None and self._socket.state is State.OPEN

    def send(self, *frames: str) -> None:
        """Write frames to the socket now, all or none; `LinkLost` if that fails, `InvalidValue` for one too large."""
        socket = self._socket
        if socket is None or not self.is_open or socket.transport.is_closing():
            why = "it is being closed" if self.error is None else bare_reason(self.url, self.error)
            raise LinkLost(f"{self.url}: the link is down ({why}). Nothing was sent, and nothing is kept.")
        if socket.transport.get_write_buffer_size() > _MOST_UNSENT:
            raise LinkLost(f"{self.url}: the server does not read what it is sent. Nothing more was sent.")
        largest = max(map(len, frames), default=0)
        if largest > self._max_message:
            raise InvalidValue(
                f"{self.url}: a message of {largest} bytes is above the limit of {self._max_message}; nothing was "
                "sent. Send less at once, or raise max_message on both ends."
            )
        for frame in frames:
            # `send` of websockets would wait while the server does not read, and send stale messages later.
            broadcast([socket], frame)

    def ask(self, identity: str, frame: str, answer: Future[dict[str, Any]]) -> None:
        """Send a request; `answer` gets the whole response, or an error. Raises the errors of `send`."""
        self.send(frame)
        self._pending[identity] = answer

    def forget(self, identity: str) -> None:
        """Stop waiting for an answer."""
        self._pending.pop(identity, None)

    # ---- ending

    def drop(self, error: BamEnvsError) -> None:
        """End it at once, without a closing handshake; unsent messages are discarded."""
        self._end(error)
        if self._socket is not None:
            self._socket.transport.abort()

    async def close(self) -> None:
        """End it with a closing handshake, or without one if the server does not answer in time."""
        if self._socket is not None and self.error is None:
            self._end(LinkLost(f"{self.url}: the link was closed."))
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._socket.close(), _CLOSE_WITHIN)
        self.drop(LinkLost(f"{self.url}: the link was closed."))

    def _end(self, error: BamEnvsError) -> None:
        if self.error is not None:
            return
        self.error = error
        self._on_end(self, error)
        pending, self._pending = self._pending, {}
        for answer in pending.values():
            if not answer.done():
                answer.set_exception(error)
        for task in self._tasks:
            if task is not asyncio.current_task():
                task.cancel()
        self.ended.set()

    async def _watch(self, socket: ClientConnection) -> None:
        """End the connection when the server gives no sign of life, or does not finish closing."""
        lost_after, closing_since = self._lost_after, math.inf
        every = _LOOK if lost_after == math.inf else lost_after / _PINGS

        def ponged(pong: asyncio.Future[float]) -> None:
            if not pong.cancelled() and pong.exception() is None:
                self._heard_at = time.monotonic()

        while self.error is None:
            # A server that does not read its pending messages answers no ping either.
            if lost_after < math.inf and self.is_open and not socket.transport.get_write_buffer_size():
                with contextlib.suppress(ConnectionClosed):
                    asyncio.ensure_future(await socket.ping()).add_done_callback(ponged)
            woken = time.monotonic() + min(every, max(0.0, self._heard_at + lost_after - time.monotonic()))
            await asyncio.sleep(woken - time.monotonic())
            now = time.monotonic()
            if now - woken > every:
                self._heard_at = now  # this process itself was paused, and messages may be unread
            closing_since = math.inf if self.is_open else min(closing_since, now)
            if now - self._heard_at >= lost_after:
                self.drop(LinkLost(f"{self.url}: nothing from the server for {lost_after:g} s."))
            elif now - closing_since > _CLOSE_WITHIN:
                self.drop(LinkLost(f"{self.url}: the link dropped: the server did not finish closing it."))

    # ---- receiving

    async def _read(self, socket: ClientConnection) -> None:
        try:
            while True:
                frame = await socket.recv(decode=False)
                self._heard_at = time.monotonic()
                try:
                    self._dispatch(decode_server_frame(frame))
                except BamEnvsError as error:  # a meaningless message, or an answer to it that cannot be sent
                    self.pass_over(str(error))
        except ConnectionClosed as end:
            if end.sent is not None and end.sent.code == _TOO_LARGE and not end.rcvd_then_sent:
                reason: BamEnvsError = ProtocolError(
                    f"{self.url}: the server sent a message above the limit of {self._max_message} bytes. "
                    "Take compressed images, or raise max_message."
                )
            elif end.rcvd is not None:
                cause = ", ".join(filter(None, (f"code {end.rcvd.code}", end.rcvd.reason)))
                reason = LinkLost(f"{self.url}: the link dropped: the server closed it with {cause}.")
            else:
                why = f": {end.__cause__}" if end.__cause__ is not None and str(end.__cause__) else ""
                reason = LinkLost(f"{self.url}: the link dropped: the connection was cut{why}.")
            self._end(reason)

    def pass_over(self, text: str) -> None:
        """Log a meaningless message; after many of them, drop the connection."""
        _LOG.info("%s: passed over: %s", self.url, text)
        self._passed_over += 1
        if self._passed_over == _MOST_PASSED_OVER:
            self.drop(
                ProtocolError(
                    f"{self.url}: the server sends what is no rosbridge message, {self._passed_over} times by now: "
                    f"{text}. Is it the right port?"
                )
            )

    def _dispatch(self, message: dict[str, Any]) -> None:
        operation, identity = message.get("op"), str(message.get("id"))
        if operation == "service_response":
            self._resolve(identity, message)
        elif operation == "fragment":
            self._fragments.expire(self._heard_at)
            whole = self._fragments.add(message, self._heard_at)
            if whole is not None:
                self._dispatch(decode_server_frame(whole.encode()))
        # Only before the server is known: later, one of its requests may have an id like ours.
        elif operation == "call_service" and not self._ready and identity in self._pending:
            echo = NoServer(self.url, "an echo server: it sends back what it is sent. Is it the right port?")
            self._resolve(identity, echo)
        else:
            # A server may answer a request that it cannot read only with a status of the same id.
            if operation == "status" and message.get("level") == "error":
                self._resolve(identity, RemoteError(str(message.get("msg"))))
            self._on_message(self, message)

    def _resolve(self, identity: str, outcome: dict[str, Any] | BamEnvsError) -> None:
        answer = self._pending.pop(identity, None)
        if answer is None or answer.done():
            return
        if isinstance(outcome, BamEnvsError):
            answer.set_exception(outcome)
        else:
            answer.set_result(outcome)


# ---- the socket, and the reasons why it could not be opened


async def open_port(address: Address, timeout: float) -> socket.socket:
    """A TCP connection to a server; `NoServer` gives the reason why there is none within `timeout` [s]."""
    opening = asyncio.get_running_loop().create_task(_open_tcp(address))
    try:
        await asyncio.wait((opening,), timeout=timeout)
        await asyncio.sleep(0)  # on a busy computer, the answer may have come together with the end of the time
        if not opening.done():
            raise asyncio.TimeoutError
        return opening.result()
    except (OSError, asyncio.TimeoutError) as error:
        raise NoServer(address.url, _no_connection(address, error, timeout)) from error
    finally:
        opening.cancel()


async def open_socket(endpoint: Endpoint, timeout: float, max_message: int, path: str = "/") -> ClientConnection:
    """Connect and do the WebSocket handshake in `timeout` [s]; `max_message` limits received messages [bytes].

    `NoServer` gives the reason why that failed; an `InvalidStatus` is its cause if a web server answered.
    """
    address, context = endpoint.address, endpoint.tls_context()
    deadline = time.monotonic() + timeout
    # TCP first, to tell apart a closed port, one behind a firewall and a silent one; and so that websockets uses
    # no proxy, behind which there is no robot.
    plain = await open_port(address, timeout)
    try:
        return await connect(
            f"{address.url}{path}",
            sock=plain,
            ssl=context,
            server_hostname=address.host if context is not None else None,
            additional_headers={"Authorization": f"Bearer {endpoint.token}"} if endpoint.token else None,
            compression=None,  # deflate costs more time than a fast network saves
            open_timeout=deadline - time.monotonic(),
            close_timeout=_CLOSE_WITHIN,
            ping_interval=None,
            max_size=max_message,
            logger=_QUIET,
        )
    except InvalidStatus as error:
        status = error.response.status_code
        text = f"a web server answers there, with HTTP {status}: no WebSocket. Is it the right port?"
        said = bytes(error.response.body or b"")[:300].decode(errors="replace").strip()
        if status in (400, 403, 429, 503) and said.endswith("."):  # a server of ours gives its reason
            text = f"the server refuses this client (HTTP {status}): {said}"
        elif status in (401, 403):
            text = f"the token was refused (HTTP {status}). Give the server's token (--token-file)."
        raise NoServer(address.url, text) from error
    except TimeoutError as error:
        hint = " Does it speak TLS? If not, use ws://." if address.secure else ""
        text = f"the port is open, and what listens there is silent for {timeout:.1f} s. "
        raise NoServer(address.url, f"{text}Is it a rosbridge server?{hint}") from error
    except OSError as error:
        raise NoServer(address.url, _no_connection(address, error, timeout)) from error
    except ValueError as error:  # a redirect, which leads to another server than the one that was meant
        raise NoServer(address.url, f"a web server answers there: {error}. Is it the right port?") from error
    except WebSocketException as error:
        reason = error.__cause__ or error
        text = f"something listens there that is no WebSocket server ({reason}). If it has TLS, use wss://."
        raise NoServer(address.url, text) from error


async def _open_tcp(address: Address) -> socket.socket:
    loop = asyncio.get_running_loop()
    infos = await loop.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
    for place, (family, kind, protocol, _, target) in enumerate(infos):
        plain = socket.socket(family, kind, protocol)
        plain.setblocking(False)
        try:
            await loop.sock_connect(plain, target)
            return plain
        except BaseException as error:
            plain.close()
            if not isinstance(error, OSError) or place == len(infos) - 1:
                raise
    raise OSError("the name has no address")


def _no_connection(address: Address, error: OSError | asyncio.TimeoutError, timeout: float) -> str:
    """The reason why no TCP or TLS connection was made within `timeout` [s]."""
    if isinstance(error, ssl.SSLCertVerificationError):
        reason = error.verify_message.rstrip(".")
        if error.verify_code in _HOST_MISMATCH:
            return f"the certificate is not for {address.host!r}: {reason}. Use a name that is in it."
        remedy = "Give the file of the authority that signed it as ca_file (--ca-file)."
        return f"the certificate is not trusted: {reason}. {remedy}"
    if isinstance(error, ssl.SSLError):
        return f"TLS failed: {error.reason}. If the server has no TLS, use ws://."
    if isinstance(error, TimeoutError | asyncio.TimeoutError):
        return f"no connection within {timeout:.1f} s. Is the address right, is the machine on, is a firewall between?"
    if isinstance(error, socket.gaierror):
        return f"the name {address.host!r} is not known: {error.strerror}. Try the IP address."
    if isinstance(error, ConnectionRefusedError):
        return (
            f"refused: nothing listens there. Is the port open? Start one with `bam-serve --env bam/pick --port "
            f"{address.port}` or `ros2 launch rosbridge_server rosbridge_websocket_launch.xml`."
        )
    if isinstance(error, ConnectionError):
        hint = "If the server has no TLS, use ws://." if address.secure else "Is it the right port?"
        return f"the connection was cut while it was made. {hint}"
    return f"cannot be reached: {error.strerror or error}."
