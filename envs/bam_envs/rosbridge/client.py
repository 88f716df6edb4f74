"""A link to a rosbridge server, for a robot: a `roslibpy.Ros` that sends a message now or not at all.

Each link has a thread that connects, reads and writes, so that a slow listener of one link never delays the halt on
another. After a cut the server gets the declarations (topics, subscriptions, services) again, but no older message.
`roslibpy.Topic`, `Service` and `ActionClient` work on a link as on every `Ros`.
"""

import asyncio
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from typing import Any

from roslibpy import Feedback, GoalStatus, Result, Ros, ServiceResponse

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NoServer
from bam_envs.rosbridge.bus import Message, tell
from bam_envs.rosbridge.client_connection import Connection, LinkFactory, open_connection
from bam_envs.rosbridge.encoding import dump_json
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.ros_bus import SEND_WITHIN, Reply, RosBus, bare_reason
from bam_envs.rosbridge.threads import LoopThread

_LOG = logging.getLogger(__name__)
_FIRST_DELAY, _LONGEST_DELAY = 0.05, 2.0
_LEAST_TRY = 0.1  # least time for one attempt: a server that refuses is told apart, also on a busy computer [s]
_STEADY = 2.0  # a connection that lasted this long [s] is reopened without a longer delay
_LEAVE_WITHIN = 3.0
_DECLARE = ("advertise", "subscribe", "advertise_service")
_EVENTS = frozenset(("ready", "close", "closing", "error", "new_listener"))  # names that are roslibpy's own
_WITHDRAW = ("unadvertise", "unsubscribe", "unadvertise_service")


class RosbridgeLink(RosBus, Ros):  # type: ignore[misc]
    """A client of a rosbridge server; a `Bus` that can also call services, and a `roslibpy.Ros`.

    Args:
        endpoint: The server; a URL stands for `Endpoint(url)`.
        name: Its purpose, for the names of its threads.
        lost_after: The link drops when the server answers no WebSocket ping for this time [s]. Infinite: only when the
            network reports it.
        max_message: Largest message, in either direction [bytes].
    """

    def __init__(
        self,
        endpoint: Endpoint | str,
        *,
        name: str = "control",
        lost_after: float = math.inf,
        max_message: int = 64 * 1024 * 1024,
    ) -> None:
        # Not that of `Ros`, which connects at once, and keeps what is sent before.
        self.endpoint = Endpoint(endpoint) if isinstance(endpoint, str) else endpoint
        address = self.endpoint.address
        super().__init__(address.url, address.namespace, name)
        self.factory, self.is_connecting = LinkFactory(), False
        if not lost_after > 0.0:
            raise InvalidValue(f"lost_after: expected a time above 0 s, found {lost_after!r}.")
        self._lost_after, self._max_message = lost_after, max_message
        self._main_task: asyncio.Task[None] | None = None
        self._connecting = threading.Lock()

    # ---- connecting

    def connect(self) -> None:
        """Connect, and check that the server answers. Afterwards the link reconnects by itself whenever it drops.

        Raises:
            NoServer: There is no usable server; the text gives the reason.
            LinkLost: The link was closed, or dropped and is not back yet.
        """
        self._require_waiting_allowed("connect")
        with self._connecting:
            self._require_open()
            if self._thread.was_started:
                self.wait_up(self.endpoint.connect_timeout)
                return
            try:
                self._thread.start(self._main)
            except BaseException:  # even Ctrl-C: a connection that opened later would have no owner
                self._thread.post(self._stop)
                self._thread = LoopThread(f"bam-link-{self.name}", self.url)
                raise

    def run(self, timeout: float | None = None) -> None:
        """Connect, as `roslibpy.Ros` calls it; `timeout` is the endpoint's."""
        self.connect()

    def close(self, timeout: float = _LEAVE_WITHIN) -> None:
        """Close the link for good, with a closing handshake. Idempotent; does nothing in a forked child."""
        if self._pid != os.getpid():
            return
        self._closed = True
        with self._changed:
            self._changed.notify_all()
        self._thread.post(self._stop)
        if not self._thread.is_current:
            if not self._thread.join(timeout):
                _LOG.warning("%s: not closed properly: a listener holds up the network thread.", self.url)
            self._workers.close()

    terminate = close

    @property
    def is_up(self) -> bool:
        """Whether a message can be sent now."""
        return (connection := self._up) is not None and connection.can_send

    # ---- what roslibpy's Topic, Service and ActionClient call

    @property
    def id_counter(self) -> int:
        """A number for the id of an operation, each time another one."""
        return next(self._numbers)

    def send_on_ready(self, message: Message) -> None:
        """Send an operation now or not at all; a declaration is kept, and repeated after a cut."""
        request = dict(message)
        if request["op"] not in _DECLARE + _WITHDRAW:
            self._thread.do(partial(self._send, self._require_up(), dump_json(request)), SEND_WITHIN)
            return
        self._require_process()
        identity = request.setdefault("id", f"serve:{request.get('service')}")
        with self._lock:
            if request["op"] in _DECLARE:
                self._declared[identity] = request
            else:
                self._declared.pop(identity, None)
            self._announce(request)

    def call_async_service(
        self, message: Message, callback: Callable[[Any], Any] | None, errback: Callable[[Any], Any] | None
    ) -> None:
        """Call a service now or not at all; a cut is an error of the call."""

        def took(reply: Reply) -> None:
            failed = isinstance(reply, BamEnvsError) or reply.get("result") is False
            values = str(reply) if isinstance(reply, BamEnvsError) else reply.get("values")
            if (back := errback if failed else callback) is not None:
                back(values if failed else ServiceResponse(values))

        self._thread.do(self._asking(self._require_up(), dict(message), took)[0], SEND_WITHIN)

    def call_async_action(
        self,
        message: Message,
        resultback: Callable[[Any], Any],
        feedback: Callable[[Any], Any],
        errback: Callable[[Any], Any],
    ) -> None:
        """Send a goal now or not at all; a cut is an error of the goal, whose action may go on."""

        def took(reply: Reply) -> None:
            if isinstance(reply, BamEnvsError):
                errback({"status": GoalStatus.UNKNOWN, "values": str(reply)})
                return
            values = reply.get("values", {})
            status = reply.get("status", values.get("status") if isinstance(values, Mapping) else None)
            result = {"status": GoalStatus(status or 0), "values": values}
            (errback(result) if reply.get("result") is False else resultback(Result(result)))

        request, news = dict(message), lambda values: feedback(Feedback(values))
        self._thread.do(self._asking(self._require_up(), request, took, news)[0], SEND_WITHIN)

    def blocking_call_from_thread(self, callback: Callable[[Any], Any], timeout: float | None) -> Any:
        """Run a request on the network thread and wait for its result; `LinkLost` if the link is down."""
        self._require_waiting_allowed("call")
        self._require_up()
        return super().blocking_call_from_thread(callback, timeout)

    # ---- used by any thread

    def _send(self, connection: Connection, *frames: str) -> None:
        connection.send(*frames)

    def _asking(
        self,
        connection: Connection,
        request: Message,
        took: Callable[[Reply], None],
        news: Callable[[Any], Any] | None = None,
    ) -> tuple[Callable[[], None], Callable[[], object]]:
        identity, frame = str(request["id"]), dump_json(request)
        ask = partial(connection.ask, identity, frame, took, news)
        return ask, partial(self._thread.post, partial(connection.forget, identity))

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost(f"{self.url}: this link was closed. Make a new one.")

    # ---- the network thread: connections, one after the other

    async def _main(self, ready: Future[None]) -> None:
        self._main_task, self.factory.manager.loop = asyncio.current_task(), asyncio.get_running_loop()
        try:
            connection = await self._first()
            ready.set_result(None)
            await self._stay_connected(connection)
        except asyncio.CancelledError:  # by `_stop`; not in `finally`, which would also run in a forked child
            if not ready.done():
                ready.set_exception(LinkLost(f"{self.url}: this link was closed. Make a new one."))
            await self._leave()

    def _stop(self) -> None:
        task, self._main_task = self._main_task, None  # once: a second cancellation would interrupt `_leave`
        if task is not None:
            task.cancel()

    async def _first(self) -> Connection:
        left = max(self.endpoint.connect_timeout, _LEAST_TRY)
        deadline, delay = time.monotonic() + left, _FIRST_DELAY
        while True:
            self._require_open()
            try:
                return await self._open(left)
            except NoServer as error:
                # A server that refuses connections may still be starting; other errors persist.
                if not isinstance(error.__cause__, ConnectionRefusedError) or time.monotonic() + delay >= deadline:
                    raise
            await asyncio.sleep(delay)
            delay, left = min(2 * delay, _LONGEST_DELAY), max(deadline - time.monotonic(), _LEAST_TRY)

    async def _stay_connected(self, connection: Connection) -> None:
        delay = _FIRST_DELAY
        while True:
            since = time.monotonic()
            await connection.ended.wait()
            # A connection that repeatedly breaks at once is reopened after longer and longer delays.
            if time.monotonic() - since > _STEADY:
                delay = _FIRST_DELAY
            while connection.error is not None:
                await asyncio.sleep(delay)
                delay = min(2 * delay, _LONGEST_DELAY)
                try:
                    connection = await self._open(self.endpoint.connect_timeout)
                except BamEnvsError as error:
                    self._why = bare_reason(self.url, error)
                except Exception as error:  # the link must keep trying
                    _LOG.exception("%s: connecting failed", self.url)
                    self._why = f"{type(error).__name__}: {error}"

    async def _open(self, timeout: float) -> Connection:
        deadline, hooks = time.monotonic() + timeout, (self.epoch + 1, self._take, self._note_end)
        connection = await open_connection(self.endpoint, timeout, self._max_message, *hooks)
        try:
            await connection.probe(deadline - time.monotonic(), timeout)
            connection.watch(self._lost_after)
            self._require_open()
            # All of them before `_up`, so that nothing is published before it is advertised.
            self.epoch, self.ros = connection.epoch, connection.ros or self.ros
            self.clock_offset = connection.clock_offset
            self._begin(connection)
        except BaseException as error:
            connection.drop(error if isinstance(error, BamEnvsError) else LinkLost(f"{self.url}: no answer."))
            raise
        self.factory.connection = connection
        tell(partial(self.factory.emit, "ready"), connection)
        return connection

    def _note_end(self, connection: Connection, error: BamEnvsError) -> None:
        if connection is self._up:
            self.factory.connection = None
            self._note_down(error)
            tell(partial(self.factory.emit, "close"), connection)

    async def _leave(self) -> None:
        self._why = "it was closed; make a new one"
        connection, self._up = self._up, None
        self.factory.connection = None
        if connection is not None:
            try:
                connection.send(*self._farewell("advertise", "advertise_service"))
            except LinkLost as error:
                _LOG.debug("no farewell: %s", error)
            await connection.close()

    # ---- the network thread: receiving

    def _take(self, connection: Connection, message: dict[str, Any]) -> None:
        operation = message.get("op")
        if operation == "publish":
            self._take_published(message.get("topic"), message.get("msg"))
            self._emit(message["topic"], message["msg"])
        elif operation == "call_service":
            service = str(message.get("service"))
            if service in self._handlers or not self._emit(service, message):
                self._answer(connection, message)
        elif operation == "status":
            self.statuses.append(message)
            for callback in self._status_callbacks:
                tell(callback, message)
        else:
            connection.pass_over(f"a message with op {operation!r:.40}")

    def _emit(self, name: str, news: Mapping[str, Any]) -> bool:
        """Give it to a `roslibpy.Topic` or `Service` of that name; whether there is one."""
        if heard := name in self.factory.heard - _EVENTS:  # others would be kept as names of events
            tell(partial(self.factory.emit, name), news)
        return heard
