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
from contextlib import suppress
from functools import partial
from typing import Any

from roslibpy import Ros

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NoServer, ProtocolError, RemoteError
from bam_envs.rosbridge.bus import Message, tell
from bam_envs.rosbridge.client_connection import Connection, LinkFactory, open_connection
from bam_envs.rosbridge.encoding import dump_json
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.ros_bus import SEND_WITHIN, RosBus, bare_reason
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
        self.factory, self.is_connecting = LinkFactory(self._use), False
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

    is_connected = is_up

    # ---- what roslibpy's Topic, Service and ActionClient call

    @property
    def id_counter(self) -> int:
        """A number for the id of an operation, each time another one."""
        return next(self._numbers)

    def send_on_ready(self, message: Message) -> None:
        """Send an operation now or not at all; a declaration is kept, and repeated after a cut."""
        request = dict(message)
        if request["op"] not in _DECLARE + _WITHDRAW:
            frame = dump_json(request)
            self._use(lambda connection: connection.send(frame))
            return
        self._require_process()
        identity = request.setdefault("id", f"serve:{request.get('service')}")
        with self._lock:
            if request["op"] in _DECLARE:
                self._declared[identity] = request
            else:
                self._declared.pop(identity, None)
            self._announce(request)

    def on_ready(self, callback: Callable[[], object], run_in_thread: bool = True) -> None:
        """Call `callback` now, or when there is a connection."""
        call = partial(self.call_in_thread, callback) if run_in_thread else callback
        if self.is_up:
            call()
        else:
            self.factory.once("ready", lambda _: call())

    def blocking_call_from_thread(self, callback: Callable[[Any], Any], timeout: float | None) -> Any:
        """Run a request on the network thread and wait for its result; `LinkLost` if the link is down."""
        self._require_waiting_allowed("call")
        self._require_up()
        return super().blocking_call_from_thread(callback, timeout)

    # ---- used by any thread

    def do_surely(self, work: Callable[[], object]) -> None:
        """Call `work` on the network thread, where it sends what may not be given up: a halt.

        `LinkLost` if the link is down, or if the thread is held up, as on a busy computer: then it is called later.
        """
        self._require_up()
        self._thread.do(work, SEND_WITHIN, surely=True)

    def _use(self, callback: Callable[[Connection], object]) -> None:
        """Call `callback` with the connection on the network thread, now or not at all."""
        self._thread.do(partial(callback, self._require_up()), SEND_WITHIN)

    def _send(self, connection: Connection, *frames: str) -> None:
        connection.send(*frames)

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost(f"{self.url}: this link was closed. Make a new one.")

    # ---- the network thread: connections, one after the other

    async def _main(self, ready: Future[None]) -> None:
        self._main_task, self.factory.manager.loop = asyncio.current_task(), asyncio.get_running_loop()
        with suppress(asyncio.CancelledError):  # by `_stop`; not `finally`, which would also run in a forked child
            await self._stay_connected(ready)
        if not ready.done():
            ready.set_exception(LinkLost(f"{self.url}: this link was closed. Make a new one."))
        await self._leave()

    def _stop(self) -> None:
        task, self._main_task = self._main_task, None  # once: a second cancellation would interrupt `_leave`
        if task is not None:
            task.cancel()

    async def _stay_connected(self, ready: Future[None]) -> None:
        """Connect, and after each loss again. An error before the first connection ends it."""
        delay, first_by = _FIRST_DELAY, time.monotonic() + self.endpoint.connect_timeout
        while not self._closed and self._main_task is asyncio.current_task():
            left = self.endpoint.connect_timeout if ready.done() else first_by - time.monotonic()
            try:
                connection = await self._open(max(left, _LEAST_TRY))
            except Exception as error:  # the link must keep trying
                # A server that refuses connections may still be starting; other errors persist.
                waits = isinstance(error.__cause__, ConnectionRefusedError) and time.monotonic() + delay < first_by
                if not ready.done() and not waits:
                    raise
                if not isinstance(error, BamEnvsError):
                    _LOG.exception("%s: connecting failed", self.url)
                self._why = bare_reason(self.url, error)
            else:
                since = time.monotonic()
                if not ready.done():
                    ready.set_result(None)
                await connection.watch(self._lost_after)
                # A connection that repeatedly breaks at once is reopened after longer and longer delays.
                if time.monotonic() - since > _STEADY:
                    delay = _FIRST_DELAY
            await asyncio.sleep(delay)
            delay = min(2 * delay, _LONGEST_DELAY)

    async def _open(self, timeout: float) -> Connection:
        deadline = time.monotonic() + timeout
        connection = await open_connection(self.endpoint, timeout, self._max_message, self._take, self._note_end)
        try:
            await self._probe(connection, deadline - time.monotonic(), timeout)
            self._require_open()
            # All declarations before `_up`, so that nothing is published before it is advertised.
            self._begin(connection)
        except BaseException as error:
            connection.drop(error if isinstance(error, BamEnvsError) else LinkLost(f"{self.url}: no answer."))
            raise
        tell(partial(self.factory.emit, "ready"), connection)
        return connection

    async def _probe(self, connection: Connection, within: float, timeout: float) -> None:
        """Check `within` [s] that a rosbridge server answers; `NoServer` has the `timeout` of the whole attempt [s]."""
        try:
            await asyncio.wait_for(self._learn_clock(connection), within)
        except asyncio.TimeoutError as error:
            raise NoServer(
                self.url,
                f"a WebSocket server that answers no rosbridge request within {timeout:.1f} s. "
                "Is it a rosbridge server, and is its ROS node alive?",
            ) from error
        except NoServer:
            raise
        except (LinkLost, ProtocolError) as error:
            reason = bare_reason(self.url, error).removeprefix("the link dropped: ")
            raise NoServer(self.url, f"closed the connection before it answered a request: {reason}.") from error

    def _note_end(self, connection: Connection, error: BamEnvsError) -> None:
        was_up = self._up is not None
        self._note_down(error)
        if was_up:
            tell(partial(self.factory.emit, "close"), connection)

    async def _leave(self) -> None:
        self._why = "it was closed; make a new one"
        connection, self._up = self._up, None
        if connection is not None:
            try:
                connection.send(*self._farewell("advertise", "advertise_service"))
            except LinkLost as error:
                _LOG.debug("no farewell: %s", error)
            await connection.close()

    # ---- the network thread: receiving

    def _take(self, connection: Connection, message: dict[str, Any]) -> None:
        operation, identity = message.get("op"), str(message.get("id"))
        if operation == "publish":
            self._thread.listens = True
            try:
                self._take_published(message.get("topic"), message.get("msg"))
                self._emit(message["topic"], message["msg"])
            finally:
                self._thread.listens = False
        elif operation in ("service_response", "action_result"):
            self._answered(identity, message)
        elif operation == "call_service" and self._up is None and identity in self._waiting:
            # Only before the server is known: later, one of its requests may have an id like ours.
            echo = NoServer(self.url, "an echo server: it sends back what it is sent. Is it the right port?")
            self._answered(identity, echo)
        elif operation == "call_service":
            service = str(message.get("service"))
            if service in self._handlers or not self._emit(service, message):
                self._answer(connection, message)
        elif operation == "status":
            # A server may answer a request that it cannot read only with a status of the same id.
            if message.get("level") == "error":
                self._answered(identity, RemoteError(str(message.get("msg"))))
            self.statuses.append(message)
            for callback in self._status_callbacks:
                tell(callback, message)
        elif operation != "action_feedback":
            connection.pass_over(f"a message with op {operation!r:.40}")

    def _emit(self, name: str, news: Mapping[str, Any]) -> bool:
        """Give it to a `roslibpy.Topic` or `Service` of that name; whether there is one."""
        if heard := name in self.factory.heard - _EVENTS:  # others would be kept as names of events
            tell(partial(self.factory.emit, name), news)
        return heard
