"""What a client has declared: its topics, subscriptions and services, and the listeners of each topic.

Kept here over every connection, because each new one must be told all of it again. One subscription per topic goes to
the server, whatever the number of listeners: a server sends one stream per topic, and ends it at the first unsubscribe.
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
    kind: str
    throttle_ms: int
    queue_length: int
    listeners: dict[object, Listener] = field(default_factory=dict)


class Declarations:
    """The tables of one client; any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._topics: dict[str, tuple[str, bool]] = {}
        self._subscriptions: dict[str, _Subscription] = {}
        self._services: dict[str, tuple[str, Handler]] = {}

    # ---- declaring: each returns what to tell the server

    def advertise(self, topic: str, kind: str, latch: bool) -> dict[str, Any]:
        """`topic` will be published."""
        with self._lock:
            known = self._topics.setdefault(topic, (normal_name(kind), latch))
            _require_same("topic", topic, known[0], kind)
            return _advertise(topic, *known)

    def unadvertise(self, topic: str) -> dict[str, Any]:
        """`topic` will be published no more."""
        with self._lock:
            self._topics.pop(topic, None)
        return {"op": "unadvertise", "id": f"advertise:{topic}", "topic": topic}

    def require_advertised(self, topic: str) -> None:
        """Raise `InvalidValue` unless `topic` may be published."""
        if topic not in self._topics:
            raise InvalidValue(f"Topic {topic!r} was not advertised: call advertise(topic, type) before publish.")

    def subscribe(
        self, topic: str, kind: str, listener: Listener, throttle_ms: int, queue_length: int
    ) -> tuple[object, dict[str, Any]]:
        """`listener` wants `topic`. Returns a key to remove it by, too.

        The lowest throttle of all listeners of a topic counts, for the server sends one stream.
        """
        _require_whole("throttle_ms", throttle_ms)
        _require_whole("queue_length", queue_length)
        key = object()
        with self._lock:
            entry = self._subscriptions.get(topic)
            if entry is None:
                entry = self._subscriptions[topic] = _Subscription(normal_name(kind), throttle_ms, queue_length)
            _require_same("topic", topic, entry.kind, kind)
            entry.throttle_ms = min(entry.throttle_ms, throttle_ms)
            entry.queue_length = min(entry.queue_length, queue_length)
            # A new table each time, so that the fan-out can walk over the old one without a lock.
            entry.listeners = {**entry.listeners, key: listener}
            return key, _subscribe(topic, entry)

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
        with self._lock:
            if service in self._services:
                raise InvalidValue(f"Service {service!r} is served by this client already.")
            self._services[service] = (normal_name(kind), handler)
            return _serve(service, self._services[service][0])

    # ---- using

    def handler(self, service: str) -> Handler | None:
        """Who answers `service`."""
        found = self._services.get(service)
        return None if found is None else found[1]

    def deliver(self, topic: str, message: Mapping[str, Any]) -> None:
        """Give a message to each listener of `topic`. What one of them raises is logged and harms no other."""
        entry = self._subscriptions.get(topic)
        for listener in () if entry is None else entry.listeners.values():
            _give(topic, message, listener)

    def greeting(self) -> list[dict[str, Any]]:
        """Everything, for a server that knows nothing yet."""
        with self._lock:
            return [
                *(_advertise(topic, kind, latch) for topic, (kind, latch) in self._topics.items()),
                *(_serve(service, kind) for service, (kind, _) in self._services.items()),
                *(_subscribe(topic, entry) for topic, entry in self._subscriptions.items()),
            ]

    def farewell(self) -> list[dict[str, Any]]:
        """What to take back before leaving: some servers keep a service that nobody answers any more."""
        with self._lock:
            return [
                *({"op": "unadvertise_service", "service": service} for service in self._services),
                *({"op": "unadvertise", "id": f"advertise:{topic}", "topic": topic} for topic in self._topics),
            ]


def _give(topic: str, message: Mapping[str, Any], listener: Listener) -> None:
    try:
        listener(message, UNKNOWN_CALLER)
    except BamEnvsError as error:
        _LOG.info("a message was refused: %s", refusal_of(topic, error))
    except Exception:  # a listener is foreign code, and the others must hear the message all the same
        _LOG.exception("%s: a listener failed", topic)


def _advertise(topic: str, kind: str, latch: bool) -> dict[str, Any]:
    return {"op": "advertise", "id": f"advertise:{topic}", "topic": topic, "type": kind, "latch": latch}


def _serve(service: str, kind: str) -> dict[str, Any]:
    return {"op": "advertise_service", "id": f"serve:{service}", "service": service, "type": kind}


def _subscribe(topic: str, entry: _Subscription) -> dict[str, Any]:
    return {
        "op": "subscribe",
        "id": f"subscribe:{topic}",
        "topic": topic,
        "type": entry.kind,
        "throttle_rate": entry.throttle_ms,
        "queue_length": entry.queue_length,
    }


def _require_same(what: str, name: str, known: str, kind: str) -> None:
    if known != normal_name(kind):
        raise InvalidValue(f"{what.capitalize()} {name!r} is of type {known} here already; found {kind!r}.")


def _require_whole(name: str, value: object) -> None:
    # The Python servers drop a subscription without a word for anything but an integer.
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise InvalidValue(f"{name} is {value!r}: expected a whole number, 0 or more.")
