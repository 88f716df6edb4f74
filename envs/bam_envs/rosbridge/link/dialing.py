"""Connecting to a server that is ready: the socket, TLS, the WebSocket handshake, and a request that it answers."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from bam_envs.core.errors import LinkLost, NoServer, RemoteError
from bam_envs.rosbridge.endpoint import Address, Endpoint
from bam_envs.rosbridge.link.connection import Connection
from bam_envs.rosbridge.link.refusals import no_connection, no_websocket, refused_status, silent_bridge, silent_port

_CLOCK_PROBES = 3
_DEAD_NODE = "context is invalid"
"""What rosbridge_suite answers to everything after its node was told to end."""


@dataclass(frozen=True)
class Dial:
    """What it takes to connect."""

    endpoint: Endpoint
    """Where to, and with what."""
    max_message: int
    """Largest message to receive [bytes]."""

    @property
    def address(self) -> Address:
        """Where to."""
        return self.endpoint.address


@dataclass(frozen=True)
class ServerClock:
    """What a server says of itself and its time."""

    ros: str | None
    """``"ros1"`` or ``"ros2"``, by how it spells a time; None where it tells none."""
    offset: float | None
    """Our wall clock minus theirs [s], to within half the round trip; None where it tells none."""


async def dial_server(dial: Dial, connection: Connection, timeout: float, clock: Callable[[], float]) -> ServerClock:
    """Open `connection` and see that a rosbridge server answers on it.

    Args:
        dial: Where to, and how.
        connection: A new one.
        timeout: For everything together [s].
        clock: Our wall clock [s].

    Raises:
        NoServer: One of many reasons, each with its own text; a `ConnectionRefusedError` is its cause where the server
            may just not be up yet.
        InvalidValue: The CA file cannot be read.
    """
    deadline = time.monotonic() + timeout
    transport = await _open_socket(dial, connection, timeout)
    try:
        await asyncio.wait_for(asyncio.shield(connection.opening), deadline - time.monotonic())
        if connection.error is not None:
            raise _not_opened(connection)
        return await _first_answer(connection, deadline, clock)
    except asyncio.TimeoutError as error:
        silence = silent_bridge if connection.opening.done() else silent_port
        raise silence(connection.url, timeout) from error
    finally:
        if not connection.ready:
            transport.abort()


async def _open_socket(dial: Dial, connection: Connection, timeout: float) -> asyncio.Transport:
    from bam_envs.rosbridge.link.protocol import LinkFactory, open_socket

    context = dial.endpoint.tls_context()
    factory = LinkFactory(dial.address, dial.endpoint.headers, dial.max_message, connection)
    try:
        return await asyncio.wait_for(open_socket(factory, dial.address, context), timeout)
    except (OSError, asyncio.TimeoutError) as error:
        raise no_connection(dial.address, error, timeout) from error


def _not_opened(connection: Connection) -> NoServer:
    status = re.search(r"upgrade failed \[(\d+)\]", connection.reason)
    if status is None:
        return no_websocket(connection.url, connection.reason)
    return refused_status(connection.url, int(status[1]))


async def _first_answer(connection: Connection, deadline: float, clock: Callable[[], float]) -> ServerClock:
    best, best_trip = ServerClock(None, None), float("inf")
    for probe in range(_CLOCK_PROBES):
        asked = clock()
        found = await _ask_time(connection, probe, deadline)
        answered = clock()
        if found is None:
            break
        if answered - asked < best_trip:
            best_trip, best = answered - asked, _read_clock(found, (asked + answered) / 2)
    connection.ready = True
    return best


async def _ask_time(connection: Connection, probe: int, deadline: float) -> Mapping[str, Any] | None:
    # Any answer will do, also that there is no such service: it comes from the part of the server that does the work.
    identity = f"ready:{connection.epoch}:{probe}"
    request = {
        "op": "call_service",
        "id": identity,
        "service": "/rosapi/get_time",
        "type": "rosapi/GetTime",
        "args": {},
    }
    try:
        answer = await asyncio.wait_for(connection.ask(identity, request), deadline - time.monotonic())
    except RemoteError:
        return None
    except NoServer:
        raise
    except LinkLost as error:
        text = f"closed the connection before it answered a request: {connection.reason}."
        raise NoServer(connection.url, text) from error
    values = answer.get("values")
    if isinstance(values, str) and _DEAD_NODE in values:
        text = f"its ROS node has ended and its socket has not ({values}). Restart the bridge."
        raise NoServer(connection.url, text)
    found = values.get("time") if isinstance(values, Mapping) else None
    return found if isinstance(found, Mapping) else None


def _read_clock(found: Mapping[str, Any], now: float) -> ServerClock:
    for ros, seconds, nanoseconds in (("ros2", "sec", "nanosec"), ("ros1", "secs", "nsecs")):
        if isinstance(found.get(seconds), int) and isinstance(found.get(nanoseconds), int):
            return ServerClock(ros, now - found[seconds] - found[nanoseconds] * 1e-9)
    return ServerClock(None, None)
