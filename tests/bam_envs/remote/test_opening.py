"""Transports of URLs."""

import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.location import Credentials
from bam_envs.remote.remote_env import open_transport
from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.remote.tcp_transport import TcpTransport
from tests.raising import raising


def test_each_scheme_has_its_class():
    tcp = open_transport("tcp://127.0.0.1:5555", env_id="bam/pick", timeout=2.0)
    assert type(tcp) is TcpTransport
    assert (tcp.url, tcp.env_id, tcp.timeout) == ("tcp://127.0.0.1:5555", "bam/pick", 2.0)
    assert type(open_transport("ws://127.0.0.1:9090/bam_001")) is RosbridgeTransport
    assert type(open_transport("wss://robot.example:9090")) is RosbridgeTransport


URL = "A transport is a URL such as tcp://10.0.0.5:5555 or ws://10.0.0.5:9090, not "
TCP = "A TCP address is tcp://host:port, such as tcp://10.0.0.5:5555, not "
SCHEMES = "there are tcp://, ws://, wss://, ros2://."


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("tcq://x:1", f"tcq://x:1: unknown transport tcq://; {SCHEMES} Did you mean 'tcp://x:1'?"),
        ("http://x:1", f"http://x:1: unknown transport http://; {SCHEMES} Did you mean 'ws://x:1'?"),
        ("mqtt://x:1", f"mqtt://x:1: unknown transport mqtt://; {SCHEMES}"),
        ("10.0.0.5:9090", f"{URL}'10.0.0.5:9090'. Did you mean 'ws://10.0.0.5:9090'?"),
        *((url, f"{URL}{url!r}.") for url in ("ws://", "")),
        *((url, f"{TCP}{url!r}.") for url in ("tcp://x", "tcp://x:0", "tcp://x:1/space")),
        ("tcp://a..b:1", "'tcp://a..b:1' is not a TCP address: "),
        ("tcp://[::1:1", "'tcp://[::1:1' is not a TCP address: Invalid IPv6 URL."),
        ("tcp://x:99999", "'tcp://x:99999' is not a TCP address: Port out of range 0-65535."),
    ],
)
def test_what_is_no_address(url, text):
    with raising(InvalidValue, text, begins=True):
        open_transport(url)


def test_options_that_a_transport_does_not_have():
    with raising(
        InvalidValue,
        "tcp://x:1 takes no channel; its options are timeout, connect_timeout, credentials, token, name, take.",
    ):
        open_transport("tcp://x:1", channel="topics")


@pytest.mark.parametrize("url", ["tcp://x:1", "ws://x:1"])
def test_certificates_without_tls(url):
    with raising(InvalidValue, f"{url}: ca_file is for wss:// only, and this address is without TLS; leave it out."):
        open_transport(url, credentials=Credentials("ca.pem"))
    open_transport("wss://x:1", credentials=Credentials("ca.pem"))


@pytest.mark.parametrize("url", ["tcp://x:1", "ws://x:1", "ros2://x"])
def test_how_long_an_answer_is_waited_for(url):
    assert open_transport(url, timeout=None).timeout == 30.0
    assert open_transport(url, timeout=2.5).timeout == 2.5


def test_a_token_file(tmp_path):
    path = tmp_path / "token"
    path.touch(0o600)
    path.write_text("geheim\n")
    assert open_transport("tcp://x:1", credentials=Credentials.of(token_file=path)).endpoint.token == "geheim"
    with raising(
        InvalidValue,
        f"The token file {tmp_path / 'none'} cannot be read: No such file or directory. "
        "Write a secret into a file that only you can read.",
    ):
        open_transport("tcp://x:1", credentials=Credentials.of(token_file=tmp_path / "none"))
