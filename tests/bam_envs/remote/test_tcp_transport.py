"""TcpTransport: what it says when nobody is there, and what it does when the link drops."""

import contextlib
import multiprocessing
import os
import socket
import threading
import time

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import LinkLost, NoServer, ProtocolError
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.remote.tcp_transport import TcpTransport
from bam_envs.remote.wire.tcp_wire import FrameSocket, encode
from bam_envs.remote.wire.transport import spec_to_json
from bam_envs.ros.freshness import read_tag
from bam_envs.testing.transports import MirrorEnv
from tests.bam_envs.remote.fakes import FakeEnv
from tests.raising import raising

PATIENCE = 10.0
ACTION = np.zeros(2, np.float32)
UNUSABLE = "no usable bam-serve TCP server"


@pytest.fixture
def env():
    return MirrorEnv(spaces.Box(-1, 1, (2,)))


class Slow(MirrorEnv):
    """A step lasts until it may end."""

    def __init__(self):
        super().__init__(spaces.Box(-1, 1, (2,)))
        self.begun, self.may_end = threading.Event(), threading.Event()

    def step(self, action):
        self.begun.set()
        assert self.may_end.wait(PATIENCE)
        return super().step(action)


@pytest.fixture
def server(env):
    with TcpServer(EnvServer(env)) as server:
        yield server


@contextlib.contextmanager
def answering(*answers):
    """A server that gives each connection these answers, one after each frame, and then hangs up; its URL."""
    listener = socket.create_server(("127.0.0.1", 0))
    asked = []

    def serve():
        with contextlib.suppress(OSError):
            while True:
                sock, _ = listener.accept()
                frames = FrameSocket(sock)
                for answer in answers:
                    with contextlib.suppress(ProtocolError, LinkLost):
                        asked.append(frames.receive(time.monotonic() + PATIENCE))
                        answer(sock, frames, asked[-1])
                frames.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{listener.getsockname()[1]}", asked
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join(PATIENCE)


def welcome(sock, frames, tree):
    spec = EnvServer(FakeEnv()).spec()
    telling("ok", spec_to_json(spec))(sock, frames, tree)


def hang_up(sock, frames, tree):
    pass


def saying(data):
    return lambda sock, frames, tree: sock.sendall(data)


def telling(kind, content):
    def tell(sock, frames, tree):
        frames.send(encode([read_tag(tree[1]).sequence, kind, content]), time.monotonic() + PATIENCE)

    return tell


def refused(url, **options):
    transport = TcpTransport(url, **options)
    with pytest.raises(NoServer) as caught:
        transport.connect()
    transport.close()
    assert caught.value.url == url
    return str(caught.value).removeprefix(f"{url}: ")


def test_many_addresses_take_no_longer_than_one(monkeypatch):
    limits = []

    def silent(address, timeout):
        limits.append(timeout)
        threading.Event().wait(timeout)
        raise TimeoutError

    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (f"10.0.0.{number}", 5)) for number in range(3)]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **options: found)
    monkeypatch.setattr(socket, "create_connection", silent)
    assert refused("tcp://many:5", connect_timeout=0.1).startswith("no connection within 0.1 s")
    assert sum(limits) <= 0.125  # of each address 0.01 s at the least


def test_nobody_listens():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    assert refused(f"tcp://127.0.0.1:{port}") == (
        f"refused: nothing listens there. Is the port open? Start one: bam-serve --env ENV --tcp {port}"
    )
    assert refused(f"tcp://127.0.0.1:{port}", env_id="bam/reach").endswith(f"bam-serve --env bam/reach --tcp {port}")


def test_a_name_that_nobody_has():
    text = refused("tcp://nobody.invalid:5555")
    assert text.startswith("the name 'nobody.invalid' is not known: ")
    assert text.endswith(". Try the IP address.")


def test_somebody_listens_and_says_nothing():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        assert refused(url, connect_timeout=1.0).startswith(f"{UNUSABLE}: timed out. If it is rosbridge, use ws://. ")


NO_DESCRIPTION = "Expected the description of an environment, found "


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (hang_up, "the other end closed the connection. If it is rosbridge, use ws://. Start one: bam-serve --env "),
        (saying(b"HTTP/1.1 400 Bad Request\r\n\r\n"), "it says b'HTTP/1.1'. If it is rosbridge, use ws://. "),
        *((telling("ok", content), NO_DESCRIPTION) for content in ({}, 3, {"env_id": "x"})),
    ],
)
def test_somebody_else_listens(answer, text):
    with answering(answer) as (url, _):
        said = refused(url)
    assert said.startswith(f"{UNUSABLE}: {text}")
    assert said.endswith(" Start one: bam-serve --env ENV --tcp PORT, at a free port.")


def test_requests_carry_session_epoch_sequence_and_deadline():
    with answering(welcome, telling("ok", [np.zeros(3, np.float32), {}])) as (url, asked):
        transport = TcpTransport(url, timeout=7.0)
        transport.connect()
        transport.reset(5)
        transport.close()
    hello, tag = read_tag(asked[0][1]), read_tag(asked[1][1])
    assert (asked[1][0], *asked[1][2:]) == ("reset", 5, None, False)
    assert (tag.session, tag.epoch, tag.sequence) == (hello.session, 1, 2)
    assert round(tag.deadline - tag.sent, 3) == 7.0


def test_a_lost_link_stays_down_until_a_reset_and_nothing_is_sent_again(env):
    with TcpServer(EnvServer(env)) as server:
        transport = TcpTransport(server.url)
        transport.reset()
    for reason in (
        "the other end closed the connection.",
        "the link is down, and nothing was sent. Call reset() to connect again.",
    ):
        with TcpServer(EnvServer(env), port=server.port), raising(LinkLost, f"{server.url}: {reason}"):
            transport.step(ACTION)
    assert env.seen == []
    with TcpServer(EnvServer(env), port=server.port):
        transport.reset()
        transport.step(ACTION)
        transport.close()
    assert len(env.seen) == 1


def test_no_answer_in_time_is_a_lost_link_and_the_server_does_not_act_later(env):
    ahead = [0.0]
    with TcpServer(EnvServer(env, clock=lambda: time.monotonic() + ahead[0])) as server:
        transport = TcpTransport(server.url)
        transport.reset()
        transport.timeout = 0.1
        with server.server.lock:
            with pytest.raises(LinkLost) as caught:
                transport.step(ACTION)
            ahead[0] = PATIENCE  # the server counts the lifetime of a request from its arrival, a little later
        assert str(caught.value) == f"{server.url}: no answer to step within 0.1 s."
        transport.close()
    assert env.seen == []


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (np.zeros(4, np.float32), "observation must have shape (3,), not (4,)."),
        (np.float32([0, np.nan, 0]), "observation[1] is NaN; only numbers are sent."),
    ],
)
def test_a_server_that_answers_something_else(answer, text):
    with answering(welcome, telling("ok", [answer, {}])) as (url, _):
        transport = TcpTransport(url)
        with raising(ProtocolError, f"{url}: {text}"):
            transport.reset()
        transport.close()


def test_an_answer_to_another_request_drops_the_link():
    wrong = lambda sock, frames, tree: frames.send(encode([99, "ok", None]), time.monotonic() + PATIENCE)  # noqa: E731
    with answering(welcome, wrong) as (url, _):
        transport = TcpTransport(url)
        with raising(ProtocolError, f"{url}: Expected the answer to request 2, found [99, 'ok', None]."):
            transport.reset()
        with pytest.raises(LinkLost):
            transport.step(ACTION)
        transport.close()


def test_another_environment_after_a_reconnect_is_refused(env):
    with TcpServer(EnvServer(env)) as server:
        transport = TcpTransport(server.url)
        transport.connect()
    with TcpServer(EnvServer(FakeEnv()), port=server.port):
        with pytest.raises(LinkLost):
            transport.reset()
        with raising(ProtocolError, f"{server.url}: it serves another environment than before: FakeEnv."):
            transport.reset()
        transport.close()


def test_closing_ends_a_request_that_is_under_way():
    env, told = Slow(), []

    def step():
        with pytest.raises(LinkLost) as caught:
            transport.step(ACTION)
        told.append(str(caught.value))

    with TcpServer(EnvServer(env)) as server:
        transport = TcpTransport(server.url)
        transport.reset()
        thread = threading.Thread(target=step)
        thread.start()
        assert env.begun.wait(PATIENCE)
        transport.close()
        thread.join(PATIENCE)
        env.may_end.set()
    assert told == [f"{server.url}: this transport was closed meanwhile."]


def test_closing_while_it_connects_leaves_no_link():
    def close_first(sock, frames, tree):
        transport.close()
        welcome(sock, frames, tree)

    with answering(close_first) as (url, _):
        transport = TcpTransport(url)
        for _ in range(2):
            with raising(LinkLost, f"{url}: this transport is closed; make a new one."):
                transport.connect()


def test_options_reach_the_environment(server, env):
    transport = TcpTransport(server.url)
    transport.reset(options={"easy": True, "at": np.arange(2)})
    assert env.given[-1][1]["easy"] is True
    np.testing.assert_array_equal(env.given[-1][1]["at"], [0, 1])
    transport.close()


def steps_in_child(transport, other_url, connection):
    try:
        transport.step(ACTION)
    except LinkLost as error:
        connection.send(str(error))
    fresh = TcpTransport(other_url)
    fresh.reset()
    connection.send(fresh.step(ACTION)[1])
    fresh.close()
    connection.close()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_link_of_the_parent_is_not_the_childs(server):
    with TcpServer(EnvServer(MirrorEnv(spaces.Box(-1, 1, (2,))))) as other:
        transport = TcpTransport(server.url)
        transport.reset()
        here, there = multiprocessing.Pipe()
        child = multiprocessing.get_context("fork").Process(target=steps_in_child, args=(transport, other.url, there))
        child.start()
        assert here.poll(PATIENCE)
        assert here.recv() == f"{server.url}: the link is down, and nothing was sent. Call reset() to connect again."
        assert here.poll(PATIENCE)
        assert here.recv() == 1 / 7
        child.join(PATIENCE)
        assert transport.step(ACTION)[1] == 1 / 7
        transport.close()
        here.close()
        there.close()
