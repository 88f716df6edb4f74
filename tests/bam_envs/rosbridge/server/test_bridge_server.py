import base64
import contextlib
import json
import socket
import struct
import threading
import time

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from bam_envs.core.errors import InvalidValue, LinkLost, NotInCommand
from bam_envs.rosbridge.server import BridgeServer, ServerOptions

DEADLINE = 10.0
TEXT, BYTES, TRIGGER = "std_msgs/String", "std_msgs/UInt8MultiArray", "std_srvs/Trigger"


class Client:
    """A plain WebSocket."""

    def __init__(self, url, **options):
        stack = contextlib.ExitStack()
        self.socket = stack.enter_context(connect(url, max_size=None, compression=None, **options))
        self.close = stack.close

    def send(self, **message):
        self.socket.send(json.dumps(message))

    def receive(self):
        return json.loads(self.socket.recv(timeout=DEADLINE))

    def ask(self, **message):
        self.send(**message)
        return self.receive()

    def call(self, service, **more):
        return self.ask(op="call_service", service=service, **more)

    def sync(self):
        """Return when the server has done everything that was sent before."""
        assert self.call("/rosapi/get_time")["result"]


@pytest.fixture
def new_server(stack):
    return lambda **options: stack.enter_context(BridgeServer(port=0, **options))


@pytest.fixture
def server(new_server):
    return new_server()


@pytest.fixture
def new_client(server, stack):
    def make(url=None, **options):
        client = Client(url or server.url, **options)
        stack.callback(client.close)
        return client

    return make


@pytest.fixture
def client(new_client):
    return new_client()


@pytest.fixture
def threads():
    """Names of the threads of servers that the test started and that still run; other tests may have servers too."""
    before = set(threading.enumerate())
    return lambda: {one.name for one in set(threading.enumerate()) - before if one.name.startswith("bam-bridge")}


# Start and end.


def test_it_ends_with_a_goodbye_and_leaves_no_thread(threads):
    server = BridgeServer(port=0)
    server.serve("/s", TRIGGER, lambda request, caller: {"message": caller.name})  # there after the start
    with server:
        assert server.url == f"ws://127.0.0.1:{server.port}"
        client = Client(server.url)
        assert client.call("/s")["values"]["message"] == "client1"
        assert server.clients == 1
        server.close()
        with pytest.raises(ConnectionClosed) as end:
            client.receive()
        client.close()
    assert (end.value.rcvd.code, end.value.rcvd.reason) == (1001, "the server is closing")
    assert server.clients == 0
    assert threads() == set()


def test_it_starts_once_and_alone_on_its_port(server):
    with pytest.raises(InvalidValue, match=r"^A server starts once; make a new one\.$"):
        server.start()
    with pytest.raises(InvalidValue) as caught:
        BridgeServer(port=server.port).start()
    remedy = "Stop the program there, or choose another port (0 takes a free one)."
    assert str(caught.value) == f"Port {server.port} on 127.0.0.1 is in use. {remedy}"
    text = r"^Listening on '192\.0\.2\.1', port 0: expected an address of this computer"
    with pytest.raises(InvalidValue, match=text):
        BridgeServer("192.0.2.1", 0).start()


def test_a_constructor_opens_nothing_and_close_may_come_first(threads):
    server = BridgeServer(port=0)
    server.close()
    server.close()
    assert threads() == set()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"port": 70000}, "Port: expected an integer in [0, 65535], found 70000."),
        ({"port": 0, "key": "k.pem"}, "A key needs its certificate; name the file of that too."),
    ],
)
def test_wrong_options_are_refused_at_once(options, text):
    with pytest.raises(InvalidValue) as caught:
        BridgeServer(**options)
    assert str(caught.value) == text


# The bus.


def test_nothing_is_kept_while_it_does_not_run():
    server = BridgeServer(port=0)
    server.advertise("/t", TEXT)
    with pytest.raises(LinkLost, match=r"^/t: the server is not running; nothing was sent\.$"):
        server.publish("/t", {"data": "x"})
    with server:
        server.publish("/t", {"data": "x"})
    with pytest.raises(LinkLost, match=r"^/t: the server is not running; nothing was sent\.$"):
        server.publish("/t", {"data": "x"})


def test_topics_both_ways(server, new_client, heard):
    stop = server.subscribe("/to", TEXT, heard)
    server.advertise("/from", TEXT, latch=True)
    server.publish("/from", {"data": "0"})
    clients = [new_client() for _ in range(3)]
    for client in clients:
        assert client.ask(op="subscribe", topic="/from", type=TEXT)["msg"] == {"data": "0"}
    server.publish("/from", {"data": "1"})
    assert [client.receive()["msg"] for client in clients] == [{"data": "1"}] * 3
    clients[0].send(op="publish", topic="/to", msg={"data": "2"})
    assert heard.wait() == [{"data": "2"}]
    stop()
    assert clients[0].ask(op="publish", topic="/to", msg={"data": "3"})["op"] == "status"
    assert len(heard.messages) == 1


def test_a_listener_may_use_the_bus_and_refuse(server, client):
    def listener(message, caller):
        server.advertise("/echo", TEXT)
        server.publish("/echo", message)
        raise NotInCommand("somebody else is in command")

    server.subscribe("/t", TEXT, listener)
    client.send(op="subscribe", topic="/echo", type=TEXT)
    client.send(op="publish", topic="/t", msg={"data": "x"})
    got = [client.receive(), client.receive()]
    assert {"op": "publish", "topic": "/echo", "msg": {"data": "x"}} in got
    assert {"op": "status", "level": "error", "msg": "/t: somebody else is in command"} in got


def test_a_handler_that_takes_its_time_delays_nobody(server, new_client):
    gate = threading.Event()
    server.serve("/slow", TRIGGER, lambda request, caller: {"success": gate.wait(DEADLINE)})
    server.serve("/quick", TRIGGER, lambda request, caller: {})
    slow, quick = new_client(), new_client()
    slow.send(op="call_service", service="/slow")
    assert quick.call("/quick")["result"]
    assert slow.call("/quick")["service"] == "/quick"
    gate.set()
    assert slow.receive()["values"]["success"] is True


def test_time_limits_are_kept_without_traffic(server, client):
    client.send(op="advertise_service", service="/mine", type=TRIGGER)
    client.send(op="call_service", service="/mine", timeout=0.01)
    assert client.receive()["op"] == "call_service"
    assert client.receive()["values"] == "Timeout exceeded: service /mine did not answer in 0.01 s."


def test_a_service_of_a_client_that_is_cut_off(server, new_client):
    robot, client = new_client(), new_client()
    robot.send(op="advertise_service", service="/mine", type=TRIGGER)
    robot.sync()
    client.send(op="call_service", service="/mine")
    assert robot.receive()["op"] == "call_service"
    robot.socket.socket.shutdown(socket.SHUT_RDWR)
    assert client.receive()["values"] == "Service /mine is gone: the client that offered it left or withdrew it."


# Who may come in.


def refused(url, **options):
    """The HTTP status and text of a refusal."""
    with pytest.raises(InvalidStatus) as caught:
        connect(url, **options)
    response = caught.value.response
    assert (response.headers.get("WWW-Authenticate") == "Bearer") == (response.status_code == 401)
    return response.status_code, response.body.decode()


def bearer(token):
    return {"additional_headers": {"Authorization": f"Bearer {token}"}}


NEEDED = (
    401,
    "This server needs its token: send the header 'Authorization: Bearer TOKEN', or open the URL with ?token=TOKEN.\n",
)


def test_the_token(new_server, new_client):
    url = new_server(token="secret").url
    for wrong in ({}, bearer("Secret"), {"additional_headers": {"Authorization": "secret"}}):
        assert refused(url, **wrong) == NEEDED
    assert refused(url + "/?token=wrong") == NEEDED
    new_client(url, additional_headers={"Authorization": "bearer secret"}).sync()
    new_client(url + "/?token=secret").sync()


@pytest.mark.parametrize("more", [bearer("first"), {}])
def test_one_request_is_one_guess(new_server, new_client, more):
    url = new_server(token="secret").url
    assert refused(f"{url}/?token=second&token=secret", **more) == NEEDED
    new_client(f"{url}/?token=secret", **bearer("secret")).sync()


def test_a_web_page_comes_in_only_with_the_token(new_server, new_client, caplog):
    page = {"additional_headers": {"Origin": "https://evil.example"}}
    text = "A web page comes in only with the token of this server, and it was started without one.\n"
    assert refused(new_server().url, **page) == (403, text)
    assert [record.getMessage() for record in caplog.records] == [
        "The web page 'https://evil.example' was refused: a browser comes in only with a token. "
        'To let it in, start the server with one, and send it as the first message: {"op": "auth", "token": TOKEN}.'
    ]
    url = new_server(token="secret").url
    new_client(url + "/?token=secret", **page).sync()
    assert refused(url + "/?token=wrong", **page) == NEEDED


def ending(client):
    """Close code and reason with which the server ends a connection."""
    with pytest.raises(ConnectionClosed) as caught:
        client.receive()
    return caught.value.rcvd.code, caught.value.rcvd.reason


def test_a_page_shows_its_token_in_its_first_message(new_server, new_client):
    url, page = new_server(token="secret").url, {"additional_headers": {"Origin": "https://good.example"}}
    good = new_client(url, **page)
    good.send(op="auth", token="secret")
    good.sync()
    first = 'The first message of a page must be its token, within 2 s: {"op": "auth", "token": TOKEN}'
    others = [
        ({"op": "auth", "token": "wrong"}, "The token is wrong."),
        ({"op": "auth", "token": 3}, first),
        ({"op": "call_service", "service": "/rosapi/get_time"}, first),
    ]
    for message, reason in others:
        bad = new_client(url, **page)
        bad.send(**message)
        assert ending(bad) == (1008, reason)
    url = new_server(token="secret", options=ServerOptions(token_timeout=0.05)).url
    assert ending(new_client(url, **page)) == (1008, first.replace("2 s", "0.05 s"))


def test_an_operator_is_known_by_another_token(new_server, new_client):
    server, callers = new_server(token="secret", operator_token="mine"), []
    server.subscribe("/who", TEXT, lambda message, caller: callers.append(caller))
    for token in ("secret", "mine"):
        client = new_client(server.url, **bearer(token))
        client.send(op="publish", topic="/who", msg={"data": token})
        client.sync()
    assert [caller.operator for caller in callers] == [False, True]
    assert all(0.0 <= caller.silence() < DEADLINE for caller in callers)


def test_guessing_tokens_is_slow_and_keeps_no_other_address_out(new_server, new_client):
    server = new_server(token="secret")
    statuses = [refused(server.url, **bearer("guess"))[0] for _ in range(20)]
    assert statuses[:4] == [401] * 4
    assert 429 in statuses
    try:
        elsewhere = socket.create_connection(("127.0.0.1", server.port), source_address=("127.0.0.2", 0))
    except OSError:
        pytest.skip("this system has one loopback address")
    new_client(server.url, sock=elsewhere, **bearer("secret")).sync()


def test_certificates_that_are_none(certificates, tmp_path, threads):
    cert, _ = certificates("127.0.0.1")
    (tmp_path / "other.pem").write_text("no PEM at all")
    nowhere, other = str(tmp_path / "nowhere.pem"), str(tmp_path / "other.pem")
    for options, text in (
        ({"cert": nowhere}, f"{nowhere} cannot be read: No such file or directory."),
        ({"cert": cert, "key": cert}, f"{cert} and {cert} are not a certificate with its key in PEM: "),
        ({"cert": cert}, f"{cert} holds no key; give the file with its key too (--key)."),
        ({"cert": other}, f"{other} is not a certificate with its key in PEM: not PEM."),
    ):
        with pytest.raises(InvalidValue) as caught:
            BridgeServer(port=0, **options).start()
        assert str(caught.value).startswith(f"Certificate: {text}")
    assert threads() == set()


def test_websockets_that_say_nothing_keep_nobody_out(new_server, new_client, caplog):
    server = new_server(options=ServerOptions(max_clients=4))
    first, *others = [new_client(server.url) for _ in range(4)]
    for client in others:
        client.sync()
    client = new_client(server.url)
    client.sync()
    with pytest.raises(ConnectionClosed) as end:
        first.receive()
    assert (end.value.rcvd.code, end.value.rcvd.reason) == (1013, "It gave its place to another client.")
    assert "127.0.0.1 was refused: It gave its place to another client." in [one.getMessage() for one in caplog.records]
    for one in (*others, client):
        one.sync()
    assert refused(server.url) == (503, "There are 4 clients, and no room for more.\n")


def test_no_address_takes_all_places(new_server, new_client):
    """Whoever was silent for longest leaves, of the address with the most clients; a driver never is."""
    server = new_server(options=ServerOptions(max_clients=4))
    driver, *others = [new_client(server.url) for _ in range(4)]
    for client in (*others, driver):
        client.sync()
    new_client(server.url, source_address=("127.0.0.2", 0)).sync()
    with pytest.raises(ConnectionClosed):
        others[0].receive()
    for client in (*others[1:], driver):
        client.sync()


# Bad company.


def test_a_message_that_is_too_large_ends_only_its_connection(server, new_client):
    big, other = new_client(), new_client()
    # The server closes while the message is still on its way.
    with contextlib.suppress(ConnectionClosed):
        big.socket.send(b" " * (16 * 2**20 + 1))
    with pytest.raises(ConnectionClosed) as end:
        big.receive()
    assert end.value.rcvd is None or end.value.rcvd.code == 1009
    other.sync()


def test_what_comes_is_bounded_otherwise_than_answers(new_server, new_client):
    server = new_server(options=ServerOptions(max_incoming=1000))
    server.serve("/big", TRIGGER, lambda request, caller: {"message": "x" * 5000})
    client = new_client(server.url)
    assert client.call("/big")["values"]["message"] == "x" * 5000
    client.send(op="fragment", id="a", num=0, total=3, data="x" * 700)
    answer = client.ask(op="fragment", id="a", num=1, total=3, data="x" * 700)
    assert answer["msg"] == "fragment: Fragments: expected at most 1000 bytes, found 1600."


def test_sockets_that_say_nothing_are_closed_and_keep_nobody_out(new_server, new_client):
    server = new_server(options=ServerOptions(open_timeout=1.0, max_clients=1))
    silent = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(200)]
    silent[-1].sendall(b"GET / HTTP/1.1\r\n")
    new_client(server.url).sync()
    for one in silent:
        one.settimeout(DEADLINE)
        with contextlib.suppress(ConnectionResetError):
            assert one.recv(1) == b""
        one.close()


def halted_within(server, client):
    """CPU time of this process until a halt of `client` is heard [s]: on an idle computer, the time that it takes."""
    heard = threading.Event()
    unsubscribe = server.subscribe("/bam/halt", "std_msgs/Empty", lambda message, caller: heard.set())
    began = time.process_time()
    client.send(op="publish", topic="/bam/halt", msg={})
    assert heard.wait(DEADLINE)
    unsubscribe()
    return time.process_time() - began


BOMBS = {
    "two million messages": b"{}" * 2_000_000,
    "lists in lists": b"[" * 4_000_000,
    "a million lists": b'{"op":"publish","topic":"/t","msg":{"data":[' + b"[]," * 1_300_000 + b"[]]}}",
    "many objects of a type that nobody knows": (
        b'{"op":"publish","topic":"/u","msg":{"a":[' + b'{"b":[1]},' * 30_000 + b"{}]}}" + b" " * 3_500_000
    ),
    "many floats": b'{"op":"publish","topic":"/t","msg":{"data":[' + b"0.123456789," * 99_000 + b"0]}}",
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_a_large_message_delays_no_halt(new_server, new_client, bomb):
    server = new_server()
    attacker, driver = new_client(server.url), new_client(server.url)
    attacker.send(op="advertise", topic="/t", type="std_msgs/Float64MultiArray")
    attacker.send(op="advertise", topic="/u", type="strange_msgs/Strange")
    attacker.sync()
    for _ in range(2):
        attacker.socket.send(BOMBS[bomb], text=True)
    assert max(halted_within(server, driver) for _ in range(10)) < 1.0
    attacker.send(op="call_service", service="/rosapi/get_time")
    while attacker.receive()["op"] != "service_response":
        pass


def test_unfinished_frames_of_all_clients_are_bounded(new_server, new_client, until):
    server = new_server(options=ServerOptions(max_incoming=2**20, unfinished=4 * 2**20))
    clients = [new_client(server.url, close_timeout=0.01) for _ in range(8)]
    head = struct.pack("!BBQ4s", 0x81, 0xFF, 1_000_000, bytes(4))
    for client in clients:
        with contextlib.suppress(OSError):
            client.socket.socket.sendall(head + b" " * 900_000)
    until(lambda: server.held[0] <= 4 * 2**20)
    new_client(server.url).sync()


def test_of_many_sockets_at_once_that_say_nothing_few_stay_open(new_server, new_client):
    server = new_server(options=ServerOptions(open_timeout=100.0))
    with contextlib.ExitStack() as sockets:
        silent = [
            sockets.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=DEADLINE))
            for _ in range(100)
        ]
        for one in silent[:68]:
            with contextlib.suppress(ConnectionResetError):
                assert one.recv(1) == b""
        new_client(server.url).sync()


def test_it_closes_at_once_beside_sockets_that_say_nothing(threads, new_server, certificates):
    cert, _ = certificates("127.0.0.1")
    for server in (new_server(), new_server(cert=cert, key=cert.replace("cert.pem", "key.pem"))):
        with socket.create_connection(("127.0.0.1", server.port)) as silent:
            silent.sendall(b"\x16\x03")
            server.close()
    assert threads() == set()


@pytest.mark.parametrize(
    "data", [b"\x00" * 100, b"GET / HTTP/1.1\r\n\r\n", b"SSH-2.0-OpenSSH\r\n\r\n", b"\x16\x03\x01" * 20]
)
def test_what_is_no_websocket_harms_nobody(server, client, data):
    with socket.create_connection(("127.0.0.1", server.port), timeout=DEADLINE) as stranger:
        stranger.sendall(data)
        stranger.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            while stranger.recv(1000):
                pass
    client.sync()


def test_a_client_that_never_reads_gets_the_newest_when_it_does(new_server, new_client, heard):
    server = new_server(options=ServerOptions(outbox_size=2**20, outbox_of_a_topic=2))
    server.advertise("/t", BYTES)
    sleeper, other = new_client(server.url, max_queue=1), new_client(server.url)
    for client in (sleeper, other):
        client.send(op="subscribe", topic="/t", type=BYTES)
        client.sync()
    for number in range(60):
        server.publish("/t", {"data": bytes([number]) * 500_000})
        assert other.receive()["msg"]["data"]
    most = server.held[1]
    assert 0 < most < 2**20 + 700_000
    numbers = [first_byte(sleeper.receive())]
    while numbers[-1] != 59:
        numbers.append(first_byte(sleeper.receive()))
    assert len(numbers) < 60
    assert numbers == sorted(numbers)


def first_byte(message):
    return base64.b64decode(message["msg"]["data"])[0]


def test_a_client_that_does_not_take_its_answers_is_closed(new_server, new_client):
    server = new_server(options=ServerOptions(outbox_size=2**20, close_timeout=5.0))
    server.serve("/big", TRIGGER, lambda request, caller: {"message": "x" * 1_000_000})
    sleeper, other = new_client(server.url, max_queue=1), new_client(server.url)
    with contextlib.suppress(ConnectionClosed):
        for _ in range(200):
            sleeper.send(op="call_service", service="/big")
    with pytest.raises(ConnectionClosed) as end:
        list(iter(sleeper.receive, None))
    assert end.value.rcvd.code == 1013
    assert end.value.rcvd.reason.endswith(" bytes wait, and the client does not read")
    other.sync()


def test_pings_that_are_never_read_do_not_pile_up(new_server, new_client, until):
    server = new_server(options=ServerOptions(max_message=100_000, outbox_size=100_000))
    sleeper, other = socket.create_connection(("127.0.0.1", server.port), timeout=DEADLINE), new_client(server.url)
    sleeper.sendall(
        b"GET / HTTP/1.1\r\nHost: here\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )
    ping = b"\x89\xfd\x00\x00\x00\x00" + b"x" * 125
    with pytest.raises(OSError, match=r"reset|Broken pipe"):
        list(iter(lambda: sleeper.sendall(ping * 500), 1))
    sleeper.close()
    until(lambda: server.clients == 1)
    other.sync()
