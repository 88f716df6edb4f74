import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.remote.serve.serve_options import ServeOptions
from tests.raising import raising


def test_the_defaults_are_possible():
    ServeOptions().require_sane()
    ServeOptions(rclpy=True, token_file="t", tcp=0).require_sane()  # the token is for the TCP port


EXCLUDE, ONLY = "exclude each other; give one of the two.", "means something only where"
CLIENTS = "clients connect to this program."
TCP, NO_TOKEN = "and --cert does not change that", "ROS 2 has no token. Leave it out."


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"realtime": True, "fast": True}, f"--realtime and --fast {EXCLUDE}"),
        ({"via": "ws://a", "rclpy": True}, f"--via and --rclpy {EXCLUDE}"),
        ({"via": "ws://a", "cert": "c"}, f"--via and --cert {EXCLUDE}"),
        ({"rclpy": True, "cert": "c"}, f"--rclpy and --cert {EXCLUDE}"),
        ({"cert": "c", "tcp": 0}, f"--tcp carries everything in the clear, {TCP}; leave one of the two out."),
        ({"key": "k"}, "--key means something only with --cert."),
        ({"ca_file": "k"}, "--ca-file means something only with --via."),
        ({"rclpy": True, "token_file": "t"}, f"--token-file protects nothing with --rclpy: {NO_TOKEN}"),
        ({"no_token": True, "token_file": "t"}, f"--no-token and --token-file {EXCLUDE}"),
        ({"via": "ws://a", "operator_token_file": "t"}, f"--operator-token-file {ONLY} {CLIENTS}"),
        ({"lease": 0.0}, "--lease: expected a number above 0, found 0.0"),
        ({"lease": float("nan")}, "--lease: expected a number above 0, found nan"),
        ({"port": -1}, "--port: expected a whole number from 0 to 65535, found -1"),
        ({"tcp": 65536}, "--tcp: expected a whole number from 0 to 65535, found 65536"),
        ({"namespace": "a b"}, "--namespace must be letters, digits and _, such as bam_001, not 'a b'."),
        ({"namespace": "1a"}, "--namespace must be letters, digits and _, such as bam_001, not '1a'."),
    ],
)
def test_what_cannot_be(options, text):
    with raising(InvalidValue, text):
        ServeOptions(**options).require_sane()


CLEAR = "The token is sent unencrypted to {}, and so is everything else: give --cert, or trust that network."
OPEN = "Anybody who reaches {} may command what is served here, because of --no-token."
REFUSED = (
    "Anybody who reaches {} could command what is served here: give --token-file, or --bind 127.0.0.1; or --no-token, "
    "if everybody there is to."
)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, None),
        ({"bind": "127.0.0.5"}, None),
        ({"bind": "::1"}, None),
        ({"bind": "localhost", "tcp": 0}, None),
        ({"bind": "0.0.0.0", "no_token": True}, OPEN.format("0.0.0.0")),
        ({"bind": "", "no_token": True}, OPEN.format("every address of this computer")),
        ({"bind": "0.0.0.0", "token_file": "t"}, CLEAR.format("0.0.0.0")),
        ({"bind": "0.0.0.0", "token_file": "t", "rclpy": True, "tcp": 0}, CLEAR.format("0.0.0.0")),
        ({"bind": "0.0.0.0", "token_file": "t", "cert": "c"}, None),
        ({"bind": "0.0.0.0", "via": "ws://a"}, None),
        ({"bind": "0.0.0.0", "rclpy": True}, None),
    ],
)
def test_what_stands_open_is_said(options, text):
    ServeOptions(**options).require_sane()
    assert ServeOptions(**options).warning == text


@pytest.mark.parametrize(
    ("options", "place"),
    [
        ({"bind": "0.0.0.0"}, "0.0.0.0"),
        ({"bind": "::"}, "::"),
        ({"bind": ""}, "every address of this computer"),
        ({"bind": "robot.lab", "cert": "c"}, "robot.lab"),
        ({"bind": "0.0.0.0", "rclpy": True, "tcp": 0}, "0.0.0.0"),
    ],
)
def test_no_network_without_a_token_by_oversight(options, place):
    with raising(InvalidValue, REFUSED.format(place)):
        ServeOptions(**options).require_sane()


@pytest.mark.parametrize(("name", "prefix"), [("", ""), ("/", ""), ("a", "/a"), ("/a/b_1/", "/a/b_1")])
def test_the_prefix_of_every_name(name, prefix):
    assert ServeOptions(namespace=name).prefix == prefix
