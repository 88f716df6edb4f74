"""One client of the rosbridge server: its limits, declarations and calls, its fields, and packets for it."""

import itertools
import math
import re
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.core.wording import brief
from bam_envs.rosbridge.bus import Caller, Handler, Message
from bam_envs.rosbridge.encoding import COMPRESSIONS, Fragments, Id, dump_json, encode_cbor, encode_png, split

LEVELS = ("none", "error", "warning", "info")  # of status messages: each one includes those before it
_NEVER_SPLIT = 2**31  # a fragment size above that of every message
_NUMBERS = itertools.count(1)
_NAME = re.compile(r"/?[A-Za-z_~][\w~]*(?:/[\w~]+)*", re.ASCII)
_LONGEST = 256
_LARGEST = 2**53
_LONGEST_QUEUE = 100


@dataclass(frozen=True)
class ServerOptions:
    """Limits on the clients of a `BridgeServer`: a client that exceeds one gets an error, and others are unaffected."""

    max_clients: int = 256  # for the next one another leaves (`places`), or it gets HTTP status 503
    service_timeout: float = 30.0  # for the answer of a client's service [s], if the caller gives no timeout
    handler_timeout: float = 300.0  # the same for services of this process [s]: a robot's motion may take long
    max_message: int = 64 * 2**20  # largest answer to a client [bytes]
    max_incoming: int = 16 * 2**20  # largest message of a client, and most of its unfinished fragments together [bytes]
    # Most unfinished fragments of all clients, and unfinished frames [bytes]; the client with most of them loses them.
    unfinished: int = 64 * 2**20
    topics: int = 1024  # most subscriptions, and most advertisements, of a client
    services: int = 256  # most services that a client offers
    calls: int = 256  # most unanswered calls of a client
    at_once: int = 4  # most calls of a client that handlers of this process run at once; the others wait
    fragment_lifetime: float = 10.0  # within which a message in fragments must be complete [s]
    outbox_size: int = 8 * 2**20  # most data that waits for a slow client [bytes]
    outbox_of_a_topic: int = 100  # most messages of one topic that wait for it, unless it asked for fewer
    open_timeout: float = 5.0  # within which a socket must have become a WebSocket [s]
    token_timeout: float = 2.0  # within which a web page must have shown its token [s]
    ping_interval: float = 1.0  # between two pings [s]: a driver that does not answer loses command soon
    ping_timeout: float = 20.0  # for their answer [s]
    close_timeout: float = 1.0  # for the closing handshake [s]


@dataclass(frozen=True)
class Wish:
    """A client's options for the messages of a topic or the answer of a service."""

    compression: str = "none"  # one of `encoding.COMPRESSIONS`
    fragment_size: int = _NEVER_SPLIT  # most characters of a message in one frame; CBOR is never split
    throttle: float = 0.0  # least time between two messages of a topic [s]
    queue_length: int = 0  # most messages of a topic that may wait; 0: the server's limit


@dataclass(frozen=True)
class Packet:
    """The WebSocket frames of one message."""

    frames: tuple[bytes, ...]
    text: bool  # whether they are text frames
    stream: str | None = None
    """Name of the stream in which a newer packet may replace it; None for a required packet."""

    @property
    def size(self) -> int:
        """Bytes of all frames."""
        return sum(map(len, self.frames))


def pack(
    message: Mapping[str, Any], wish: Wish | None = None, *, stream: str | None = None, kind: str | None = None
) -> Packet:
    """A protocol message as frames; `kind` is the type of its field ``msg``, for the typed arrays of CBOR."""
    wish = wish or Wish()
    if wish.compression == "cbor":
        return Packet((encode_cbor(message, kind),), text=False, stream=stream)
    text = dump_json(message)
    if wish.compression == "png":
        text = dump_json({"op": "png", "data": encode_png(text)})
    parts = split(text, wish.fragment_size, f"fragment:{next(_NUMBERS)}")
    return Packet(tuple(part.encode("ascii") for part in parts), text=True, stream=stream)


class Publication:
    """One checked, complete message of type `kind` on `topic`, for any number of subscribers."""

    def __init__(self, topic: str, kind: str, message: Mapping[str, Any]) -> None:
        self.topic, self.kind, self.message = topic, kind, message
        self._packets: dict[tuple[str, str, int], Packet] = {}

    def packet(self, name: str, wish: Wish) -> Packet:
        """The packet for clients that call the topic `name` and have the options `wish`; made once for all of them."""
        key = (name, wish.compression, wish.fragment_size)
        packet = self._packets.get(key)
        if packet is None:
            message = {"op": "publish", "topic": name, "msg": self.message}
            packet = self._packets[key] = pack(message, wish, stream=self.topic, kind=self.kind)
        return packet


@dataclass(frozen=True)
class Send:
    """Event: send a packet to a client."""

    session: "ClientSession"
    packet: Packet
    keep: int = 0  # most packets of the same stream that may wait for a slow client; 0: the server's limit


class Stream:
    """All subscriptions of one client to one topic, which it calls `name`; the client gets each message once."""

    def __init__(self, session: "ClientSession", topic: str, name: str) -> None:
        self.session, self.topic, self.name = session, topic, name
        self.wishes: dict[Id, Wish] = {}
        self.wish = Wish()  # all of them combined
        self._waiting: deque[Publication] = deque(maxlen=1)
        self._next = -math.inf

    def set_wish(self, name: Id, wish: Wish | None) -> None:
        """Add a subscription, or remove it with None."""
        if wish is None:
            self.wishes.pop(name, None)
        else:
            self.wishes[name] = wish
        wishes = self.wishes.values()
        if wishes:
            self.wish = Wish(
                max((one.compression for one in wishes), key=COMPRESSIONS.index),
                *(min(getattr(one, name) for one in wishes) for name in ("fragment_size", "throttle", "queue_length")),
            )
            self._waiting = deque(self._waiting, maxlen=max(1, self.wish.queue_length))

    @property
    def deadline(self) -> float:
        """When a waiting message may be sent [s]; infinite if none waits."""
        return self._next if self._waiting else math.inf

    def offer(self, publication: Publication, now: float) -> Send | None:
        """Take a new message; returns what to send now, or None. Early messages wait; the oldest is dropped."""
        if self.wish.throttle == 0.0:
            return self._send(publication)
        self._waiting.append(publication)
        return self.due(now)

    def due(self, now: float) -> Send | None:
        """The message that has waited long enough, or None."""
        if not self._waiting or now < self._next:
            return None
        # On a grid, so that a topic of exactly this rate does not lose every second message to jitter.
        on_grid = self._next + self.wish.throttle
        self._next = on_grid if on_grid > now else now + self.wish.throttle
        return self._send(self._waiting.popleft())

    def _send(self, publication: Publication) -> Send:
        return Send(self.session, publication.packet(self.name, self.wish), self.wish.queue_length)


@dataclass(frozen=True)
class Service:
    """A service and its provider."""

    name: str  # with a leading slash
    kind: str  # normal name of its type
    spelling: str  # its name as its provider spells it
    provider: "ClientSession | None" = None  # the client that offers it; None for this process
    handler: Handler | None = None  # answers it in this process
    inline: bool = False  # whether the handler is quick and may run in the network thread


@dataclass(eq=False)
class Call:
    """A client's call of a service; `Services.call` fills the last fields.

    As an event: run `Services.packed_answer` outside the network thread, and give its result to `Services.finish`.
    """

    session: "ClientSession"
    id: Id
    name: str  # of the service, as the client spells it
    wish: Wish = field(default_factory=Wish)
    timeout: float = 0.0  # time after which it fails [s]; 0: the default
    deadline: float = math.inf  # when it fails [s], clock of `Bridge`
    number: int = 0
    service: Service = field(init=False)
    values: Message = field(init=False)  # its arguments, complete


Event = Send | Call


@dataclass(eq=False)
class ClientSession:
    """The state of one connection."""

    caller: Caller
    options: ServerOptions
    level: str = "error"  # the status messages it wants: this one of LEVELS and those before it
    advertised: dict[str, set[Id]] = field(default_factory=dict)
    """Its topics, each with the ids of its advertisements."""
    streams: dict[str, Stream] = field(default_factory=dict)  # what it has subscribed, by topic
    services: set[str] = field(default_factory=set)
    calls: set[int] = field(default_factory=set)  # numbers of its unanswered calls
    running: int = 0  # number of its calls that handlers run
    waiting: deque[Call] = field(default_factory=deque)  # its calls that wait for a handler

    def __post_init__(self) -> None:
        self.fragments = Fragments(self.options.max_incoming, self.options.fragment_lifetime)


@lru_cache(maxsize=1024)
def canonical(name: str) -> str:
    """The name of a topic or service with its leading slash; `InvalidValue` if it is not a valid name."""
    if len(name) > _LONGEST or not _NAME.fullmatch(name):
        raise InvalidValue(f"Name: expected one such as '/joint_states', found {brief(name)}.")
    return name if name.startswith("/") else f"/{name}"


def read_name(message: Mapping[str, Any], what: str) -> str:
    """The name of the topic or service in a message, with a leading slash."""
    return canonical(read_text(message, what))


def read_text(message: Mapping[str, Any], name: str) -> str:
    """A required text field."""
    value = message.get(name)
    if not isinstance(value, str) or not value:
        raise ProtocolError(f"{name}: expected a text, found {brief(value)}.")
    return value


def read_number(message: Mapping[str, Any], name: str, otherwise: float) -> float:
    """A numeric field >= 0, or `otherwise` if it is missing."""
    value = message.get(name)
    if value is None:
        return otherwise
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= _LARGEST:
        raise ProtocolError(f"{name}: expected a number >= 0, found {brief(value)}.")
    return value


def read_wish(message: Mapping[str, Any]) -> Wish:
    """The options in a client's message."""
    throttle = read_number(message, "throttle_rate", 0) / 1000
    queue_length = int(min(read_number(message, "queue_length", 0), _LONGEST_QUEUE))
    compression = message.get("compression") or "none"
    if compression not in COMPRESSIONS:
        expected = ", ".join(COMPRESSIONS)
        raise ProtocolError(f"compression: expected one of {expected}, found {brief(compression)}.")
    size = read_number(message, "fragment_size", _NEVER_SPLIT)
    if size < 1:
        raise ProtocolError(f"fragment_size: expected an integer >= 1, found {brief(size)}.")
    return Wish(compression, min(int(size), _NEVER_SPLIT), throttle, queue_length)
