"""What a client of a rosbridge server may say: one function for each ``op``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from bam_envs.core.errors import BamEnvsError, ProtocolError
from bam_envs.ros.interfaces import complete
from bam_envs.rosbridge.fragments import read_id
from bam_envs.rosbridge.server.packets import Publication, Wire, pack
from bam_envs.rosbridge.server.services import (
    Request,
    Services,
    checked_args,
    checked_values,
    new_service,
    packed_response,
)
from bam_envs.rosbridge.server.session import (
    LEVELS,
    Event,
    Send,
    Session,
    read_flag,
    read_name,
    read_number,
    read_text,
    read_wire,
)
from bam_envs.rosbridge.server.topics import Stream, Topic, Topics, Wish

_LONGEST_QUEUE = 100
_NO_ACTIONS = "Actions are not supported by this server; use a service, or a pair of topics."
_NO_AUTH = "The op auth is for the first message of a web page; this client has been let in already."


@dataclass(frozen=True)
class Checked:
    """What stands in a message for content that was checked before, in another thread."""

    kind: str
    """Of what it was found to be."""
    value: Any = None
    """What came of it."""
    error: BamEnvsError | None = None
    """Why nothing came of it."""

    @classmethod
    def of(cls, kind: str, check: Callable[[], Any]) -> Checked:
        """What `check` returns, or raises."""
        try:
            return cls(kind, check())
        except BamEnvsError as error:
            return cls(kind, error=error)

    def get(self, kind: str) -> Any:
        """The value.

        Raises:
            BamEnvsError: It does not fit, or should be of another type by now.
        """
        if self.error is not None:
            raise self.error
        if self.kind != kind:
            raise ProtocolError(f"Expected a {kind}, found a {self.kind}: the type was another one a moment ago.")
        return self.value


class Operations:
    """Does what clients say.

    Args:
        topics: Of the server.
        services: Of the server.
        emit: Takes what is to be done.
        spread: Takes what a client published.
    """

    def __init__(
        self,
        topics: Topics,
        services: Services,
        emit: Callable[[Event], None],
        spread: Callable[[Publication, Session | None, float], None],
    ) -> None:
        self._topics, self._services, self._emit, self._spread = topics, services, emit, spread
        self._table: dict[str, Callable[[Session, Mapping[str, Any], float], None]] = {
            "advertise": self._advertise,
            "unadvertise": self._unadvertise,
            "publish": self._publish,
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "call_service": self._call_service,
            "advertise_service": self._advertise_service,
            "unadvertise_service": self._unadvertise_service,
            "service_response": self._service_response,
            "set_level": self._set_level,
            "send_action_goal": self._send_action_goal,
        }

    def execute(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        """Do what one message says.

        Raises:
            BamEnvsError: It cannot be done; nothing happened.
        """
        name = read_text(message, "op")
        operation = self._table.get(name)
        if operation is None:
            raise ProtocolError(_unknown(name, self._table))
        operation(session, message, now)

    def checked(self, message: Mapping[str, Any]) -> Mapping[str, Any]:
        """`message` with its content checked, where `execute` would do that. From any thread."""
        find = _CONTENT.get(str(message.get("op")))
        try:
            return message if find is None else find(self, message)
        except ProtocolError:  # it is about nothing, as `execute` will say
            return message

    def _checked_publish(self, message: Mapping[str, Any]) -> Mapping[str, Any]:
        topic = self._topics.find(read_name(message, "topic"))
        if topic is None or None in topic.publishers:
            return message
        return {**message, "msg": Checked.of(topic.kind, lambda: _publication(topic, message))}

    def _checked_call(self, message: Mapping[str, Any]) -> Mapping[str, Any]:
        service = self._services.find(read_name(message, "service"))
        if service is None:
            return message
        return {**message, "args": Checked.of(service.kind, lambda: checked_args(service, message.get("args")))}

    def _checked_response(self, message: Mapping[str, Any]) -> Mapping[str, Any]:
        kind = self._services.kind_of_call(message.get("id"))
        if kind is None or message.get("result", True) is not True:
            return message
        return {**message, "values": Checked.of(kind, lambda: checked_values(kind, message.get("values")))}

    def _advertise(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        name, kind = read_name(message, "topic"), read_text(message, "type")
        latch, number = read_flag(message, "latch", False), read_id(message)
        _require_room(sum(map(len, session.advertised.values())), session.limits.topics, "advertisements")
        topic = self._topics.require(name, kind)
        _require_public(topic)
        topic.publishers.add(session)
        if latch:
            topic.latching.add(session)
        session.advertised.setdefault(name, set()).add(number)

    def _unadvertise(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        name, number = read_name(message, "topic"), read_id(message)
        ids = session.advertised.get(name)
        topic = self._topics.find(name)
        if ids is None or topic is None or (number is not None and number not in ids):
            raise ProtocolError(f"Topic {name} was not advertised so by this client.")
        ids.discard(number)
        if number is None or not ids:
            del session.advertised[name]
            self._topics.retire(topic, session)

    def _publish(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        name = read_name(message, "topic")
        topic = self._topics.find(name)
        if topic is None:
            raise ProtocolError(f"Topic {name} does not exist; advertise it with its type first.")
        _require_public(topic)
        content = message.get("msg")
        ready = content.get(topic.kind) if isinstance(content, Checked) else _publication(topic, message)
        self._spread(ready, session, now)

    def _subscribe(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        name, number = read_name(message, "topic"), read_id(message)
        kind = message.get("type")
        wish = Wish(
            read_number(message, "throttle_rate", 0) / 1000,
            int(min(read_number(message, "queue_length", 0), _LONGEST_QUEUE)),
            read_wire(message),
        )
        _require_room(sum(len(one.wishes) for one in session.streams.values()), session.limits.topics, "subscriptions")
        topic = self._topics.require(name, None if kind is None else read_text(message, "type"))
        stream = session.streams.get(name)
        if stream is not None:
            stream.wish(number, wish)
            return
        stream = session.streams[name] = Stream(session, name, read_text(message, "topic"))
        stream.wish(number, wish)
        self._topics.subscribe(stream, topic, now)

    def _unsubscribe(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        name, number = read_name(message, "topic"), read_id(message)
        stream = session.streams.get(name)
        if stream is None or (number is not None and number not in stream.wishes):
            raise ProtocolError(f"Topic {name} was not subscribed so by this client.")
        stream.wish(number, None)
        if number is None or not stream.wishes:
            self._topics.unsubscribe(session.streams.pop(name))

    def _call_service(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        number, spelling = read_id(message), message.get("service")
        request = Request(session, number, spelling if isinstance(spelling, str) else "", message.get("args"))
        # A call is answered by a response also when it is wrong: who called waits for nothing else.
        try:
            name = read_name(message, "service")
            service = self._services.find(name)
            if service is None:
                raise ProtocolError(f"Service {name} does not exist")
            limit = read_number(message, "timeout", 0) or None
            args = request.args
            values = args.get(service.kind) if isinstance(args, Checked) else checked_args(service, args)
            self._services.call(service, replace(request, wire=read_wire(message), timeout=limit), values, now)
        except BamEnvsError as error:
            self._emit(Send(session, packed_response(request, str(error), False)))

    def _advertise_service(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        name, kind = read_name(message, "service"), read_text(message, "type")
        _require_room(len(session.services), session.limits.services, "services")
        before = self._services.offer(new_service(name, kind, read_text(message, "service"), provider=session))
        if before is not None and before.provider is not None:
            for event in before.provider.status("error", f"Service {name} is offered by another client now."):
                self._emit(event)

    def _unadvertise_service(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        name = read_name(message, "service")
        service = self._services.find(name)
        if service is None or service.provider is not session:
            raise ProtocolError(f"Service {name} is not offered by this client.")
        self._services.withdraw(service)

    def _service_response(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        values = message.get("values")
        self._services.respond(session, message, values.get if isinstance(values, Checked) else None)

    def _set_level(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        level = message.get("level")
        if level not in LEVELS:
            raise ProtocolError(f"level: expected one of {', '.join(LEVELS)}, found {level!r:.40}.")
        session.level = level

    def _send_action_goal(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        action, aborted = read_text(message, "action"), 6
        result = {"op": "action_result", "action": action, "values": _NO_ACTIONS, "status": aborted, "result": False}
        self._emit(Send(session, pack({**result, "id": read_id(message)}, Wire())))


_CONTENT = {
    "publish": Operations._checked_publish,
    "call_service": Operations._checked_call,
    "service_response": Operations._checked_response,
}
"""What may be long in a message, by its op."""


def _publication(topic: Topic, message: Mapping[str, Any]) -> Publication:
    content = message.get("msg")
    return topic.packed(Publication(topic.name, topic.kind, complete(topic.kind, {} if content is None else content)))


def _require_public(topic: Topic) -> None:
    """What this process says, such as where its robot is, nobody says in its place."""
    if None in topic.publishers:
        raise ProtocolError(f"Topic {topic.name} is published by this server alone; its clients may subscribe.")


def _require_room(used: int, most: int, what: str) -> None:
    if used >= most:
        raise ProtocolError(f"A client may have at most {most} {what}.")


def _unknown(name: str, table: Mapping[str, object]) -> str:
    if "action" in name:
        return _NO_ACTIONS
    if name == "auth":
        return _NO_AUTH
    return f"Unknown op {name!r:.40}; expected one of {', '.join(table)}, fragment."
