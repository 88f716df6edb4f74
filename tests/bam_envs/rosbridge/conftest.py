"""A small rosbridge server that does what a test tells it, also what no server should do."""

import asyncio
import contextlib
import json
import socket
import threading
from http import HTTPStatus

import pytest
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

from tests.tls_certificates import certificates

__all__ = ["certificates"]  # fixtures from elsewhere
DEADLINE = 10.0


class ScriptedServer:
    """Keeps every frame it gets; answers requests from a table; misbehaves on request.

    It has TLS with a `context`, and refuses each connection with the HTTP `status`, if any.
    """

    def __init__(self, context=None, status=None, port=0):
        self.frames = []
        """Every message of every client, in order."""
        self.headers = []
        """HTTP path and authorization of each client."""
        self.responses = {"/rosapi/get_time": lambda args: {"time": {"sec": 1000, "nanosec": 500_000_000}}}
        """By service: a function of the arguments. A text it returns is the text of a failure; None: no answer."""
        self.port = port
        self.connected = 0
        self._context, self._status = context, status
        self._changed = threading.Condition()
        self.connections = set()
        self.loop = self._server = self._thread = None

    @property
    def url(self):
        return f"{'wss' if self._context else 'ws'}://127.0.0.1:{self.port}"

    def start(self):
        started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run(started)), name="scripted-server")
        self._thread.start()
        assert started.wait(DEADLINE)
        return self

    def stop(self, code=1001):
        with contextlib.suppress(RuntimeError):  # its loop is closed: the server has ended by itself
            self.loop.call_soon_threadsafe(self.stopped.set)
        self._thread.join(DEADLINE)
        assert not self._thread.is_alive()

    def send(self, *messages):
        """Send dicts as JSON, text and bytes as they are, to every client."""
        for message in messages:
            data = json.dumps(message) if isinstance(message, dict) else message
            asyncio.run_coroutine_threadsafe(self._send(data), self.loop).result(DEADLINE)

    def drop(self):
        """Cut every TCP connection, without a closing handshake."""
        self._on_each(lambda connection: connection.transport.abort())

    def freeze(self):
        """Neither read nor answer, as a stopped process does."""
        self._on_each(lambda connection: connection.transport.pause_reading())

    def close_without_end(self):
        """Begin a closing handshake, and leave the TCP connections open."""
        self._on_each(lambda connection: connection.transport.write(b"\x88\x02\x03\xe8"))

    def wait_for(self, op, count=1):
        """The messages with this `op`, once there are `count` of them."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.of(op)) >= count, DEADLINE), self.frames
            return self.of(op)

    def wait_connected(self, count):
        """Wait until so many clients are connected now."""
        with self._changed:
            assert self._changed.wait_for(lambda: self.connected == count, DEADLINE), self.connected

    def of(self, op):
        return [frame for frame in self.frames if frame["op"] == op]

    def _on_each(self, action):
        done = threading.Event()

        def act():
            for connection in self.connections:
                action(connection)
            done.set()

        self.loop.call_soon_threadsafe(act)
        assert done.wait(DEADLINE)

    async def _run(self, started):
        self.loop, self.stopped = asyncio.get_running_loop(), asyncio.Event()
        settings = {"ssl": self._context, "process_request": self._greet, "compression": None, "ping_interval": None}
        async with serve(self._serve, "127.0.0.1", self.port, max_size=None, close_timeout=0.5, **settings) as server:
            self.port = server.sockets[0].getsockname()[1]
            started.set()
            await self.stopped.wait()

    def _greet(self, connection, request):
        self.headers.append((request.path, request.headers.get("Authorization")))
        return None if self._status is None else connection.respond(HTTPStatus(self._status), "no")

    async def _serve(self, connection):
        self._count(connection, 1)
        try:
            async for text in connection:
                await self._take(connection, json.loads(text))
        except ConnectionClosed:
            pass
        finally:
            self._count(connection, -1)

    async def _take(self, connection, frame):
        with self._changed:
            self.frames.append(frame)
            self._changed.notify_all()
        if frame["op"] != "call_service":
            return
        respond = self.responses.get(frame["service"], lambda args: f"Service {frame['service']} does not exist")
        values = respond(frame["args"])
        if values is not None:
            head = {"op": "service_response", "id": frame["id"], "service": frame["service"]}
            await connection.send(json.dumps({**head, "values": values, "result": not isinstance(values, str)}))

    async def _send(self, data):
        for connection in set(self.connections):
            await connection.send(data)

    def send_soon(self, message):
        """Send a dict; for the functions in `responses`, which run in the server's thread."""
        self.loop.create_task(self._send(json.dumps(message)))

    def _count(self, connection, change):
        with self._changed:
            self.connected += change
            (self.connections.add if change > 0 else self.connections.discard)(connection)
            self._changed.notify_all()


class Heard:
    """A listener that keeps what it hears."""

    def __init__(self):
        self.messages = []
        self._changed = threading.Condition()

    def __call__(self, message, caller=None):
        with self._changed:
            self.messages.append(message)
            self._changed.notify_all()

    def wait(self, count=1):
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.messages) >= count, DEADLINE), self.messages
            return self.messages


@pytest.fixture
def new_heard():
    return Heard


@pytest.fixture
def heard():
    return Heard()


@pytest.fixture
def new_scripted(stack):
    """Make `ScriptedServer`s; they are stopped at the end."""

    def make(**options):
        server = ScriptedServer(**options).start()
        stack.callback(server.stop)
        return server

    return make


@pytest.fixture
def scripted(new_scripted):
    """A running `ScriptedServer`."""
    return new_scripted()


@pytest.fixture
def new_link(stack):
    """Make a connected `RosbridgeLink`; closed at the end. Options are of the link, or of its endpoint."""
    from bam_envs.rosbridge.client import RosbridgeLink
    from bam_envs.rosbridge.endpoint import Endpoint

    def make(server, connect=True, **options):
        url = server if isinstance(server, str) else server.url
        names = ("credentials", "token", "connect_timeout")
        endpoint = Endpoint(url, **{name: options.pop(name) for name in names if name in options})
        link = RosbridgeLink(endpoint, **options)
        stack.callback(link.close)
        if connect:
            link.connect()
        return link

    return make


@pytest.fixture
def link(scripted, new_link):
    """A link to `scripted`."""
    return new_link(scripted)


@pytest.fixture
def free_port():
    """A port at which nothing listens."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return taken.getsockname()[1]
