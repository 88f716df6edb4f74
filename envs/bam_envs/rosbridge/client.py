"""A link to a rosbridge server, for a robot: a message is sent now or not at all.

Each link has a thread that connects, reads and writes, so that a slow listener of one link never delays the halt on
another. After a cut the server gets the declarations (topics, subscriptions, services) again, but no older message.
"""

import asyncio
import itertools
import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoResultYet
from contextlib import suppress
from functools import partial
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NoServer, ProtocolError, RemoteError
from bam_envs.core.wording import brief
from bam_envs.ros.interfaces import normal_name
from bam_envs.ros.messages import write_stamp
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Handler, Message, answer, tell
from bam_envs.rosbridge.client_connection import Connection, bare_reason
from bam_envs.rosbridge.declarations import Declarations
from bam_envs.rosbridge.encoding import dump_json
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.threads import LoopThread, Workers

_LOG = logging.getLogger(__name__)
_FIRST_DELAY, _LONGEST_DELAY = 0.05, 2.0
_LEAST_TRY = 0.1  # least time for one attempt: a server that refuses is told apart, also on a busy computer [s]
_STEADY = 2.0  # a connection that lasted this long [s] is reopened without a longer delay
_SEND_WITHIN = 0.5
_LEAVE_WITHIN = 3.0
_STATUSES_KEPT = 20
_MOST_ANSWERING = 64  # requests of the server that are answered at the same time; more of them are refused
_ENDED = "Timeout exceeded"  # servers' error for a call that they end; rosbridge from 2.2 on does so after 5 s
_NEARLY = 0.9


class RosbridgeLink(Declarations):
    """A client of a rosbridge server; a `Bus` that can also call services.

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
        self.endpoint = Endpoint(endpoint) if isinstance(endpoint, str) else endpoint
        super().__init__(self.endpoint.address.url)
        self.namespace, self.name = self.endpoint.address.namespace, name
        self.statuses: deque[dict[str, Any]] = deque(maxlen=_STATUSES_KEPT)
        """The last `status` messages of the server."""
        self.epoch = 0
        """Number of the connection; 0 before the first."""
        self.ros: str | None = None
        """``"ros1"`` or ``"ros2"``, by the server's spelling of a time; None until it has sent one."""
        self.clock_offset: float | None = None
        """The local wall clock minus the server's [s]; None if the server does not report its time."""
        if not lost_after > 0.0:
            raise InvalidValue(f"lost_after: expected a time above 0 s, found {lost_after!r}.")
        self._lost_after, self._max_message = lost_after, max_message
        self._up: Connection | None = None
        self._why = "not connected yet: call connect()"
        self._down_callbacks: list[Callable[[LinkLost], None]] = []
        self._status_callbacks: list[Callable[[Mapping[str, Any]], None]] = []
        self._numbers = itertools.count(1)
        self._workers = Workers(_MOST_ANSWERING, f"bam-link-{name}-service")
        self._may_answer = threading.Semaphore(_MOST_ANSWERING)
        self._thread = LoopThread(f"bam-link-{name}", self.url)
        self._main_task: asyncio.Task[None] | None = None
        self._connecting, self._changed = threading.Lock(), threading.Condition()
        self._closed = False

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

    def close(self) -> None:
        """Close the link for good, with a closing handshake. Idempotent; does nothing in a forked child."""
        if self._pid != os.getpid():
            return
        self._closed = True
        with self._changed:
            self._changed.notify_all()
        self._thread.post(self._stop)
        if not self._thread.is_current:
            if not self._thread.join(_LEAVE_WITHIN):
                _LOG.warning("%s: not closed properly: a listener holds up the network thread.", self.url)
            self._workers.close()

    @property
    def is_up(self) -> bool:
        """Whether a message can be sent now."""
        return (connection := self._up) is not None and connection.is_open

    def wait_up(self, timeout: float) -> None:
        """Wait until the link is up; `LinkLost` if it is not after `timeout` [s]."""
        self._require_waiting_allowed("wait_up")
        with self._changed:
            self._changed.wait_for(lambda: self._up is not None or self._closed, timeout)
        if self._up is None:
            raise LinkLost(f"{self.url}: the link is down ({self._why}).")

    def on_down(self, callback: Callable[[LinkLost], None]) -> None:
        """Call `callback` with the reason on the network thread each time the link drops, but not when it is closed."""
        self._down_callbacks.append(callback)

    def stamp(self, t: float) -> dict[str, int]:
        """A time [s] in the server's spelling; in that of ROS 2 if it is not known."""
        return write_stamp(t, ros1=self.ros == "ros1")

    # ---- topics and services

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages now or not at all: on return they are written to the socket. See `Bus`."""
        connection = self._require_up()
        for topic, _ in messages:
            if topic not in self._topics:
                raise InvalidValue(f"Topic {topic!r} was not advertised: call advertise(topic, type) before publish.")
        frames = [dump_json({"op": "publish", "topic": one, "msg": msg}) for one, msg in messages]
        self._thread.do(lambda: connection.send(*frames), _SEND_WITHIN)

    def publish_soon(self, topic: str, message: Message) -> None:
        """Hand a report to the network thread without waiting for it; dropped if it cannot be sent at once."""
        connection, frame = self._up, dump_json({"op": "publish", "topic": topic, "msg": message})

        def send() -> None:
            with suppress(LinkLost):
                if connection is not None:
                    connection.send(frame)

        self._thread.post(send)

    def on_status(self, callback: Callable[[Mapping[str, Any]], None]) -> None:
        """Call `callback` with each `status` message; on the network thread."""
        self._status_callbacks.append(callback)

    def call(self, service: str, kind: str, args: Message, timeout: float) -> dict[str, Any]:
        """Call `service` of type `kind`, and wait for its response.

        With an empty `kind` the server looks the type up, and reports a missing service at once; with a type it waits
        for the service to appear.

        Raises:
            LinkLost: The link is down, and nothing was sent. Or it drops while waiting, or no answer comes in `timeout`
                [s] or in the time that the server itself allows: the service may have been executed.
            RemoteError: The service, or the server, refused or failed.
            InvalidValue: `args` are not plain and finite, `timeout` is no time, or this is the network thread.
        """
        self._require_waiting_allowed("call")
        if not isinstance(timeout, int | float) or not 0.0 < timeout < float("inf"):
            raise InvalidValue(f"{service}: timeout is {timeout!r}: expected a time above 0 s, for a call can be lost.")
        connection, identity, begun = self._require_up(), f"call:{next(self._numbers)}", time.monotonic()
        # Servers that know the field `timeout` use it instead of a shorter default.
        request = {"op": "call_service", "id": identity, "service": service, "args": args, "timeout": timeout}
        frame = dump_json({**request, "type": normal_name(kind)} if kind else request)
        response: Future[dict[str, Any]] = Future()
        try:
            self._thread.do(lambda: connection.ask(identity, frame, response), timeout)
            reply = response.result(begun + timeout - time.monotonic())
        except NoResultYet as error:
            self._thread.post(lambda: connection.forget(identity))
            raise LinkLost(f"{self.url}: {service} did not answer in {timeout:g} s; it may still be at it.") from error
        return self._response(service, reply, time.monotonic() - begun, timeout)

    def _response(self, service: str, reply: Mapping[str, Any], waited: float, timeout: float) -> dict[str, Any]:
        values = reply.get("values")
        if reply.get("result") is False and _ENDED in str(values):
            if waited > _NEARLY * timeout:
                raise LinkLost(f"{self.url}: {service} did not answer in {timeout:g} s; it may still be at it.")
            raise LinkLost(
                f"{self.url}: the server gave up {service} after {waited:.1f} s, and {timeout:g} s were asked for; it "
                f"may still be at it. Start the bridge with default_call_service_timeout:={timeout:.1f}, or use a pair "
                'of topics instead of the service (channel="topics").'
            )
        if reply.get("result") is False:
            raise RemoteError(values if isinstance(values, str) and values else f"{service} failed: {values!r}.")
        if values is None:
            return {}
        if not isinstance(values, dict):
            raise ProtocolError(f"{service}: expected a response with fields, found {values!r}.")
        return values

    # ---- used by any thread

    def _announce(self, request: dict[str, Any]) -> None:
        # Within the lock of the declarations, so that they reach the network thread in order.
        self._thread.post(partial(self._tell, request, dump_json(request)))

    def _require_up(self) -> Connection:
        self._require_process()
        connection = self._up
        if connection is None:
            raise LinkLost(f"{self.url}: the link is down ({self._why}). Nothing was sent, and nothing is kept.")
        return connection

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost(f"{self.url}: this link was closed. Make a new one.")

    def _require_waiting_allowed(self, method: str) -> None:
        self._require_process()
        if self._thread.is_current:
            raise InvalidValue(
                f"{method}() waits for the network, and a listener called it on the network thread. "
                "Hand the work to another thread."
            )

    # ---- the network thread: connections, one after the other

    async def _main(self, ready: Future[None]) -> None:
        self._main_task = asyncio.current_task()
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
        timeout = self.endpoint.connect_timeout
        deadline, delay = time.monotonic() + timeout, _FIRST_DELAY
        while True:
            self._require_open()
            try:
                return await self._open(max(deadline - time.monotonic(), _LEAST_TRY))
            except NoServer as error:
                # A server that refuses connections may still be starting; other errors persist.
                if not isinstance(error.__cause__, ConnectionRefusedError) or time.monotonic() + delay >= deadline:
                    raise
            await asyncio.sleep(delay)
            delay = min(2 * delay, _LONGEST_DELAY)

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
        connection = Connection(
            self.endpoint, self.epoch + 1, self._max_message, self._lost_after, self._take, self._note_end
        )
        await connection.open(timeout)
        try:
            for request in self._greeting():
                frame = connection.announced[request["id"]] = dump_json(request)
                connection.send(frame)
            self._require_open()
        except BamEnvsError as error:
            connection.drop(error)
            raise
        self.epoch, self.ros, self.clock_offset = connection.epoch, connection.ros or self.ros, connection.clock_offset
        with self._changed:
            self._up = connection
            self._changed.notify_all()
        return connection

    def _note_end(self, connection: Connection, error: BamEnvsError) -> None:
        if connection is self._up:
            self._up, self._why = None, bare_reason(self.url, error)
            for callback in self._down_callbacks:
                tell(callback, LinkLost(str(error)))

    async def _leave(self) -> None:
        self._why = "it was closed; make a new one"
        connection, self._up = self._up, None
        if connection is not None:
            try:
                connection.send(*map(dump_json, self._farewell()))
            except LinkLost as error:
                _LOG.debug("no farewell: %s", error)
            await connection.close()

    def _tell(self, request: Mapping[str, Any], frame: str) -> None:
        connection, identity = self._up, request["id"]
        if connection is None or connection.announced.get(identity) == frame:
            return
        connection.announced[identity] = frame
        try:
            connection.send(frame)
        except LinkLost as error:
            _LOG.warning("%s was not declared: %s", identity, error)

    # ---- the network thread: receiving

    def _take(self, connection: Connection, message: dict[str, Any]) -> None:
        operation = message.get("op")
        if operation == "publish":
            topic, content = message.get("topic"), message.get("msg")
            if not isinstance(topic, str) or not isinstance(content, Mapping):
                raise ProtocolError(f"a published message has topic {topic!r} and msg {brief(content)}")
            header = content.get("header") if self.ros is None else None
            stamp = header.get("stamp") if isinstance(header, Mapping) else None
            if isinstance(stamp, Mapping):
                self.ros = "ros2" if "sec" in stamp else "ros1" if "secs" in stamp else None
            self._deliver(topic, content)
        elif operation == "call_service":
            self._answer(connection, message)
        elif operation == "status":
            self.statuses.append(message)
            for callback in self._status_callbacks:
                tell(callback, message)
        else:
            connection.pass_over(f"a message with op {operation!r:.40}")

    def _answer(self, connection: Connection, request: dict[str, Any]) -> None:
        """Answer a request of the server in a worker thread, so that the network thread waits for no handler."""
        service = request.get("service")
        response = {"op": "service_response", "service": service, "id": request.get("id")}
        handler = self._services.get(str(service), (None, None))[1]
        if handler is None:
            refusal = f"Service {service} is not served here"
        elif self._may_answer.acquire(blocking=False):
            self._workers.submit(partial(self._run_handler, connection, handler, request, response))
            return
        else:
            refusal = f"{_MOST_ANSWERING} requests are being answered already"
        connection.send(dump_json({**response, "values": refusal, "result": False}))

    def _run_handler(
        self, connection: Connection, handler: Handler, request: dict[str, Any], response: dict[str, Any]
    ) -> None:
        args, service = request.get("args"), str(response["service"])
        fields = args if isinstance(args, Mapping) else {}
        try:
            values = answer(lambda *arguments: dict(handler(*arguments)), fields, UNKNOWN_CALLER, service)
            frame = dump_json({**response, "values": values, "result": True})
        except BamEnvsError as error:
            frame = dump_json({**response, "values": str(error), "result": False})
        self._may_answer.release()
        try:
            self._thread.do(lambda: connection.send(frame), _SEND_WITHIN)
        except BamEnvsError as error:
            _LOG.warning("%s: the response could not be sent: %s", service, error)
