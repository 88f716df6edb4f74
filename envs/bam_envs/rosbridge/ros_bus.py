"""Topics and services over a `roslibpy.Ros`: a message is sent now or not at all, a declaration to each connection.

The server gets one subscription per topic for any number of listeners: it sends one stream per topic, and ends it at
the first unsubscribe.
Longer than most files: what is declared, sent and answered shares one lock and one network thread.
"""

import asyncio
import itertools
import logging
import math
import os
import threading
import time
from abc import abstractmethod
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
from bam_envs.rosbridge.actionlib import ActionTopics
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Action, Bus, Handler, Listener, Message, answer, deliver, tell
from bam_envs.rosbridge.encoding import dump_json
from bam_envs.rosbridge.threads import LoopThread, Workers

_LOG = logging.getLogger(__name__)
SEND_WITHIN = 0.5  # longest time until the network thread begins to send a message [s]
_STATUSES_KEPT = 20
_NAMES = {"advertise": ("id", "topic"), "subscribe": ("id", "topic"), "advertise_service": ("service",)}
"""What a withdrawal of each declaration names."""
_MOST_ANSWERING = 64  # requests of the server that are answered at the same time; more of them are refused
_ENDED = "Timeout exceeded"  # servers' error for a call that they end; rosbridge from 2.2 on does so after 5 s
_NEARLY = 0.9
_CLOCK_PROBES = 3
_DEAD_NODE = "context is invalid"  # answer of rosbridge_suite to every request after its node has shut down

Reply = dict[str, Any] | BamEnvsError
"""The response to a request, or why there is none."""


def bare_reason(url: str, error: Exception) -> str:
    """The text of `error` without the address and the full stop, for a text that begins with the address."""
    return str(error).removeprefix(f"{url}: ").rstrip(".")


def _read_clock(values: object) -> tuple[str, float] | None:
    """``"ros1"`` or ``"ros2"``, and the time [s], in a response of ``/rosapi/get_time``; None if it has none."""
    now = values.get("time") if isinstance(values, Mapping) else None
    for ros, seconds, nanoseconds in (("ros2", "sec", "nanosec"), ("ros1", "secs", "nsecs")):
        whole, rest = (now.get(seconds), now.get(nanoseconds)) if isinstance(now, Mapping) else (None, None)
        if isinstance(whole, int) and isinstance(rest, int):
            return ros, whole + rest * 1e-9
    return None


class RosBus(Bus):
    """A `Bus` to the server of `url` that can also call services. Usable in the process that made it.

    A subclass connects it, and writes to the server.
    """

    def __init__(self, url: str, namespace: str, name: str) -> None:
        self.url, self.namespace, self.name = url, namespace, name
        self.statuses: deque[dict[str, Any]] = deque(maxlen=_STATUSES_KEPT)
        """The last `status` messages of the server."""
        self.epoch = 0
        """Number of the connection; 0 before the first."""
        self.ros: str | None = None
        """``"ros1"`` or ``"ros2"``, by the server's spelling of a time; None until it has sent one."""
        self.clock_offset: float | None = None
        """The local wall clock minus the server's [s]; None if the server does not report its time."""
        self._pid, self._lock = os.getpid(), threading.Lock()
        self._declared: dict[str, dict[str, Any]] = {}  # by id
        self._listeners: dict[str, dict[object, Listener]] = {}
        self._handlers: dict[str, Handler] = {}
        self._down_callbacks: list[Callable[[LinkLost], None]] = []
        self._status_callbacks: list[Callable[[Mapping[str, Any]], None]] = []
        self._numbers = itertools.count(1)
        self._thread, self._changed = LoopThread(f"bam-link-{name}", url), threading.Condition()
        self._workers = Workers(_MOST_ANSWERING, f"bam-link-{name}-service")
        self._may_answer = threading.Semaphore(_MOST_ANSWERING)
        self._up: Any = None  # the present connection
        self._waiting: dict[str, Callable[[Reply], None]] = {}  # by id of the request that is not answered
        self._why = "not connected yet: call connect()"  # there is none
        self._closed = False

    # ---- what a subclass provides

    @abstractmethod
    def connect(self) -> None:
        """Connect; see the subclass."""

    @property
    @abstractmethod
    def is_up(self) -> bool:
        """Whether a message can be sent now."""

    @abstractmethod
    def _send(self, connection: Any, *frames: str) -> None:
        """Write frames to `connection` now, all or none; on the network thread."""

    def _ask(self, connection: Any, request: Message, frame: str) -> None:
        """Send a request, whose `frame` is made already; its response goes to `_answered`; on the network thread."""
        self._send(connection, frame)

    # ---- topics

    @property
    def declared(self) -> dict[str, tuple[str, str]]:
        """Id of each declaration, which a `status` may name -> topic or service, and type."""
        return {name: (one.get("topic") or one["service"], one["type"]) for name, one in self._declared.items()}

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Declare that `topic` of type `kind` will be published."""
        self._declare({"op": "advertise", "topic": topic, "type": normal_name(kind), "latch": latch}, kind)

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages now or not at all: on return they are written to the socket. See `Bus`."""
        connection = self._require_up()
        for topic, _ in messages:
            if f"advertise:{topic}" not in self._declared:
                raise InvalidValue(f"Topic {topic!r} was not advertised: call advertise(topic, type) before publish.")
        frames = [dump_json({"op": "publish", "topic": one, "msg": msg}) for one, msg in messages]
        self._thread.do(partial(self._send, connection, *frames), SEND_WITHIN)

    def publish_soon(self, topic: str, message: Message) -> None:
        """Hand a report to the network thread without waiting for it; dropped if it cannot be sent at once."""
        self.send_soon({"op": "publish", "topic": topic, "msg": message})

    def send_soon(self, operation: Message) -> None:
        """As `publish_soon`, for any operation of the protocol."""
        connection, frame = self._up, dump_json(operation)

        def send() -> None:
            with suppress(LinkLost):
                self._send(connection, frame)

        if connection is not None:
            self._thread.post(send)

    def subscribe(
        self,
        topic: str,
        kind: str,
        listener: Listener,
        *,
        throttle_ms: int = 0,
        queue_length: int = 0,
        compression: str = "none",
    ) -> Callable[[], None]:
        """Call `listener` for each message on the network thread. Returns a function that ends the subscription.

        Args:
            topic: Its name.
            kind: Its type, the same for all listeners.
            listener: Must return at once.
            throttle_ms: Least time between two messages [ms], the lowest of all listeners; the server drops the others.
            queue_length: Number of the newest messages that the server keeps while they are throttled; 0: none.
            compression: ``"none"`` for JSON, or ``"cbor"``, seven times as fast for images and large arrays; its typed
                arrays arrive as NumPy arrays, byte arrays as `bytes`.
        """
        wish = {"throttle_rate": throttle_ms, "queue_length": queue_length}
        for name, value in (("throttle_ms", throttle_ms), ("queue_length", queue_length)):
            # The Python servers silently drop a subscription for anything but an integer.
            if type(value) is not int or value < 0:
                raise InvalidValue(f"{name} is {value!r}: expected a whole number, 0 or more.")
        request = {"op": "subscribe", "topic": topic, "type": normal_name(kind), **wish}
        key = object()
        with_compression = request if compression == "none" else {**request, "compression": compression}
        self._declare(with_compression, kind, (key, listener))
        return partial(self._unsubscribe, topic, key)

    def _declare(self, request: dict[str, Any], kind: str, listener: tuple[object, Listener] | None = None) -> None:
        self._require_process()
        topic, identity = request["topic"], f"{request['op']}:{request['topic']}"
        with self._lock:  # also around `_announce`, so that requests reach the network thread in order
            before = self._declared.get(identity)
            known = before or {**request, "id": identity}
            if known["type"] != normal_name(kind):
                raise InvalidValue(f"Topic {topic!r} is of type {known['type']} here already; found {kind!r}.")
            wish = ("throttle_rate", "queue_length") if listener else ()
            self._declared[identity] = known = {**known, **{name: min(known[name], request[name]) for name in wish}}
            if listener:  # a new table each time, so that delivery can iterate over the old one without a lock
                self._listeners[topic] = {**self._listeners.get(topic, {}), listener[0]: listener[1]}
            if known != before:
                self._announce(known)

    def _unsubscribe(self, topic: str, key: object) -> None:
        self._require_process()
        with self._lock:
            listeners = self._listeners.get(topic, {})
            self._listeners[topic] = {other: one for other, one in listeners.items() if other is not key}
            if key in listeners and not self._listeners[topic]:
                identity = f"subscribe:{topic}"
                del self._listeners[topic], self._declared[identity]
                self._announce({"op": "unsubscribe", "id": identity, "topic": topic})

    def _take_published(self, topic: object, content: object) -> None:
        if not isinstance(topic, str) or not isinstance(content, Mapping):
            raise ProtocolError(f"a published message has topic {topic!r} and msg {brief(content)}")
        header = content.get("header") if self.ros is None else None
        stamp = header.get("stamp") if isinstance(header, Mapping) else None
        if isinstance(stamp, Mapping):
            self.ros = "ros2" if "sec" in stamp else "ros1" if "secs" in stamp else None
        for listener in self._listeners.get(topic, {}).values():
            if refusal := deliver(listener, content, UNKNOWN_CALLER, topic):
                _LOG.info("a message was refused: %s", refusal)

    # ---- services

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` of type `kind` through the server."""
        self._require_process()
        request = {"op": "advertise_service", "id": f"serve:{service}", "service": service, "type": normal_name(kind)}
        with self._lock:
            if service in self._handlers:
                raise InvalidValue(f"Service {service!r} is served by this client already.")
            self._handlers[service], self._declared[request["id"]] = handler, request
            self._announce(request)

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
        connection, begun = self._require_up(), time.monotonic()
        # Servers that know the field `timeout` use it instead of a shorter default.
        request: dict[str, Any] = {
            "op": "call_service",
            "id": f"call:{next(self._numbers)}",
            "service": service,
            "args": args,
        }
        request["timeout"] = timeout
        if kind:
            request["type"] = normal_name(kind)
        response: Future[Reply] = Future()
        try:
            self._thread.do(self._asking(connection, request, response.set_result), timeout)
            reply = response.result(begun + timeout - time.monotonic())
        except NoResultYet as error:
            raise LinkLost(f"{self.url}: {service} did not answer in {timeout:g} s; it may still be at it.") from error
        finally:
            self._thread.post(partial(self._waiting.pop, request["id"], None))
        if isinstance(reply, BamEnvsError):
            raise reply
        return self._response(service, reply, time.monotonic() - begun, timeout)

    def ask_soon(self, request: dict[str, Any], took: Callable[[Reply], None]) -> None:
        """Send a goal or a call of a service without waiting, now or not at all.

        Its reply, or why there is none, goes to `took` on the network thread. `LinkLost` if the link is down.
        """
        ask = self._asking(self._require_up(), request, took)

        def send() -> None:
            try:
                ask()
            except BamEnvsError as error:
                tell(took, error)

        self._thread.post(send)

    def _asking(self, connection: Any, request: Message, took: Callable[[Reply], None]) -> Callable[[], None]:
        """A function for the network thread that sends a request; its reply goes to `took`."""
        identity, frame = str(request["id"]), dump_json(request)

        def ask() -> None:
            self._ask(connection, request, frame)
            self._waiting[identity] = took

        return ask

    def _answered(self, identity: str, reply: Reply) -> None:
        if identity in self._waiting:
            tell(self._waiting.pop(identity), reply)

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

    def act(self, action: Action) -> bool:
        """Offer an action over the topics of actionlib through a bridge of ROS 1; False for another one."""
        if self.ros == "ros1":
            ActionTopics(self, action)
        return self.ros == "ros1"

    # ---- the link

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

    def on_status(self, callback: Callable[[Mapping[str, Any]], None]) -> None:
        """Call `callback` with each `status` message; on the network thread."""
        self._status_callbacks.append(callback)

    def stamp(self, t: float) -> dict[str, int]:
        """A time [s] in the server's spelling; in that of ROS 2 if it is not known."""
        return write_stamp(t, ros1=self.ros == "ros1")

    async def _learn_clock(self, connection: Any) -> None:
        """Ask the server for its time, and take its clock and its spelling from the quickest of the answers."""
        best, self.clock_offset = math.inf, None
        for number in range(_CLOCK_PROBES):
            response: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
            # Any answer will do, even that there is no such service: it shows that the server's node works.
            request = {"op": "call_service", "id": f"ready:{number}", "service": "/rosapi/get_time"}
            asked = time.time()
            try:
                self._asking(connection, {**request, "type": "rosapi/GetTime", "args": {}}, response.set_result)()
                reply = await response
            finally:
                self._waiting.pop(request["id"], None)
            trip = time.time() - asked
            if isinstance(reply, BamEnvsError) and not isinstance(reply, RemoteError):
                raise reply
            values = None if isinstance(reply, BamEnvsError) else reply.get("values")
            if isinstance(values, str) and _DEAD_NODE in values:
                raise NoServer(
                    self.url, f"its ROS node has ended and its socket has not ({values}). Restart the bridge."
                )
            if (now := _read_clock(values)) is None:
                return
            if trip < best:
                best, self.ros, self.clock_offset = trip, now[0], asked + trip / 2 - now[1]

    def _announce(self, request: dict[str, Any]) -> None:
        """Send `request`, in the lock, if there is a connection; the next one gets all declarations anyway."""
        connection, frame = self._up, dump_json(request)

        def send() -> None:
            try:
                self._send(connection, frame)
            except LinkLost as error:
                _LOG.info("%s was not declared: %s", request["id"], error)

        if connection is not None:
            self._thread.post(send)

    def _begin(self, connection: Any) -> None:
        """Declare everything to a new connection, and use it from now on; on the network thread."""
        with self._lock:  # what is declared a moment later is sent behind it
            self._send(connection, *map(dump_json, self._declared.values()))
            self.epoch += 1
            self._up = connection
        with self._changed:
            self._changed.notify_all()

    def _farewell(self, *operations: str) -> list[str]:
        """The withdrawals of what was declared, to send before leaving: some servers keep a client's services."""
        gone = (one for one in self._declared.values() if one["op"] in operations)
        return [dump_json({"op": f"un{one['op']}", **{name: one[name] for name in _NAMES[one["op"]]}}) for one in gone]

    def _note_down(self, error: BamEnvsError) -> None:
        if self._up is not None:
            self._up, self._why = None, bare_reason(self.url, error)
            for callback in self._down_callbacks:
                tell(callback, LinkLost(str(error)))
        for identity in list(self._waiting):
            self._answered(identity, error)

    def _require_up(self) -> Any:
        self._require_process()
        connection = self._up
        if connection is None:
            raise LinkLost(f"{self.url}: the link is down ({self._why}). Nothing was sent, and nothing is kept.")
        return connection

    def _require_waiting_allowed(self, method: str) -> None:
        self._require_process()
        if self._thread.is_current:
            raise InvalidValue(
                f"{method}() waits for the network, and a listener called it on the network thread. "
                "Hand the work to another thread."
            )

    def _require_process(self) -> None:
        if self._pid != os.getpid():
            raise InvalidValue(
                f"This link to {self.url} was made in process {self._pid}, and this is a fork of it. "
                "Make and connect a link in the child itself."
            )

    # ---- answering, on the network thread and in workers

    def _answer(self, connection: Any, request: dict[str, Any]) -> None:
        """Answer a request of the server in a worker thread, so that the network thread waits for no handler."""
        service = str(request.get("service"))
        response = {"op": "service_response", "service": request.get("service"), "id": request.get("id")}
        handler = self._handlers.get(service)
        if handler is None:
            refusal = f"Service {service} is not served here"
        elif self._may_answer.acquire(blocking=False):
            self._workers.submit(partial(self._run_handler, connection, handler, request, response))
            return
        else:
            refusal = f"{_MOST_ANSWERING} requests are being answered already"
        self._send(connection, dump_json({**response, "values": refusal, "result": False}))

    def _run_handler(
        self, connection: Any, handler: Handler, request: dict[str, Any], response: dict[str, Any]
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
            self._thread.do(partial(self._send, connection, frame), SEND_WITHIN)
        except BamEnvsError as error:
            _LOG.warning("%s: the response could not be sent: %s", service, error)
