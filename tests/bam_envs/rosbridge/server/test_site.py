"""A site on the port of a rosbridge server: its pages, its sockets, and who is let in."""

import asyncio
import contextlib
import gzip
import json
import socket
import ssl
import threading
from http.client import HTTPConnection

import pytest
from websockets.asyncio.client import connect as async_connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from bam_envs.core.errors import InvalidValue
from bam_envs.rosbridge.server import BridgeServer, Page, ServerOptions, Site, read_pages
from bam_envs.rosbridge.server.client_session import Packet
from bam_envs.rosbridge.tokens import TokenFile, Tokens

DEADLINE = 10.0
TEXT, TRIGGER = "std_msgs/String", "std_srvs/Trigger"
ROLES = Tokens({"w": "watch", "d": "drive", "a": "administer"})


async def echo(connection, caller):
    """Says who the caller is, and repeats its messages."""
    answer = json.dumps([caller.role, caller.operator])
    while True:
        connection.put(Packet((answer.encode(),), text=True), 0)
        connection.flush()
        message = await connection.next_message()
        answer = message if isinstance(message, str) else f"{len(message)} bytes"


SITE = Site({"/": Page("text/html; charset=utf-8", b"<p>hello")}, {"/echo": echo})


@pytest.fixture
def new_server(stack):
    def make(tokens=None, site=SITE, **options):
        tokens = tokens or Tokens(otherwise="administer")
        return stack.enter_context(BridgeServer(port=0, tokens=tokens, site=site, **options))

    return make


def get(server, path, **headers):
    """Status, headers and body of a page; without http.client's check of the path."""
    connection = HTTPConnection("127.0.0.1", server.port, timeout=DEADLINE)
    connection._validate_path = lambda url: None
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    with contextlib.closing(connection):
        body = response.read()
        if response.headers["Content-Encoding"] == "gzip":
            body = gzip.decompress(body)
        return response.status, dict(response.getheaders()), body.decode()


def opened(server, path="/echo", token=None, **headers):
    if token is not None:
        headers["Authorization"] = f"Bearer {token}"
    return connect(server.url + path, additional_headers=headers, compression=None)


def refused(server, path="/echo", **headers):
    """HTTP status and text with which a server refuses a WebSocket."""
    with pytest.raises(InvalidStatus) as caught:
        opened(server, path, **headers)
    return caught.value.response.status_code, caught.value.response.body.decode()


def messages(caplog):
    return [record.getMessage() for record in caplog.records]


def test_a_page_is_kept_to_its_own_server(new_server):
    status, headers, body = get(new_server(), "/")
    assert (status, body, headers["Content-Type"]) == (200, "<p>hello", "text/html; charset=utf-8")
    assert headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'self'; style-src 'self'; ")
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert "unsafe" not in headers["Content-Security-Policy"]
    assert (headers["X-Content-Type-Options"], headers["Cache-Control"]) == ("nosniff", "no-cache")


@pytest.mark.parametrize(
    "path", ["/../../etc/passwd", "/%2e%2e/etc/passwd", "/..%2fetc/passwd", "//etc/passwd", "/./", "/index.html", "/[x"]
)
def test_a_page_is_one_of_a_table_or_none(new_server, path, caplog):
    status, _, body = get(new_server(), path)
    assert (status, body) == (404, f"There is no {path!r} here.\n")
    assert messages(caplog) == [f"127.0.0.1 was refused: There is no {path!r} here."]


@pytest.mark.parametrize(
    ("accepts", "encoding"),
    [
        ("gzip, deflate", "gzip"),
        ("br;q=1, GZIP;q=0.5", "gzip"),
        ("gzip;q=0, deflate", None),
        ("xgzip", None),
        ("", None),
    ],
)
def test_a_page_is_compressed_for_who_takes_that(new_server, accepts, encoding):
    site = Site({"/": Page("text/plain", b"hello " * 99), "/short": Page("text/plain", b"hello")})
    server, accept = new_server(site=site), {"Accept-Encoding": accepts}
    status, headers, body = get(server, "/", **accept)
    assert (status, headers.get("Content-Encoding"), body) == (200, encoding, "hello " * 99)
    assert (int(headers["Content-Length"]) < 99, headers["Vary"]) == (encoding is not None, "Accept-Encoding")
    assert get(server, "/short", **accept)[2] == "hello"


def test_a_page_that_a_client_has_already_is_not_sent_again(new_server):
    server = new_server()
    _, headers, _ = get(server, "/")
    status, again, body = get(server, "/", **{"If-None-Match": headers["ETag"]})
    assert (status, again["ETag"], body) == (304, headers["ETag"], "")
    assert "default-src 'none'" in again["Content-Security-Policy"]
    assert get(server, "/", **{"If-None-Match": 'W/"another"'})[::2] == (200, "<p>hello")


def test_the_pages_of_a_folder(tmp_path):
    for name in ("index.html", "console.js", ".hidden"):
        (tmp_path / name).write_text(name)
    (tmp_path / "folder").mkdir()
    pages = read_pages(tmp_path)
    assert {name: page.body for name, page in pages.items()} == {
        "/": b"index.html",
        "/index.html": b"index.html",
        "/console.js": b"console.js",
    }
    assert pages["/console.js"].kind == "text/javascript; charset=utf-8"
    (tmp_path / "script.py").touch()
    with pytest.raises(InvalidValue) as error:
        read_pages(tmp_path)
    assert str(error.value).startswith(f"{tmp_path / 'script.py'}: expected a page with one of .html, .css, .js, ")


def test_a_socket_of_the_site_and_one_of_rosbridge(new_server):
    server = new_server(ROLES)
    for token, who in (("w", ["watch", False]), ("d", ["drive", False]), ("a", ["administer", True])):
        with opened(server, token=token) as client:
            assert json.loads(client.recv(DEADLINE)) == who
            client.send("hello")
            assert client.recv(DEADLINE) == "hello"
            client.send(b"12345")
            assert client.recv(DEADLINE) == "5 bytes"
    with opened(server, "", token="d") as client:
        client.send('{"op": "call_service", "service": "/rosapi/topics"}')
        assert json.loads(client.recv(DEADLINE))["result"]


def test_without_tokens_everybody_administers_and_nobody_is_an_operator(new_server):
    with opened(new_server()) as client:
        assert json.loads(client.recv(DEADLINE)) == ["administer", False]


NO_TOKEN = "This server needs its token: send the header 'Authorization: Bearer TOKEN'."
IN_ADDRESS = "A token never stands in an address, which is logged: send the header 'Authorization: Bearer TOKEN'."


@pytest.mark.parametrize(
    ("path", "headers", "status", "text"),
    [
        ("/echo", {}, 401, NO_TOKEN),
        ("/echo", {"token": "x"}, 401, "The token is wrong."),
        ("/echo?token=a", {}, 400, IN_ADDRESS),
        ("?token=a", {"token": "a"}, 400, IN_ADDRESS),
        ("/elsewhere", {"token": "a"}, 404, "There is no '/elsewhere' here."),
    ],
)
def test_a_client_is_refused_in_one_line(new_server, caplog, path, headers, status, text):
    assert refused(new_server(ROLES), path, **headers) == (status, f"{text}\n")
    assert messages(caplog) == [f"127.0.0.1 was refused: {text}"]


def test_an_address_with_a_token_shows_no_page(new_server):
    assert get(new_server(), "/?token=a")[::2] == (400, f"{IN_ADDRESS}\n")
    assert get(new_server(), "/?view=2")[0] == 200


def test_a_page_of_another_origin_is_refused_with_and_without_tokens(new_server):
    for server in (new_server(), new_server(ROLES)):
        own = f"127.0.0.1:{server.port}"
        for origin in ("https://evil.example", f"https://{own}", "http://127.0.0.1:1", "null", ""):
            text = f"The page {origin!r} is not of this server, which is 'http://{own}'.\n"
            assert refused(server, Origin=origin) == (403, text)
            assert refused(server, "", Origin=origin) == (403, text)


def raw(server, *lines):
    """The first line that a server answers to these lines."""
    with socket.create_connection(("127.0.0.1", server.port), DEADLINE) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        return client.makefile().readline().strip()


UPGRADE = ("Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {'A' * 22}==", "Sec-WebSocket-Version: 13")


def test_a_foreign_name_that_leads_here_is_refused_without_tokens(new_server):
    server, guarded = new_server(), new_server(ROLES)
    for more in (UPGRADE, (*UPGRADE, "Origin: http://evil.example"), ()):
        assert raw(server, "GET / HTTP/1.1", "Host: evil.example", *more) == "HTTP/1.1 403 Forbidden"
    assert raw(guarded, "GET / HTTP/1.1", "Host: robot.lab") == "HTTP/1.1 200 OK"
    for host in ("localhost:1", "127.1.2.3", "[::1]:9095"):
        assert raw(server, "GET / HTTP/1.1", f"Host: {host}", *UPGRADE) == "HTTP/1.1 101 Switching Protocols"
        origin = f"Origin: http://{host}"
        assert raw(server, "GET / HTTP/1.1", f"Host: {host}", origin, *UPGRADE) == "HTTP/1.1 101 Switching Protocols"
    assert raw(server, "GET / HTTP/1.1") == "HTTP/1.1 400 Bad Request"


def ending(client):
    with pytest.raises(ConnectionClosed) as caught:
        client.recv(DEADLINE)
    return caught.value.rcvd.code, caught.value.rcvd.reason


def test_a_page_is_asked_for_its_token(new_server, caplog):
    server = new_server(ROLES, options=ServerOptions(token_timeout=1.0))
    page = {"Origin": f"http://127.0.0.1:{server.port}"}
    with opened(server, **page) as client:
        assert json.loads(client.recv(DEADLINE)) == {"event": "auth"}
        client.send('{"op": "auth", "token": "d"}')
        assert json.loads(client.recv(DEADLINE)) == ["drive", False]
    with opened(server, **page) as client:
        client.recv(DEADLINE)
        client.send('{"op": "auth", "token": "x"}')
        assert ending(client) == (1008, "The token is wrong.")
    with opened(server, **page) as client:
        client.recv(DEADLINE)
        first = 'The first message of a page must be its token, within 1 s: {"op": "auth", "token": TOKEN}'
        assert ending(client) == (1008, first)
    assert messages(caplog) == [f"127.0.0.1 was refused: {text}" for text in ("The token is wrong.", first)]


def test_a_token_that_is_taken_out_of_its_file(new_server, tmp_path, caplog):
    path = tmp_path / "tokens"
    path.touch(0o600)
    path.write_text("drive d\nadminister a\n")
    server = new_server(TokenFile(path))
    with opened(server, token="d") as gone, opened(server, token="a") as stays:
        gone.recv(DEADLINE), stays.recv(DEADLINE)
        path.write_text("administer a\nwatch w\n\n")
        assert ending(gone) == (1008, "The token of this connection is valid no longer.")
        stays.send("hello")
        assert stays.recv(DEADLINE) == "hello"
    assert refused(server, token="d") == (401, "The token is wrong.\n")
    with opened(server, token="w") as client:
        assert json.loads(client.recv(DEADLINE)) == ["watch", False]
    assert "127.0.0.1 was refused: The token of this connection is valid no longer." in messages(caplog)


def test_clients_of_the_site_count(new_server):
    server = new_server(options=ServerOptions(max_clients=1))
    with opened(server) as client:
        client.recv(DEADLINE)
        client.send("hello")
        assert client.recv(DEADLINE) == "hello"
        assert (server.clients, refused(server)) == (1, (503, "There are 1 clients, and no room for more.\n"))


def test_a_handler_that_fails_ends_its_connection_only_and_is_logged(new_server, caplog):
    async def fail(connection, caller):
        raise ValueError("a mistake")

    server = new_server(site=Site(sockets={"/fail": fail, "/echo": echo}))
    with opened(server) as other, opened(server, "/fail") as client:
        assert ending(client)[0] == 1011
        other.send("hello")
        assert [other.recv(DEADLINE), other.recv(DEADLINE)][1] == "hello"
    assert caplog.records[-1].exc_text.endswith("ValueError: a mistake")


def test_equal_refusals_are_logged_once_a_second(new_server, caplog):
    server = new_server(ROLES)
    for _ in range(30):
        refused(server)
    assert 1 <= len(messages(caplog)) < 30


def test_over_tls_the_origin_is_https(new_server, certificates):
    cert, _ = certificates("127.0.0.1")
    server = new_server(ROLES, cert=cert, key=cert.replace("cert.pem", "key.pem"))
    own, tls = f"127.0.0.1:{server.port}", ssl.create_default_context(cafile=cert)
    assert server.url == f"wss://{own}"

    async def first_message(origin):
        # Not the client of `websockets.sync`: its two threads use one TLS object, which is not safe.
        async with async_connect(f"wss://{own}/echo", ssl=tls, additional_headers={"Origin": origin}) as client:
            return json.loads(await client.recv())

    assert asyncio.run(first_message(f"https://{own}")) == {"event": "auth"}
    with pytest.raises(InvalidStatus) as caught:
        asyncio.run(first_message(f"http://{own}"))
    assert caught.value.response.status_code == 403


# What a watcher may do in rosbridge


@pytest.fixture
def watcher(new_server):
    server = new_server(ROLES)
    server.serve("/bam/robot", TRIGGER, lambda request, caller: {"success": True, "message": "a robot"})
    server.serve("/bam/session", TRIGGER, lambda request, caller: {"success": True})
    server.advertise("/state", TEXT, latch=True)
    server.publish("/state", {"data": "rests"})
    server.heard, server.halted = [], threading.Event()
    server.subscribe("/command", TEXT, lambda message, caller: server.heard.append(message))
    server.subscribe("/bam/halt", "std_msgs/Empty", lambda message, caller: server.halted.set())
    with opened(server, "", token="w") as client:

        def ask(**message):
            client.send(json.dumps(message))
            return json.loads(client.recv(DEADLINE))

        yield server, client, ask


def test_a_watcher_reads(watcher):
    _, _, ask = watcher
    assert ask(op="subscribe", topic="/state")["msg"] == {"data": "rests"}
    assert ask(op="call_service", service="/bam/robot")["values"]["message"] == "a robot"
    assert "/state" in ask(op="call_service", service="/rosapi/topics")["values"]["topics"]


REASON = "This needs a token of the role drive; the token shown may watch, and halt the robot."


@pytest.mark.parametrize(
    "message",
    [
        {"op": "publish", "topic": "/command", "msg": {"data": "go"}},
        {"op": "advertise", "topic": "/command", "type": TEXT},
        {"op": "advertise_service", "service": "/mine", "type": TRIGGER},
        {"op": "unadvertise_service", "service": "/bam/session"},
        {"op": "service_response", "service": "/bam/session", "values": {}, "result": True},
    ],
)
def test_a_watcher_sends_nothing(watcher, caplog, message):
    server, _, ask = watcher
    names = [message["op"], message.get("topic") or message["service"]]
    assert ask(**message) == {"op": "status", "level": "error", "msg": f"{' '.join(names)}: {REASON}"}
    assert ask(op="call_service", service="/rosapi/get_time")["result"]
    assert server.heard == []
    assert [line.partition(" was ")[2] for line in messages(caplog)] == [
        f"refused: {message['op']} is not for the role watch"
    ]


def test_a_watcher_opens_no_session(watcher, caplog):
    answer = watcher[2](op="call_service", service="/bam/session")
    assert (answer["result"], answer["values"]) == (False, REASON)
    assert messages(caplog)[0].endswith("was refused: The service /bam/session is not for the role watch")


def test_a_watcher_halts(watcher):
    server, client, ask = watcher
    client.send('{"op": "advertise", "topic": "/bam/halt", "type": "std_msgs/Empty"}')
    client.send('{"op": "publish", "topic": "/bam/halt", "msg": {}}')
    assert ask(op="call_service", service="/rosapi/get_time")["result"]
    assert server.halted.is_set()
