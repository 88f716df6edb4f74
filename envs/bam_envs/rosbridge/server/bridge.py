"""The server side of the rosbridge v2 protocol without I/O: it takes frames and the time, and returns events.

Every message of a client is answered: a request by its response, any other failure by a message ``status``. Every
operation of the protocol is here.
"""

import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from bam_envs.core.errors import BamEnvsError, InvalidValue, ProtocolError, RemoteError
from bam_envs.core.wording import brief
from bam_envs.ros.codec import HALT_TOPIC, INFO_SERVICE
from bam_envs.ros.interfaces import complete, normal_name, request_type, response_type
from bam_envs.ros.messages import write_stamp
from bam_envs.rosbridge.bus import Action, Caller, Handler, Listener, Message, deliver, tell
from bam_envs.rosbridge.encoding import Id, decode_frame, read_id
from bam_envs.rosbridge.server.actions import Actions, ClientGoal, Post
from bam_envs.rosbridge.server.client_session import (
    LEVELS,
    Call,
    ClientSession,
    Event,
    Publication,
    Send,
    ServerOptions,
    Service,
    Stream,
    canonical,
    pack,
    read_name,
    read_number,
    read_text,
    read_wish,
)
from bam_envs.rosbridge.server.services import Services, checked, packed_response
from bam_envs.rosbridge.server.topics import Topic, Topics
from bam_envs.rosbridge.sessions import FORBIDDEN
from bam_envs.rosbridge.tokens import Refusals

_FOR_WATCHERS = frozenset({"subscribe", "unsubscribe", "set_level", "fragment", "call_service", "send_action_goal"})
_ON_HALT = frozenset({"advertise", "unadvertise", "publish"})  # what a watcher may do on the topic that halts, only
_logger = logging.getLogger(__name__)
_PROCESS = Caller("this process")
_OPERATIONS = (
    *("advertise", "unadvertise", "publish", "subscribe", "unsubscribe", "call_service", "advertise_service"),
    *("unadvertise_service", "service_response", "set_level", "send_action_goal", "cancel_action_goal"),
)
_NO_ACTIONS = "Clients cannot offer actions to this server; offer a service, or a pair of topics."
_NO_AUTH = "The op auth is for the first message of a web page; this client has been let in already."


class Incoming(NamedTuple):
    """A decoded frame of a client."""

    message: Mapping[str, Any]
    kind: str  # the type that its content was checked for; empty without content
    content: Any  # its complete content (a message, arguments, a response), or the error of the check

    def content_of(self, kind: str) -> Any:
        """The content; raises if it does not fit, or the type has changed meanwhile."""
        if self.kind != kind:
            raise ProtocolError(f"Expected a {kind}, found a {self.kind}: the type was another one a moment ago.")
        if isinstance(self.content, BamEnvsError):
            raise self.content
        return self.content


class Bridge:
    """Clients, topics, services and actions of one server. `clock` is the wall clock [s], for ``/rosapi/get_time``."""

    def __init__(
        self,
        options: ServerOptions | None = None,
        clock: Callable[[], float] = time.time,
        refusals: Refusals | None = None,
    ) -> None:
        self.options = options or ServerOptions()
        self._events: list[Event] = []
        self.topics = Topics(self._events.append)
        self.services = Services(self._events.append)
        self.actions = Actions(self._events.append)
        self._fragmented: set[ClientSession] = set()
        self._leave: list[Callable[[Caller], None]] = []
        self._reserved: dict[str, Callable[[Caller], None]] = {}
        self._refusals = refusals or Refusals(_logger)
        self._post: Post = lambda work: work()  # of the goals of actions
        rosapi: dict[str, tuple[str, Handler]] = {
            "get_time": ("GetTime", lambda *_: {"time": _time_of_day(clock())}),
            "topics": ("Topics", lambda *_: {"topics": [*self.topics], "types": self.topics.kinds}),
            "topic_type": ("TopicType", lambda request, _: _type_of(self.topics, request, "topic")),
            "services": ("Services", lambda *_: {"services": [*self.services]}),
            "service_type": ("ServiceType", lambda request, _: _type_of(self.services, request, "service")),
            "action_servers": ("GetActionServers", lambda *_: {"action_servers": [*self.actions]}),
            "action_type": ("ActionType", lambda request, _: _type_of(self.actions, request, "action")),
        }
        for name, (kind, handler) in rosapi.items():
            path = f"/rosapi/{name}"
            self.services.offer(Service(path, f"rosapi/{kind}", path, handler=handler, inline=True))

    # ---- clients

    def open(self, caller: Caller) -> ClientSession:
        """Add a client that connected."""
        return ClientSession(caller, self.options)

    def lost(self, session: ClientSession) -> None:
        """Remove a client whose connection ended, with everything that it declared."""
        self._fragmented.discard(session)
        self.services.leave(session)
        self.actions.leave(session)
        self.topics.leave(session)
        for callback in self._leave:
            tell(callback, session.caller)

    def read(self, frame: str | bytes, *, joined: bool = False) -> Incoming | ProtocolError:
        """Decode a frame, or the text `joined` from fragments, for `take`. May take long; thread-safe."""
        try:
            message = decode_frame(frame)
            if joined and message.get("op") == "fragment":
                raise ProtocolError("A fragment must not hold fragments.")
        except ProtocolError as error:
            return error
        kind = ""
        try:
            kind, check = self._carried(message)
            return Incoming(message, kind, check())
        except BamEnvsError as error:
            return Incoming(message, kind, error)

    def _carried(self, message: Mapping[str, Any]) -> tuple[str, Callable[[], Any]]:
        """The type of a message's content, empty without content, and the function that completes the content."""
        operation = message.get("op")
        if operation == "publish":
            topic = self.topics.get(read_name(message, "topic"))
            if topic is not None and None not in topic.publishers:
                return topic.kind, lambda: _publication(topic, message.get("msg"))
        elif operation == "call_service":
            service = self.services.get(read_name(message, "service"))
            if service is not None:
                return request_type(service.kind), lambda: checked(service.kind, request_type, message.get("args"))
        elif operation == "service_response" and message.get("result", True) is True:
            call = self.services.call_named(message.get("id"))
            if call is not None:
                kind = call.service.kind
                return response_type(kind), lambda: checked(kind, response_type, message.get("values"))
        return "", lambda: None

    def take(self, session: ClientSession, incoming: Incoming | ProtocolError, now: float) -> str | None:
        """Execute a frame at `now` [s, steady]; returns the joined text if it was the last fragment of a message."""
        if isinstance(incoming, ProtocolError):
            self._status(session, str(incoming))
            return None
        message = incoming.message
        try:
            name = read_text(message, "op")
            if name == "fragment":
                return self._add_fragment(session, message, now)
            if name not in _OPERATIONS:
                unknown = f"Unknown op {name!r:.40}; expected one of {', '.join(_OPERATIONS)}, fragment."
                raise ProtocolError(_NO_ACTIONS if "action" in name else _NO_AUTH if name == "auth" else unknown)
            if session.caller.role == "watch":
                self._require_watching(session, name, message)
            getattr(self, f"_{name}")(session, incoming, now)
        except BamEnvsError as error:
            number: Id = None
            with contextlib.suppress(ProtocolError):
                number = read_id(message)
            self._status(session, f"{_title(message, str(error))}: {error}", number)
        return None

    def tick(self, now: float) -> None:
        """Execute the work that is due at `next_deadline`."""
        self.services.expire(now)
        self.topics.tick(now)
        for session in list(self._fragmented):
            for name in session.fragments.expire(now):
                self._status(session, f"Fragments of {name!r} did not all come in time.")
            self._note_fragments(session)

    @property
    def next_deadline(self) -> float:
        """When `tick` is needed next [s], clock of `take`; infinite if nothing waits."""
        fragments = (session.fragments.deadline for session in self._fragmented)
        return min(self.services.deadline, self.topics.deadline, *fragments)

    def events(self) -> list[Event]:
        """Return the events in their order, and clear them."""
        events = self._events[:]
        self._events.clear()
        return events

    # ---- this process; names and types as in `Bus`, and a wrong one raises InvalidValue

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Declare that this process publishes `topic`."""
        entry = self.topics.require(canonical(topic), kind)
        entry.publishers.add(None)
        if latch:
            entry.latching.add(None)

    def publication(self, topic: str, message: Message) -> Publication:
        """Check a message of this process, for `publish`. Thread-safe."""
        return _publication(self._existing(canonical(topic)), message)

    def publish(self, publication: Publication, now: float, publisher: ClientSession | None = None) -> None:
        """Send a message, of this process unless a client is its `publisher`, to all subscribers."""
        topic = self.topics.get(publication.topic)
        if topic is None or topic.kind != publication.kind:
            return
        self.topics.publish(publication, topic, publisher, now)
        for listener in tuple(topic.listeners):
            self._deliver(listener, publication, publisher)

    def subscribe(self, topic: str, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener` for each message of `topic`, the latched one at once. Returns a function that ends this."""
        entry = self.topics.require(canonical(topic), kind)
        entry.listeners.append(listener)
        if entry.latched is not None:
            publisher, publication = entry.latched
            self._deliver(listener, publication, publisher)

        def unsubscribe() -> None:
            if listener in entry.listeners:
                entry.listeners.remove(listener)
                self.topics.forget(entry)

        return unsubscribe

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service` with `handler`, which runs for each event that is a `Call`."""
        self.services.offer(Service(canonical(service), normal_name(kind), service, handler=handler))

    def act(self, action: Action, post: Post = lambda work: work()) -> None:
        """Offer `action`; what its goals report runs by `post`, in the network thread."""
        self.actions.offer(replace(action, name=canonical(action.name), kind=normal_name(action.kind)))
        self._post = post

    def reserve(self, topic: str, check: Callable[[Caller], None]) -> None:
        """Let clients publish on `topic` only if `check` raises nothing."""
        self._reserved[canonical(topic)] = check

    def on_leave(self, callback: Callable[[Caller], None]) -> None:
        """Call `callback` when a client's connection ends."""
        self._leave.append(callback)

    # ---- messages of clients: one function for each op

    def _advertise(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        message = incoming.message
        name, kind, number = read_name(message, "topic"), read_text(message, "type"), read_id(message)
        latch = message.get("latch")
        if not (latch is None or isinstance(latch, bool)):
            raise ProtocolError(f"latch: expected true or false, found {brief(latch)}.")
        _require_room(sum(map(len, session.advertised.values())), session.options.topics, "advertisements")
        topic = self.topics.require(name, kind)
        _require_not_ours(topic)
        topic.publishers.add(session)
        if latch:
            topic.latching.add(session)
        session.advertised.setdefault(name, set()).add(number)

    def _unadvertise(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        name, number = read_name(incoming.message, "topic"), read_id(incoming.message)
        ids = session.advertised.get(name)
        topic = self.topics.get(name)
        if ids is None or topic is None or (number is not None and number not in ids):
            raise ProtocolError(f"Topic {name} was not advertised so by this client.")
        ids.discard(number)
        if number is None or not ids:
            del session.advertised[name]
            self.topics.retire(topic, session)

    def _publish(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        topic = self._existing(read_name(incoming.message, "topic"))
        _require_not_ours(topic)
        if topic.name in self._reserved:
            self._reserved[topic.name](session.caller)
        self.publish(incoming.content_of(topic.kind), now, session)

    def _subscribe(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        message = incoming.message
        name, number = read_name(message, "topic"), read_id(message)
        kind, wish = message.get("type"), read_wish(message)
        _require_room(sum(len(one.wishes) for one in session.streams.values()), session.options.topics, "subscriptions")
        topic = self.topics.require(name, None if kind is None else read_text(message, "type"))
        stream = session.streams.get(name)
        if stream is not None:
            stream.set_wish(number, wish)
            return
        stream = session.streams[name] = Stream(session, name, read_text(message, "topic"))
        stream.set_wish(number, wish)
        self.topics.subscribe(stream, topic, now)

    def _unsubscribe(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        name, number = read_name(incoming.message, "topic"), read_id(incoming.message)
        stream = session.streams.get(name)
        if stream is None or (number is not None and number not in stream.wishes):
            raise ProtocolError(f"Topic {name} was not subscribed so by this client.")
        stream.set_wish(number, None)
        if number is None or not stream.wishes:
            self.topics.unsubscribe(session.streams.pop(name))

    def _call_service(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        message = incoming.message
        spelling = message.get("service")
        call = Call(session, read_id(message), spelling if isinstance(spelling, str) else "")
        # Even an invalid call is answered by a response, which its caller waits for.
        try:
            name = read_name(message, "service")
            service = self.services.get(name)
            if service is None:
                raise ProtocolError(f"Service {name} does not exist")
            if session.caller.role == "watch" and not (service.inline or name.endswith(INFO_SERVICE)):
                raise self._refused(session, f"The service {name}")
            call.timeout, values = read_number(message, "timeout", 0), incoming.content_of(request_type(service.kind))
            call.wish = read_wish(message)
            self.services.call(call, service, values, now)
        except BamEnvsError as error:
            self._events.append(Send(session, packed_response(call, str(error), False)))

    def _advertise_service(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        message = incoming.message
        name, kind = read_name(message, "service"), read_text(message, "type")
        _require_room(len(session.services), session.options.services, "services")
        before = self.services.offer(Service(name, normal_name(kind), read_text(message, "service"), provider=session))
        if before is not None and before.provider is not None:
            self._status(before.provider, f"Service {name} is offered by another client now.")

    def _unadvertise_service(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        name = read_name(incoming.message, "service")
        service = self.services.get(name)
        if service is None or service.provider is not session:
            raise ProtocolError(f"Service {name} is not offered by this client.")
        self.services.withdraw(service)

    def _service_response(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        self.services.respond(session, incoming.message, incoming.content_of)

    def _set_level(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        level = incoming.message.get("level")
        if level not in LEVELS:
            raise ProtocolError(f"level: expected one of {', '.join(LEVELS)}, found {level!r:.40}.")
        session.level = level

    def _send_action_goal(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        message, spelling, number = incoming.message, incoming.message.get("action"), read_id(incoming.message)
        # Even an invalid goal is answered by a result, which its caller waits for.
        try:
            action = self.actions.get(read_name(message, "action"))
            if session.caller.role == "watch":
                raise self._refused(session, f"The action {spelling}")
            if action is None:
                raise ProtocolError(f"Action {canonical(str(spelling))} does not exist")
            wants, post = message.get("feedback") is True, self._post
            goal = ClientGoal(session, number, str(spelling), action, wants, self.actions, post)
            self.actions.send(goal, read_text(message, "action_type"), message.get("args"))
        except BamEnvsError as error:
            self.actions.reject(session, number, spelling, str(error))

    def _cancel_action_goal(self, session: ClientSession, incoming: Incoming, now: float) -> None:
        self.actions.cancel(session, read_name(incoming.message, "action"), read_id(incoming.message))

    # ---- inside

    def _require_watching(self, session: ClientSession, name: str, message: Mapping[str, Any]) -> None:
        """Refuse what a client that may only watch asks for; everybody may halt the robot."""
        halts = name in _ON_HALT and read_name(message, "topic").endswith(HALT_TOPIC)
        if name not in _FOR_WATCHERS and not halts:
            raise self._refused(session, name)

    def _refused(self, session: ClientSession, what: str) -> RemoteError:
        self._refusals.note(session.caller.shown, f"{what} is not for the role watch")
        return RemoteError(FORBIDDEN)

    def _existing(self, name: str) -> Topic:
        topic = self.topics.get(name)
        if topic is None:
            raise InvalidValue(f"Topic {name} does not exist; advertise it with its type first.")
        return topic

    def _add_fragment(self, session: ClientSession, message: Mapping[str, Any], now: float) -> str | None:
        try:
            return session.fragments.add(message, now)
        finally:
            self._note_fragments(session)
            while sum(one.fragments.size for one in self._fragmented) > self.options.unfinished:
                greatest = max(self._fragmented, key=lambda one: one.fragments.size)
                greatest.fragments.clear()
                self._note_fragments(greatest)
                self._status(greatest, f"All unfinished fragments hold more than {self.options.unfinished} bytes.")

    def _note_fragments(self, session: ClientSession) -> None:
        (self._fragmented.add if session.fragments.size else self._fragmented.discard)(session)

    def _deliver(self, listener: Listener, publication: Publication, publisher: ClientSession | None) -> None:
        # An error of one listener must not end the publisher's connection, nor skip the other listeners.
        text = deliver(
            listener, publication.message, publisher.caller if publisher is not None else _PROCESS, publication.topic
        )
        if not text:
            return
        if publisher is None:
            _logger.warning("%s", text)
        else:
            self._status(publisher, text)

    def _status(self, session: ClientSession, text: str, name: Id = None) -> None:
        """Send an error to a client, unless its level excludes errors."""
        if session.level != "none":
            message = {"op": "status", "level": "error", "msg": text}
            packet = pack(message if name is None else {**message, "id": name}, stream="status")
            self._events.append(Send(session, packet))


def _publication(topic: Topic, content: Any) -> Publication:
    publication = Publication(topic.name, topic.kind, complete(topic.kind, {} if content is None else content))
    for stream in list(topic.streams.values()):
        if stream.wish.throttle == 0.0:  # packed here, in any thread, to relieve the network thread
            publication.packet(stream.name, stream.wish)
    return publication


def _require_not_ours(topic: Topic) -> None:
    # Clients must not publish on topics of this process, such as the state of the robot.
    if None in topic.publishers:
        raise ProtocolError(f"Topic {topic.name} is published by this server alone; its clients may subscribe.")


def _require_room(used: int, most: int, what: str) -> None:
    if used >= most:
        raise ProtocolError(f"A client may have at most {most} {what}.")


def _time_of_day(now: float) -> dict[str, int]:
    """`now` in the spellings of both ROS 1 and ROS 2."""
    return {**write_stamp(now), **write_stamp(now, ros1=True)}


def _type_of(table: Topics | Services | Actions, request: Message, field: str) -> dict[str, str]:
    entry = table.get(read_name(request, field))
    return {"type": entry.kind if entry else ""}


def _title(message: Mapping[str, Any], text: str) -> str:
    """The operation and names of a message, for the status with the error `text`; without names that are in it."""
    names = [name for name in (message.get("topic"), message.get("service")) if f" {name} " not in text]
    return " ".join(part[:80] for part in (message.get("op"), *names) if isinstance(part, str)) or "message"
