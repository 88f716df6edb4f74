"""The services of a rosbridge server: who offers them, which calls are unanswered. Every call is answered.

The file is long because each of the ways in which a call can end is in it: that none is missing is to be seen here.
"""

from __future__ import annotations

import heapq
import itertools
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from bam_envs.core.errors import BamEnvsError, ProtocolError
from bam_envs.ros.interfaces import (
    complete,
    complete_known,
    describe,
    normal_name,
    request_type,
    response_type,
    variants,
)
from bam_envs.rosbridge.bus import Handler
from bam_envs.rosbridge.fragments import Id
from bam_envs.rosbridge.server.packets import Packet, Wire, pack
from bam_envs.rosbridge.server.session import Event, Invoke, Send, Session

_LENIENT = ("bam_msgs/GymAPI",)
"""Types that are still growing: what a newer end says beside is ignored, as on every other way to an environment."""
_LONGEST_NUMBER = 20
"""Digits of the number of a call."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Service:
    """A service, and who offers it."""

    name: str
    """With a leading slash."""
    kind: str
    """Normal name of its type."""
    spelling: str
    """Its name as who offers it spells it."""
    provider: Session | None = None
    """The client that offers it; None for this process."""
    handler: Handler | None = None
    """What answers it in this process."""
    inline: bool = False
    """Whether the handler is quick and may run in the thread of the network."""


@dataclass(frozen=True)
class Request:
    """What a client asks of a service."""

    session: Session
    """Who asks."""
    id: Id
    """As the client gave it."""
    name: str
    """Of the service, as the client spells it."""
    args: Any
    """With names, or in the order of the fields; not checked yet."""
    wire: Wire = field(default_factory=Wire)
    """How the answer is packed."""
    timeout: float | None = None
    """How long it waits [s]; None for the usual time."""


@dataclass(frozen=True)
class Call:
    """An unanswered request."""

    number: int
    service: Service
    request: Request
    timeout: float
    """After which time it is answered in any case [s]."""
    deadline: float
    """When that is [s], clock of `Bridge`."""


class Services:
    """Every service of a server, and the unanswered calls.

    Args:
        emit: Takes what is to be done.
    """

    def __init__(self, emit: Callable[[Event], None]) -> None:
        self._emit = emit
        self._services: dict[str, Service] = {}
        self._calls: dict[int, Call] = {}
        self._numbers = itertools.count(1)
        self._queue: list[tuple[float, int]] = []

    def __iter__(self) -> Iterator[Service]:
        return iter(self._services.values())

    @property
    def deadline(self) -> float | None:
        """When the next unanswered call runs out of time [s]; None if there is none."""
        while self._queue and self._queue[0][1] not in self._calls:
            heapq.heappop(self._queue)
        return self._queue[0][0] if self._queue else None

    def find(self, name: str) -> Service | None:
        """The service `name`, if there is one."""
        return self._services.get(name)

    def offer(self, service: Service) -> Service | None:
        """Add a service; returns the one of another client whose place it takes.

        A client that comes back after a cut would otherwise wait until its old connection is noticed to be dead.

        Raises:
            ProtocolError: It is offered by this process.
        """
        before = self._services.get(service.name)
        if before is not None and before.provider is None:
            raise ProtocolError(f"Service {service.name} is offered by this server already.")
        if before is not None:
            self.withdraw(before)
        self._services[service.name] = service
        if service.provider is not None:
            service.provider.services.add(service.name)
        return before if before is not None and before.provider is not service.provider else None

    def withdraw(self, service: Service) -> None:
        """Take a service away; who waits for it is told."""
        del self._services[service.name]
        if service.provider is not None:
            service.provider.services.discard(service.name)
        for call in [one for one in self._calls.values() if one.service is service]:
            self.fail(call, f"Service {service.name} is gone: the client that offered it left or withdrew it.")

    def leave(self, session: Session) -> None:
        """A client left: its calls are forgotten, its services end."""
        for number in session.calls:
            self._calls.pop(number, None)
        session.calls.clear()
        session.waiting.clear()
        for name in list(session.services):
            self.withdraw(self._services[name])

    def call(self, service: Service, request: Request, values: Mapping[str, Any], now: float) -> None:
        """Pass a request on to who offers `service`.

        Args:
            service: What is asked.
            request: By whom, and how.
            values: What `checked_args` makes of its arguments.
            now: Clock of `Bridge` [s].

        Raises:
            BamEnvsError: There are too many.
        """
        session, limits = request.session, request.session.limits
        if max(len(session.calls), len(session.waiting)) >= limits.calls:
            raise ProtocolError(f"At most {limits.calls} calls may be unanswered; wait for an answer first.")
        usual = limits.service_timeout if service.provider is not None else limits.handler_timeout
        timeout = usual if request.timeout is None else request.timeout
        call = Call(next(self._numbers), service, request, timeout, now + timeout)
        self._calls[call.number] = call
        session.calls.add(call.number)
        self._queue_up(call)
        self._start(call, values)

    def _queue_up(self, call: Call) -> None:
        heapq.heappush(self._queue, (call.deadline, call.number))
        # Answered calls stay in the heap until their time comes; not more of them than of the others.
        if len(self._queue) > 2 * len(self._calls) + 64:
            self._queue = [(one.deadline, one.number) for one in self._calls.values()]
            heapq.heapify(self._queue)

    def _start(self, call: Call, values: Mapping[str, Any]) -> None:
        service, session = call.service, call.request.session
        if service.provider is not None:
            message = {"op": "call_service", "id": str(call.number), "service": service.spelling, "args": values}
            self._emit(Send(service.provider, pack(message, Wire())))
        elif service.handler is not None:
            invoke = Invoke(session, call.number, service.handler, values, session.caller)
            if service.inline:
                self.finish(call.number, self.packed_answer(invoke))
            else:
                session.waiting.append(invoke)
                self._start_waiting(session)

    def _start_waiting(self, session: Session) -> None:
        while session.waiting and session.running < session.limits.at_once:
            invoke = session.waiting.popleft()
            if invoke.number in self._calls:
                session.running += 1
                self._emit(invoke)

    def packed_answer(self, invoke: Invoke) -> Packet | None:
        """What the handler answers, as a packet; None if nobody waits for it any more. From any thread."""
        call = self._calls.get(invoke.number)
        if call is None:
            return None
        try:
            values = invoke.handler(invoke.request, invoke.caller)
            return self._packed(
                call, values if call.service.inline else checked_values(call.service.kind, values), True
            )
        except BamEnvsError as error:
            return self._packed(call, str(error), False)
        # A caller is always answered, whatever the handler of somebody else does.
        except Exception as error:
            _logger.exception("The handler of %s failed.", call.service.name)
            return self._packed(call, f"Service {call.service.name} failed: {_line(error)}", False)

    def finish(self, number: int, packet: Packet | None) -> None:
        """Send the packed answer, if the call is still unanswered."""
        call = self._calls.get(number)
        if call is not None and packet is not None:
            self._answer(call, packet)

    def ran(self, session: Session) -> None:
        """A handler is done with a call of `session`: the next one's turn."""
        session.running -= 1
        self._start_waiting(session)

    def kind_of_call(self, name: object) -> str | None:
        """Type of the service that the unanswered call with the id `name` is of. From any thread."""
        call = self._call_named(name)
        return None if call is None else call.service.kind

    def _call_named(self, name: object) -> Call | None:
        known = isinstance(name, str) and len(name) < _LONGEST_NUMBER and name.isascii() and name.isdigit()
        return self._calls.get(int(str(name))) if known else None

    def respond(
        self, provider: Session, message: Mapping[str, Any], checked: Callable[[str], Any] | None = None
    ) -> None:
        """Pass on what a client answers to a call of its service; `checked` gives what was found good in it before.

        Raises:
            ProtocolError: Nobody waits for it, or it does not fit.
        """
        name = message.get("id")
        call = self._call_named(name)
        if call is None or call.service.provider is not provider:
            raise ProtocolError(f"Nobody waits for a response with the id {describe(name)}.")
        result = message.get("result", True)
        if result is not True:
            self.fail(call, _reason(call, message.get("values")))
            return
        try:
            kind = call.service.kind
            values = checked(kind) if checked is not None else checked_values(kind, message.get("values"))
            self._answer(call, self._packed(call, values, True))
        except BamEnvsError as error:
            self.fail(call, f"Service {call.service.name} answered wrongly: {error}")
            raise ProtocolError(f"Response of {call.service.name}: {error}") from None

    def expire(self, now: float) -> None:
        """Answer the calls whose time is over."""
        while self.deadline is not None and self.deadline <= now:
            call = self._calls[self._queue[0][1]]
            self.fail(call, f"Timeout exceeded: service {call.service.name} did not answer in {call.timeout:g} s.")

    def fail(self, call: Call, reason: str) -> None:
        """Answer a call with a reason why not."""
        self._answer(call, self._packed(call, reason, False))

    def _answer(self, call: Call, packet: Packet) -> None:
        del self._calls[call.number]
        call.request.session.calls.discard(call.number)
        self._emit(Send(call.request.session, packet))

    def _packed(self, call: Call, values: Any, result: bool) -> Packet:
        packet = packed_response(call.request, values, result)
        most = call.request.session.limits.max_message
        if packet.size <= most:
            return packet
        reason = f"The response of {call.service.name} has {packet.size} bytes, and {most} is the most."
        return packed_response(call.request, reason, False)


def packed_response(request: Request, values: Any, result: bool) -> Packet:
    """A message ``service_response``; of a failed one, `values` is the reason."""
    message = {"op": "service_response", "service": request.name, "values": values, "result": result}
    return pack(message if request.id is None else {**message, "id": request.id}, request.wire)


def _named(kind: str, args: Any) -> Any:
    """Arguments by name: a list has them in the order of the fields."""
    if not isinstance(args, list):
        return {} if args is None else args
    fields = variants(request_type(kind))
    if not fields or len(args) > len(fields[0]):
        raise ProtocolError(f"args: expected an object, found {describe(args)}.")
    return {one.name: value for one, value in zip(fields[0], args, strict=False)}


def checked_args(service: Service, args: Any) -> dict[str, Any]:
    """The arguments of a call, complete.

    Raises:
        BamEnvsError: They do not fit.
    """
    return _check_of(service.kind)(request_type(service.kind), _named(service.kind, args))


def checked_values(kind: str, values: Any) -> dict[str, Any]:
    """The response of a service of type `kind`, complete.

    Raises:
        InvalidValue: It does not fit.
    """
    return _check_of(kind)(response_type(kind), {} if values is None else values)


def _check_of(kind: str) -> Callable[[str, object], dict[str, Any]]:
    return complete_known if kind in _LENIENT else complete


def _reason(call: Call, values: Any) -> str:
    return values if isinstance(values, str) and values else f"Service {call.service.name} failed and gave no reason."


def _line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def new_service(name: str, kind: str, spelling: str, **offered: Any) -> Service:
    """A service of type `kind`, with or without ``/srv/``."""
    return Service(name, normal_name(kind), spelling, **offered)
