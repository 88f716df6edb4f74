"""The server side of the agent socket: who asks for what, in which role, and what the `Hub` behind it answers.

Halts and twists go to the hub at once, in the network thread; everything else in worker threads, so that nothing that
takes long holds them up. What waits for a client is bounded: of events it gets the newest only.
Longer than most files: a socket is one object from its greeting to its last upload.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bam_envs import __version__
from bam_envs.core.errors import BamEnvsError, InvalidValue, NotInCommand, ProtocolError
from bam_envs.rosbridge.bus import Caller
from bam_envs.rosbridge.server.client_session import Packet
from bam_envs.rosbridge.server.server_connection import BridgeConnection
from bam_envs.rosbridge.threads import Workers
from bam_envs.rosbridge.tokens import Refusals
from bam_train.agent.front.hub import AgentHub, Person
from bam_train.agent.remote import agent_protocol as protocol
from bam_train.errors import BamTrainError, OutputError, RequestRefused, kind_of

_log = logging.getLogger(__name__)
_THREADS = 64
_AT_ONCE = 4  # most unanswered requests of one client
_PUSHES = 4  # most uploads, and pushes that wait for their answer, of all clients that are there
_RATE, _BURST = 200.0, 400.0  # most messages of one client a second, and at once
_STALLED = 10.0  # longest time between two pieces of an upload [s]
_FLOOD = 1008  # close code
_EVENTS = {"watch": ("status", "telemetry"), "transitions": ("transitions",)}
"""Request to the kinds of events that it turns on."""
_NEWEST = {"status": 1, "telemetry": 1}
"""Most events of a kind that wait for a slow client; of others, as many as the server lets."""
_PREFIX, _SUFFIX = "upload-", ".part"
_RESERVE = 128 * 2**20
"""Space that stays free on the disk for recordings and logs [bytes]."""


class AgentSocket:
    """Serves the agent socket; `serve` is its handler for a `Site`, at `agent_protocol.PATH`.

    Args:
        hub: The agent behind it. Its `stop` and `jog` are called in the network thread.
        most_upload: Most bytes of an upload.
        stalled: Longest time between two pieces of an upload [s].
    """

    def __init__(self, hub: AgentHub, *, most_upload: int = 256 * 2**20, stalled: float = _STALLED) -> None:
        self.hub, self.most_upload, self.stalled = hub, most_upload, stalled
        self.refusals = Refusals(_log)
        self.pushing: list[_Client] = []  # by their uploads, and by pushes without an answer yet
        self.learner: Person | None = None  # who gets the transitions
        self.workers = Workers(_THREADS, "bam-agent-ask")
        remove_leftovers(hub.incoming)

    async def serve(self, connection: BridgeConnection, caller: Caller) -> None:
        """Serve one socket until it closes."""
        await _Client(self, connection, caller).run()

    def close(self) -> None:
        """End the worker threads."""
        self.workers.close()


class _Client:
    """One socket."""

    def __init__(self, owner: AgentSocket, connection: BridgeConnection, caller: Caller) -> None:
        self._owner, self._hub, self._connection = owner, owner.hub, connection
        self._person = Person(**vars(caller), who=caller.address)
        self._loop = asyncio.get_running_loop()
        self._last = -1  # id of the last request
        self._running = 0  # requests that worker threads execute
        self._ends: dict[str, Callable[[], None]] = {}  # of the kinds of events that it gets
        self._upload: Upload | None = None
        self._skip = 0  # bytes of an upload that failed, which are still on their way
        self._room, self._at = _BURST, time.monotonic()  # messages that may come at once, and when that was so

    async def run(self) -> None:
        """Take messages until the socket closes."""
        hello = {"event": "hello", "protocol": protocol.PROTOCOL, "agent": __version__, "role": self._person.role}
        self._send(hello)
        try:
            while True:
                upload, stalled = self._upload, self._owner.stalled
                try:
                    limit = None if upload is None else stalled
                    data, is_text = await asyncio.wait_for(self._connection.next_data(), limit)
                except asyncio.TimeoutError:
                    if upload is not None:
                        self._end_upload(upload, ProtocolError(f"The upload stood still for {stalled:g} s."))
                    continue
                if (is_text or (self._upload is None and self._skip <= 0)) and not self._has_room():
                    reason = f"More than {_RATE:g} messages a second came."
                    self._note(reason)
                    await self._connection.close(_FLOOD, reason)
                    return
                await (self._take(data) if is_text else self._take_piece(data))
        finally:
            self._leave()

    def _leave(self) -> None:
        for op in _EVENTS:
            self._switch(op, False)
        if self._learns:
            self._owner.learner = None
        if self._upload is not None:
            self._upload.remove()
        self._owner.pushing[:] = [one for one in self._owner.pushing if one is not self]
        self._hub.left(self._person)

    def _has_room(self) -> bool:
        now = time.monotonic()
        self._room, self._at = min(_BURST, self._room + _RATE * (now - self._at)) - 1.0, now
        return self._room >= 0.0

    # ---- requests

    async def _take(self, data: bytes) -> None:
        number, op = None, "request"
        try:
            request = protocol.decode_request(data)
            number, op = request.id, str(request.__struct_config__.tag)
            if number is not None:
                if number <= self._last:
                    raise protocol.BadRequest(f"The id {number} is not above {self._last}: ids grow.", number)
                self._last = number
            if request.name:
                self._person = replace(self._person, who=request.name)
            self._require_role(request)
            await self._do(request)
        except protocol.BadRequest as error:
            self._note(str(error))
            self._refuse(error.number, error)
        except (BamTrainError, BamEnvsError) as error:
            # A lease says how long it lasts: of twists, many a second, the log gets equal lines.
            self._note(f"{op}: {kind_of(error) if op == 'jog' else error}")
            self._refuse(number, error)

    def _require_role(self, request: protocol.Request) -> None:
        op, role = request.__struct_config__.tag, self._person.role
        if not protocol.may(role, type(request)):
            raise RequestRefused(
                f"{op} needs a token of the role {request.role}; the token shown has the role {role}.", "RoleTooLow"
            )
        if self._person.full and not isinstance(request, (protocol.Stop, protocol.Status)):
            raise RequestRefused(f"{self._person.full} This connection can stop the robot, and look at its status.")
        if isinstance(request, protocol.Take) and request.force and not self._person.operator:
            raise RequestRefused(
                "Taking command by force needs a token of the role administer (bam-agent --token-file).", "RoleTooLow"
            )

    async def _do(self, request: protocol.Request) -> None:
        match request:
            case protocol.Stop():
                self._answer(request.id, self._hub.stop(self._person, request.why))
            case protocol.Jog():
                self._hub.jog(_arguments(request), self._person)
            case protocol.Watch():
                self._switch("watch", request.on)
                self._answer(request.id, {"on": request.on, "scene": self._hub.scene})
            case protocol.StreamTransitions():
                self._learn(request.on)
                self._answer(request.id, {"on": request.on})
            case protocol.Push():
                await self._begin_upload(request)
            case _:
                self._ask(request, _arguments(request))

    def _switch(self, op: str, on: bool) -> None:
        for kind in _EVENTS[op]:
            if on and kind not in self._ends:
                self._ends[kind] = self._hub.listen(kind, partial(self._pass_on, kind))
            elif not on and kind in self._ends:
                self._ends.pop(kind)()

    def _pass_on(self, kind: str, event: bytes) -> None:
        """Send an event; called in any thread."""
        packet = Packet((event,), text=True, stream=kind)
        self._post(lambda: self._send_packet(packet, _NEWEST.get(kind, 0)))

    def _learn(self, on: bool) -> None:
        learner = self._owner.learner
        if on and learner is not None and not self._learns:
            who = learner.who if learner.who == learner.address else f"{learner.who} ({learner.address})"
            raise NotInCommand(f"{who} learns from this robot already, and there is one learner at a time.")
        if on or self._learns:
            self._owner.learner = self._person if on else None
        self._switch("transitions", on)

    @property
    def _learns(self) -> bool:
        learner = self._owner.learner
        return learner is not None and learner.name == self._person.name

    def _ask(self, request: protocol.Request, arguments: dict[str, Any], upload: Upload | None = None) -> None:
        """Let a worker thread execute a request and answer it."""
        if self._running >= _AT_ONCE:
            raise InvalidValue(f"At most {_AT_ONCE} requests may be unanswered; wait for an answer first.")
        self._running += 1
        op, person, number = str(request.__struct_config__.tag), self._person, request.id

        def progress(text: str) -> None:
            self._post(lambda: self._send({"id": number, "progress": text}))

        def work() -> None:
            try:
                result, error = self._hub.ask(op, arguments, person, progress), None
            except Exception as failure:  # a request is always answered
                result, error = {}, failure
            if upload is not None:
                upload.remove()
            self._post(lambda: finish(result, error))

        def finish(result: dict[str, Any], error: Exception | None) -> None:
            self._running -= 1
            if upload is not None and self in self._owner.pushing:
                self._owner.pushing.remove(self)
            if error is None:
                self._answer(number, result)
            else:
                self._note(f"{op}: {' '.join(str(error).split())}")
                self._refuse(number, error)

        self._owner.workers.submit(work)

    # ---- uploads

    async def _begin_upload(self, push: protocol.Push) -> None:
        pushing = self._owner.pushing
        if self._upload is not None or len(pushing) >= _PUSHES:
            whose = "of this socket" if self._upload is not None else "of others"
            raise InvalidValue(f"Uploads {whose} are not done yet; push again when they are.")
        pushing.append(self)
        try:
            make = partial(Upload, self._hub.incoming, push, self._owner.most_upload)
            self._upload = await self._loop.run_in_executor(None, make)
        except BaseException:
            pushing.remove(self)
            raise
        self._send({"id": push.id, "progress": "the agent takes the upload"})

    async def _take_piece(self, data: bytes) -> None:
        upload = self._upload
        if upload is None:
            self._skip -= len(data)
            if self._skip < 0:
                self._note("It sent bytes that belong to no upload.")
                self._refuse(None, ProtocolError("Binary frames belong to an upload, and none has begun: push first."))
            return
        try:
            if await self._loop.run_in_executor(None, upload.write, data):
                self._ask(upload.push, {**_arguments(upload.push), "path": upload.path}, upload)
                self._upload = None
        except (BamTrainError, BamEnvsError) as error:
            self._end_upload(upload, error)

    def _end_upload(self, upload: Upload, error: Exception) -> None:
        upload.remove()
        self._upload, self._skip = None, upload.push.size - upload.received
        self._owner.pushing.remove(self)
        self._note(f"push: {error}")
        self._refuse(upload.push.id, error)

    # ---- answers

    def _answer(self, number: int, result: dict[str, Any]) -> None:
        self._send({"id": number, "ok": True, "result": result})

    def _refuse(self, number: int | None, error: Exception) -> None:
        if not isinstance(error, (BamTrainError, BamEnvsError)):
            _log.error("the agent failed", exc_info=error)
        text = " ".join((str(error) or type(error).__name__).split())
        self._send({"id": number, "ok": False, "error": text, "kind": kind_of(error)})

    def _send(self, message: Mapping[str, Any]) -> None:
        self._send_packet(Packet((protocol.encode_message(message),), text=True), 0)

    def _send_packet(self, packet: Packet, keep: int) -> None:
        """Send a packet, or let it wait for a slow client."""
        self._connection.put(packet, keep)
        self._connection.flush()

    def _post(self, work: Callable[[], None]) -> None:
        with contextlib.suppress(RuntimeError):  # the server was closed a moment ago
            self._loop.call_soon_threadsafe(work)

    def _note(self, why: str) -> None:
        self._owner.refusals.note(self._person.address, why)


def _arguments(request: protocol.Request) -> dict[str, Any]:
    return {name: getattr(request, name) for name in request.__struct_fields__ if name not in ("id", "name")}


class Upload:
    """Takes the bytes that a push announces into a new file in `folder`. Its content is never opened here.

    Raises:
        InvalidValue: The upload is larger than `most` bytes, or than the disk has room for.
        OutputError: The file cannot be written.
    """

    def __init__(self, folder: Path, push: protocol.Push, most: int) -> None:
        if (size := push.size) > most:
            raise InvalidValue(f"The upload has {_mb(size)}, and {_mb(most)} is the most that this agent takes.")
        self.push, self.received, self._digest = push, 0, hashlib.sha256()
        with _on_disk(folder):
            folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(folder).free
            if free < size + _RESERVE:
                raise InvalidValue(
                    f"The disk of the robot's computer has {_mb(free)} free, and the upload of {_mb(size)} needs "
                    f"{_mb(size + _RESERVE)}. Make room in {folder}."
                )
            number, name = tempfile.mkstemp(_SUFFIX, _PREFIX, folder)  # readable by this user alone
        self.path, self._file = Path(name), os.fdopen(number, "wb")

    def write(self, data: bytes) -> bool:
        """Add a piece; True if the upload is complete, and is what was announced. Otherwise the file is removed."""
        try:
            if self.received + len(data) > self.push.size:
                raise ProtocolError(f"The upload is longer than the {self.push.size} bytes that were announced.")
            with _on_disk(self.path.parent):
                self._file.write(data)
                self.received += len(data)
                self._digest.update(data)
                if self.received < self.push.size:
                    return False
                self._file.close()
            if (found := self._digest.hexdigest()) != self.push.sha256:
                raise ProtocolError(
                    f"The upload has the SHA-256 {found[:12]}, and {self.push.sha256[:12]} was announced. Push again."
                )
        except BaseException:
            self.remove()
            raise
        return True

    def remove(self) -> None:
        """Close and remove the file, if it is still there. Idempotent."""
        with contextlib.suppress(OSError):
            self._file.close()
        with contextlib.suppress(OSError):
            self.path.unlink()


def remove_leftovers(folder: Path) -> None:
    """Remove the uploads of a process that was killed."""
    for path in folder.glob(f"{_PREFIX}*{_SUFFIX}"):
        with contextlib.suppress(OSError):
            path.unlink()


class _on_disk(contextlib.AbstractContextManager[None]):  # noqa: N801 - reads as a phrase
    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            raise OutputError(f"The upload cannot be written to {self._folder}: {error.strerror or error}.") from error


def _mb(size: int) -> str:
    return f"{size / 1e6:.1f} MB"
