"""What a client of a rosbridge server may say: one function for each ``op``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from bam_envs.bridge.interfaces import complete
from bam_envs.bridge.server.packets import Publication, Wire, pack
from bam_envs.bridge.server.services import Request, Services, new_service, packed_response
from bam_envs.bridge.server.session import (
    LEVELS,
    Event,
    Send,
    Session,
    read_flag,
    read_id,
    read_name,
    read_number,
    read_text,
    read_wire,
)
from bam_envs.bridge.server.topics import Stream, Topics, Wish
from bam_envs.errors import BamEnvsError, ProtocolError

_LONGEST_QUEUE = 100
_NO_ACTIONS = "Actions are not supported by this server; use a service, or a pair of topics."
_NO_AUTH = "The op auth is not supported by this server; send its token as the header 'Authorization: Bearer ...'."


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

    def _advertise(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        name, kind = read_name(message, "topic"), read_text(message, "type")
        latch, number = read_flag(message, "latch", False), read_id(message)
        _require_room(sum(map(len, session.advertised.values())), session.limits.topics, "advertisements")
        topic = self._topics.require(name, kind)
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
        content = message.get("msg")
        publication = Publication(name, topic.kind, complete(topic.kind, {} if content is None else content))
        self._spread(publication, session, now)

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
            self._services.call(service, replace(request, wire=read_wire(message), timeout=limit), now)
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
        self._services.respond(session, message)

    def _set_level(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        level = message.get("level")
        if level not in LEVELS:
            raise ProtocolError(f"level: expected one of {', '.join(LEVELS)}, found {level!r:.40}.")
        session.level = level

    def _send_action_goal(self, session: Session, message: Mapping[str, Any], now: float) -> None:
        action, aborted = read_text(message, "action"), 6
        result = {"op": "action_result", "action": action, "values": _NO_ACTIONS, "status": aborted, "result": False}
        self._emit(Send(session, pack({**result, "id": read_id(message)}, Wire())))


def _require_room(used: int, most: int, what: str) -> None:
    if used >= most:
        raise ProtocolError(f"A client may have at most {most} {what}.")


def _unknown(name: str, table: Mapping[str, object]) -> str:
    if "action" in name:
        return _NO_ACTIONS
    if name == "auth":
        return _NO_AUTH
    return f"Unknown op {name!r:.40}; expected one of {', '.join(table)}, fragment."
