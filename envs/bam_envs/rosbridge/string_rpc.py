"""Requests and replies over a pair of topics, as JSON in std_msgs/String.

Every ROS graph has std_msgs, and a topic pair goes through a bridge several times faster than a service. A request on
``<name>/request`` is ``{"id": …, "tag": …, "payload": {…}}``; its reply on ``<name>/reply`` is
``{"id": …, "payload": {…}}`` or ``{"id": …, "error": text, "kind": name}``. A request without a tag, as other clients
may send it, is executed too; one with a signed tag belongs to its session.
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NoAnswer  # not the builtin before Python 3.11
from dataclasses import replace
from typing import Any

from bam_envs.core.errors import BamEnvsError, LinkLost, NotInCommand, ProtocolError, RemoteError, SafetyStop
from bam_envs.ros.freshness import FreshnessCheck, Tagger, read_tag
from bam_envs.rosbridge.bus import Bus, Caller, Handler, Message, answer
from bam_envs.rosbridge.encoding import MOST_ITEMS, dump_json, load_json
from bam_envs.rosbridge.ros_bus import RosBus
from bam_envs.rosbridge.sessions import Sessions

_log = logging.getLogger(__name__)
_STRING = "std_msgs/String"
# Time between two publications of a request before the first reply [s]: a ROS graph loses a topic's first messages.
_RESEND = 0.5
_MOST_WAITING = 64  # requests that a service executes or keeps waiting at once
_WORKERS = 8
_ANSWERS_KEPT = 32  # newest answers, by the key of their request: a repeated request is executed once


class StringRpc:
    """Calls the `StringRpcService` of the same name, such as ``/bam/scene``; `tagger` signs for a session.

    Thread-safe; the first call opens the topics. When the link drops, calls under way fail at once.
    """

    def __init__(self, link: RosBus, name: str, tagger: Tagger | None = None) -> None:
        self.name = name
        self._link, self._tagger, self._lock = link, tagger or Tagger(), threading.Lock()
        self._pending: dict[str, Future[dict[str, Any]]] = {}
        self._unsubscribe: Callable[[], None] | None = None
        self._answered = -1  # the connection of the last reply
        link.on_down(lambda *_: self._fail(f"the link dropped while {name} was to answer"))

    def call(self, payload: dict[str, Any], timeout: float) -> dict[str, Any]:
        """Send `payload` and wait at most `timeout` [s] for the reply.

        Raises:
            InvalidValue: `payload` is not plain finite JSON; nothing was sent.
            LinkLost: The link is down or dropped, or there was no reply in time: whether it was executed is unknown.
            RemoteError: The other end refused or failed; `NotInCommand` if another client is in command there.
            SafetyStop: A guard stopped the robot there.
        """
        deadline, epoch = time.monotonic() + timeout, self._link.epoch
        tag = self._tagger.next(epoch, timeout)
        identity = f"{tag.session}-{tag.sequence}"
        content = dump_json({"id": identity, "payload": payload}, f"A request to {self.name}")
        signed = dump_json({"tag": self._tagger.sign(tag, self.name, content.encode())}, self.name)
        text = f"{signed[:-1]},{content[1:]}"
        with self._lock:
            if self._unsubscribe is None:
                self._link.advertise(f"{self.name}/request", _STRING)
                self._unsubscribe = self._link.subscribe(f"{self.name}/reply", _STRING, self._on_reply)
        future = self._pending[identity] = Future()
        try:
            while (left := deadline - time.monotonic()) > 0:
                self._link.publish(f"{self.name}/request", {"data": text})
                try:
                    reply = future.result(left if self._answered == epoch else min(left, _RESEND))
                except NoAnswer:
                    continue
                self._answered = epoch
                return self._payload_of(reply)
        finally:
            self._pending.pop(identity, None)
        raise LinkLost(f"{self.name} did not answer in {timeout:g} s; whether it did what was asked is unknown.")

    def close(self) -> None:
        """Unsubscribe; calls under way fail."""
        with self._lock:
            unsubscribe, self._unsubscribe = self._unsubscribe, None
        if unsubscribe is not None:
            unsubscribe()
        self._fail(f"the calls to {self.name} were closed")

    def _on_reply(self, message: Message, _caller: Caller) -> None:
        reply = load_json(message.get("data"), f"{self.name}/reply")
        future = self._pending.pop(str(reply.get("id")), None)
        if future is not None:  # replies to other clients arrive here too
            future.set_result(reply)

    def _payload_of(self, reply: dict[str, Any]) -> dict[str, Any]:
        if "error" in reply:
            text, kind = str(reply["error"]), reply.get("kind")
            stop = SafetyStop.told(text) if kind == SafetyStop.__name__ else None
            raise stop or (NotInCommand if kind == NotInCommand.__name__ else RemoteError)(text)
        payload = reply.get("payload")
        if not isinstance(payload, dict):
            raise ProtocolError(f"{self.name}/reply: payload must be an object, not {type(payload).__name__}.")
        return payload

    def _fail(self, reason: str) -> None:
        for identity in list(self._pending):
            future = self._pending.pop(identity, None)
            if future is not None:
                future.set_exception(LinkLost(f"No reply: {reason}. Whether it did what was asked is unknown."))


class StringRpcService:
    """Answers requests, each once, in separate threads; outdated requests are refused.

    The `handler` returns the reply's payload; the text of a `BamEnvsError` that it raises is the reply's error.
    Requests may be signed for `sessions`; without them a signature is ignored.
    """

    def __init__(self, bus: Bus, name: str, handler: Handler, sessions: Sessions | None = None) -> None:
        self.name = name
        self._bus, self._handler, self._sessions = bus, handler, sessions
        self._freshness, self._lock = FreshnessCheck(), threading.Lock()
        self._answers: OrderedDict[tuple[str, str], Future[str]] = OrderedDict()
        self._workers = ThreadPoolExecutor(_WORKERS, thread_name_prefix=f"rpc{name.replace('/', '-')}")
        self._room = threading.BoundedSemaphore(_MOST_WAITING)
        self._unsubscribe: Callable[[], None] | None = None

    def start(self) -> "StringRpcService":
        """Advertise and listen. Returns itself."""
        self._bus.advertise(f"{self.name}/reply", _STRING)
        self._unsubscribe = self._bus.subscribe(f"{self.name}/request", _STRING, self._on_request)
        return self

    def close(self) -> None:
        """Stop listening and wait for running answers. Idempotent."""
        unsubscribe, self._unsubscribe = self._unsubscribe, None
        if unsubscribe is not None:
            unsubscribe()
        self._workers.shutdown()

    def _on_request(self, message: Message, caller: Caller) -> None:
        request = load_json(message.get("data"), f"{self.name}/request", MOST_ITEMS)
        identity = request.get("id")
        if not isinstance(identity, str):
            raise ProtocolError(f"{self.name}/request: id must be a string, not {type(identity).__name__}.")
        if not self._room.acquire(blocking=False):
            raise RemoteError(f"{self.name} is busy: {_MOST_WAITING} requests are waiting.")
        caller, refused = self._proven(request, identity, caller)
        try:
            self._workers.submit(self._answer, request, caller, refused, time.monotonic())
        except RuntimeError as error:  # shut down meanwhile
            self._room.release()
            raise RemoteError(f"{self.name} is closed.") from error

    def _proven(self, request: dict[str, Any], identity: str, caller: Caller) -> tuple[Caller, str]:
        """The caller with its session, and why a new request must not be executed, or an empty text."""
        tag = read_tag(request.get("tag"))
        if tag is None or not identity.startswith(tag.session):
            return caller, ""
        try:
            if self._sessions is None or not tag.mac:
                self._freshness.require(tag, self.name)
                return caller, ""
            content = dump_json({"id": identity, "payload": request.get("payload")}, self.name).encode()
            fresh = self._sessions.prove(tag, self.name, content, caller)
            caller = replace(caller, session=tag.session)
            fresh.require(tag, self.name)
        except BamEnvsError as error:
            return caller, str(error)
        return caller, ""

    def _answer(self, request: dict[str, Any], caller: Caller, refused: str, arrived: float) -> None:
        try:
            with self._lock:
                key = (caller.session, request["id"])
                new = key not in self._answers
                future = self._answers.setdefault(key, Future())
                if len(self._answers) > _ANSWERS_KEPT:
                    self._answers.popitem(last=False)
            if new:
                future.set_result(self._reply(request, caller, refused, arrived))
            if new or future.done():  # a repetition gets no reply while the first request runs
                self._bus.publish(f"{self.name}/reply", {"data": future.result()})
        except LinkLost as error:
            _log.warning("%s: a reply was dropped: %s", self.name, error)
        finally:
            self._room.release()

    def _reply(self, request: dict[str, Any], caller: Caller, refused: str, arrived: float) -> str:
        identity, what = request["id"], f"The reply of {self.name}"
        tag, payload = read_tag(request.get("tag")), request.get("payload")
        try:
            if refused:
                raise RemoteError(refused)
            if not isinstance(payload, dict):
                raise ProtocolError(f"{self.name}/request: payload must be an object, not {type(payload).__name__}.")
            if tag is not None and (waited := time.monotonic() - arrived) > tag.deadline - tag.sent:
                raise RemoteError(f"expired: it waited {waited:.3f} s for others")
            return dump_json({"id": identity, "payload": answer(self._handler, payload, caller, self.name)}, what)
        except BamEnvsError as error:
            return dump_json({"id": identity, "error": str(error), "kind": type(error).__name__}, what)
