"""A link to a rosbridge server, for a robot: what is sent is sent now or not at all.

roslibpy's asyncio transport carries it; the connecting, the waiting and the sending are its own. While the link is
down, publishing and calling raise at once, and nothing is kept: after a cut the server gets the declarations (topics,
subscriptions, services) again and no message from before it.

Longer than other modules, because everything that a user of a link can do is in one place.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoResultYet
from functools import partial
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, ProtocolError, RemoteError
from bam_envs.ros.interfaces import describe, normal_name
from bam_envs.rosbridge.bus import Caller, Handler, Listener, Message
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.json_frames import encode_frame
from bam_envs.rosbridge.link.answering import Answerer
from bam_envs.rosbridge.link.callbacks import tell_all
from bam_envs.rosbridge.link.connection import Connection
from bam_envs.rosbridge.link.declarations import Declarations
from bam_envs.rosbridge.link.dialing import Dial
from bam_envs.rosbridge.link.handover import Parcel
from bam_envs.rosbridge.link.heartbeat import Heartbeat
from bam_envs.rosbridge.link.keeper import Keeper

_LOG = logging.getLogger(__name__)
_SEND_WITHIN = 0.5
_STATUSES_KEPT = 20
_ENDED = "Timeout exceeded"
"""What servers say of a call that they end; rosbridge from 2.2 on does after 5 s, if it is told no other time."""
_NEARLY = 0.9


class RosbridgeLink:
    """A client of a rosbridge server; a `Bus` that can also call services.

    Args:
        endpoint: The server; the text of a URL stands for `Endpoint(url)`.
        name: What it is for; in the names of threads.
        max_message: Largest message, either way [bytes].
        clock: Our wall clock [s].

    Raises:
        InvalidValue: The address or the token is none.
    """

    def __init__(
        self,
        endpoint: Endpoint | str,
        *,
        name: str = "control",
        max_message: int = 64 * 1024 * 1024,
        clock: Callable[[], float] = time.time,
    ) -> None:
        endpoint = Endpoint(endpoint) if isinstance(endpoint, str) else endpoint
        address = endpoint.address
        self.url, self.namespace, self.name = address.url, address.namespace, name
        self.statuses: deque[dict[str, Any]] = deque(maxlen=_STATUSES_KEPT)
        """The last `status` messages of the server."""
        self._declarations, self._answerer = Declarations(), Answerer(f"bam-link-{name}-service")
        self._keeper = Keeper(
            Dial(endpoint, max_message), endpoint.connect_timeout, clock, self._declarations, self._take
        )
        self._numbers = itertools.count(1)
        # A declaration and its announcement must reach the network thread in the same order.
        self._declaring = threading.Lock()
        self._status_callbacks: list[Callable[[Mapping[str, Any]], None]] = []
        self._seen_ros: str | None = None

    # ---- connecting

    def connect(self) -> None:
        """Connect, and see that the server answers. Afterwards the link comes back by itself whenever it drops.

        Raises:
            NoServer: There is none, or not one that can be used; the text says which of many reasons.
            InvalidValue: The CA file cannot be read, or Twisted is active in this process.
            LinkLost: The link was closed.
        """
        self._require_waiting_allowed("connect")
        self._keeper.connect()

    def close(self) -> None:
        """Leave, with a closing handshake, and stay away. As often as one likes; a forked child leaves it alone."""
        self._keeper.close()
        if threading.get_ident() != self._keeper.thread:
            self._answerer.join(1.0)

    @property
    def is_up(self) -> bool:
        """Whether a message can be sent now."""
        return self._keeper.up is not None

    @property
    def epoch(self) -> int:
        """Counts the connections; 0 before the first."""
        return self._keeper.epoch

    def wait_up(self, timeout: float) -> None:
        """Wait until the link is up.

        Raises:
            LinkLost: It is not, after `timeout` [s].
        """
        self._require_waiting_allowed("wait_up")
        if not self._keeper.wait_up(timeout):
            raise LinkLost(f"{self.url}: the link is down ({self._keeper.why}).")

    def on_down(self, callback: Callable[[LinkLost], None]) -> None:
        """Call `callback` with the reason each time the link drops, but not when it is closed.

        On the network thread: it must return at once.
        """
        self._keeper.down_callbacks.append(callback)

    def heartbeat(self, every: float = 0.2, lost_after: float = 1.0) -> None:
        """From now on ask the server for a sign of life, and drop the link when it gives none for `lost_after` [s].

        The question is a WebSocket ping: a bridge answers it also while it holds everything else back for a call.

        Raises:
            InvalidValue: Not 0 < every < lost_after.
        """
        self._keeper.watch(Heartbeat(every, lost_after))

    @property
    def last_answer_age(self) -> float:
        """How long the server has said nothing [s]; infinite while the link is down."""
        connection = self._keeper.up
        return float("inf") if connection is None else time.monotonic() - connection.answered_at

    # ---- the server's time

    @property
    def ros(self) -> str | None:
        """``"ros1"`` or ``"ros2"``, by how the server spells a time; None until it has shown that."""
        return self._keeper.server.ros or self._seen_ros

    @property
    def clock_offset(self) -> float | None:
        """Our wall clock minus the server's [s]; None where it tells no time."""
        return self._keeper.server.offset

    def stamp(self, t: float) -> dict[str, int]:
        """A time [s] as the server spells it; as ROS 2 does where that is not known."""
        seconds, nanoseconds = divmod(round(t * 1e9), 1_000_000_000)
        if self.ros == "ros1":
            return {"secs": seconds, "nsecs": nanoseconds}
        return {"sec": seconds, "nanosec": nanoseconds}

    # ---- topics

    @property
    def declared(self) -> dict[str, tuple[str, str]]:
        """What was declared: id of the declaration, which a `status` may name -> topic or service, and type."""
        return {one["id"]: (one.get("topic") or one["service"], one["type"]) for one in self._declarations.greeting()}

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Say that `topic` of type `kind` will be published."""
        self._keeper.require_process()
        with self._declaring:
            self._keeper.tell(self._declarations.advertise(topic, kind, latch))

    def unadvertise(self, topic: str) -> None:
        """Say that `topic` will be published no more."""
        self._keeper.require_process()
        with self._declaring:
            self._keeper.tell(self._declarations.unadvertise(topic))

    def publish(self, topic: str, message: Message) -> None:
        """Send `message` now, or not at all: on return it has been written to the socket.

        Raises:
            LinkLost: It was not sent, and is not kept.
            InvalidValue: A number in it is not finite or not plain, or the topic was not advertised.
        """
        self.publish_all([(topic, message)])

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages, each on its topic, in this order and with one hand-over to the network thread.

        Raises:
            LinkLost: As `publish`; not all of them were sent.
            InvalidValue: As `publish`; nothing was sent.
        """
        self._hand_over(self._require_up(), *map(Parcel, self._frames(messages)))

    def begin_publishing(
        self, messages: Sequence[tuple[str, Message]], refused: Callable[[BamEnvsError], None]
    ) -> Callable[[], None]:
        """As `publish_all`, without waiting until they are written: for who waits for an answer to them anyway.

        Args:
            messages: As of `publish_all`.
            refused: Hears on the network thread why a message was not sent.

        Returns:
            What takes back whatever has not been sent when it is called. To be called before they may come too late.

        Raises:
            LinkLost: The link is down; nothing was sent.
            InvalidValue: As `publish`; nothing was sent.
        """
        connection, frames = self._require_up(), self._frames(messages)
        parcels = [Parcel(frame, refused=refused) for frame in frames]
        self._keeper.post(connection.post, *parcels)

        def take_back() -> None:
            for parcel in parcels:
                parcel.take()

        return take_back

    def _frames(self, messages: Sequence[tuple[str, Message]]) -> list[bytes]:
        for topic, _ in messages:
            self._declarations.require_advertised(topic)
        return [encode_frame({"op": "publish", "topic": topic, "msg": message}) for topic, message in messages]

    def subscribe(
        self, topic: str, kind: str, listener: Listener, *, throttle_ms: int = 0, queue_length: int = 0
    ) -> Callable[[], None]:
        """Call `listener` for each message on the network thread, until what is returned is called.

        Args:
            topic: Its name.
            kind: Its type.
            listener: Must return at once. Other listeners of the topic are not touched by it, nor by its leaving.
            throttle_ms: Least time between two messages [ms]; the server drops the others.
            queue_length: How many messages the server keeps while they are throttled, the newest; 0: none.

        Raises:
            InvalidValue: The topic has another type here already, or a number is not whole.
        """
        self._keeper.require_process()
        with self._declaring:
            key, request = self._declarations.subscribe(topic, kind, listener, throttle_ms, queue_length)
            self._keeper.tell(request)
        return partial(self._unsubscribe, topic, key)

    def _unsubscribe(self, topic: str, key: object) -> None:
        with self._declaring:
            request = self._declarations.unsubscribe(topic, key)
            if request is not None:
                self._keeper.tell(request)

    def on_status(self, callback: Callable[[Mapping[str, Any]], None]) -> None:
        """Call `callback` with each `status` message; on the network thread."""
        self._status_callbacks.append(callback)

    # ---- services

    def call(self, service: str, kind: str, args: Message, timeout: float) -> dict[str, Any]:
        """Ask `service` of type `kind`, and wait for its response.

        With an empty `kind` the server looks the type up. For a service that may not exist: a server that is told the
        type waits for the service to appear, and one that is not says at once that there is none.

        Raises:
            LinkLost: The link is down, drops while waiting, or no answer comes in `timeout` [s], or in the time that
                the server itself allows. In the first case nothing was sent; in the others what was asked may have been
                done.
            RemoteError: The service, or the server, refused or failed.
            ProtocolError: The response is none.
            InvalidValue: A number in `args` is not finite or not plain; `timeout` is none; or called on the network
                thread.
        """
        self._require_waiting_allowed("call")
        if not isinstance(timeout, int | float) or not 0.0 < timeout < float("inf"):
            raise InvalidValue(f"{service}: timeout is {timeout!r}: expected a time above 0 s, for a call can be lost.")
        connection, identity, answer = self._require_up(), f"call:{next(self._numbers)}", Future[dict[str, Any]]()
        request = {"op": "call_service", "id": identity, "service": service, "args": args}
        if kind:
            request["type"] = normal_name(kind)
        # Servers that know the field end the call then, and not after a shorter time of their own.
        self._hand_over(connection, Parcel(encode_frame({**request, "timeout": timeout}), identity, answer))
        begun = time.monotonic()
        try:
            said = answer.result(timeout)
            if said.get("result") is False and _ENDED in str(said.get("values")):
                raise self._ended(service, time.monotonic() - begun, timeout)
            return _response(service, said)
        except NoResultYet as error:
            self._keeper.post(connection.forget, identity)
            raise LinkLost(f"{self.url}: {service} did not answer in {timeout:g} s; it may still be at it.") from error

    def _ended(self, service: str, waited: float, timeout: float) -> LinkLost:
        """The server gave a call up after `waited` [s]."""
        if waited > _NEARLY * timeout:
            return LinkLost(f"{self.url}: {service} did not answer in {timeout:g} s; it may still be at it.")
        return LinkLost(
            f"{self.url}: the server gave up {service} after {waited:.1f} s, and {timeout:g} s were asked for; it may "
            f"still be at it. Start the bridge with default_call_service_timeout:={timeout:.1f}, or use a pair of "
            'topics instead of the service (channel="topics").'
        )

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` of type `kind` through the server: always, also when the handler fails."""
        self._keeper.require_process()
        with self._declaring:
            self._keeper.tell(self._declarations.serve(service, kind, handler))

    def on_leave(self, callback: Callable[[Caller], None]) -> None:
        """A rosbridge server does not say who sends a message, nor who left: `callback` is never called."""

    # ---- sending

    def _hand_over(self, connection: Connection, *parcels: Parcel) -> None:
        if threading.get_ident() == self._keeper.thread:
            connection.send(*(parcel.frame for parcel in parcels))
            return
        self._keeper.post(connection.post, *parcels)
        try:
            for parcel in reversed(parcels):  # the last one first: the others are written before it
                parcel.wait(_SEND_WITHIN)
        finally:
            for parcel in parcels:
                parcel.take()  # what was not sent by now is not to be sent any more

    def _require_up(self) -> Connection:
        self._keeper.require_process()
        connection = self._keeper.up
        if connection is None:
            raise LinkLost(f"{self.url}: the link is down ({self._keeper.why}). Nothing was sent, and nothing is kept.")
        return connection

    def _require_waiting_allowed(self, method: str) -> None:
        self._keeper.require_process()
        if threading.get_ident() == self._keeper.thread:
            raise InvalidValue(
                f"{method}() waits for the network, and a listener called it on the network thread. "
                "Hand the work to another thread."
            )

    # ---- receiving, on the network thread

    def _take(self, connection: Connection, message: dict[str, Any]) -> None:
        operation = message.get("op")
        if operation == "publish":
            self._take_published(message)
        elif operation == "call_service":
            handler = self._declarations.handler(str(message.get("service")))
            self._answerer.answer(message, handler, partial(self._respond, connection))
        elif operation == "status":
            self._take_status(message)
        else:
            connection.pass_over(f"a message with op {operation!r:.40}")

    def _take_published(self, message: dict[str, Any]) -> None:
        topic, content = message.get("topic"), message.get("msg")
        if not isinstance(topic, str) or not isinstance(content, Mapping):
            raise ProtocolError(f"a published message has topic {topic!r} and msg {describe(content)}")
        if self.ros is None:
            self._seen_ros = _ros_of(content)
        self._declarations.deliver(topic, content)

    def _take_status(self, status: dict[str, Any]) -> None:
        self.statuses.append(status)
        tell_all(self._status_callbacks, status)

    def _respond(self, connection: Connection, response: dict[str, Any]) -> None:
        self._hand_over(connection, Parcel(encode_frame(response)))


def _response(service: str, answer: Mapping[str, Any]) -> dict[str, Any]:
    values = answer.get("values")
    if answer.get("result") is False:
        raise RemoteError(values if isinstance(values, str) and values else f"{service} failed: {values!r}.")
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ProtocolError(f"{service}: expected a response with fields, found {values!r}.")
    return values


def _ros_of(message: Mapping[str, Any]) -> str | None:
    header = message.get("header")
    stamp = header.get("stamp") if isinstance(header, Mapping) else None
    if not isinstance(stamp, Mapping):
        return None
    return "ros2" if "sec" in stamp else "ros1" if "secs" in stamp else None
