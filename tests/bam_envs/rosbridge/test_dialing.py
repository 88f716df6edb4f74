"""Connecting fails for many reasons, each with its own text; addresses; certificates."""

import socket
import ssl
import threading
from contextlib import contextmanager

import pytest

from bam_envs.core.errors import InvalidValue, NoServer
from bam_envs.core.location import Credentials
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.dialing import AGENT_PORT, no_connection
from bam_envs.rosbridge.endpoint import Address, Endpoint

TLS = "If it has TLS, use wss://; if it is the port of bam-serve --tcp, tcp://."


@contextmanager
def answering(answer=None):
    """A TCP server that answers its first client with some bytes and the end of the connection, or never; its URL."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            client, _ = listener.accept()
            with client:
                client.recv(4096)
                client.sendall(answer)
                client.shutdown(socket.SHUT_WR)
                client.recv(4096)

        thread = threading.Thread(target=serve)
        if answer is not None:
            thread.start()
        yield f"ws://127.0.0.1:{listener.getsockname()[1]}"
        if answer is not None:
            thread.join()


def failure(url, **options):
    """What the error says behind the address."""
    link = RosbridgeLink(Endpoint(url, **{"connect_timeout": 1.0, **options}))
    with pytest.raises(NoServer) as raised:
        link.connect()
    assert (raised.value.url, link.is_up) == (url, False)
    link.close()
    text = str(raised.value)
    assert text.startswith(f"{url}: ")
    return text.removeprefix(f"{url}: ")


def test_refused(free_port):
    assert failure(f"ws://127.0.0.1:{free_port}") == (
        "refused: nothing listens there. Is the port open? "
        f"Start one with `bam-serve --env bam/pick --port {free_port}` "
        f"or `ros2 launch rosbridge_server rosbridge_websocket_launch.xml port:={free_port} address:=127.0.0.1`."
    )


@pytest.mark.parametrize(
    ("url", "flags"),
    [
        ("ws://localhost", "port:=9090 address:=127.0.0.1"),
        ("ws://[::1]:9091", "port:=9091 address:=::1"),
        ("ws://10.0.0.5", "port:=9090"),
    ],
)
def test_what_is_started_for_this_computer_listens_to_nobody_else(url, flags):
    text = no_connection(Endpoint(url).address, ConnectionRefusedError(), 1.0)
    assert text.endswith(f"`ros2 launch rosbridge_server rosbridge_websocket_launch.xml {flags}`.")


def test_refused_at_the_port_of_live_agents():
    address = Endpoint(f"ws://10.0.0.5:{AGENT_PORT}").address
    assert no_connection(address, ConnectionRefusedError(), 1.0).startswith(
        "refused: nothing listens there. Is the port open? 9095 is the port of bam-agent: does it run there? Start one "
    )


def test_silent():
    text = "the port is open, and what listens there is silent for 1.0 s. Is it a rosbridge server?"
    with answering() as url:
        assert failure(url) == text
    with answering() as url:
        assert failure(url.replace("ws:", "wss:")) == f"{text} Does it speak TLS? If not, use ws://."


def test_a_name_that_nobody_knows():
    text = failure("ws://no-such-robot.invalid:9090")
    assert text.startswith("the name 'no-such-robot.invalid' is not known: ")
    assert text.endswith(". Try the IP address.")
    error = socket.gaierror(socket.EAI_NONAME, "Name or service not known")
    assert no_connection(Address("robot", 9090, False, ""), error, 1.0) == (
        "the name 'robot' is not known: Name or service not known. Try the IP address. "
        "In examples it stands for the robot's computer."
    )


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"HTTP/1.1 200 OK\r\n\r\n", "a web server answers there, with HTTP 200: no WebSocket. Is it the right port?"),
        (b"HTTP/1.1 404 No\r\n\r\n", "a web server answers there, with HTTP 404: no WebSocket. Is it the right port?"),
        (
            b"220 mail.example.org ESMTP\r\n\r\n",
            "something listens there that is no WebSocket server "
            f"(unsupported protocol; expected HTTP/1.1: 220 mail.example.org ESMTP). {TLS}",
        ),
        (
            b"\x15\x03\x03\x00\x02\x02\x0a",
            "something listens there that is no WebSocket server "
            f"(connection closed while reading HTTP status line). {TLS}",
        ),
    ],
)
def test_another_server(answer, text):
    with answering(answer) as url:
        assert failure(url, connect_timeout=5.0) == text


@pytest.mark.parametrize(
    ("response", "text"),
    [
        (
            lambda server: None,
            "a WebSocket server that answers no rosbridge request within 1.0 s. "
            "Is it a rosbridge server, and is its ROS node alive?",
        ),
        (
            lambda server: "Failed to create client: rcl node's context is invalid",
            "its ROS node has ended and its socket has not (Failed to create client: rcl node's context is invalid). "
            "Restart the bridge.",
        ),
        (
            lambda server: server.stopped.set(),
            "closed the connection before it answered a request: the server closed it with code 1001.",
        ),
        (
            lambda server: server.send_soon(server.frames[-1]),
            "an echo server: it sends back what it is sent. Is it the right port?",
        ),
    ],
)
def test_a_websocket_server_that_is_no_rosbridge_server(scripted, response, text):
    scripted.responses["/rosapi/get_time"] = lambda args: response(scripted)
    assert failure(scripted.url) == text
    scripted.wait_connected(0)


@pytest.mark.parametrize("status", [401, 403])
def test_a_token_that_is_refused_is_shown_once(new_scripted, status, caplog):
    server = new_scripted(status=status)
    text = failure(server.url, token="wrong", connect_timeout=30.0)
    assert text == f"the token was refused (HTTP {status}). Give the server's token (--token-file)."
    none = f"the server asks for a token, and none was given (HTTP {status}). Give the server's token (--token-file)."
    assert failure(new_scripted(status=status).url, connect_timeout=30.0) == none
    assert len(server.headers) == 1  # what will not change is not tried twice
    assert caplog.records == []  # websockets would say it too, in its own words


def test_tls_with_the_authority_of_the_certificate(new_scripted, new_link, certificates):
    ca_file, context = certificates("127.0.0.1")
    server = new_scripted(context=context)
    link = new_link(server, credentials=Credentials(str(ca_file)), token="secret")
    assert (link.is_up, link.url, server.headers) == (True, server.url, [("/", "Bearer secret")])


def test_tls_that_fails(new_scripted, scripted, certificates):
    url = new_scripted(context=certificates("127.0.0.1")[1]).url
    assert failure(url) == (
        "the certificate is not trusted: self-signed certificate. "
        "Give the file of the authority that signed it as ca_file (--ca-file)."
    )
    assert failure(url.replace("wss:", "ws:")) == (
        f"something listens there that is no WebSocket server (connection closed while reading HTTP status line). {TLS}"
    )
    ca_file, context = certificates("robot.example")
    assert failure(new_scripted(context=context).url, credentials=Credentials(str(ca_file))) == (
        "the certificate is not for '127.0.0.1': "
        "IP address mismatch, certificate is not valid for '127.0.0.1'. Use a name that is in it."
    )
    assert failure(scripted.url.replace("ws:", "wss:")) == (
        "the connection was cut while it was made. If the server has no TLS, use ws://."
    )
    with answering(b"HTTP/1.1 400 Bad Request\r\n\r\n") as url:
        text = failure(url.replace("ws:", "wss:"))
    assert text.startswith("TLS failed: ")
    assert text.endswith(". If the server has no TLS, use ws://.")


@pytest.mark.parametrize(("content", "reason"), [(None, "No such file or directory"), ("no certificate", "[X509")])
def test_a_ca_file_that_is_none(scripted, tmp_path, content, reason):
    path = tmp_path / "ca.pem"
    if content is not None:
        path.write_text(content)
    link = RosbridgeLink(Endpoint(scripted.url.replace("ws://", "wss://"), credentials=Credentials(str(path))))
    with pytest.raises(InvalidValue) as raised:
        link.connect()
    assert str(raised.value).startswith(f"CA file {str(path)!r} cannot be used: {reason}")
    assert str(raised.value).endswith(" Give a file of certificates in PEM.")
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
    assert Endpoint("ws://[::1]/a").address.url == "ws://[::1]:9090"


EXAMPLE = "Expected ws://host:port or wss://host:port, followed by a namespace if there is one."


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("10.0.0.5:9090", f"has the scheme ''. {EXAMPLE}"),
        ("http://robot", f"has the scheme 'http'. {EXAMPLE}"),
        ("ws://", f"names no host. {EXAMPLE}"),
        ("ws://me:secret@robot", f"has more than host, port and namespace. {EXAMPLE}"),
        ("ws://robot/a?b=c", f"has more than host, port and namespace. {EXAMPLE}"),
        ("ws://robot:0", f"has an invalid port: no server has port 0. {EXAMPLE}"),
        ("ws://robot:70000", f"has an invalid port: Port out of range 0-65535. {EXAMPLE}"),
        ("ws://a\0b:9090", f"has an invalid host: a NUL character. {EXAMPLE}"),
        *((f"ws://{host}:9090", "has an invalid host: ") for host in ("[::1", "[robot]", "a..b", ".", "x" * 64)),
        (
            "ws://robot/a-b",
            "has the namespace '/a-b'. "
            "Expected names of letters, digits and underscores, each after a slash, e.g. /bam_001.",
        ),
    ],
)
def test_an_address_that_is_none(url, text):
    with pytest.raises(InvalidValue) as raised:
        assert Endpoint(url).address is None
    assert str(raised.value).startswith(f"Address {url!r} {text}")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"credentials": Credentials("ca.pem")},
            "ca_file is for wss:// only, and this address is without TLS; leave it out.",
        ),
        ({"connect_timeout": 0}, "connect_timeout: expected a time above 0 s, found 0."),
        ({"timeout": float("nan")}, "timeout: expected a time above 0 s, found nan."),
        *(
            ({"token": token}, "The token is empty, or contains blanks, line ends or characters beyond ASCII, which ")
            for token in ("", "secret\n", "two words", "Schlüssel")
        ),
    ],
)
def test_what_does_not_fit_the_address_is_refused(options, text):
    with pytest.raises(InvalidValue) as raised:
        Endpoint("ws://a:1", **options)
    assert str(raised.value).removeprefix("ws://a:1: ").startswith(text)


def test_a_token_from_a_file_is_not_shown(tmp_path):
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("hush\n")
    endpoint = Endpoint("tcp://a:1", Credentials.of(token_file=tmp_path / "token"))
    assert (endpoint.token, "hush" in repr(endpoint)) == ("hush", False)
