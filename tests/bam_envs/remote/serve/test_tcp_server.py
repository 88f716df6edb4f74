"""The TCP server, whatever its clients do."""

import contextlib
import random
import socket
import threading
import time

import numpy as np
import pytest
from gymnasium import spaces
from msgspec.msgpack import Ext
from msgspec.msgpack import encode as packed

from bam_envs.core.errors import LinkLost, NoServer, NotInCommand, ProtocolError
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.remote.tcp_transport import TcpTransport
from bam_envs.remote.wire.tcp_wire import FrameSocket, Hello, encode
from bam_envs.ros.freshness import Tag
from bam_envs.testing.transports import MirrorEnv
from tests.bam_envs.remote.fakes import FakeEnv
from tests.raising import raising

PATIENCE = 10.0
ACTION = np.zeros(2, np.float32)


class Stranger:
    """A client that says what it wants."""

    def __init__(self, server):
        self.socket = socket.create_connection((server.host, server.port), timeout=PATIENCE)
        self.frames = FrameSocket(self.socket)

    def close(self):
        self.frames.close()

    def hello(self, epoch=1):
        return self.ask(Hello(tagged(0, epoch=epoch), "stranger", "", ""))

    def ask(self, tree):
        self.frames.send(encode(tree), time.monotonic() + PATIENCE)
        return self.frames.receive(time.monotonic() + PATIENCE)

    def request(self, kind, number, *values, **when):
        return self.ask([kind, tagged(number, **when), *values])


def tagged(number, *, epoch=1, lifetime=PATIENCE, sent=None):
    """The text of a tag."""
    sent = time.monotonic() if sent is None else sent
    return Tag("s1", epoch, number, sent, sent + lifetime).to_text()


@pytest.fixture
def env():
    return MirrorEnv(spaces.Box(-1, 1, (2,)))


@pytest.fixture
def server(env):
    with TcpServer(EnvServer(env)) as server:
        yield server


@pytest.fixture
def stranger(server):
    strangers = []

    def one():
        strangers.append(Stranger(server))
        return strangers[-1]

    yield one
    for each in strangers:
        each.frames.close()


@pytest.fixture
def client(server):
    clients = []

    def one(**options):
        clients.append(TcpTransport(server.url, **options))
        return clients[-1]

    yield one
    for each in clients:
        each.close()


def test_old_and_late_requests_are_refused(stranger, env):
    one = stranger()
    one.hello()
    one.request("reset", 5, None, None, False)
    for number in (4, 5):
        text = f"old message: number {number} after number 5"
        assert one.request("step", number, ACTION) == [number, "RemoteError", text]
    assert one.request("step", 6, ACTION, epoch=2)[1] == "ok"
    assert one.request("step", 7, ACTION) == [7, "RemoteError", "old connection: epoch 1, and epoch 2 is there"]
    late = one.request("step", 8, ACTION, epoch=2, sent=time.monotonic() - 30, lifetime=1.0)
    assert (*late[:2], late[2][:9]) == (8, "RemoteError", "expired: ")
    assert len(env.seen) == 1


def test_a_new_connection_of_a_client_ends_its_old_one(stranger):
    one, two = stranger(), stranger()
    one.hello()
    one.request("reset", 1, None, None, False)
    two.hello(epoch=2)
    with pytest.raises(LinkLost):
        one.frames.receive(time.monotonic() + PATIENCE)
    assert two.request("reset", 2, None, None, False, epoch=2)[1] == "ok"


def test_command_can_be_taken_by_an_operator(env):
    with TcpServer(EnvServer(env), token="secret", operator_token="mine") as server:
        one, thief, two = (
            TcpTransport(server.url, token=token, take=take)
            for token, take in (("secret", False), ("secret", True), ("mine", True))
        )
        one.connect(), two.connect()
        one.reset()
        with pytest.raises(NotInCommand, match="Taking it by force needs the operator's token"):
            thief.reset()
        two.reset()
        with pytest.raises(NotInCommand):
            one.step(ACTION)
        two.step(ACTION)
        assert len(env.seen) == 1
        for each in (one, thief, two):
            each.close()


def test_a_silent_client_keeps_command_while_its_connection_is_there(env):
    now = [0.0]
    with (
        TcpServer(EnvServer(env, lease=CommandLease(2.0, lambda: now[0]))) as server,
        contextlib.closing(TcpTransport(server.url)) as one,
        contextlib.closing(TcpTransport(server.url)) as two,
    ):
        one.connect(), two.connect()
        one.reset()
        now[0] = 1e9
        with pytest.raises(NotInCommand):
            two.reset()


def test_connections_that_say_nothing_keep_nobody_out(server, client):
    silent = [socket.create_connection((server.host, server.port)) for _ in range(80)]
    client().connect()
    for one in silent:
        one.close()


def test_guessing_tokens_is_slow(env):
    with TcpServer(EnvServer(env), token="secret") as server:
        said = []
        for _ in range(12):
            with pytest.raises(NoServer) as caught:
                TcpTransport(server.url, token="guess").connect()
            said.append(str(caught.value).removeprefix(f"{server.url}: "))
    assert said[:4] == ["The token is wrong; give the one that the server was started with (--token-file)."] * 4
    assert "Too many wrong tokens came from this address; try again in a second." in said[4:]


def test_a_client_that_vanishes_gives_command_back(server, stranger, client):
    left = threading.Event()
    server.server.lease.on_change(lambda before, after: after is None and left.set())
    one = stranger()
    one.hello()
    one.request("reset", 1, None, None, False)
    one.socket.close()
    assert left.wait(PATIENCE)
    two = client()
    two.connect()
    two.reset()


def test_the_token(env):
    with TcpServer(EnvServer(env), token="geheim") as server:
        for token, what in ((None, "missing"), ("", "missing"), ("falsch", "wrong")):
            with raising(
                NoServer,
                f"{server.url}: The token is {what}; give the one that the server was started with (--token-file).",
            ):
                TcpTransport(server.url, token=token).connect()
        right = TcpTransport(server.url, token="geheim")
        right.connect()
        right.close()


def test_a_token_that_is_no_text_is_refused(env):
    with TcpServer(EnvServer(env), token="secret") as server, contextlib.closing(Stranger(server)) as one:
        hello = encode(Hello(tagged(0), "stranger", "XYZ", ""))
        one.socket.sendall(hello.replace(b"XYZ", b"\xed\xa0\x80"))  # half of a surrogate pair
        assert one.frames.receive(time.monotonic() + PATIENCE)[2].startswith("A message is damaged: ")


def test_a_client_that_cannot_be_served_keeps_no_other_out(server, client, monkeypatch, caplog):
    start = threading.Thread.start

    def fail(thread):
        if not thread.name.startswith("bam-tcp "):
            return start(thread)
        monkeypatch.setattr(threading.Thread, "start", start)
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", fail)
    with pytest.raises(NoServer):
        TcpTransport(server.url).connect()
    assert "A client could not be served: can't start new thread" in caplog.text
    client().connect()


def test_too_many_clients_are_refused_and_told(env):
    with TcpServer(EnvServer(env), max_clients=1) as server:
        silent, one = TcpTransport(server.url), TcpTransport(server.url)
        silent.connect()
        one.connect()  # in place of the silent one
        one.reset(seed=0, options={})
        with pytest.raises(LinkLost):
            silent.reset(seed=0, options={})
        with raising(NoServer, f"{server.url}: All 1 places for clients are taken; try again when one has left."):
            TcpTransport(server.url).connect()
        one.close()


@pytest.mark.parametrize(
    ("sent", "told"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "it says b'GET / HT'"),
        (b"bam\x09" + bytes(8), "version 9 of the protocol there, 2 here; install one bam-train on both sides"),
        (b"bam\x02\x00\x00\x00\x01\xc1", "A message is damaged: "),
        (b"bam\x02\x00\x00\x00\x01\x07", "Expected a hello: Expected `array`, got `int`."),
        (encode(Hello("tag", "ann", "", "")), "Expected the tag of a request, found 'tag'."),
        (b"bam\x02\x00\x10\x00\x00", "A message of 1048576 bytes is too large; 65536 are allowed."),
    ],
)
def test_strangers_are_told_what_is_wrong(stranger, sent, told):
    one = stranger()
    one.socket.sendall(sent)
    number, kind, text = one.frames.receive(time.monotonic() + PATIENCE)
    assert (number, kind) == (0, "RemoteError")
    assert text.startswith(told)
    with pytest.raises(LinkLost):
        one.frames.receive(time.monotonic() + PATIENCE)


@pytest.mark.parametrize(
    ("sent", "text"),
    [
        (encode(7), "Expected a request: "),
        (encode(["step", "tag"]), "Expected a request: "),
        (b"bam\x02" + (2**31).to_bytes(4, "big"), "A message of 2147483648 bytes is too large; 1048608 are allowed."),
    ],
)
def test_what_is_no_request_ends_its_connection_alone(stranger, client, sent, text):
    one, two = stranger(), client()
    two.connect()
    two.reset()
    one.hello()
    one.socket.sendall(sent)
    assert one.frames.receive(time.monotonic() + PATIENCE)[2].startswith(text)
    with pytest.raises(LinkLost):
        one.frames.receive(time.monotonic() + PATIENCE)
    two.step(ACTION)


class Large(FakeEnv):
    """Its observations are more than sockets keep for a client that does not read."""

    def __init__(self):
        super().__init__(spaces.Box(0, 255, (12_000_000,), np.uint8))

    def reset(self, *, seed=None, options=None):
        return np.zeros(12_000_000, np.uint8), {}


@pytest.mark.slow
def test_a_client_that_never_reads_is_dropped_and_holds_up_nobody():
    with TcpServer(EnvServer(Large(), lease=0.0), patience=1.0) as server:
        left = threading.Event()
        server.server.lease.on_change(lambda before, after: after is None and left.set())
        deaf = Stranger(server)
        deaf.hello()
        deaf.frames.send(encode(["reset", tagged(1), None, None, False]))
        assert left.wait(PATIENCE)
        other = TcpTransport(server.url)
        other.connect()
        assert other.reset()[0].shape == (12_000_000,)
        other.close()
        deaf.frames.close()


@pytest.mark.parametrize("half", [b"bam", b"bam\x02" + bytes(3) + b"\x07" + b"\x81"])
def test_half_a_message_does_not_keep_a_connection(env, half):
    with TcpServer(EnvServer(env), patience=0.1) as server:
        one = Stranger(server)
        one.hello()
        one.socket.sendall(half)
        with pytest.raises(LinkLost):
            one.frames.receive(time.monotonic() + PATIENCE)
        one.frames.close()


def test_closing_drops_clients_and_ends_every_thread(env):
    before = set(threading.enumerate())
    server = TcpServer(EnvServer(env))
    server.start()
    one = TcpTransport(server.url)
    one.connect()
    one.reset()
    server.close()
    server.close()
    assert set(threading.enumerate()) == before
    with pytest.raises(LinkLost):
        one.step(ACTION)
    one.close()


def junk(rng, depth=0):
    """Anything that MessagePack can hold."""
    kind = rng.randrange(11 if depth < 3 else 7)
    if kind < 7:
        dtype, shape = rng.choice(["<f4", "|u1", "O", "f8,(", 3]), rng.choice([[2], [-1], [2**40], [0], [], "x", 2])
        array = Ext(rng.choice([1, 2, 3]), packed([dtype, shape, rng.choice([bytes(8), b"", b"a", 2**50])]))
        number = rng.choice([0, -1, 2**63, float("nan"), 1e300])
        return rng.choice([None, True, number, rng.randbytes(9), "hello", array, np.zeros(2, np.float32)])
    if kind < 9:
        return [junk(rng, depth + 1) for _ in range(rng.randrange(6))]
    return {key: junk(rng, depth + 1) for key in rng.sample(["a", "t", "s", "n", "x"], 4)}


def fuzzed(rng, number):
    if rng.random() < 0.2:
        return junk(rng)
    kind, count = rng.choice([("reset", 3), ("step", 1), ("leave", 0)])
    return [kind, tagged(number), *[junk(rng) for _ in range(count)]]


@pytest.mark.slow
def test_random_messages_change_nothing(client):
    rng = random.Random(1)
    space = spaces.Dict(
        {
            "a": spaces.Box(-1, 1, (2,)),
            "n": spaces.Tuple([spaces.Text(3), spaces.Discrete(3)]),
            "s": spaces.Sequence(spaces.MultiBinary(2), stack=True),
            "t": spaces.MultiDiscrete([2, 3]),
        }
    )
    with TcpServer(EnvServer(MirrorEnv(space))) as server:
        number = 0
        while number < 3_000:
            one = Stranger(server)
            try:
                one.hello()
                while number < 3_000:
                    number += 1
                    answer = one.ask(fuzzed(rng, number))
                    assert isinstance(answer, list)
            except (LinkLost, ProtocolError):
                pass  # it was told, and the connection closed
            one.frames.close()
        good = TcpTransport(server.url, take=True)
        good.connect()
        action = space.sample()
        good.reset()
        assert good.step(action)[0].keys() == action.keys()
        good.close()
