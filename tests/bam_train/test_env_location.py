"""Where an environment runs."""

import pytest

from bam_train.env_location import HERE, Place, addresses
from bam_train.errors import SettingsError


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (None, ()),
        ("tcp://a:1, ws://b:2 ,", ("tcp://a:1", "ws://b:2")),
        (["a", "b"], ("a", "b")),
    ],
)
def test_addresses(text, found):
    assert addresses(text) == found


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (
            Place(robot="ws://a:1", transport=("tcp://b:2",)),
            "--robot and --transport exclude each other: the task runs here, or over there; give one",
        ),
        (Place(profile="ur5e"), "--profile describes a live robot; give its address with --robot too"),
        (
            Place(ca_file="ca.pem"),
            "--ca-file is for a link, and the robot is simulated here; give --robot or --transport",
        ),
        (
            Place(robot="ws://a:1", ca_file="ca.pem"),
            "--ca-file is for wss:// only, and ws://a:1 is without TLS; leave it out",
        ),
        (
            Place(transport=("wss://a:1", "tcp://b:2"), ca_file="ca.pem"),
            "--ca-file is for wss:// only, and tcp://b:2 is without TLS; leave it out",
        ),
        (
            Place(transport=("tcp://a:1", "tcp://b:2", "tcp://a:1/")),
            "--transport: tcp://a:1 comes twice, and an address is one environment; give it once",
        ),
        (Place(timeout=5.0), "--timeout limits the wait for an answer of --transport; leave it out"),
        (Place(transport=("tcp://a:1",), timeout=0.0), "--timeout: expected a number above 0, found 0.0"),
    ],
)
def test_what_excludes_each_other_is_refused(place, message):
    with pytest.raises(SettingsError) as caught:
        place.require_sane()
    assert str(caught.value) == message


def test_what_a_transport_is_opened_with():
    HERE.require_sane()
    assert (HERE.is_remote, HERE.text) == (False, "")
    place = Place(transport=("wss://a:1", "wss://b:2"), ca_file="ca.pem", timeout=2.5)
    place.require_sane()
    assert place.link_options == {"ca_file": "ca.pem", "token_file": None, "timeout": 2.5}


def test_a_live_robot_is_as_it_is():
    place = Place(robot="ws://a:1", profile="mine.toml", ca_file="ca.pem")
    assert place.robot_kwargs("bam/pick-v0", {"randomize": True}) == {
        "robot": "ws://a:1",
        "profile": "mine.toml",
        "ca_file": "ca.pem",
        "token_file": None,
    }


def test_an_environment_without_a_robot_says_so():
    with pytest.raises(SettingsError) as caught:
        Place(robot="ws://a:1").robot_kwargs("CartPole-v1", {})
    assert str(caught.value) == (
        "CartPole-v1 has no robot that --robot could exchange; serve it next to the robot with "
        "bam-serve --env CartPole-v1, and give --transport"
    )
