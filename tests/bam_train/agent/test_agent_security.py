"""Attacks on the port of a real agent: each is refused and logged in one line, and changes nothing.

Longer than most files: every case is here, as one agent serves them all.
"""

import contextlib
import hashlib
import io
import itertools
import json
import os
import pickle
import socket
import ssl
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import gymnasium as gym
import pytest
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus
from websockets.sync.client import connect

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.errors import RemoteError
from bam_envs.core.location import LiveRobot
from bam_train.agent.agent_options import AgentOptions

DEADLINE = 60.0
CHECKPOINT = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"
TOKENS = {"www": "watch", "ddd": "drive", "aaa": "administer"}
PROGRAM = "import sys; from bam_train.cli.live.live_agent import main; main(sys.argv[1:])"
UPGRADE = ("Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {'A' * 22}==", "Sec-WebSocket-Version: 13")
PATHS = ("/", "/agent", "/camera")


class Agent:
    """`bam-agent` with a simulated robot, in processes of its own."""

    def __init__(self, folder, *arguments):
        self.tokens, self._log = folder / "tokens", folder / "log"
        self.tokens.touch(0o600)
        self.write_tokens(TOKENS)
        self._hosts = itertools.count()
        command = [sys.executable, "-c", PROGRAM, "--policy", str(CHECKPOINT), "--port", "0", *arguments]
        with self._log.open("w") as log:
            self.process = subprocess.Popen(
                [*command, "--folder", str(folder / "agent"), "--no-record"],
                stdout=log,
                stderr=log,
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )
        line = self.logged("listens on ws://127.0.0.1:", 0)
        self.port = int(line.partition("ws://127.0.0.1:")[2].partition(";")[0])
        self.incoming = folder / "agent" / "incoming"

    def close(self):
        self.process.terminate()
        self.process.wait(DEADLINE)

    def write_tokens(self, tokens):
        self.tokens.write_text("".join(f"{role} {token}\n" for token, role in tokens.items()))

    def lines(self):
        return self._log.read_text().splitlines()

    def logged(self, text, after):
        """The line of the log, behind its first `after` ones, that holds `text`."""
        end = time.monotonic() + DEADLINE
        while True:
            for line in self.lines()[after:]:
                if text in line:
                    return line
            assert time.monotonic() < end, (text, self.lines()[after:])
            assert self.process.poll() is None, self.lines()
            time.sleep(0.02)

    def dial(self, host=None):
        """A TCP connection, by default from an address of its own, which no limit has seen."""
        if host is None:
            number = next(self._hosts)
            host = f"127.1.{number // 250}.{number % 250 + 1}"
        with contextlib.suppress(OSError):  # a system with one loopback address
            return socket.create_connection(("127.0.0.1", self.port), DEADLINE, source_address=(host, 0))
        return socket.create_connection(("127.0.0.1", self.port), DEADLINE)

    def open(self, path="/agent", token=None, host=None, **headers):
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
        url = f"ws://127.0.0.1:{self.port}{path}"
        options = {"compression": None, "max_size": None, "open_timeout": DEADLINE}
        return connect(url, sock=self.dial(host), additional_headers=headers, **options)

    def status(self):
        with self.open(token="www") as client:
            return ask(client, "status")["result"]


def receive(client):
    return json.loads(client.recv(DEADLINE))


def answer(client, number):
    while (got := receive(client)).get("id") != number or "progress" in got:
        pass
    return got


def ask(client, op, number=1, **arguments):
    client.send(json.dumps({"id": number, "op": op, **arguments}))
    return answer(client, number)


def status_of(error):
    return error.value.response.status_code, error.value.response.body.decode().strip()


def ending(client):
    """Close code and reason with which the agent ends a connection."""
    with pytest.raises(ConnectionClosed) as caught:
        drain(client)
    return caught.value.rcvd.code, caught.value.rcvd.reason


def drain(client):
    """Everything that comes, until the connection ends."""
    while True:
        client.recv(DEADLINE)


@pytest.fixture(scope="module")
def paused(tmp_path_factory):
    """A paused agent: on a busy computer a simulated robot that moves may be stopped by a guard."""
    folder = tmp_path_factory.mktemp("agent")
    agent = Agent(folder, "--paused", "--token-file", str(folder / "tokens"))
    try:
        agent.logged("-> paused", 0)
        before = agent.status()
        yield agent
        after = agent.status()
        assert (after["active"], after["names"]) == (before["active"], before["names"])
        assert not [line for line in agent.lines() if "Traceback" in line or "Error:" in line]
        assert list(agent.incoming.iterdir()) == []
    finally:
        agent.close()


@pytest.fixture
def agent(paused):
    """The same one; after each test it is as it was."""
    yield paused
    status = paused.status()
    assert (status["state"], status["owner"]) == ("paused", None)


@pytest.fixture
def refusals(agent):
    """``refusals(text)`` waits for a line of the log that ends with " was refused: {text}"."""
    begun = len(agent.lines())
    return lambda text: agent.logged(f" was refused: {text}", begun)


NO_TOKEN = "This server needs its token: send the header 'Authorization: Bearer TOKEN'."
IN_ADDRESS = "A token never stands in an address, which is logged: send the header 'Authorization: Bearer TOKEN'."


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    ("query", "token", "status", "text"),
    [
        ("", None, 401, NO_TOKEN),
        ("", "aab", 401, "The token is wrong."),
        ("?token=aaa", None, 400, IN_ADDRESS),
        ("?token=aaa", "aaa", 400, IN_ADDRESS),
    ],
    ids=["no token", "a wrong token", "a token in the address", "two tokens"],
)
def test_tokens(agent, refusals, path, query, token, status, text):
    with pytest.raises(InvalidStatus) as error, agent.open(path + query, token):
        pass
    assert status_of(error) == (status, text)
    refusals(text)


def test_a_stale_token(agent, refusals):
    agent.write_tokens({**TOKENS, "old": "administer"})
    with agent.open(token="old") as client:
        assert ask(client, "status")["ok"]
        agent.write_tokens(TOKENS)
        assert ending(client) == (1008, "The token of this connection is valid no longer.")
    refusals("The token of this connection is valid no longer.")
    with pytest.raises(InvalidStatus) as error, agent.open(token="old"):
        pass
    assert status_of(error) == (401, "The token is wrong.")


@pytest.mark.parametrize(
    ("path", "origin"),
    [(path, "https://evil.example") for path in PATHS] + [("/agent", one) for one in ("null", "http://127.0.0.1:1")],
)
def test_a_page_of_another_origin(agent, refusals, path, origin):
    with pytest.raises(InvalidStatus) as error, agent.open(path, "aaa", Origin=origin):
        pass
    own = f"http://127.0.0.1:{agent.port}"
    assert status_of(error) == (403, f"The page {origin!r} is not of this server, which is {own!r}.")
    refusals(f"The page {origin!r} is not of this server")


def raw(agent, *lines):
    """What the agent answers to these lines, until it closes or is silent."""
    with agent.dial() as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        return client.recv(100_000).decode()


def test_without_tokens_a_foreign_name_that_leads_here(new_server, caplog):
    """DNS rebinding: the fake agent behind a real port, as the real one has tokens here."""
    from bam_envs.rosbridge.tokens import Tokens

    server = new_server(Tokens(otherwise="administer"))
    server.dial = lambda: socket.create_connection(("127.0.0.1", server.port), DEADLINE)
    reason = "Without tokens this server is there for 127.0.0.1 and localhost only, not for 'evil.example'."
    for more in ((), UPGRADE, (*UPGRADE, "Origin: http://evil.example")):
        assert raw(server, "GET /agent HTTP/1.1", "Host: evil.example", *more).startswith("HTTP/1.1 403 Forbidden")
    assert reason in caplog.records[0].getMessage()


def test_a_second_driver(agent, refusals):
    with agent.open(token="ddd") as first, agent.open(token="ddd") as second:
        try:
            assert ask(first, "take", name="anna")["ok"]
            refused = ask(second, "take", name="bob")
            assert (refused["ok"], refused["kind"]) == (False, "NotInCommand")
            assert refused["error"].startswith("anna (")
            second.send('{"op": "jog", "seq": 1, "twist": [0.1, 0, 0, 0]}')
            assert receive(second)["kind"] == "NotInCommand"
            forced = ask(second, "take", 3, force=True)
            assert forced["kind"] == "RoleTooLow"
            refusals("take: anna (")
            refusals("jog: NotInCommand")
            refusals("take: Taking command by force needs a token of the role administer")
        finally:
            assert ask(first, "hand_back", 2, resume=False)["ok"]


def test_an_upload_of_10_gb_undeclared(agent, refusals):
    with agent.open(token="aaa") as client:
        client.send(json.dumps({"id": 1, "op": "push", "size": 1000, "sha256": "0" * 64}))
        assert "progress" in answer_or_progress(client)
        with contextlib.suppress(ConnectionClosed):  # what goes on is a flood
            for _ in range(10_000):
                client.send(bytes(10_000))
        got = []
        with contextlib.suppress(ConnectionClosed):
            while True:
                got.append(receive(client))
        assert got[0]["error"] == "The upload is longer than the 1000 bytes that were announced."
    refusals("push: The upload is longer than the 1000 bytes that were announced.")


def answer_or_progress(client):
    while "id" not in (got := receive(client)):
        pass
    return got


@pytest.mark.parametrize(
    "path", ["/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..\\..\\secret", "/tokens"]
)
def test_path_traversal_by_a_page(agent, refusals, path):
    answered = raw(agent, f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{agent.port}")
    assert answered.startswith("HTTP/1.1 404 Not Found")
    assert answered.endswith(f"There is no {path!r} here.\n")
    refusals(f"There is no {path!r} here.")


def test_bytes_that_are_no_request(agent, refusals):
    with agent.dial() as client:
        client.sendall(bytes(range(256)) * 4)
        with contextlib.suppress(ConnectionError):
            client.recv(1000)
    refusals("It sent no complete request.")


def test_slow_loris_before_the_request(agent, refusals):
    began = time.monotonic()
    with agent.dial() as client:
        client.sendall(b"GET /agent HTTP/1.1\r\n")
        with contextlib.suppress(OSError):
            while time.monotonic() - began < DEADLINE:
                client.sendall(b"X-A: b\r\n")
                time.sleep(0.1)
    assert 1.0 < time.monotonic() - began < DEADLINE
    refusals("It sent no complete request.")


@pytest.mark.parametrize("path", PATHS)
def test_slow_loris_before_the_token(agent, refusals, path):
    began = time.monotonic()
    with agent.open(path, Origin=f"http://127.0.0.1:{agent.port}") as client:
        first = 'The first message of a page must be its token, within 2 s: {"op": "auth", "token": TOKEN}'
        assert ending(client) == (1008, first)
    assert time.monotonic() - began > 1.5
    refusals(first)


def test_a_flood_of_connections(agent, refusals):
    flood = [agent.dial("127.0.0.1") for _ in range(300)]
    try:
        with agent.open(token="www", host="127.0.0.1") as client:
            assert ask(client, "status")["ok"]
        refusals("It opens too many sockets.")
    finally:
        for one in flood:
            one.close()


def test_a_flood_of_wrong_tokens(agent, refusals):
    codes = []
    for number in range(40):
        with pytest.raises(InvalidStatus) as error, agent.open(token=f"guess {number}", host="127.0.0.250"):
            pass
        codes.append(error.value.response.status_code)
    assert codes[:4] == [401] * 4
    assert 429 in codes
    with agent.open(token="www") as client:
        assert ask(client, "status")["ok"]
    refusals("Too many wrong tokens came from this address; try again in a second.")


@pytest.mark.parametrize(("path", "size"), [("/agent", 1 << 21), ("/camera", 1 << 21), ("/", 1 << 25)])
def test_a_giant_frame(agent, refusals, path, size):
    with agent.open(path, "ddd") as client:
        with contextlib.suppress(ConnectionClosed):
            client.send(b" " * size, text=True)
        with pytest.raises(ConnectionClosed) as caught:
            drain(client)
    assert caught.value.rcvd is None or caught.value.rcvd.code == 1009
    refusals("Its connection was closed: 1009 (message too big)")


def test_a_watcher_of_the_topics_sends_nothing(agent, refusals):
    reason = "This needs a token of the role drive; the token shown may watch, and halt the robot."
    with agent.open("/", "www") as client:
        topic = "/joint_group_velocity_controller/commands"
        message = {"op": "publish", "topic": topic, "msg": {"data": [0.1] * 6}}
        client.send(json.dumps(message))
        assert receive(client)["msg"].endswith(reason)
        client.send(json.dumps({"op": "call_service", "id": "1", "service": "/bam/session"}))
        assert receive(client)["values"] == reason
    refusals("publish is not for the role watch")
    refusals("The service /bam/session is not for the role watch")


def test_a_watcher_who_would_drive_by_a_program(agent, refusals, tmp_path):
    path = tmp_path / "token"
    path.touch(0o600)
    path.write_text("www")
    env = gym.make("bam/pick-v0", robot=f"ws://127.0.0.1:{agent.port}", token_file=str(path))
    with contextlib.closing(env), pytest.raises(RemoteError) as error:
        env.reset()
    reason = "This needs a token of the role drive; the token shown may watch, and halt the robot."
    assert str(error.value).endswith(reason)
    refusals("The service /bam/session is not for the role watch")


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


@pytest.mark.parametrize("wrapped", [False, True], ids=["alone", "in a zip"])
def test_a_pickle_is_never_opened(agent, refusals, tmp_path, wrapped):
    mark = tmp_path / "it-ran"
    data = pickle.dumps(Bomb(mark))
    if wrapped:
        box = io.BytesIO()
        with zipfile.ZipFile(box, "w") as archive, zipfile.ZipFile(CHECKPOINT) as good:
            for name in good.namelist():
                archive.writestr(name, data if name in ("data", "policy.pth") else good.read(name))
        data = box.getvalue()
    with agent.open(token="aaa") as client:
        about = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest(), "file": "pick.zip"}
        client.send(json.dumps({"id": 1, "op": "push", **about}))
        assert "progress" in answer_or_progress(client)
        for start in range(0, len(data), 250_000):
            client.send(data[start : start + 250_000])
        refused = answer(client, 1)
    assert refused["ok"] is False
    refusals("push: ")
    assert not mark.exists()


@pytest.mark.parametrize(
    ("bind", "cert", "warns"),
    [("127.0.0.1", None, False), ("localhost", None, False), ("0.0.0.0", None, True), ("0.0.0.0", "cert.pem", False)],
)
def test_tls_is_recommended_where_other_computers_connect(bind, cert, warns):
    text = "tokens and commands go over 0.0.0.0 unencrypted: give --cert and --key, or trust that network"
    options = AgentOptions(LiveRobot("ws://robot:9090"), Path("agent"), bind=bind, cert=cert)
    assert options.warning == (text if warns else None)


def test_tls_is_not_talked_down(new_server, certificates, caplog):
    """On a port with TLS of a fake agent: the real one here has none."""
    cert, _ = certificates("127.0.0.1")
    server = new_server(cert=cert, key=cert.replace("cert.pem", "key.pem"))
    with pytest.raises((InvalidMessage, EOFError, ConnectionError)), connect(f"ws://127.0.0.1:{server.port}/agent"):
        pass
    assert "A client was refused: TLS failed: HTTP_REQUEST." in [one.getMessage() for one in caplog.records]
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
    with pytest.warns(DeprecationWarning, match="TLSv1_1"):
        old.maximum_version = ssl.TLSVersion.TLSv1_1
    plain = socket.create_connection(("127.0.0.1", server.port), DEADLINE)
    with plain, pytest.raises((ssl.SSLError, ConnectionError)):
        old.wrap_socket(plain)
