"""One connection of a link: roslibpy's protocol on Autobahn, with bounds before parsing, CBOR, fragments, a heartbeat.

Everything here runs on the network thread. A connection is never reopened: messages that it had not sent cannot reach
the server over the next one.
Longer than most files: how a connection begins, and every way in which it ends, are read together.
"""

import asyncio
import logging
import re
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import txaio
from roslibpy import GoalStatus
from roslibpy.comm import RosBridgeProtocol
from roslibpy.event_emitter import EventEmitterMixin

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NoServer, ProtocolError
from bam_envs.rosbridge.bus import tell
from bam_envs.rosbridge.dialing import http_refusal, no_connection, no_websocket, open_port, silent
from bam_envs.rosbridge.encoding import Fragments, decode_server_frame, dump_json
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.ros_bus import bare_reason

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
_PINGS = 5  # pings to a server before its silence is a loss
_MOST_UNSENT = 1024 * 1024  # bytes that may wait for the server to read before sending fails
_MOST_PASSED_OVER = 20  # meaningless messages of one connection, after which it is closed
_LONGEST_REFUSAL = 64 * 1024  # bytes of an HTTP response that is not that of a WebSocket server


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
    """What `roslibpy.Ros` asks of its transport; `on_ready` calls with the connection, now or not at all."""

    def __init__(self, on_ready: Callable[[Callable[["Connection"], object]], None]) -> None:
        super().__init__()
        self.on_ready = on_ready
        self.manager = AsyncioEventLoopManager()  # its loop is that of the link, which runs
        self.heard: set[str] = set()  # events that have listeners

    def on(self, event: str, f: Callable[..., object] | None = None) -> Any:
        """Call `f` at each `event`: the name of a topic or a service, ``ready``, ``close``."""
        self.heard.add(event)
        return super().on(event, f)


class Connection(RosBridgeProtocol, WebSocketClientProtocol):  # type: ignore[misc]
    """A connection of a link to the server of `url`; `max_message` is the link's.

    `on_message` takes each whole message; `on_end` is called once, at the end of the connection.
    """

    log = txaio.make_logger()

    def __init__(
        self,
        url: str,
        max_message: int,
        on_message: Callable[["Connection", dict[str, Any]], None] = lambda *_: None,
        on_end: Callable[["Connection", BamEnvsError], None] = lambda *_: None,
    ) -> None:
        super().__init__()
        self.url = url
        self.error: BamEnvsError | None = None  # why it ended; None before
        self.ended = asyncio.Event()
        self.handshake = b""  # the server's response to the opening handshake, up to its end if it refuses
        self._max_message, self._on_message, self._on_end = max_message, on_message, on_end
        self._heard_at = time.monotonic()  # when the server last gave a sign of life [s]
        self._asked: dict[str, str] = {}  # id of each request of roslibpy's that waits -> the op of its response
        self._fragments, self._passed_over = Fragments(max_message), 0
        self._cut_by: Exception | None = None

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

    async def watch(self, lost_after: float) -> None:
        """Wait for the end of the connection, and end it when the server is silent for `lost_after` [s]."""
        every, self._heard_at = lost_after / _PINGS, time.monotonic()
        while self.error is None:
            # A server that does not read its pending messages answers no ping either.
            if not self.transport.get_write_buffer_size():
                self.sendPing()
            woken = time.monotonic() + min(every, max(0.0, self._heard_at + lost_after - time.monotonic()))
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self.ended.wait(), woken - time.monotonic())
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
        """Send an encoded message of roslibpy's; on the network thread."""
        self.send(payload.decode())

    def send_ros_service_request(self, message: Any, *hooks: Any) -> None:
        """Call a service for roslibpy, or raise the errors of `send`; its end is an error of the call."""
        self._ask("service_response", message, super().send_ros_service_request, *hooks)

    def send_ros_action_goal(self, message: Any, *hooks: Any) -> None:
        """Send a goal for roslibpy, or raise the errors of `send`; its end is an error of the goal."""
        self._ask("action_result", message, super().send_ros_action_goal, *hooks)

    def _ask(self, answer: str, message: Any, send: Callable[..., object], *hooks: Any) -> None:
        dump_json(message)  # refuses what roslibpy would send: numbers that are not finite
        send(message, *hooks)
        self._asked[str(message["id"])] = answer

    def _answer(self, message: dict[str, Any]) -> None:
        """Give roslibpy a response to one of its requests."""
        if (identity := str(message.get("id"))) in self._asked:
            if message["op"] != "action_feedback":
                del self._asked[identity]
            tell(self.on_message, dump_json({"values": {}, **message}).encode())

    def _fail(self, identity: str, text: str) -> None:
        failure = {"op": self._asked[identity], "id": identity, "values": text, "result": False}
        self._answer({**failure, "status": GoalStatus.UNKNOWN.value})

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
        for identity in list(self._asked):
            self._fail(identity, str(error))
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
        operation = message.get("op")
        if operation == "fragment":
            self._fragments.expire(self._heard_at)
            whole = self._fragments.add(message, self._heard_at)
            if whole is not None:
                self._dispatch(decode_server_frame(whole.encode()))
            return
        if operation in ("service_response", "action_result", "action_feedback"):
            self._answer(message)
        elif operation == "status" and message.get("level") == "error" and str(message.get("id")) in self._asked:
            self._fail(str(message["id"]), str(message.get("msg")))
        self._on_message(self, message)


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
            raise NoServer(address.url, _no_websocket(endpoint, connection, timeout))
        return connection
    finally:
        if not connection.can_send:
            connection.drop(LinkLost(f"{address.url}: no answer."))


def _no_websocket(endpoint: Endpoint, connection: Connection, timeout: float) -> str:
    line, end, _ = connection.handshake.partition(b"\r\n")
    status = re.match(rb"HTTP/\S+ (\d{3})\b", line)
    if status and status[1] != b"101":
        return http_refusal(int(status[1]), connection.handshake.partition(b"\r\n\r\n")[2], endpoint.token)
    if not connection.is_closed.done():
        return silent(endpoint.address, timeout)
    reason = connection.wasNotCleanReason if status else "connection closed while reading HTTP status line"
    if end and not status:
        reason = f"unsupported protocol; expected HTTP/1.1: {line[:100].decode(errors='replace')}"
    return no_websocket(reason)
