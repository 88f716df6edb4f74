"""The services of a rosbridge server, their providers, and the unanswered calls. Every call is answered.

Every possible end of a call is in this file, which shows that none is missing.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, ProtocolError
from bam_envs.core.wording import brief
from bam_envs.ros.interfaces import complete, request_type, response_type, variants
from bam_envs.rosbridge.bus import Message, answer
from bam_envs.rosbridge.server.client_session import Call, ClientSession, Event, Packet, Send, Service, pack

_GROWING = "bam_msgs/GymAPI"  # unknown fields of this type, of a newer version, are ignored, as in every transport
_LONGEST_NUMBER = 20  # digits of the number of a call


class Services(dict[str, Service]):
    """Every service of a server by name, and the unanswered calls; `emit` takes the events."""

    def __init__(self, emit: Callable[[Event], None]) -> None:
        super().__init__()
        self._emit = emit
        self._calls: dict[int, Call] = {}
        self._numbers = itertools.count(1)
        self.deadline = math.inf  # when to call `expire` next [s]; may be that of an answered call

    def offer(self, service: Service) -> Service | None:
        """Add a service; returns the service of another client that it replaces."""
        # A client that reconnects after a cut does not wait until the old connection is found dead.
        before = self.get(service.name)
        if before is not None:
            if before.provider is None:
                raise InvalidValue(f"Service {service.name} is offered by this server already.")
            self.withdraw(before)
        self[service.name] = service
        if service.provider is not None:
            service.provider.services.add(service.name)
        return before if before is not None and before.provider is not service.provider else None

    def withdraw(self, service: Service) -> None:
        """Remove a service; its unanswered calls fail."""
        del self[service.name]
        if service.provider is not None:
            service.provider.services.discard(service.name)
        for call in [one for one in self._calls.values() if one.service is service]:
            self._fail(call, f"Service {service.name} is gone: the client that offered it left or withdrew it.")

    def leave(self, session: ClientSession) -> None:
        """Forget the calls of a client that left, and withdraw its services."""
        for number in session.calls:
            self._calls.pop(number, None)
        session.calls.clear()
        session.waiting.clear()
        for name in list(session.services):
            self.withdraw(self[name])

    def call(self, call: Call, service: Service, values: Message, now: float) -> None:
        """Pass a call with complete `values` on to the provider of `service`; limits a client's unanswered calls."""
        session, options = call.session, call.session.options
        if max(len(session.calls), len(session.waiting)) >= options.calls:
            raise ProtocolError(f"At most {options.calls} calls may be unanswered; wait for an answer first.")
        usual = options.service_timeout if service.provider is not None else options.handler_timeout
        call.number, call.service, call.values = next(self._numbers), service, values
        call.timeout = call.timeout or usual
        call.deadline = now + call.timeout
        self._calls[call.number] = call
        session.calls.add(call.number)
        self.deadline = min(self.deadline, call.deadline)
        if service.provider is not None:
            message = {"op": "call_service", "id": str(call.number), "service": service.spelling, "args": values}
            self._emit(Send(service.provider, pack(message)))
        elif service.inline:
            self._answer(call, self.packed_answer(call))
        else:
            session.waiting.append(call)
            self._start_waiting(session)

    def _start_waiting(self, session: ClientSession) -> None:
        while session.waiting and session.running < session.options.at_once:
            call = session.waiting.popleft()
            if call.number in self._calls:
                session.running += 1
                self._emit(call)

    def packed_answer(self, call: Call) -> Packet | None:
        """The answer of the handler, as a packet; None if the call is answered already. Thread-safe."""
        handler, service = call.service.handler, call.service
        if handler is None or call.number not in self._calls:
            return None
        try:
            values = answer(handler, call.values, call.session.caller, f"Service {service.name}")
            if not service.inline:  # the answer of /rosapi/get_time has fields of ROS 1 and of ROS 2
                values = checked(service.kind, response_type, values)
            return _packed(call, values, True)
        except BamEnvsError as error:
            return _packed(call, str(error), False)

    def finish(self, call: Call, packet: Packet | None) -> None:
        """Send the result of `packed_answer` if the call is still unanswered, and start the next waiting call."""
        if call.number in self._calls:
            self._answer(call, packet)
        call.session.running -= 1
        self._start_waiting(call.session)

    def call_named(self, name: object) -> Call | None:
        """The unanswered call with the id `name`, or None. Thread-safe."""
        known = isinstance(name, str) and len(name) < _LONGEST_NUMBER and name.isascii() and name.isdigit()
        return self._calls.get(int(str(name))) if known else None

    def respond(self, provider: ClientSession, message: Mapping[str, Any], values: Callable[[str], Any]) -> None:
        """Pass on a client's answer to a call of its service; `values` completes its content for a type."""
        call = self.call_named(message.get("id"))
        if call is None or call.service.provider is not provider:
            raise ProtocolError(f"Nobody waits for a response with the id {brief(message.get('id'))}.")
        name = call.service.name
        if message.get("result", True) is not True:
            reason = message.get("values")
            text = reason if isinstance(reason, str) and reason else f"Service {name} failed and gave no reason."
            self._fail(call, text)
            return
        try:
            self._answer(call, _packed(call, values(response_type(call.service.kind)), True))
        except BamEnvsError as error:
            self._fail(call, f"Service {name} answered wrongly: {error}")
            raise ProtocolError(f"Response of {name}: {error}") from None

    def expire(self, now: float) -> None:
        """Fail the calls that have timed out."""
        if now < self.deadline:
            return
        for call in [one for one in self._calls.values() if one.deadline <= now]:
            self._fail(call, f"Timeout exceeded: service {call.service.name} did not answer in {call.timeout:g} s.")
        self.deadline = min((one.deadline for one in self._calls.values()), default=math.inf)

    def _fail(self, call: Call, reason: str) -> None:
        self._answer(call, _packed(call, reason, False))

    def _answer(self, call: Call, packet: Packet | None) -> None:
        if packet is not None:
            del self._calls[call.number]
            call.session.calls.discard(call.number)
            self._emit(Send(call.session, packet))


def _packed(call: Call, values: Any, result: bool) -> Packet:
    packet = packed_response(call, values, result)
    most = call.session.options.max_message
    if packet.size <= most:
        return packet
    reason = f"The response of {call.service.name} has {packet.size} bytes, and {most} is the most."
    return packed_response(call, reason, False)


def packed_response(call: Call, values: Any, result: bool) -> Packet:
    """A message ``service_response``; `values` of a failed call is the reason."""
    message = {"op": "service_response", "service": call.name, "values": values, "result": result}
    return pack(message if call.id is None else {**message, "id": call.id}, call.wish)


def checked(kind: str, part: Callable[[str], str], values: Any) -> dict[str, Any]:
    """A request or a response (`part`) of a service of type `kind`, complete; a request may be a list of its fields."""
    name = part(kind)
    if isinstance(values, list) and part is request_type:
        fields = variants(name)
        if not fields or len(values) > len(fields[0]):
            raise ProtocolError(f"args: expected an object, found {brief(values)}.")
        values = {one.name: value for one, value in zip(fields[0], values, strict=False)}
    return complete(name, {} if values is None else values, lenient=kind == _GROWING)
