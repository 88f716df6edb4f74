"""Every way in which connecting fails has its own text; addresses; certificates."""

import json
import socket
import ssl
import threading

import pytest

from bam_envs.core.errors import InvalidValue, NoServer
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Address, Endpoint

START = (
    "Start one with `bam-serve --env bam/pick --port {port}` "
    "or `ros2 launch rosbridge_server rosbridge_websocket_launch.xml`."
)


@pytest.fixture
def answering():
    """A TCP server that sends each client some bytes, and ends the connection if told so; its URL."""
    listeners, clients, threads = [], [], []

    def make(answer, ends=True):
        listener = socket.create_server(("127.0.0.1", 0))
        listeners.append(listener)

        def serve():
            client, _ = listener.accept()
            clients.append(client)
            client.recv(4096)
            client.sendall(answer)
            if ends:
                client.shutdown(socket.SHUT_WR)

        threads.append(threading.Thread(target=serve))
        threads[-1].start()
        return f"ws://127.0.0.1:{listener.getsockname()[1]}"

    yield make
    for thread in threads:
        thread.join()
    for one in (*clients, *listeners):
        one.close()


def _failure(url, **options):
    link = RosbridgeLink(Endpoint(url, **{"connect_timeout": 0.3, **options}))
    with pytest.raises(NoServer) as raised:
        link.connect()
    assert raised.value.url == url
    assert not link.is_up
    link.close()
    return str(raised.value)


def test_refused(free_port):
    url = f"ws://127.0.0.1:{free_port}"
    expected = f"{url}: refused: nothing listens there. Is the port open? {START.format(port=free_port)}"
    assert _failure(url) == expected


def test_silent():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"ws://127.0.0.1:{silent.getsockname()[1]}"
        expected = (
            f"{url}: the port is open, and what listens there says nothing within 0.3 s. Is it a rosbridge server?"
        )
        assert _failure(url) == expected


def test_silent_behind_tls():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"wss://127.0.0.1:{silent.getsockname()[1]}"
        assert _failure(url) == (
            f"{url}: the port is open, and what listens there says nothing within 0.3 s. "
            "Is it a rosbridge server? Does it speak TLS? If not, use ws://."
        )


def test_a_name_that_nobody_knows():
    text = _failure("ws://no-such-robot.invalid:9090")
    assert text.startswith("ws://no-such-robot.invalid:9090: the name 'no-such-robot.invalid' is not known: ")
    assert text.endswith(". Try the IP address.")


@pytest.mark.parametrize("status", [200, 404])
def test_a_web_server_without_websocket(answering, status):
    url = answering(f"HTTP/1.1 {status} OK\r\nContent-Length: 0\r\n\r\n".encode())
    expected = f"{url}: a web server answers there, with HTTP {status}: no WebSocket. Is it the right port?"
    assert _failure(url) == expected


def test_something_that_is_no_web_server(answering):
    url = answering(b"220 mail.example.org ESMTP\r\n\r\n")
    assert _failure(url) == (
        f"{url}: something listens there that is no WebSocket server "
        "(unsupported protocol; expected HTTP/1.1: 220 mail.example.org ESMTP). If it has TLS, use wss://."
    )


def test_something_that_hangs_up(answering):
    url = answering(b"\x15\x03\x03\x00\x02\x02\x0a")
    assert _failure(url) == (
        f"{url}: something listens there that is no WebSocket server "
        "(connection closed while reading HTTP status line). If it has TLS, use wss://."
    )


def test_a_websocket_server_that_is_not_rosbridge(scripted):
    scripted.responses["/rosapi/get_time"] = lambda args: None
    assert _failure(scripted.url) == (
        f"{scripted.url}: a WebSocket server that answers no rosbridge request within 0.3 s. "
        "Is it a rosbridge server, and is its ROS node alive?"
    )
    scripted.wait_connected(0)


def test_an_echo_server(scripted, monkeypatch):
    async def send_back(connection, frame):
        await connection.send(json.dumps(frame))

    monkeypatch.setattr(scripted, "_answer", send_back)
    assert _failure(scripted.url) == (
        f"{scripted.url}: an echo server: it sends back what it is sent. Is it the right port?"
    )
    scripted.wait_connected(0)
    assert scripted.of("service_response") == []


def test_a_bridge_whose_node_has_ended(scripted):
    text = "Failed to create client: rcl node's context is invalid"
    scripted.responses["/rosapi/get_time"] = lambda args: text
    expected = f"{scripted.url}: its ROS node has ended and its socket has not ({text}). Restart the bridge."
    assert _failure(scripted.url) == expected


def test_a_websocket_server_that_hangs_up_on_a_request(scripted):
    scripted.responses["/rosapi/get_time"] = lambda args: scripted._stop.set()
    assert _failure(scripted.url) == (
        f"{scripted.url}: closed the connection before it answered a request: the server closed it with code 1001."
    )


@pytest.mark.parametrize("status", [401, 403])
def test_a_token_that_is_refused(new_scripted, status, caplog):
    url = new_scripted(status=status).url
    expected = f"{url}: the token was refused (HTTP {status}). Give the server's token (--token-file)."
    assert _failure(url, token="wrong") == expected
    assert caplog.records == []  # websockets would say it too, in its own words


def test_what_will_not_change_is_not_tried_twice(new_scripted):
    server = new_scripted(status=401)
    _failure(server.url, connect_timeout=30.0)
    assert len(server.headers) == 1


def test_tls_with_the_authority_of_the_certificate(new_scripted, new_link, certificates):
    ca_file, context = certificates("127.0.0.1")
    server = new_scripted(context=context)
    link = new_link(server, ca_file=ca_file, token="secret")
    assert (link.is_up, link.url, server.headers) == (True, server.url, [("/", "Bearer secret")])


def test_tls_with_a_certificate_that_nobody_trusts(new_scripted, certificates):
    url = new_scripted(context=certificates("127.0.0.1")[1]).url
    assert _failure(url) == (
        f"{url}: the certificate is not trusted: self-signed certificate. "
        "Give the file of the authority that signed it as ca_file (--ca-file)."
    )


def test_tls_with_the_certificate_of_another_host(new_scripted, certificates):
    ca_file, context = certificates("robot.example")
    url = new_scripted(context=context).url
    assert _failure(url, ca_file=ca_file) == (
        f"{url}: the certificate is not for '127.0.0.1': "
        "IP address mismatch, certificate is not valid for '127.0.0.1'. Use a name that is in it."
    )


def test_tls_to_a_server_without_it(scripted):
    url = scripted.url.replace("ws://", "wss://")
    assert _failure(url) == f"{url}: the connection was cut while it was made. If the server has no TLS, use ws://."


def test_tls_to_something_that_answers_otherwise(answering):
    url = answering(b"HTTP/1.1 400 Bad Request\r\n\r\n").replace("ws://", "wss://")
    text = _failure(url)
    assert text.startswith(f"{url}: TLS failed: ")
    assert text.endswith(". If the server has no TLS, use ws://.")


def test_no_tls_to_a_server_with_it(new_scripted, certificates):
    url = new_scripted(context=certificates("127.0.0.1")[1]).url.replace("wss://", "ws://")
    assert _failure(url) == (
        f"{url}: something listens there that is no WebSocket server "
        "(connection closed while reading HTTP status line). If it has TLS, use wss://."
    )


@pytest.mark.parametrize(
    ("content", "reason"), [(None, "[Errno 2] No such file or directory"), ("no certificate", "[X509")]
)
def test_a_ca_file_that_is_none(scripted, tmp_path, content, reason):
    path = tmp_path / "ca.pem"
    if content is not None:
        path.write_text(content)
    link = RosbridgeLink(Endpoint(scripted.url.replace("ws://", "wss://"), ca_file=str(path)))
    with pytest.raises(InvalidValue) as raised:
        link.connect()
    assert str(raised.value).startswith(f"CA file {str(path)!r} cannot be used: {reason}")
    assert str(raised.value).endswith(" Expected certificates in PEM.")
    assert isinstance(raised.value.__cause__, ssl.SSLError | OSError)
    link.close()


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("ws://10.0.0.5", Address("10.0.0.5", 9090, False, "")),
        ("ws://10.0.0.5:9091/", Address("10.0.0.5", 9091, False, "")),
        ("wss://robot.lab/bam_001", Address("robot.lab", 9090, True, "/bam_001")),
        ("ws://[::1]:9090/a/b_2/", Address("::1", 9090, False, "/a/b_2")),
    ],
)
def test_an_address(url, address):
    assert Endpoint(url).address == address


def test_an_address_without_its_namespace():
    assert Endpoint("ws://[::1]/a").address.url == "ws://[::1]:9090"


EXAMPLE = "Expected ws://host:port or wss://host:port, with a namespace behind it if there is one."


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("10.0.0.5:9090", f"Address '10.0.0.5:9090' has the scheme ''. {EXAMPLE}"),
        ("http://robot", f"Address 'http://robot' has the scheme 'http'. {EXAMPLE}"),
        ("ws://", f"Address 'ws://' names no host. {EXAMPLE}"),
        ("ws://me:secret@robot", f"Address 'ws://me:secret@robot' has more than host, port and namespace. {EXAMPLE}"),
        ("ws://robot/a?b=c", f"Address 'ws://robot/a?b=c' has more than host, port and namespace. {EXAMPLE}"),
        (
            "ws://robot:0",
            f"Address 'ws://robot:0' has an invalid port: no server has port 0. {EXAMPLE}",
        ),
        (
            "ws://robot:70000",
            f"Address 'ws://robot:70000' has an invalid port: Port out of range 0-65535. {EXAMPLE}",
        ),
        (
            "ws://robot/a-b",
            "Address 'ws://robot/a-b' has the namespace '/a-b'. "
            "Expected names of letters, digits and underscores, each after a slash, e.g. /bam_001.",
        ),
    ],
)
def test_an_address_that_is_none(url, text):
    with pytest.raises(InvalidValue) as raised:
        assert Endpoint(url).address is None
    assert str(raised.value) == text


def test_a_host_with_a_character_that_ends_texts():
    with pytest.raises(InvalidValue) as raised:
        Endpoint("ws://a\0b:9090")
    assert str(raised.value) == (f"Address 'ws://a\\x00b:9090' has an invalid host: a NUL character. {EXAMPLE}")


@pytest.mark.parametrize("host", ["[::1", "[robot]", "a..b", ".", "x" * 64])
def test_a_host_that_is_none(host):
    with pytest.raises(InvalidValue) as raised:
        Endpoint(f"ws://{host}:9090")
    assert str(raised.value).startswith(f"Address 'ws://{host}:9090' has an invalid host: ")
    assert str(raised.value).endswith(EXAMPLE)


def test_what_does_not_fit_the_address_is_refused(tmp_path):
    for options, text in (
        (
            {"ca_file": "ca.pem"},
            "ca_file says whom wss:// trusts, and this address is without TLS; leave it out.",
        ),
        ({"connect_timeout": 0}, "connect_timeout: expected a time above 0 s, found 0."),
        ({"timeout": float("nan")}, "timeout: expected a time above 0 s, found nan."),
    ):
        with pytest.raises(InvalidValue) as raised:
            Endpoint("ws://a:1", **options)
        assert str(raised.value).removeprefix("ws://a:1: ") == text
    secret = tmp_path / "token"
    secret.write_text("hush\n")
    endpoint = Endpoint.with_token_file("tcp://a:1", token_file=secret)
    assert (endpoint.token, endpoint.is_websocket, "hush" in repr(endpoint)) == ("hush", False, False)
