"""A blocking client of a live agent, for programs: requests, uploads, events.

Longer than most files: it is one client, with all that may go wrong between two computers.
"""

from __future__ import annotations

import asyncio
import getpass
import hashlib
import itertools
import json
import logging
import math
import re
import socket
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from bam_envs import __version__
from bam_envs.core.errors import BamEnvsError, LinkLost, NoServer
from bam_envs.core.wording import brief
from bam_envs.rosbridge.bus import tell
from bam_envs.rosbridge.dialing import http_refusal, no_connection, open_port, silent
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.threads import LoopThread
from bam_train.agent.remote.agent_protocol import CHUNK, PATH, PROTOCOL, Stage, When
from bam_train.errors import AgentRefused, NotACheckpoint

PORT = 9095
"""Default port of an agent."""
_REFUSALS = frozenset(
    (
        *("CandidateRefused", "ContractRefused", "UntrustedCheckpoint", "AlteredCheckpoint", "NotACheckpoint"),
        *("NewerFormat", "CheckpointMismatch", "CheckpointError", "PolicyError", "TrialsNeeded", "UnknownVersion"),
        *("NotInCommand", "RoleTooLow", "InvalidValue", "SettingsError", "NotReady", "SafetyStop", "RequestRefused"),
    )
)
"""Kinds of errors by which an agent refuses what it understood."""
REFUSED = 3
"""Exit status of a program whose request an agent refuses."""
_LARGEST = 64 * 2**20
_SILENT_SERVER_TIMEOUT = 1.0  # time after which a silent server is asked whether it is one of rosbridge [s]
_PING, _PONG = 5.0, 20.0  # time between two pings, and longest time for their answer [s]
_CLOSE = 1.0  # longest time for a closing handshake [s]
_CLOSED_POLL_PERIOD = 0.5  # time between two looks whether the connection has ended [s]
_IS_IT_ROSBRIDGE = '{"op": "call_service", "service": "/rosapi/get_time", "id": "agent?"}'

_QUIET = logging.getLogger(f"{__name__}.websockets")
_QUIET.setLevel(logging.CRITICAL)  # a client itself reports in one line why it ended or did not connect
T = TypeVar("T")
Event = Mapping[str, Any]
Progress = Callable[[str], None]


class AgentClient:
    """A client of the agent at `url`; a context manager. Thread-safe.

    Args:
        url: ``ws://robot:9095`` or ``wss://…``; the port is 9095 by default.
        token_file: File with one token of the agent.
        ca_file: Certificate authorities that ``wss://`` trusts instead of the system's.
        timeout: Longest time to connect, and for an answer [s].
        name: Who asks, for the agent's log and for other people; by default the user and the computer.
    """

    def __init__(
        self,
        url: str,
        *,
        token_file: str | Path | None = None,
        ca_file: str | Path | None = None,
        timeout: float = 10.0,
        name: str | None = None,
    ) -> None:
        full = agent_url(url)
        self._endpoint = Endpoint.with_token_file(full, ca_file=ca_file, token_file=token_file)
        address = self._endpoint.address
        self.url, self.host, self.timeout, self.name = address.url, address.host, timeout, name or _whoami()
        self.role, self.agent = "", ""
        """What this client may do, and the agent's version of bam-train; known once it is connected."""
        self.error: BamEnvsError | None = None
        """Why the connection ended; None before."""
        self._numbers = itertools.count(1)
        self._answers: dict[int, tuple[Future[dict[str, Any]], Progress]] = {}
        self._listeners: dict[str, list[Callable[[Event], None]]] = {}
        self._order = threading.Lock()
        self._thread = LoopThread("bam-agent-client", self.url)
        self._socket: ClientConnection | None = None

    def connect(self) -> AgentClient:
        """Connect; returns itself.

        Raises:
            NoServer: There is no agent, or none that this version can talk to; the text gives the reason.
        """
        self._thread.start(self._main)
        return self

    def close(self) -> None:
        """Close the connection. Idempotent."""
        self._thread.post(self._hang_up)
        self._thread.join(2.0)

    def __enter__(self) -> AgentClient:
        return self.connect()

    def __exit__(self, *_: object) -> None:
        self.close()

    def ask(self, op: str, *, within: float | None = None, progress: Progress | None = None, **arguments: Any) -> Any:
        """Ask for `op` with its `arguments`, and return the result; `progress` gets lines while it lasts.

        Args:
            op: See `bam_train.agent.remote.agent_protocol`.
            within: Longest time for the answer [s]; by default that of the client, infinite is allowed.
            progress: Called in the network thread.
            arguments: Those of the op.

        Raises:
            AgentRefused: The agent refuses, or failed.
            LinkLost: The connection ended, or no answer came in time.
        """
        number, answer = self._begin(op, arguments, progress or (lambda text: None))
        try:
            return self._wait(answer, op, within or self.timeout)
        finally:
            self._answers.pop(number, None)

    def push(
        self,
        path: str | Path,
        *,
        stage: Stage = "auto",
        when: When = "episode",
        wait: bool = False,
        why: str = "",
        progress: Progress = lambda text: None,
    ) -> dict[str, Any]:
        """Upload a checkpoint, which becomes the candidate; with `wait`, return when its trial has ended.

        Returns:
            The version's ``digest``, the agent's ``state``, ``stage``, ``names``, ``active`` and ``owner``, the
            ``lines`` of the check, and with `wait` the ``outcome``: "promoted: …", "rolled back: …", "replaced: …".

        Raises:
            NotACheckpoint: The file cannot be read.
            AgentRefused: The agent refuses the candidate, or the trial failed.
            LinkLost: The connection ended.
        """
        try:
            data = Path(path).read_bytes()
        except OSError as error:
            raise NotACheckpoint(path, f"cannot be read: {error.strerror}. Give a checkpoint.zip.") from error
        go: Future[None] = Future()

        def heard(text: str) -> None:
            if go.done():
                progress(text)
            else:
                go.set_result(None)  # the agent takes the upload

        about = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        choice = {"stage": stage, "when": when, "wait": wait, "file": Path(path).name[:100], "why": why}
        number, answer = self._begin("push", {**about, **choice}, heard)
        answer.add_done_callback(lambda _: None if go.done() else go.set_result(None))
        try:
            self._wait(go, "push", self.timeout)
            if not answer.done():
                self._upload(data, answer, progress)
            return self._wait(answer, "push", math.inf)  # a trial takes as long as it takes; a dead link is noticed
        finally:
            self._answers.pop(number, None)

    def listen(self, op: str, listener: Callable[[Event], None]) -> None:
        """Call `listener` in the network thread with each event of ``watch`` or ``transitions``, until it closes."""
        kinds = ("status", "telemetry") if op == "watch" else (op,)
        for kind in kinds:
            self._listeners.setdefault(kind, []).append(listener)
        self.ask(op, on=True)

    # ---- inside: the caller's thread

    def _begin(self, op: str, arguments: Mapping[str, Any], progress: Progress) -> tuple[int, Future[dict[str, Any]]]:
        answer: Future[dict[str, Any]] = Future()
        with self._order:  # requests are sent in the order of their numbers
            number = next(self._numbers)
            self._answers[number] = answer, progress
            text = json.dumps({"id": number, "op": op, "name": self.name, **arguments})
            if self.error is not None or not self._thread.post(partial(self._send, text)):
                raise self.error or LinkLost(f"{self.url}: not connected: call connect().")
        return number, answer

    def _wait(self, answer: Future[T], op: str, within: float) -> T:
        end = time.monotonic() + within
        while not wait([answer], max(0.0, min(_CLOSED_POLL_PERIOD, end - time.monotonic()))).done:
            if self.error is not None:  # it ended before this was sent
                raise self.error
            if time.monotonic() > end:
                raise LinkLost(f"{self.url}: no answer to {op} within {within:g} s.")
        return answer.result()

    def _upload(self, data: bytes, answer: Future[dict[str, Any]], progress: Progress) -> None:
        told = time.monotonic()
        for start in range(0, len(data), CHUNK):
            sent: Future[None] = Future()
            piece = data[start : start + CHUNK]
            if not self._thread.post(partial(self._send, piece, sent)):
                break
            self._wait(sent, "push", math.inf)
            if answer.done():  # refused while it was on its way
                break
            if time.monotonic() - told > 1.0:
                told = time.monotonic()
                progress(f"sent {(start + len(piece)) / 1e6:.1f} of {len(data) / 1e6:.1f} MB")

    # ---- the network thread

    async def _main(self, ready: Future[None]) -> None:
        self._loop, self._tasks = asyncio.get_running_loop(), set[asyncio.Task[None]]()
        socket = await self._open()
        self._socket = socket
        ready.set_result(None)
        pings = asyncio.create_task(self._ping(socket))
        try:
            while True:
                self._take(json.loads(await socket.recv()))
        except ConnectionClosed as end:
            self._end(LinkLost(f"{self.url}: the link dropped: {_reason(end)}."))
        except (ValueError, KeyError, TypeError) as error:
            self._end(LinkLost(f"{self.url}: the server sent what is no message of an agent: {brief(str(error))}."))
        finally:
            pings.cancel()
            with suppress(ConnectionClosed):
                await socket.close()

    async def _open(self) -> ClientConnection:
        try:
            socket = await self._open_socket()
        except NoServer as error:
            raise self._better(error) from error.__cause__
        try:
            first = await asyncio.wait_for(self._hello(socket), self.timeout)
            problem = self._problem(first)
        except (asyncio.TimeoutError, ConnectionClosed, ValueError):
            problem = _NO_AGENT
        if problem:
            await socket.close()
            raise NoServer(self.url, problem)
        return socket

    async def _open_socket(self) -> ClientConnection:
        endpoint, address, timeout = self._endpoint, self._endpoint.address, self.timeout
        context, deadline = endpoint.tls_context(), time.monotonic() + timeout
        plain = await open_port(address, timeout)  # and so that websockets uses no proxy
        try:
            return await connect(
                f"{address.url}{PATH}",
                sock=plain,
                ssl=context,
                server_hostname=address.host if context is not None else None,
                additional_headers={"Authorization": f"Bearer {endpoint.token}"} if endpoint.token else None,
                compression=None,  # deflate costs more time than a fast network saves
                open_timeout=deadline - time.monotonic(),
                close_timeout=_CLOSE,
                ping_interval=None,
                max_size=_LARGEST,
                logger=_QUIET,
            )
        except InvalidStatus as error:
            refusal = http_refusal(error.response.status_code, bytes(error.response.body or b""))
            raise NoServer(address.url, refusal) from error
        except TimeoutError as error:
            raise NoServer(address.url, silent(address, timeout)) from error
        except OSError as error:
            raise NoServer(address.url, no_connection(address, error, timeout)) from error
        except ValueError as error:  # a redirect, which leads to another server than the one that was meant
            raise NoServer(address.url, f"a web server answers there: {error}. Is it the right port?") from error
        except WebSocketException as error:
            text = f"something listens there that is no WebSocket server ({error.__cause__ or error})."
            raise NoServer(address.url, f"{text} If it has TLS, use wss://.") from error

    async def _hello(self, socket: ClientConnection) -> Any:
        first = asyncio.ensure_future(socket.recv())
        done, _ = await asyncio.wait([first], timeout=_SILENT_SERVER_TIMEOUT)
        if not done:
            await socket.send(_IS_IT_ROSBRIDGE)
        return json.loads(await first)

    def _problem(self, hello: Any) -> str:
        """Why the other end is no agent of ours, by its first message; empty if it is one."""
        if not isinstance(hello, dict) or hello.get("event") != "hello":
            return _NO_AGENT
        self.role, self.agent, found = str(hello.get("role")), str(hello.get("agent")), hello.get("protocol")
        if found == PROTOCOL:
            return ""
        age = "newer" if isinstance(found, int) and found > PROTOCOL else "older"
        return (
            f"the agent there is {age}: bam-train {brief(self.agent)} has version {brief(found)} of the protocol, "
            f"and bam-train {__version__} here {PROTOCOL}. Install one version on both computers."
        )

    def _better(self, error: NoServer) -> NoServer:
        cause = error.__cause__
        if isinstance(cause, InvalidStatus) and cause.response.status_code == 404:
            return NoServer(self.url, _NO_AGENT)
        if isinstance(cause, ConnectionRefusedError):
            return NoServer(self.url, "refused: nothing listens there. Does bam-agent run there, with this port?")
        return error

    def _take(self, message: dict[str, Any]) -> None:
        if "event" in message:
            for listener in tuple(self._listeners.get(message["event"], ())):
                tell(listener, message)
            return
        answer, progress = self._answers.get(message["id"], (None, None))
        if answer is None or progress is None or answer.done():
            return
        if "progress" in message:
            tell(progress, str(message["progress"]))
        elif message["ok"]:
            answer.set_result(message["result"])
        else:
            kind = str(message["kind"])
            answer.set_exception(AgentRefused(kind, str(message["error"]), REFUSED if kind in _REFUSALS else 1))

    def _send(self, data: str | bytes, sent: Future[None] | None = None) -> None:
        async def send() -> None:
            with suppress(ConnectionClosed):  # `_main` learns of it too
                if self._socket is not None:
                    await self._socket.send(data)
            if sent is not None:
                sent.set_result(None)

        task = self._loop.create_task(send())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _ping(self, socket: ClientConnection) -> None:
        with suppress(ConnectionClosed):
            while True:
                await asyncio.sleep(_PING)
                try:
                    await asyncio.wait_for(await socket.ping(), _PONG)
                except asyncio.TimeoutError:
                    self._end(LinkLost(f"{self.url}: the link dropped: the agent was silent for {_PONG:g} s."))
                    socket.transport.abort()

    def _end(self, error: BamEnvsError) -> None:
        self.error = self.error or error
        for answer, _ in tuple(self._answers.values()):
            if not answer.done():
                answer.set_exception(self.error)

    def _hang_up(self) -> None:
        self._end(LinkLost(f"{self.url}: this client is closed."))
        if self._socket is not None:
            task = self._loop.create_task(self._socket.close())
            self._tasks.add(task)


_NO_AGENT = (
    "no live agent: a rosbridge server, or another program, answers there. Give the address of bam-agent "
    f"(ws://robot:{PORT}), of version 0.1 or newer."
)


def agent_url(text: str) -> str:
    """The address of an agent as a URL with a port; ``http://`` and ``https://`` of its console are accepted."""
    url = re.sub(rf"^http(?=s?://)|(?:{PATH})?/*$", lambda found: "ws" if found[0] == "http" else "", text)
    return url if re.search(r":\d+$", url) or not re.match(r"wss?://[^/]+$", url) else f"{url}:{PORT}"


def _whoami() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError, ImportError):  # a user without a name, in a container
        user = "somebody"
    return f"{user}@{socket.gethostname()}"[:100]


def _reason(end: ConnectionClosed) -> str:
    if end.rcvd is not None:
        return f"the agent closed it with {', '.join(filter(None, (f'code {end.rcvd.code}', end.rcvd.reason)))}"
    return "the connection was cut"
