"""A live agent without a robot: the sockets are real, and the hub behind them does what a test tells it."""

from __future__ import annotations

import contextlib
import json
import threading

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import serve

from bam_envs.core.errors import NotInCommand
from bam_envs.rosbridge.server import BridgeServer, Page, Site
from bam_envs.rosbridge.tokens import Tokens
from bam_train.agent.front.agent_socket import AgentSocket
from bam_train.agent.remote.agent_client import AgentClient
from bam_train.agent.remote.agent_protocol import PATH, encode_message
from bam_train.errors import RequestRefused
from tests.tls_certificates import certificates

__all__ = ["certificates"]  # fixtures from elsewhere
DEADLINE = 10.0
ROLES = Tokens({"w": "watch", "d": "drive", "a": "administer"})
STATUS = {"state": "paused", "active": None, "owner": None}


class FakeHub:
    """Keeps what it was asked for. It answers at once, except ``pause``, which waits until `go` is set."""

    def __init__(self, incoming):
        self.incoming, self.asked, self.jogs, self.stops, self.gone = incoming, [], [], [], []
        self.scene = {"table": 0.0}
        self.go, self.listeners, self.threads = threading.Event(), {}, set()
        self.changed = threading.Condition()

    def ask(self, op, arguments, person, progress):
        content = arguments.pop("path").read_bytes() if op == "push" else None
        self._add(self.asked, (op, arguments, person))
        if op == "pause":
            progress("waits for the tick")
            assert self.go.wait(DEADLINE)
        if content is not None:
            progress("the checker reads it")
            if content.startswith(b"bad"):
                raise RequestRefused("the policy says NaN", "CandidateRefused")
            return {"digest": content[:4].hex(), "stage": "trial", "state": "on trial", "names": [], "lines": []}
        if op == "take":
            raise NotInCommand("bob@lab is in command")
        if op == "versions":
            raise KeyError("a mistake")
        return dict(STATUS)

    def stop(self, person, why):
        self.threads.add(threading.current_thread().name)
        self._add(self.stops, (person, why))
        return dict(STATUS)

    def jog(self, message, person):
        self.threads.add(threading.current_thread().name)
        self._add(self.jogs, message)
        if message["seq"] == 13:
            raise NotInCommand("bob@lab is in command")

    def listen(self, kind, listener):
        self.listeners.setdefault(kind, []).append(listener)
        return lambda: self.listeners[kind].remove(listener)

    def left(self, person):
        self._add(self.gone, person)

    def tell(self, kind, **event):
        for listener in tuple(self.listeners.get(kind, ())):
            listener(encode_message({"event": kind, **event}))

    def _add(self, where, what):
        with self.changed:
            where.append(what)
            self.changed.notify_all()

    def wait_for(self, condition):
        with self.changed:
            assert self.changed.wait_for(condition, DEADLINE)


class Raw:
    """A plain WebSocket to an agent, past its greeting."""

    def __init__(self, server, token=None, path="/agent", **options):
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._stack = contextlib.ExitStack()
        self.socket = self._stack.enter_context(
            connect(server.url + path, additional_headers=headers, compression=None, max_size=None, **options)
        )
        self.hello = self.receive() if path == "/agent" else None
        self._number = 0

    def close(self):
        self._stack.close()

    def send(self, op, **message):
        self._number += 1
        self.socket.send(json.dumps({"id": self._number, "op": op, **message}))

    def receive(self):
        return json.loads(self.socket.recv(DEADLINE))

    def ask(self, op, **message):
        """The answer, after what came before it."""
        self.send(op, **message)
        return self.answer()

    def answer(self, number=None):
        while (got := self.receive()).get("id") != (number or self._number) or "progress" in got:
            pass
        return got


@pytest.fixture
def hub(tmp_path):
    return FakeHub(tmp_path / "incoming")


@pytest.fixture
def new_server(hub):
    """Make servers with an agent socket; closed at the end."""
    with contextlib.ExitStack() as stack:

        def make(tokens=ROLES, options=None, **more):
            network = {name: more.pop(name) for name in ("cert", "key") if name in more}
            agent = AgentSocket(hub, **more)
            stack.callback(agent.close)
            page = Page("text/html; charset=utf-8", b"the console")
            site = Site({"/": page}, {PATH: agent.serve}, always=frozenset((PATH,)))
            return stack.enter_context(BridgeServer(port=0, tokens=tokens, site=site, options=options, **network))

        yield make
        hub.go.set()


@pytest.fixture
def server(new_server):
    return new_server()


@pytest.fixture
def new_raw(server):
    with contextlib.ExitStack() as stack:

        def make(token="a", on=None, **more):
            raw = Raw(on or server, token, **more)
            stack.callback(raw.close)
            return raw

        yield make


@pytest.fixture
def new_agent(server, tmp_path):
    """Make connected clients, with a token file each."""
    with contextlib.ExitStack() as stack:

        def make(token="a", url=None, **more):
            path = tmp_path / f"token-{token}"
            path.touch(0o600)
            path.write_text(f"{token}\n")
            return stack.enter_context(AgentClient(url or server.url, token_file=path, name="anna@laptop", **more))

        yield make


@contextlib.contextmanager
def serve_once(first):
    """A WebSocket server that greets with one message, within the ``with`` block; its URL."""

    def handle(connection):
        connection.send(first)
        with contextlib.suppress(ConnectionClosed):
            connection.recv()

    with serve(handle, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join(DEADLINE)


@pytest.fixture
def greeting():
    return serve_once
