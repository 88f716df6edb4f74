"""The Bus protocol: topics and services, over any carrier.

Three carry them: the embedded server inside its own process (`bam_envs.rosbridge.server`), a link to a rosbridge
server (`bam_envs.rosbridge.client`), and a native ROS 2 node (`bam_envs.remote.ros2_node`). Messages are plain
dicts in the JSON form of rosbridge; a byte array is `bytes`. Types are written ``pkg/Type``; ``pkg/msg/Type`` and
``pkg/srv/Type`` are taken too.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeVar

from bam_envs.core.errors import LinkLost, RemoteError
from bam_envs.core.wording import listed

T = TypeVar("T")
Message = Mapping[str, Any]
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Caller:
    """Who published a message, or calls a service."""

    name: str
    """Unique among the callers of a bus; the same as long as the connection lives."""
    address: str = ""
    """Where it is, for people."""
    session: str = ""
    """The session whose signature the message bears; empty without one."""
    operator: bool = False
    """Whether it showed the operator's token."""
    silence: Callable[[], float] = field(default=lambda: math.inf, compare=False)
    """How long its connection has given no sign of life [s]; infinite where the bus does not know."""

    @property
    def shown(self) -> str:
        """What others are told of it."""
        return self.address or self.name or (f"session {self.session}" if self.session else "a sender without a name")

    @property
    def client(self) -> str:
        """Who it is to a `CommandLease`: its session, else its connection."""
        return f"session {self.session}" if self.session else self.shown


UNKNOWN_CALLER = Caller("")
"""Where the bus does not say who it is (a real ROS graph)."""

Listener = Callable[[Message, Caller], None]
"""Takes a message. Must return at once: it runs in the thread of the network. Never raises."""
Handler = Callable[[Message, Caller], Message]
"""Answers a service request with its response; runs in a thread of its own. What it raises of our errors is the text of
a failed response."""


def tell(callback: Callable[[T], object], news: T) -> None:
    """Call foreign code; an exception in it is logged, and others are told all the same."""
    try:
        callback(news)
    except Exception:
        _log.exception("a callback failed")


def refusal_of(topic: str, reason: object) -> str:
    """Why a listener refuses a message on `topic`, with its name once: listeners may say it, without a namespace."""
    head, colon, rest = str(reason).partition(": ")
    named = bool(colon) and head.startswith("/") and topic.endswith(head)
    return f"{topic}: {rest if named else reason}"


class Bus(Protocol):
    """Publish, subscribe, serve, from any thread. A subclass inherits `publish`, and an `on_leave` that never calls."""

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Say that `topic` of type `kind` will be published; a latched one repeats its last message to newcomers."""

    def publish(self, topic: str, message: Message) -> None:
        """Send `message` now, or not at all. Raises as `publish_all`."""
        self.publish_all([(topic, message)])

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages now, each on its topic, in this order: all of them or none.

        Raises:
            LinkLost: There is no link; nothing is sent later.
            InvalidValue: A number in one is not finite or not plain, or a topic was not advertised.
        """

    def subscribe(self, topic: str, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener` for each message, until what is returned is called. Other listeners are not touched."""

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` of type `kind`: always, also when the handler fails."""

    def on_leave(self, callback: Callable[[Caller], None]) -> None:
        """Call `callback` when a caller's connection ends, where the bus knows; elsewhere never."""
        return

    def close(self) -> None:
        """Stop serving and release everything. Idempotent."""


def namespaces_with(link: Any, kind: Literal["topics", "services"], name: str) -> str:
    """A sentence about the namespaces in which the server of `link` has the topic or service `name`, if it has any."""
    try:
        names = link.call(f"/rosapi/{kind}", f"rosapi/{kind.capitalize()}", {}, 1.0).get(kind) or []
    except (RemoteError, LinkLost):
        return ""
    found = [one.removesuffix(name) for one in names if isinstance(one, str) and one.endswith(name)]
    if not found:
        return ""
    addresses = listed(f"ws://HOST:PORT{namespace}" for namespace in sorted(found))
    return f" It is there at another address: {addresses}."
