"""The topics of a rosbridge server: publishers, subscribers, throttling and queues."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from bam_envs.core.errors import InvalidValue
from bam_envs.core.wording import brief
from bam_envs.ros.interfaces import normal_name
from bam_envs.rosbridge.bus import Listener
from bam_envs.rosbridge.server.client_session import ClientSession, Publication, Send, Stream


@dataclass(eq=False)
class Topic:
    """One topic."""

    name: str
    kind: str  # normal name of its type
    publishers: set[ClientSession | None] = field(default_factory=set)  # None is this process
    streams: dict[ClientSession, Stream] = field(default_factory=dict)
    listeners: list[Listener] = field(default_factory=list)  # those of this process
    latching: set[ClientSession | None] = field(default_factory=set)
    """The publishers whose last message is repeated to newcomers."""
    latched: tuple[ClientSession | None, Publication] | None = None  # that message, with its publisher


class Topics(dict[str, Topic]):
    """Every topic of a server by name. A topic has the type of its first user, and ends with its last one."""

    def __init__(self, emit: Callable[[Send], None]) -> None:
        super().__init__()
        self._emit = emit
        self._delayed: set[Stream] = set()

    @property
    def kinds(self) -> list[str]:
        """The types of all topics."""
        return [topic.kind for topic in self.values()]

    def require(self, name: str, kind: str | None) -> Topic:
        """The topic `name`, created if it does not exist. `InvalidValue` if it has another type, or needs one."""
        topic = self.get(name)
        if topic is None and kind is None:
            raise InvalidValue(f"Topic {name} does not exist yet; its type is needed.")
        if topic is None:
            topic = self[name] = Topic(name, normal_name(kind or ""))
        if kind is not None and normal_name(kind) != topic.kind:
            raise InvalidValue(f"Topic {name} is of type {topic.kind}, found {brief(kind)}.")
        return topic

    def subscribe(self, stream: Stream, topic: Topic, now: float) -> None:
        """Send the messages of `topic` to a new stream, the latched one at once."""
        topic.streams[stream.session] = stream
        if topic.latched is not None:
            self._note(stream, stream.offer(topic.latched[1], now))

    def unsubscribe(self, stream: Stream) -> None:
        """Stop sending messages to a stream."""
        self._delayed.discard(stream)
        topic = self.get(stream.topic)
        if topic is not None and topic.streams.pop(stream.session, None) is not None:
            self.forget(topic)

    def publish(self, publication: Publication, topic: Topic, publisher: ClientSession | None, now: float) -> None:
        """Send to every subscriber that is a client."""
        if publisher in topic.latching:
            topic.latched = (publisher, publication)
        for stream in topic.streams.values():
            self._note(stream, stream.offer(publication, now))

    @property
    def deadline(self) -> float:
        """When the next waiting message may be sent [s]; infinite if none waits."""
        return min((one.deadline for one in self._delayed), default=math.inf)

    def tick(self, now: float) -> None:
        """Send the messages that have waited long enough."""
        for stream in list(self._delayed):
            self._note(stream, stream.due(now))

    def retire(self, topic: Topic, publisher: ClientSession | None) -> None:
        """Remove a publisher of `topic`, and its latched message."""
        topic.publishers.discard(publisher)
        topic.latching.discard(publisher)
        if topic.latched is not None and topic.latched[0] is publisher:
            topic.latched = None
        self.forget(topic)

    def forget(self, topic: Topic) -> None:
        """Remove a topic that nobody uses."""
        used = topic.publishers or topic.streams or topic.listeners
        if not used and self.get(topic.name) is topic:
            del self[topic.name]

    def leave(self, session: ClientSession) -> None:
        """Remove a client that left."""
        for name in session.advertised:
            self.retire(self[name], session)
        for stream in session.streams.values():
            self.unsubscribe(stream)

    def _note(self, stream: Stream, event: Send | None) -> None:
        if event is not None:
            self._emit(event)
        (self._delayed.add if stream.deadline < math.inf else self._delayed.discard)(stream)
