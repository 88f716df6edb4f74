"""The declarations of a client: its topics, subscriptions and services, and the listeners of each topic.

Each new connection repeats all of them. The server gets one subscription per topic for any number of listeners: it
sends one stream per topic, and ends it at the first unsubscribe.
"""

import logging
import os
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from bam_envs.core.errors import InvalidValue
from bam_envs.ros.interfaces import normal_name
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Bus, Handler, Listener, deliver

_LOG = logging.getLogger(__name__)


class Declarations(Bus):
    """The half of a link that declares; a subclass sends it to the server of `url`. Usable in one process only."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._pid, self._lock = os.getpid(), threading.Lock()
        self._topics: dict[str, dict[str, Any]] = {}
        self._subscriptions: dict[str, tuple[dict[str, Any], dict[object, Listener]]] = {}
        self._services: dict[str, tuple[dict[str, Any], Handler]] = {}

    @property
    def declared(self) -> dict[str, tuple[str, str]]:
        """Id of each declaration, which a `status` may name -> topic or service, and type."""
        return {one["id"]: (one.get("topic") or one["service"], one["type"]) for one in self._greeting()}

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Declare that `topic` of type `kind` will be published."""
        self._require_process()
        request = {"op": "advertise", "id": f"advertise:{topic}", "topic": topic, "type": normal_name(kind)}
        with self._lock:
            known = self._topics.setdefault(topic, {**request, "latch": latch})
            self._announce(_same_type(known, topic, kind))

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
        self._require_process()
        wish = {"throttle_rate": throttle_ms, "queue_length": queue_length}
        for name, value in (("throttle_ms", throttle_ms), ("queue_length", queue_length)):
            # The Python servers silently drop a subscription for anything but an integer.
            if type(value) is not int or value < 0:
                raise InvalidValue(f"{name} is {value!r}: expected a whole number, 0 or more.")
        request = {"op": "subscribe", "id": f"subscribe:{topic}", "topic": topic, "type": normal_name(kind), **wish}
        if compression != "none":
            request["compression"] = compression
        key = object()
        with self._lock:
            known, listeners = self._subscriptions.get(topic, (request, {}))
            request = {**_same_type(known, topic, kind), **{name: min(known[name], wish[name]) for name in wish}}
            # A new table each time, so that delivery can iterate over the old one without a lock.
            self._subscriptions[topic] = request, {**listeners, key: listener}
            self._announce(request)
        return partial(self._unsubscribe, topic, key)

    def _unsubscribe(self, topic: str, key: object) -> None:
        self._require_process()
        with self._lock:
            request, listeners = self._subscriptions.get(topic, ({}, {}))
            if key not in listeners:
                return
            left = {other: listener for other, listener in listeners.items() if other is not key}
            self._subscriptions[topic] = request, left
            if not left:
                del self._subscriptions[topic]
                self._announce({"op": "unsubscribe", "id": f"subscribe:{topic}", "topic": topic})

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` of type `kind` through the server."""
        self._require_process()
        request = {"op": "advertise_service", "id": f"serve:{service}", "service": service, "type": normal_name(kind)}
        with self._lock:
            if service in self._services:
                raise InvalidValue(f"Service {service!r} is served by this client already.")
            self._services[service] = (request, handler)
            self._announce(request)

    def _announce(self, request: dict[str, Any]) -> None:
        """Send `request` if there is a connection; the greeting of the next one contains it anyway."""
        raise NotImplementedError

    def _require_process(self) -> None:
        if self._pid != os.getpid():
            raise InvalidValue(
                f"This link to {self.url} was made in process {self._pid}, and this is a fork of it. "
                "Make and connect a link in the child itself."
            )

    def _deliver(self, topic: str, message: Mapping[str, Any]) -> None:
        """Give a message to each listener of `topic`."""
        for listener in self._subscriptions.get(topic, ({}, {}))[1].values():
            if refusal := deliver(listener, message, UNKNOWN_CALLER, topic):
                _LOG.info("a message was refused: %s", refusal)

    def _greeting(self) -> list[dict[str, Any]]:
        """All declarations, for a new connection."""
        with self._lock:
            services = (request for request, _ in self._services.values())
            return [*self._topics.values(), *services, *(request for request, _ in self._subscriptions.values())]

    def _farewell(self) -> list[dict[str, Any]]:
        """The withdrawals to send before leaving: some servers keep a service whose client has left."""
        with self._lock:
            return [
                *({"op": "unadvertise_service", "service": service} for service in self._services),
                *({"op": "unadvertise", "id": f"advertise:{topic}", "topic": topic} for topic in self._topics),
            ]


def _same_type(known: dict[str, Any], topic: str, kind: str) -> dict[str, Any]:
    if known["type"] != normal_name(kind):
        raise InvalidValue(f"Topic {topic!r} is of type {known['type']} here already; found {kind!r}.")
    return known
