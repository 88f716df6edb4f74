"""What a client has declared: its topics, subscriptions and services, and the listeners of each topic.

It outlives connections, because each new one must be told all of it again. The server gets one subscription per topic,
whatever the number of listeners: it sends one stream per topic, and ends it at the first unsubscribe.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue
from bam_envs.ros.interfaces import normal_name
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Handler, Listener, refusal_of

_LOG = logging.getLogger(__name__)


@dataclass
class _Subscription:
    request: dict[str, Any]
    listeners: dict[object, Listener] = field(default_factory=dict)


class Declarations:
    """The tables of one client; any thread. What declares something returns what to tell the server."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._topics: dict[str, dict[str, Any]] = {}
        self._subscriptions: dict[str, _Subscription] = {}
        self._services: dict[str, tuple[dict[str, Any], Handler]] = {}

    def advertise(self, topic: str, kind: str, latch: bool) -> dict[str, Any]:
        """`topic` will be published."""
        request = {"op": "advertise", "id": f"advertise:{topic}", "topic": topic, "type": normal_name(kind)}
        with self._lock:
            return _same_type(self._topics.setdefault(topic, {**request, "latch": latch}), topic, kind)

    def require_advertised(self, topic: str) -> None:
        """Raise `InvalidValue` unless `topic` may be published."""
        if topic not in self._topics:
            raise InvalidValue(f"Topic {topic!r} was not advertised: call advertise(topic, type) before publish.")

    def subscribe(
        self, topic: str, kind: str, listener: Listener, throttle_ms: int, queue_length: int, compression: str
    ) -> tuple[object, dict[str, Any]]:
        """`listener` wants `topic`; also returns a key to remove it by. The lowest throttle of a topic counts."""
        wish = {"throttle_rate": throttle_ms, "queue_length": queue_length}
        for name, value in (("throttle_ms", throttle_ms), ("queue_length", queue_length)):
            # The Python servers drop a subscription without a word for anything but an integer.
            if type(value) is not int or value < 0:
                raise InvalidValue(f"{name} is {value!r}: expected a whole number, 0 or more.")
        request = {"op": "subscribe", "id": f"subscribe:{topic}", "topic": topic, "type": normal_name(kind), **wish}
        if compression != "none":
            request["compression"] = compression
        key = object()
        with self._lock:
            entry = self._subscriptions.setdefault(topic, _Subscription(request))
            known = _same_type(entry.request, topic, kind)
            entry.request = {**known, **{name: min(known[name], value) for name, value in wish.items()}}
            # A new table each time, so that the fan-out can walk over the old one without a lock.
            entry.listeners = {**entry.listeners, key: listener}
            return key, entry.request

    def unsubscribe(self, topic: str, key: object) -> dict[str, Any] | None:
        """The listener of `key` wants `topic` no more. None if others still do, or it is gone already."""
        with self._lock:
            entry = self._subscriptions.get(topic)
            if entry is None or key not in entry.listeners:
                return None
            entry.listeners = {other: listener for other, listener in entry.listeners.items() if other is not key}
            if entry.listeners:
                return None
            del self._subscriptions[topic]
        return {"op": "unsubscribe", "id": f"subscribe:{topic}", "topic": topic}

    def serve(self, service: str, kind: str, handler: Handler) -> dict[str, Any]:
        """`handler` answers `service`."""
        request = {"op": "advertise_service", "id": f"serve:{service}", "service": service, "type": normal_name(kind)}
        with self._lock:
            if service in self._services:
                raise InvalidValue(f"Service {service!r} is served by this client already.")
            self._services[service] = (request, handler)
        return request

    def handler(self, service: str) -> Handler | None:
        """Who answers `service`."""
        return self._services.get(service, (None, None))[1]

    def deliver(self, topic: str, message: Mapping[str, Any]) -> None:
        """Give a message to each listener of `topic`. What one of them raises is logged, and the others still hear."""
        entry = self._subscriptions.get(topic)
        for listener in () if entry is None else entry.listeners.values():
            try:
                listener(message, UNKNOWN_CALLER)
            except BamEnvsError as error:  # noqa: PERF203 - each listener has its own
                _LOG.info("a message was refused: %s", refusal_of(topic, error))
            except Exception:  # listeners are foreign code
                _LOG.exception("%s: a listener failed", topic)

    def greeting(self) -> list[dict[str, Any]]:
        """Everything, for a server that knows nothing yet."""
        with self._lock:
            services = (request for request, _ in self._services.values())
            return [*self._topics.values(), *services, *(entry.request for entry in self._subscriptions.values())]

    def farewell(self) -> list[dict[str, Any]]:
        """What to take back before leaving: some servers keep a service whose client has left."""
        with self._lock:
            return [
                *({"op": "unadvertise_service", "service": service} for service in self._services),
                *({"op": "unadvertise", "id": f"advertise:{topic}", "topic": topic} for topic in self._topics),
            ]


def _same_type(known: dict[str, Any], topic: str, kind: str) -> dict[str, Any]:
    if known["type"] != normal_name(kind):
        raise InvalidValue(f"Topic {topic!r} is of type {known['type']} here already; found {kind!r}.")
    return known
