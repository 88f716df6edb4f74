"""The embedded rosbridge server: the protocol of `bridge` on WebSockets, in a network thread.

The network thread runs the protocol and the listeners; handlers of services run in a pool of threads, and long messages
are decoded in another thread, so that no halt waits for them.
"""

import asyncio
import functools
import itertools
import logging
import math
import ssl
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, TypeVar, cast

from websockets.asyncio.server import Server, serve
from websockets.exceptions import ConnectionClosed
from websockets.protocol import State

from bam_envs.core.errors import InvalidValue, LinkLost, ProtocolError
from bam_envs.rosbridge.bus import Action, Bus, Caller, Handler, Listener, Message
from bam_envs.rosbridge.endpoint import Address
from bam_envs.rosbridge.server.admission import ClientAdmission, listening_error, tls_context
from bam_envs.rosbridge.server.bridge import Bridge, Incoming
from bam_envs.rosbridge.server.client_session import Call, ClientSession, Send, ServerOptions
from bam_envs.rosbridge.server.server_connection import BridgeConnection
from bam_envs.rosbridge.server.site import Handler as SiteHandler
from bam_envs.rosbridge.server.site import Site
from bam_envs.rosbridge.threads import LoopThread, Workers
from bam_envs.rosbridge.tokens import Refusals, Tokens

T = TypeVar("T")

_HANDLER_THREADS = 32
_SHORT = 4096  # longest frame that is decoded in the network thread [bytes]
_TURN = 4  # frames of one client that are read before those of other clients
_QUEUE = 2  # messages of a client that are read from its socket before they are processed
_OF_THE_SITE = 2**20  # largest message to a socket of the site [bytes]
_EXPEL = 0.5  # time between two looks at the file of the tokens [s]
_logger = logging.getLogger(__name__)
# The logger of `websockets`, which reports every port scanner with a traceback.
_quiet = logging.getLogger(f"{__name__}.websockets")
_quiet.setLevel(logging.CRITICAL)


class BridgeServer(Bus):
    """A rosbridge server, and in its own process a `Bus`.

    Args:
        host: Address to listen on; other computers reach it only if it is not loopback.
        port: 0 takes a free one, which the attribute `port` then holds.
        cert: File with the certificate chain in PEM, for ``wss://``.
        key: File with its key, if that is another file.
        token: Clients must show it: ``Authorization: Bearer TOKEN``, or ``?token=TOKEN`` in the URL; a page in a
            browser also by its first message, ``{"op": "auth", "token": TOKEN}``. Without a token no page is admitted.
        operator_token: A client that shows this one instead is an operator (`Caller.operator`).
        tokens: Instead of these two, any secrets with their roles. When their file changes, connections whose token is
            valid no longer are closed within a second.
        site: Pages and WebSocket paths of an application on the same port.
        options: Limits and timeouts.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 9090,
        *,
        cert: str | None = None,
        key: str | None = None,
        token: str | None = None,
        operator_token: str | None = None,
        tokens: Tokens | None = None,
        site: Site | None = None,
        options: ServerOptions | None = None,
    ) -> None:
        if not 0 <= port <= 65535:
            raise InvalidValue(f"Port: expected an integer in [0, 65535], found {port}.")
        if key is not None and cert is None:
            raise InvalidValue("A key needs its certificate; name the file of that too.")
        self.host, self.port = host, port
        self.options = options or ServerOptions()
        self._cert, self._key = cert, key
        self._refusals = Refusals(_logger)
        self._bridge = Bridge(self.options, refusals=self._refusals)
        self._connections: dict[ClientSession, BridgeConnection] = {}
        self._sockets: set[BridgeConnection] = set()
        self._visitors: set[BridgeConnection] = set()  # on paths of the site
        tokens, self._site = tokens or Tokens.of_clients(token, operator_token), site
        self._admission = ClientAdmission(
            tokens, self.options, self._sockets, self._refusals, site, secure=cert is not None
        )
        self._numbers = itertools.count(1)
        self._thread = LoopThread("bam-bridge-server")
        self._workers = Workers(_HANDLER_THREADS, "bam-bridge-handler")
        self._reader = Workers(1, "bam-bridge-reader")  # one: more would slow the network thread down
        self._timer: asyncio.TimerHandle | None = None
        self._stop: asyncio.Event | None = None

    @property
    def url(self) -> str:
        """Address for clients."""
        return Address(self.host, self.port, self._cert is not None, "").url

    @property
    def clients(self) -> int:
        """Number of clients."""
        return len(self._connections) + len(self._visitors)

    @property
    def programs(self) -> int:
        """Number of these that speak rosbridge, and not to the site."""
        return len(self._connections)

    @property
    def held(self) -> tuple[int, int]:
        """Size of unfinished messages in all sockets, and of messages that wait for slow clients [bytes]."""
        sockets = list(self._sockets)
        return sum(one.unfinished for one in sockets), sum(one.outbox.size for one in sockets)

    def start(self) -> "BridgeServer":
        """Listen; returns when clients can connect. `InvalidValue` if port, address or certificate cannot be used."""
        if self._thread.was_started:
            raise InvalidValue("A server starts once; make a new one.")
        tls = tls_context(self._cert, self._key) if self._cert else None
        try:
            self._thread.start(functools.partial(self._main, tls))
        except (OSError, UnicodeError) as error:
            raise listening_error(self.host, self.port, error) from error
        return self

    def close(self) -> None:
        """Close all connections (1001), and end the threads. Idempotent."""
        if self._stop is not None:
            self._thread.post(self._stop.set)
        self._thread.join()
        self._workers.close()
        self._reader.close()

    def __enter__(self) -> "BridgeServer":
        return self.start()

    def __exit__(self, *error: object) -> None:
        self.close()

    # ---- the Bus; see there

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Declare that `topic` of type `kind` will be published."""
        self._do(lambda: self._bridge.advertise(topic, kind, latch=latch))

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages, each with its topic, in this order."""
        publications = [self._bridge.publication(topic, message) for topic, message in messages]

        def publish() -> None:
            for publication in publications:
                self._bridge.publish(publication, time.monotonic())

        if self._thread.is_current:  # in a listener, whose caller flushes afterwards
            publish()
        elif not self._post(publish):
            raise LinkLost(f"{messages[0][0]}: the server is not running; nothing was sent.")

    def subscribe(self, topic: str, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener` in the network thread for each message. Returns a function that ends the subscription."""
        unsubscribe = self._do(lambda: self._bridge.subscribe(topic, kind, listener))
        return lambda: self._do(unsubscribe)

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` of type `kind`, even when the handler fails."""
        self._do(lambda: self._bridge.serve(service, kind, handler))

    def act(self, action: Action) -> bool:
        """Offer an action, whose functions run in the network thread."""
        self._do(lambda: self._bridge.act(action, self._post))
        return True

    def reserve(self, topic: str, check: Callable[[Caller], None]) -> None:
        """Refuse what a client publishes on `topic` if `check` raises a `BamEnvsError`, in the network thread."""
        self._do(lambda: self._bridge.reserve(topic, check))

    def on_leave(self, callback: Callable[[Caller], None]) -> None:
        """Call `callback` in the network thread when a client's connection ends."""
        self._do(lambda: self._bridge.on_leave(callback))

    # ---- the network thread: connections

    async def _main(self, tls: ssl.SSLContext | None, listening: Future[None]) -> None:
        self._stop, options = asyncio.Event(), self.options
        extra: dict[str, Any] = {"ssl": tls, "ssl_handshake_timeout": options.open_timeout} if tls else {}
        # `websockets` does not know that its handlers get the connections that this makes.
        extra["create_connection"] = functools.partial(
            BridgeConnection, sockets=self._sockets, limits=options, refusals=self._refusals
        )
        extra["process_request"], handler = self._admission.check, cast(Any, self._serve)
        server = await serve(
            handler,
            self.host,
            self.port,
            compression=None,
            open_timeout=options.open_timeout,
            ping_interval=options.ping_interval,
            ping_timeout=options.ping_timeout,
            close_timeout=options.close_timeout,
            max_size=options.max_incoming,
            max_queue=_QUEUE,
            logger=_quiet,
            **extra,
        )
        self.port = server.sockets[0].getsockname()[1]
        listening.set_result(None)
        expelling = asyncio.create_task(self._expel())
        await self._stop.wait()
        expelling.cancel()
        await self._shut(server)

    async def _expel(self) -> None:
        """Close connections whose token was taken out of its file."""
        while True:
            await asyncio.sleep(_EXPEL)
            await asyncio.gather(*self._admission.revoked(list(self._sockets)), return_exceptions=True)

    async def _shut(self, server: Server) -> None:
        # asyncio leaks a socket that was accepted just before its server is closed. So accept no more, let accepted
        # sockets become connections in the next turns of the loop, and then close.
        for listener in server.sockets:
            asyncio.get_running_loop().remove_reader(listener.fileno())
        await _turns()
        for opening in [one for one in self._sockets if one.state is State.CONNECTING]:
            opening.transport.abort()
        server.close(reason="the server is closing")
        await _turns()
        # Not server.wait_closed(), which also waits for sockets in the middle of their TLS handshake.
        goodbyes = [asyncio.create_task(connection.wait_closed()) for connection in self._sockets]
        if goodbyes:
            await asyncio.wait(goodbyes, timeout=2 * self.options.close_timeout + 1.0)
        for connection in list(self._sockets):
            connection.transport.abort()
        await _turns()

    async def _serve(self, connection: BridgeConnection) -> None:
        try:
            await self._admission.greet(connection)
        except ConnectionClosed:
            return
        if connection.role is None:
            return
        host, port = connection.remote_address[:2]
        caller = Caller(
            f"client{next(self._numbers)}",
            f"{host}:{port}",
            operator=connection.role == "administer" and bool(connection.secret),
            role=connection.role,
            full=connection.full,
            silence=lambda: time.monotonic() - connection.heard,
        )
        if self._site is not None and (handler := self._site.socket(connection.request)) is not None:
            await self._visit(connection, caller, handler)
            return
        session = self._bridge.open(caller)
        self._connections[session] = connection
        try:
            await self._read(connection, session)
        except ConnectionClosed as end:
            _logger.debug("%s at %s left: %s", caller.name, caller.address, end)
        finally:
            del self._connections[session]
            self._bridge.lost(session)
            self._flush()

    async def _visit(self, connection: BridgeConnection, caller: Caller, serve: SiteHandler) -> None:
        self._visitors.add(connection)
        connection.limit_messages(_OF_THE_SITE)
        try:
            await serve(connection, caller)
        except ConnectionClosed as end:
            _logger.debug("%s at %s left: %s", caller.name, caller.address, end)
        except Exception:  # `websockets` closes the connection, and its logger is quiet
            _logger.exception("the connection of %s failed", caller.address)
            raise
        finally:
            self._visitors.discard(connection)

    async def _read(self, connection: BridgeConnection, session: ClientSession) -> None:
        for number in itertools.count(1):
            text: bytes | str | None = await connection.next_frame()
            joined = False
            while text is not None:
                incoming = await self._incoming(text, joined)
                text, joined = self._bridge.take(session, incoming, time.monotonic()), True
            self._flush()
            # Frames that have arrived already are read without a pause; other clients must not wait for all of them.
            if number % _TURN == 0:
                await asyncio.sleep(0)

    async def _incoming(self, text: bytes | str, joined: bool) -> Incoming | ProtocolError:
        """The content of a frame; a long one is decoded in another thread while its client's next frame waits."""
        if len(text) <= _SHORT:
            return self._bridge.read(text, joined=joined)
        done: asyncio.Future[Incoming | ProtocolError] = asyncio.get_running_loop().create_future()

        def read() -> None:
            incoming = self._bridge.read(text, joined=joined)
            self._thread.post(lambda: None if done.cancelled() else done.set_result(incoming))

        self._reader.submit(read)
        return await done

    # ---- the network thread: executing the events of the protocol

    def _flush(self) -> None:
        written: dict[BridgeConnection, None] = {}
        for event in self._bridge.events():
            if isinstance(event, Send):
                connection = self._connections.get(event.session)
                if connection is not None:
                    connection.put(event.packet, event.keep)
                    written[connection] = None
            else:
                self._workers.submit(functools.partial(self._work, event))
        for connection in written:
            connection.flush()
        deadline = self._bridge.next_deadline
        if deadline == math.inf or (self._timer is not None and self._timer.when() <= deadline):
            return
        if self._timer is not None:
            self._timer.cancel()
        # The loop's clock is the monotonic one.
        self._timer = asyncio.get_running_loop().call_at(deadline, self._tick)

    def _work(self, call: Call) -> None:
        packet = self._bridge.services.packed_answer(call)
        self._post(lambda: self._bridge.services.finish(call, packet))

    def _tick(self) -> None:
        self._timer = None
        self._bridge.tick(time.monotonic())
        self._flush()

    def _post(self, work: Callable[[], object]) -> bool:
        """Run `work` and its events in the network thread; False if that is not running."""
        return self._thread.post(lambda: self._then_flush(work))

    def _do(self, work: Callable[[], T]) -> T:
        """As `_post`, and return the result. While the server is not running, `work` runs in the calling thread."""
        return self._thread.do(lambda: self._then_flush(work))

    def _then_flush(self, work: Callable[[], T]) -> T:
        result = work()
        if self._thread.is_current:
            self._flush()
        return result


async def _turns() -> None:
    """Let ready callbacks, and those that they schedule, run."""
    for _ in range(5):
        await asyncio.sleep(0)
