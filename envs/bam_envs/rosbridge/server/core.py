"""The rosbridge v2 protocol of a server without any I/O: frames in, things to do out, the time passed in.

One object, used by one thread. `server` gives it sockets and a clock; a test gives it lists. Whatever a client sends,
it is answered: a request by its response, everything else that does not work by a message ``status``.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from bam_envs.core.errors import BamEnvsError, InvalidValue, ProtocolError
from bam_envs.ros.interfaces import complete
from bam_envs.rosbridge.bus import Caller, Handler, Listener, Message, refusal_of
from bam_envs.rosbridge.encoding import decode_frame
from bam_envs.rosbridge.fragments import Id, read_id
from bam_envs.rosbridge.server.operations import Operations
from bam_envs.rosbridge.server.packets import Packet, Publication
from bam_envs.rosbridge.server.rosapi import rosapi
from bam_envs.rosbridge.server.services import Services, new_service
from bam_envs.rosbridge.server.session import Event, Invoke, Limits, Session, canonical
from bam_envs.rosbridge.server.topics import Topics

T = TypeVar("T")

_logger = logging.getLogger(__name__)
_PROCESS = Caller("this process")


@dataclass(frozen=True)
class Incoming:
    """A frame of a client, read."""

    message: Mapping[str, Any]
    """What it says."""
    error: ProtocolError | None = None
    """Why it says nothing."""


class Bridge:
    """All clients, topics and services of one server.

    Args:
        limits: What one client may use.
        clock: Wall clock [s], for ``/rosapi/get_time``.
    """

    def __init__(self, limits: Limits | None = None, clock: Callable[[], float] = time.time) -> None:
        self.limits = limits or Limits()
        self._events: list[Event] = []
        self.topics = Topics(self._events.append)
        self.services = Services(self._events.append)
        self._operations = Operations(self.topics, self.services, self._events.append, self._spread)
        self._sessions: set[Session] = set()
        self._fragmented: set[Session] = set()
        self._leave: list[Callable[[Caller], None]] = []
        for name, (kind, handler) in rosapi(self.topics, self.services, clock).items():
            self.services.offer(new_service(name, kind, name, handler=handler, inline=True))

    # Clients.

    def open(self, caller: Caller) -> Session:
        """A client connected."""
        session = Session(caller, self.limits)
        self._sessions.add(session)
        return session

    def lost(self, session: Session) -> None:
        """Its connection ended: everything of it ends."""
        if session not in self._sessions:
            return
        self._sessions.discard(session)
        self._fragmented.discard(session)
        self.services.leave(session)
        self.topics.leave(session)
        for callback in self._leave:
            self._tell(callback, session.caller)

    def receive(self, session: Session, frame: str | bytes, now: float) -> None:
        """Do what a frame of a client says. Never raises about what the frame holds.

        Args:
            session: The client.
            frame: Of text, or binary.
            now: Any steady clock [s]; the same one everywhere.
        """
        text = self.take(session, self.read(frame), now)
        if text is not None:
            self.take(session, self.read(text, joined=True), now)

    def read(self, frame: str | bytes, *, joined: bool = False, check: bool = False) -> Incoming:
        """What a frame says, for `take`. From any thread, and never raises about what it holds.

        Args:
            frame: Of text, or binary.
            joined: It is the text of fragments.
            check: Check its content here, which may be long, and not where it is done.
        """
        try:
            message = decode_frame(frame)
            if joined and message.get("op") == "fragment":
                raise ProtocolError("A fragment must not hold fragments.")
        except ProtocolError as error:
            return Incoming({}, error)
        return Incoming(self._operations.checked(message) if check else message)

    def take(self, session: Session, incoming: Incoming, now: float) -> str | None:
        """Do what a frame of a client says; the text of a message whose last fragment it was, to be read in turn."""
        message = incoming.message
        try:
            if incoming.error is not None:
                self._status(session, str(incoming.error))
            elif message.get("op") == "fragment":
                return self._add_fragment(session, message, now)
            else:
                self._operations.execute(session, message, now)
        except BamEnvsError as error:
            self._status(session, f"{_title(message, str(error))}: {error}", _id(message))
        return None

    def tick(self, now: float) -> None:
        """Do what `next_deadline` was about."""
        self.services.expire(now)
        self.topics.tick(now)
        for session in list(self._fragmented):
            for name in session.fragments.expire(now):
                self._status(session, f"Fragments of {name!r} did not all come in time.")
            self._note_fragments(session)

    @property
    def next_deadline(self) -> float | None:
        """When `tick` is needed next [s], clock of `receive`; None if nothing waits."""
        times = [self.services.deadline, self.topics.deadline]
        if not self._fragmented and times == [None, None]:
            return None
        times += [session.fragments.deadline for session in self._fragmented]
        return min((one for one in times if one is not None), default=None)

    def events(self) -> list[Event]:
        """What is to be done, in this order; empties the list."""
        events = self._events[:]
        self._events.clear()
        return events

    def packed_answer(self, invoke: Invoke) -> Packet | None:
        """Call the handler, which may take its time: from any thread. For `finish`."""
        return self.services.packed_answer(invoke)

    def finish(self, invoke: Invoke, packet: Packet | None) -> None:
        """The answer of a handler."""
        self.services.finish(invoke.number, packet)
        self.services.ran(invoke.session)

    # This process. Names and types as in `Bus`; a wrong one raises InvalidValue.

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """This process publishes `topic`."""
        found = _own(lambda: self.topics.require(canonical(topic), kind))
        found.publishers.add(None)
        if latch:
            found.latching.add(None)

    def publication(self, topic: str, message: Message) -> Publication:
        """A message of this process, checked; from any thread. For `publish`."""
        name = _own(lambda: canonical(topic))
        found = self.topics.find(name)
        if found is None:
            raise InvalidValue(f"Topic {name} does not exist; advertise it with its type first.")
        return found.packed(Publication(name, found.kind, complete(found.kind, message)))

    def publish(self, publication: Publication, now: float) -> None:
        """Send a message of this process to all who want it."""
        self._spread(publication, None, now)

    def subscribe(self, topic: str, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener` for each message of `topic`, the latched one at once, until what is returned is called."""
        found = _own(lambda: self.topics.require(canonical(topic), kind))
        found.listeners.append(listener)
        if found.latched is not None:
            publisher, publication = found.latched
            self._deliver(listener, publication, publisher)

        def unsubscribe() -> None:
            if listener in found.listeners:
                found.listeners.remove(listener)
                self.topics.forget(found)

        return unsubscribe

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` with `handler`; the events `Invoke` say when."""
        _own(lambda: self.services.offer(new_service(canonical(service), kind, service, handler=handler)))

    def on_leave(self, callback: Callable[[Caller], None]) -> None:
        """Call `callback` when a client's connection ends."""
        self._leave.append(callback)

    # Inside.

    def _add_fragment(self, session: Session, message: Mapping[str, Any], now: float) -> str | None:
        try:
            return session.fragments.add(message, now)
        finally:
            self._note_fragments(session)
            self._require_room()

    def _require_room(self) -> None:
        """Who holds most in fragments gives way when all together hold too much."""
        while sum(session.fragments.size for session in self._fragmented) > self.limits.unfinished:
            greatest = max(self._fragmented, key=lambda session: session.fragments.size)
            greatest.fragments.clear()
            self._note_fragments(greatest)
            self._status(greatest, f"All unfinished fragments hold more than {self.limits.unfinished} bytes.")

    def _note_fragments(self, session: Session) -> None:
        if session.fragments.deadline is not None:
            self._fragmented.add(session)
        else:
            self._fragmented.discard(session)

    def _spread(self, publication: Publication, publisher: Session | None, now: float) -> None:
        topic = self.topics.find(publication.topic)
        if topic is None or topic.kind != publication.kind:
            return
        self.topics.publish(publication, topic, publisher, now)
        for listener in tuple(topic.listeners):
            self._deliver(listener, publication, publisher)

    def _deliver(self, listener: Listener, publication: Publication, publisher: Session | None) -> None:
        try:
            listener(publication.message, publisher.caller if publisher is not None else _PROCESS)
        except BamEnvsError as error:
            self._refused(publication, publisher, str(error))
        # One listener's mistake must not end the connection of the client that published, nor silence other listeners.
        except Exception:
            _logger.exception("A listener of %s failed.", publication.topic)
            self._refused(publication, publisher, "The receiver failed; its log says more.")

    def _tell(self, callback: Callable[[Caller], None], caller: Caller) -> None:
        try:
            callback(caller)
        # What is foreign must not keep the others from hearing that somebody left.
        except Exception:
            _logger.exception("A callback about the end of a connection failed.")

    def _refused(self, publication: Publication, publisher: Session | None, reason: str) -> None:
        if publisher is None:
            _logger.warning("%s", refusal_of(publication.topic, reason))
        else:
            self._status(publisher, refusal_of(publication.topic, reason))

    def _status(self, session: Session, text: str, name: Id = None) -> None:
        self._events.extend(session.status("error", text, name))


def _own(work: Callable[[], T]) -> T:
    """Do something for this process, whose mistakes are values, not somebody else's protocol."""
    try:
        return work()
    except ProtocolError as error:
        raise InvalidValue(str(error)) from None


def _title(message: Mapping[str, Any], said: str) -> str:
    """What a message was about, for the status that says what is wrong with it; no name that is `said` there."""
    names = [name for name in (message.get("topic"), message.get("service")) if f" {name} " not in said]
    return " ".join(part[:80] for part in (message.get("op"), *names) if isinstance(part, str)) or "message"


def _id(message: Mapping[str, Any]) -> Id:
    try:
        return read_id(message)
    except ProtocolError:
        return None
