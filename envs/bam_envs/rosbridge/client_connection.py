"""One connection of a link: roslibpy's protocol on Autobahn, with bounds before parsing, CBOR, fragments, a heartbeat.

Everything here runs on the network thread. A connection is never reopened: messages that it had not sent cannot reach
the server over the next one.
Longer than most files: how a connection begins, and every way in which it ends, are read together.
"""

import asyncio
import logging
import math
import re
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import txaio
from roslibpy.comm import RosBridgeProtocol
from roslibpy.event_emitter import EventEmitterMixin

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NoServer, ProtocolError, RemoteError
from bam_envs.rosbridge.bus import tell
from bam_envs.rosbridge.dialing import http_refusal, no_connection, open_port, silent
from bam_envs.rosbridge.encoding import Fragments, decode_server_frame, dump_json
from bam_envs.rosbridge.endpoint import Address, Endpoint
from bam_envs.rosbridge.ros_bus import Reply, bare_reason, read_clock

TWISTED = (
    "This process uses roslibpy's Twisted transport, and a live robot needs its asyncio transport: make each "
    'roslibpy.Ros with transport="asyncio", or call roslibpy.set_default_transport("asyncio") first.'
)
try:
    from autobahn.asyncio.websocket import WebSocketClientFactory, WebSocketClientProtocol
    from roslibpy.comm.comm_asyncio import AsyncioEventLoopManager
except RuntimeError as error:  # a process has one of the two transports
    raise InvalidValue(TWISTED) from error

_LOG = logging.getLogger(__name__)
logging.getLogger(f"{__name__}.Connection").setLevel(logging.CRITICAL)  # a link reports its errors itself
_CLOSE_WITHIN = 1.0  # longest time for a closing handshake [s]
_CLOCK_PROBES = 3
_PINGS = 5  # pings to a server before its silence is a loss
_MOST_UNSENT = 1024 * 1024  # bytes that may wait for the server to read before sending fails
_MOST_PASSED_OVER = 20  # meaningless messages of one connection, after which it is closed
_LONGEST_REFUSAL = 64 * 1024  # bytes of an HTTP response that is not that of a WebSocket server
_DEAD_NODE = "context is invalid"  # answer of rosbridge_suite to every request after its node has shut down


def send_now(socket: Any, url: str, down: str, max_message: int, *frames: str) -> None:
    """Write frames to a WebSocket of Autobahn now, all or none; `down` says why it is not to be used, if so.

    `LinkLost` if that fails, `InvalidValue` for a frame that is too large.
    """
    if down or socket.state != socket.STATE_OPEN or socket.transport.is_closing():
        why = down or "it is being closed"
        raise LinkLost(f"{url}: the link is down ({why}). Nothing was sent, and nothing is kept.")
    if socket.transport.get_write_buffer_size() > _MOST_UNSENT:
        raise LinkLost(f"{url}: the server does not read what it is sent. Nothing more was sent.")
    largest = max(map(len, frames), default=0)
    if largest > max_message:
        raise InvalidValue(
            f"{url}: a message of {largest} bytes is above the limit of {max_message}; nothing was "
            "sent. Send less at once, or raise max_message on both ends."
        )
    for frame in frames:
        socket.sendMessage(frame.encode())


class LinkFactory(EventEmitterMixin):  # type: ignore[misc]
    """What `roslibpy.Ros` asks of its transport; ready while there is a `connection`."""

    def __init__(self) -> None:
        super().__init__()
        self.manager = AsyncioEventLoopManager()  # its loop is that of the link, which runs
        self.connection: Connection | None = None
        self.heard: set[str] = set()  # events that have listeners

    @property
    def is_connected(self) -> bool:
        """Whether a message can be sent now."""
        return self.connection is not None and self.connection.can_send

    def on(self, event: str, f: Callable[..., object] | None = None) -> Any:
        """Call `f` at each `event`: the name of a topic or a service, ``ready``, ``close``."""
        self.heard.add(event)
        return super().on(event, f)

    def on_ready(self, callback: Callable[["Connection"], object]) -> None:
        """Call `callback` with the connection, now or when there is one."""
        if self.connection is not None:
            callback(self.connection)
        else:
            self.once("ready", callback)


class Connection(RosBridgeProtocol, WebSocketClientProtocol):  # type: ignore[misc]
    """Connection number `epoch` of a link to the server of `url`; `max_message` is the link's.

    `on_message` takes each message that is not an answer: publish, call_service, status. `on_end` is called once, at
    the end of the connection, before pending requests get the error.
    """

    log = txaio.make_logger()

    def __init__(
        self,
        url: str,
        max_message: int,
        epoch: int = 0,
        on_message: Callable[["Connection", dict[str, Any]], None] = lambda *_: None,
        on_end: Callable[["Connection", BamEnvsError], None] = lambda *_: None,
    ) -> None:
        super().__init__()
        self.url, self.epoch = url, epoch
        self.error: BamEnvsError | None = None  # why it ended; None before
        self.ended = asyncio.Event()
        self.ros: str | None = None  # as in `RosbridgeLink`; both are known after `probe`
        self.clock_offset: float | None = None  # to within half a round trip
        self.handshake = b""  # the server's response to the opening handshake, up to its end if it refuses
        self._max_message, self._on_message, self._on_end = max_message, on_message, on_end
        self._heard_at = time.monotonic()  # when the server last gave a sign of life [s]
        self._probed = False  # whether the server has answered a request
        self._pending: dict[str, tuple[Callable[[Reply], None], Callable[[Any], None] | None]] = {}
        self._fragments, self._passed_over = Fragments(max_message), 0
        self._cut_by: Exception | None = None
        self._watching: asyncio.Task[None] | None = None

    # ---- opening

    def data_received(self, data: bytes) -> None:
        """Take bytes of the server. Autobahn ends a refused handshake before the text of the refusal has come."""
        self._heard_at = time.monotonic()
        if self.state == self.STATE_CONNECTING:
            self.handshake += data
            if not b"HTTP/1.1 101".startswith(self.handshake[:12]):
                head, _, body = self.handshake.partition(b"\r\n\r\n")
                length = re.search(rb"(?i)\ncontent-length: *(\d{1,9})", head)
                if len(body) >= (int(length[1]) if length else _LONGEST_REFUSAL):
                    self.transport.close()
                return
        super().data_received(data)

    async def probe(self, within: float, timeout: float) -> None:
        """Check `within` [s] that a rosbridge server answers, and learn its clock.

        `NoServer` if it does not, with the `timeout` of the whole attempt [s].
        """
        try:
            await asyncio.wait_for(self._probe(), within)
        except asyncio.TimeoutError as error:
            raise NoServer(
                self.url,
                f"a WebSocket server that answers no rosbridge request within {timeout:.1f} s. "
                "Is it a rosbridge server, and is its ROS node alive?",
            ) from error
        self._probed = True

    async def _probe(self) -> None:
        best = math.inf
        for probe in range(_CLOCK_PROBES):
            asked = time.time()
            now = read_clock(await self._ask_time(f"ready:{self.epoch}:{probe}"))
            trip = time.time() - asked
            if now is not None and trip < best:
                best, self.ros, self.clock_offset = trip, now[0], asked + trip / 2 - now[1]
            if self.ros is None:
                return

    async def _ask_time(self, identity: str) -> object:
        # Any answer will do, even that there is no such service: it shows that the server's node works.
        request = {"op": "call_service", "id": identity, "service": "/rosapi/get_time", "type": "rosapi/GetTime"}
        answer: Future[Reply] = Future()
        self.ask(identity, dump_json({**request, "args": {}}), answer.set_result)
        reply = await asyncio.wrap_future(answer)
        if isinstance(reply, RemoteError):
            return None
        if isinstance(reply, NoServer):
            raise reply
        if isinstance(reply, BamEnvsError):
            reason = bare_reason(self.url, reply).removeprefix("the link dropped: ")
            raise NoServer(self.url, f"closed the connection before it answered a request: {reason}.") from reply
        values = reply.get("values")
        if isinstance(values, str) and _DEAD_NODE in values:
            raise NoServer(self.url, f"its ROS node has ended and its socket has not ({values}). Restart the bridge.")
        return values

    def watch(self, lost_after: float) -> None:
        """End the connection when the server gives no sign of life for `lost_after` [s] from now on."""
        if lost_after < math.inf:
            self._heard_at = time.monotonic()
            self._watching = asyncio.get_running_loop().create_task(self._watch(lost_after))

    async def _watch(self, lost_after: float) -> None:
        every = lost_after / _PINGS
        while self.error is None:
            # A server that does not read its pending messages answers no ping either.
            if not self.transport.get_write_buffer_size():
                self.sendPing()
            woken = time.monotonic() + min(every, max(0.0, self._heard_at + lost_after - time.monotonic()))
            await asyncio.sleep(woken - time.monotonic())
            now = time.monotonic()
            if now - woken > every:
                self._heard_at = now  # this process itself was paused, and messages may be unread
            if now - self._heard_at >= lost_after:
                self.drop(LinkLost(f"{self.url}: nothing from the server for {lost_after:g} s."))

    # ---- sending

    @property
    def can_send(self) -> bool:
        """Whether a message can be sent. Thread-safe."""
        return self.error is None and bool(self.state == self.STATE_OPEN)

    def send(self, *frames: str) -> None:
        """Write frames to the socket now, all or none; `LinkLost` if that fails, `InvalidValue` for one too large."""
        down = "" if self.error is None else bare_reason(self.url, self.error)
        send_now(self, self.url, down, self._max_message, *frames)

    def send_message(self, payload: bytes) -> None:
        """Send an encoded message from any thread, as roslibpy's own protocols do."""
        self.factory.loop.call_soon_threadsafe(tell, self.send, payload.decode())

    def ask(
        self, identity: str, frame: str, took: Callable[[Reply], None], news: Callable[[Any], None] | None = None
    ) -> None:
        """Send a request; `took` gets the response or an error, `news` the feedback. Raises the errors of `send`."""
        self.send(frame)
        self._pending[identity] = took, news

    def forget(self, identity: str) -> None:
        """Stop waiting for an answer."""
        self._pending.pop(identity, None)

    # ---- ending

    def drop(self, error: BamEnvsError) -> None:
        """End it at once, without a closing handshake; unsent messages are discarded."""
        self._end(error)
        self.dropConnection(abort=True)

    async def close(self) -> None:
        """End it with a closing handshake, or without one if the server does not answer in time."""
        error = LinkLost(f"{self.url}: the link was closed.")
        if self.can_send:
            self._end(error)
            self.sendClose(1000)
            await asyncio.wait([self.is_closed], timeout=_CLOSE_WITHIN)
        self.drop(error)

    def _end(self, error: BamEnvsError) -> None:
        if self.error is not None:
            return
        self.error = error
        self._on_end(self, error)
        pending, self._pending = self._pending, {}
        for took, _ in pending.values():
            tell(took, error)
        if self._watching is not None and self._watching is not asyncio.current_task():
            self._watching.cancel()
        self.ended.set()

    def onCloseFrame(self, code: int | None, reason: bytes | None) -> bool | None:  # noqa: N802 - Autobahn's name
        """Take the server's part of the closing handshake; it has to close the connection then."""
        left: bool | None = super().onCloseFrame(code, reason)
        late = LinkLost(f"{self.url}: the link dropped: the server did not finish closing it.")
        asyncio.get_running_loop().call_later(_CLOSE_WITHIN, self.drop, late)
        return left

    def connection_lost(self, error: Exception | None) -> None:
        """Take the end of the TCP connection, and its cause."""
        self._cut_by = error
        super().connection_lost(error)

    def onClose(self, clean: bool, code: int | None, reason: str | None) -> None:  # noqa: N802 - Autobahn's name
        """Take the end of the connection."""
        if self.wasMaxMessagePayloadSizeExceeded:
            self._end(
                ProtocolError(
                    f"{self.url}: the server sent a message above the limit of {self._max_message} bytes. "
                    "Take compressed images, or raise max_message."
                )
            )
        how = f"the server closed it with {', '.join(filter(None, (f'code {code}', reason)))}" if clean else ""
        why = str(self._cut_by or "") or (self.wasNotCleanReason if self.droppedByMe else "")
        how = how or f"the connection was cut{f': {why}' if why else ''}"
        self._end(LinkLost(f"{self.url}: the link dropped: {how}."))

    # ---- receiving

    def onMessage(self, payload: bytes, is_binary: bool) -> None:  # noqa: N802 - Autobahn's name
        """Take a message in JSON or CBOR; one without meaning is passed over."""
        if self.error is not None:
            return
        try:
            self._dispatch(decode_server_frame(payload))
        except BamEnvsError as error:  # a meaningless message, or an answer to it that cannot be sent
            self.pass_over(str(error))

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
        if operation in ("service_response", "action_result"):
            self._resolve(identity, message)
        elif operation == "action_feedback":
            news = self._pending.get(identity, (None, None))[1]
            if news is not None:
                tell(news, message.get("values"))
        elif operation == "fragment":
            self._fragments.expire(self._heard_at)
            whole = self._fragments.add(message, self._heard_at)
            if whole is not None:
                self._dispatch(decode_server_frame(whole.encode()))
        # Only before the server is known: later, one of its requests may have an id like ours.
        elif operation == "call_service" and not self._probed and identity in self._pending:
            echo = NoServer(self.url, "an echo server: it sends back what it is sent. Is it the right port?")
            self._resolve(identity, echo)
        else:
            # A server may answer a request that it cannot read only with a status of the same id.
            if operation == "status" and message.get("level") == "error":
                self._resolve(identity, RemoteError(str(message.get("msg"))))
            self._on_message(self, message)

    def _resolve(self, identity: str, reply: Reply) -> None:
        if identity in self._pending:
            tell(self._pending.pop(identity)[0], reply)


# ---- opening, and the reasons why there is no connection


async def open_connection(endpoint: Endpoint, timeout: float, max_message: int, *hooks: Any) -> Connection:
    """Connect and do the WebSocket handshake in `timeout` [s]; `NoServer` gives the reason why that failed.

    `max_message` limits received messages [bytes]; `hooks` are the other arguments of the `Connection`.
    """
    address, context, deadline = endpoint.address, endpoint.tls_context(), time.monotonic() + timeout
    loop = asyncio.get_running_loop()
    headers = {"Authorization": f"Bearer {endpoint.token}"} if endpoint.token else None
    factory = WebSocketClientFactory(f"{address.url}/", headers=headers, loop=loop)
    factory.protocol = lambda: Connection(address.url, max_message, *hooks)
    # Its timers are coarser than the times here. `decode_server_frame` checks UTF-8.
    factory.setProtocolOptions(openHandshakeTimeout=0, utf8validateIncoming=False, maxMessagePayloadSize=max_message)
    # TCP first, to tell apart a closed port, one behind a firewall and a silent one.
    plain = await open_port(address, timeout, stand_in=endpoint.stand_in)
    name = None if context is None else address.host
    try:
        dialing = loop.create_connection(factory, sock=plain, ssl=context, server_hostname=name)
        connection: Connection = (await asyncio.wait_for(dialing, deadline - time.monotonic()))[1]
    except BaseException as error:
        plain.close()
        if isinstance(error, asyncio.TimeoutError):
            raise NoServer(address.url, silent(address, timeout)) from error
        if isinstance(error, OSError):
            raise NoServer(address.url, no_connection(address, error, timeout)) from error
        raise
    try:
        ends = [connection.is_open, connection.is_closed]
        await asyncio.wait(ends, timeout=deadline - time.monotonic(), return_when=asyncio.FIRST_COMPLETED)
        if not connection.can_send:
            raise NoServer(address.url, _no_websocket(address, connection, timeout))
        return connection
    finally:
        if not connection.can_send:
            connection.drop(LinkLost(f"{address.url}: no answer."))


def _no_websocket(address: Address, connection: Connection, timeout: float) -> str:
    line, end, _ = connection.handshake.partition(b"\r\n")
    status = re.match(rb"HTTP/\S+ (\d{3})\b", line)
    if status and status[1] != b"101":
        return http_refusal(int(status[1]), connection.handshake.partition(b"\r\n\r\n")[2])
    if not connection.is_closed.done():
        return silent(address, timeout)
    reason = connection.wasNotCleanReason if status else "connection closed while reading HTTP status line"
    if end and not status:
        reason = f"unsupported protocol; expected HTTP/1.1: {line[:100].decode(errors='replace')}"
    return f"something listens there that is no WebSocket server ({reason}). If it has TLS, use wss://."
