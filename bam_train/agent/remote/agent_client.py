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
import time
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import CancelledError, Future, wait
from concurrent.futures import TimeoutError as NoResult
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from bam_envs import __version__
from bam_envs.core.errors import BamEnvsError, LinkLost, NoServer
from bam_envs.core.location import Credentials
from bam_envs.core.wording import brief
from bam_envs.rosbridge.bus import tell
from bam_envs.rosbridge.dialing import AGENT_PORT, http_refusal, no_connection, no_websocket, open_port, silent
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.threads import LoopThread
from bam_train.agent.remote.agent_protocol import CHUNK, PATH, PROTOCOL, Stage, When
from bam_train.errors import CheckpointError, RequestRefused

PORT = AGENT_PORT
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
_RECOGNITION_TIMEOUT = 2.0  # longest wait until another server says what it is [s]
_CLOSE = 1.0  # longest time for a closing handshake [s]
_ENDED_POLL_PERIOD = 0.5  # time between two looks whether the network thread has ended [s]
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
        self._endpoint = Endpoint(full, Credentials.of(ca_file, token_file))
        address = self._endpoint.address
        self.url, self.host, self.timeout, self.name = address.url, address.host, timeout, name or _whoami()
        self.role, self.agent = "", ""
        """What this client may do, and the agent's version of bam-train; known once it is connected."""
        self.error: BamEnvsError | None = None
        """Why the connection ended; None before."""
        self._numbers = itertools.count(1)
        self._answers: dict[int, tuple[asyncio.Future[dict[str, Any]], Progress]] = {}
        self._listeners: dict[str, list[Callable[[Event], None]]] = {}
        self._thread = LoopThread("bam-agent-client", self.url)
        self._socket: ClientConnection

    def connect(self) -> AgentClient:
        """Connect; returns itself.

        Raises:
            NoServer: There is no agent, or none that this version can talk to; the text gives the reason.
        """
        try:
            self._thread.start(self._main)
        except NoServer as error:
            if not str(error).endswith(_NO_AGENT):
                raise
            from bam_envs.live.bringup import what_answers_at

            endpoint = replace(self._endpoint, connect_timeout=min(self.timeout, _RECOGNITION_TIMEOUT))
            raise NoServer(self.url, what_answers_at(endpoint, "live agent") or _NO_AGENT) from error
        return self

    def close(self) -> None:
        """Close the connection. Idempotent."""

        async def hang_up() -> None:
            self.error = LinkLost(f"{self.url}: this client is closed.")
            await self._socket.close()

        with suppress(BamEnvsError):
            self._run(hang_up())
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
            RequestRefused: The agent refuses, or failed.
            LinkLost: The connection ended, or no answer came in time.
        """
        return self._run(self._ask(op, arguments, progress or (lambda text: None), within or self.timeout))

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
            CheckpointError: The file cannot be read.
            RequestRefused: The agent refuses the candidate, or the trial failed.
            LinkLost: The connection ended.
        """
        try:
            data = Path(path).read_bytes()
        except OSError as error:
            raise CheckpointError(path, f"cannot be read: {error.strerror}. Give a checkpoint.zip.") from error
        about = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest(), "file": Path(path).name[:100]}
        result: dict[str, Any] = self._run(
            self._push(data, {**about, "stage": stage, "when": when, "wait": wait, "why": why}, progress)
        )
        return result

    def listen(self, op: str, listener: Callable[[Event], None]) -> None:
        """Call `listener` in the network thread with each event of ``watch`` or ``transitions``, until it closes."""
        kinds = ("status", "telemetry") if op == "watch" else (op,)
        for kind in kinds:
            self._listeners.setdefault(kind, []).append(listener)
        self.ask(op, on=True)

    def _run(self, task: Coroutine[Any, Any, T]) -> T:
        """The result of `task` in the network thread; `LinkLost` if the connection ends before."""
        running, loop = None, self._thread.loop
        if self.error is None and loop is not None:
            with suppress(RuntimeError):  # it was closed a moment ago
                running = asyncio.run_coroutine_threadsafe(task, loop)
        if running is None:
            task.close()
            raise self.error or LinkLost(f"{self.url}: not connected: call connect().")
        try:
            while not wait([running], _ENDED_POLL_PERIOD).done and self._thread.loop is not None:
                pass
            return running.result(0)
        except (CancelledError, NoResult):  # the connection ended, perhaps before the task began
            raise self.error or LinkLost(f"{self.url}: the link dropped.") from None
        finally:
            running.cancel()  # after Ctrl-C

    # ---- the network thread

    async def _ask(self, op: str, arguments: Mapping[str, Any], progress: Progress, within: float) -> dict[str, Any]:
        answer = asyncio.get_running_loop().create_future()
        number = next(self._numbers)
        self._answers[number] = answer, progress
        try:
            await self._send(json.dumps({"id": number, "op": op, "name": self.name, **arguments}))
            result: dict[str, Any] = await asyncio.wait_for(answer, None if within == math.inf else within)
            return result
        except asyncio.TimeoutError as error:
            raise self._late(op, within) from error
        finally:
            del self._answers[number]

    async def _push(self, data: bytes, about: Mapping[str, Any], progress: Progress) -> dict[str, Any]:
        go = asyncio.Event()  # the agent takes the upload, or has answered

        def heard(text: str) -> None:
            progress(text) if go.is_set() else go.set()

        # A trial takes as long as it takes; a dead link is noticed.
        answer = asyncio.create_task(self._ask("push", about, heard, math.inf))
        answer.add_done_callback(lambda _: go.set())
        try:
            await asyncio.wait_for(go.wait(), self.timeout)
            told = time.monotonic()
            for start in range(0, len(data), CHUNK):
                if answer.done():  # refused while it was on its way
                    break
                await self._send(data[start : start + CHUNK])
                if time.monotonic() - told > 1.0:
                    told = time.monotonic()
                    tell(progress, f"sent {min(start + CHUNK, len(data)) / 1e6:.1f} of {len(data) / 1e6:.1f} MB")
            return await answer
        except asyncio.TimeoutError as error:
            raise self._late("push", self.timeout) from error
        finally:
            answer.cancel()

    def _late(self, op: str, within: float) -> LinkLost:
        return LinkLost(f"{self.url}: no answer to {op} within {within:g} s.")

    async def _send(self, data: str | bytes) -> None:
        with suppress(ConnectionClosed):  # `_main` learns of it too, and its end cancels what waits
            await self._socket.send(data)

    async def _main(self, ready: Future[None]) -> None:
        self._socket = await self._open()
        ready.set_result(None)
        try:
            while True:
                self._take(json.loads(await self._socket.recv()))
        except ConnectionClosed as end:
            self.error = self.error or LinkLost(f"{self.url}: the link dropped: {_reason(end)}.")
        except (ValueError, KeyError, TypeError) as error:
            reason = f"the server sent what is no message of an agent: {brief(str(error))}."
            self.error = LinkLost(f"{self.url}: {reason}")
        finally:  # the end of this task cancels those of `_run`
            await self._socket.close()

    async def _open(self) -> ClientConnection:
        socket = await self._open_socket()
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
        try:
            plain = await open_port(address, timeout)  # and so that websockets uses no proxy
        except NoServer as error:
            if isinstance(error.__cause__, ConnectionRefusedError):
                reason = "refused: nothing listens there. Does bam-agent run there, with this port?"
                raise NoServer(address.url, reason) from error.__cause__
            raise
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
                ping_interval=_PING,
                ping_timeout=_PONG,
                max_size=_LARGEST,
                logger=_QUIET,
            )
        except InvalidStatus as error:
            status = error.response.status_code
            body = bytes(error.response.body or b"")
            refusal = _NO_AGENT if status == 404 else http_refusal(status, body, endpoint.token)
            raise NoServer(address.url, refusal) from error
        except TimeoutError as error:
            raise NoServer(address.url, silent(address, timeout)) from error
        except OSError as error:
            raise NoServer(address.url, no_connection(address, error, timeout)) from error
        except ValueError as error:  # a redirect, which leads to another server than the one that was meant
            raise NoServer(address.url, f"a web server answers there: {error}. Is it the right port?") from error
        except WebSocketException as error:
            raise NoServer(address.url, no_websocket(error.__cause__ or error)) from error

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
            answer.set_exception(RequestRefused(str(message["error"]), kind, REFUSED if kind in _REFUSALS else 1))


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
    if end.sent is not None and end.sent.reason == "keepalive ping timeout":  # as `websockets` says it
        return f"the agent was silent for {_PONG:g} s"
    if end.rcvd is not None:
        return f"the agent closed it with {', '.join(filter(None, (f'code {end.rcvd.code}', end.rcvd.reason)))}"
    return "the connection was cut"
