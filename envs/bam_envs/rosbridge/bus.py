"""Topics and services over any carrier: the embedded server, a link to a server, a ROS 2 node.

Messages are plain dicts in the JSON form of rosbridge; a byte array is `bytes`. Types are written ``pkg/Type``;
``pkg/msg/Type`` and ``pkg/srv/Type`` are accepted too.
"""

import logging
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeVar

from bam_envs.core.errors import BamEnvsError, LinkLost, RemoteError
from bam_envs.core.wording import listed
from bam_envs.rosbridge.tokens import Role

T = TypeVar("T")
Message = Mapping[str, Any]
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Caller:
    """The sender of a message, or the caller of a service."""

    name: str  # unique among the callers of a bus
    address: str = ""  # its network address, for people
    session: str = ""  # the session whose signature the message bears; empty without one
    operator: bool = False  # whether it showed a token that administers, and may take command from others
    role: Role = "drive"  # what it may do
    full: str = ""  # why it has no place among the clients, and may do no more than stop a robot; empty if it has one
    silence: Callable[[], float] = field(default=lambda: math.inf, compare=False)
    """Time since the last sign of life of its connection [s]; infinite if the bus does not know."""

    @property
    def shown(self) -> str:
        """The name that other clients see."""
        return self.address or self.name or (f"session {self.session}" if self.session else "a sender without a name")

    @property
    def client(self) -> str:
        """Its name in a `CommandLease`: its session, else its connection."""
        return f"session {self.session}" if self.session else self.shown


UNKNOWN_CALLER = Caller("")  # of a bus that does not report callers (a real ROS graph)

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
"""Ends of a goal, as action_msgs/GoalStatus numbers them."""


class Goal(Protocol):
    """One goal that a caller has sent to an action."""

    values: Message
    """Its content, complete."""
    caller: Caller
    """Its sender."""

    def feedback(self, values: Message) -> None:
        """Tell the caller how far it is. Thread-safe."""

    def end(self, status: int, values: Message) -> None:
        """End it with `SUCCEEDED`, `CANCELED` or `ABORTED`, and the result; only the first end counts. Thread-safe."""


@dataclass(frozen=True)
class Action:
    """An action that this process offers. Its functions must return at once: they run in the network thread."""

    name: str  # with a leading slash
    kind: str  # normal name of its type
    begin: Callable[[Goal], None]
    """Begins a goal, which `Goal.end` ends; the text of a `BamEnvsError` that it raises rejects the goal."""
    cancel: Callable[[Goal], None]
    """Ends a goal whose caller wants that, or left."""


Listener = Callable[[Message, Caller], None]
"""Takes a message. Must return at once: it runs in the network thread."""
Handler = Callable[[Message, Caller], Message]
"""Answers a service request with its response, in a separate thread. The text of a `BamEnvsError` that it raises is
sent as a failed response."""


def tell(callback: Callable[[T], object], news: T) -> None:
    """Call a callback of other code; an exception in it is logged, so that the remaining callbacks run."""
    try:
        callback(news)
    except Exception:
        _log.exception("a callback failed")


def deliver(listener: Listener, message: Message, caller: Caller, topic: str) -> str:
    """Give a listener a message; returns why it refuses it, or an empty text. Other errors are logged."""
    try:
        listener(message, caller)
        return ""
    except BamEnvsError as error:
        head, colon, rest = str(error).partition(": ")
        named = bool(colon) and head.startswith("/") and topic.endswith(head)  # perhaps without a namespace
        return f"{topic}: {rest if named else error}"
    except Exception:
        _log.exception("%s: a listener failed", topic)
        return f"{topic}: The receiver failed; see its log."


def answer(handler: Handler, request: Message, caller: Caller, name: str) -> Message:
    """The response of the handler of `name`; an error other than ours is logged, and raised as a `RemoteError`."""
    try:
        return handler(request, caller)
    except BamEnvsError:
        raise
    except Exception as error:
        _log.exception("%s: the handler failed", name)
        line = " ".join(f"{type(error).__name__}: {error}".split())
        raise RemoteError(f"{name} failed: {line}") from error


class Bus(Protocol):
    """Publish, subscribe, serve, from any thread.

    Subclasses inherit `publish`, and `act`, `reserve` and `on_leave` without effect.
    """

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Declare `topic` of type `kind`; if latched, its last message is repeated to newcomers."""

    def publish(self, topic: str, message: Message) -> None:
        """Send `message` now, or not at all. Raises the errors of `publish_all`."""
        self.publish_all([(topic, message)])

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages now, each on its topic, in this order: all of them or none.

        Raises:
            LinkLost: There is no link; nothing is sent later.
            InvalidValue: A number in one is not finite or not plain, or a topic was not advertised.
        """

    def subscribe(self, topic: str, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener` for each message. Returns a function that ends this subscription only."""

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` of type `kind`, even when the handler fails."""

    def act(self, action: Action) -> bool:
        """Offer an action; False if the bus has none."""
        return False

    def reserve(self, topic: str, check: Callable[[Caller], None]) -> None:
        """Refuse what a caller publishes on `topic` if ``check(caller)`` raises a `BamEnvsError`, if the bus can."""
        return

    def on_leave(self, callback: Callable[[Caller], None]) -> None:
        """Call `callback` when a caller's connection ends, if the bus reports that."""
        return

    def close(self) -> None:
        """Stop serving and release everything. Idempotent."""


def namespaces_with(link: Any, kind: Literal["topics", "services"], name: str, with_it: Collection[str] = ()) -> str:
    """A sentence about the names on the server of `link` that end like the topic or service `name`, if there are any.

    It names other addresses where all names `with_it` are, else the names themselves, but not those of `with_it`.
    """
    try:
        listed_there = link.call(f"/rosapi/{kind}", f"rosapi/{kind.capitalize()}", {}, 1.0).get(kind) or []
    except (RemoteError, LinkLost):
        return ""
    names = {one for one in listed_there if isinstance(one, str)}
    found = sorted(one for one in names - {f"{link.namespace}{one}" for one in with_it} if one.endswith(name))
    spaces = [one.removesuffix(name) for one in found]
    whole = [space for space in spaces if {f"{space}{other}" for other in with_it} <= names]
    if whole:
        return f" It is there at another address: {listed(f'{link.url}{space}' for space in whole)}."
    own = [one.removeprefix(link.namespace) for one in found if one.startswith(f"{link.namespace}/")]
    if not own:
        return ""
    return f' Is it {listed(own)}? Then give a profile with [rename], and in it "{name}" = "{own[0]}".'
