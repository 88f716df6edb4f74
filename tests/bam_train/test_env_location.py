"""Where an environment runs."""

import pytest

from bam_train.env_location import HERE, EnvLocation, addresses, read_guards
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
            EnvLocation(robot="ws://a:1", transport=("tcp://b:2",)),
            "--robot and --transport exclude each other: the task runs here, or over there; give one",
        ),
        (EnvLocation(profile="ur5e"), "--profile describes a live robot; give its address with --robot too"),
        (
            EnvLocation(ca_file="ca.pem"),
            "--ca-file is for a link, and the robot is simulated here; give --robot or --transport",
        ),
        (
            EnvLocation(robot="ws://a:1", ca_file="ca.pem"),
            "--ca-file is for wss:// only, and ws://a:1 is without TLS; leave it out",
        ),
        (
            EnvLocation(transport=("wss://a:1", "tcp://b:2"), ca_file="ca.pem"),
            "--ca-file is for wss:// only, and tcp://b:2 is without TLS; leave it out",
        ),
        (
            EnvLocation(transport=("tcp://a:1", "tcp://b:2", "tcp://a:1/")),
            "--transport: tcp://a:1 comes twice, and an address is one environment; give it once",
        ),
        (
            EnvLocation(guards=(("joint_speed", 0.3),)),
            "--guard changes a limit of a live robot; give its address with --robot too",
        ),
        (EnvLocation(timeout=5.0), "--timeout limits the wait for an answer of --transport; leave it out"),
        (EnvLocation(transport=("tcp://a:1",), timeout=0.0), "--timeout: expected a number above 0, found 0.0"),
    ],
)
def test_what_excludes_each_other_is_refused(place, message):
    with pytest.raises(SettingsError) as caught:
        place.require_sane()
    assert str(caught.value) == message


def test_what_a_transport_is_opened_with():
    HERE.require_sane()
    assert (HERE.is_remote, HERE.text) == (False, "")
    place = EnvLocation(transport=("wss://a:1", "wss://b:2"), ca_file="ca.pem", timeout=2.5)
    place.require_sane()
    assert place.link_options == {"ca_file": "ca.pem", "token_file": None, "timeout": 2.5}


def test_a_live_robot_is_as_it_is():
    place = EnvLocation(robot="ws://a:1", profile="mine.toml", ca_file="ca.pem")
    assert place.robot_kwargs("bam/pick-v0", {"randomize": True, "link": "wifi", "action_delay": 2}) == {
        "robot": "ws://a:1",
        "profile": "mine.toml",
        "ca_file": "ca.pem",
        "token_file": None,
    }


def test_the_limits_of_its_guards():
    place = EnvLocation(robot="ws://a:1", guards=read_guards([" joint_speed = 0.3", "tool_speed=1e-1"]))
    assert place.robot_kwargs("bam/pick-v0", {})["guards"] == {"joint_speed": 0.3, "tool_speed": 0.1}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["joint_speed"], "--guard joint_speed: expected NAME=NUMBER, such as --guard joint_speed=0.3"),
        (["joint_speed=fast"], "--guard joint_speed=fast: expected NAME=NUMBER, such as --guard joint_speed=0.3"),
        (["joint_sped=0.3"], "--guard: Unknown limit 'joint_sped'. Did you mean 'joint_speed'?"),
        (
            ["joint_speed=9"],
            "--guard: The limit joint_speed of a live robot must be 0.01 to 3.14159 rad/s, not 9.",
        ),
        (["tool_speed=inf"], "--guard: The limit tool_speed of a live robot must be 0.005 to 1 m/s, not inf."),
        (["tool_speed=nan"], "--guard: The limit tool_speed: expected a number above 0, found nan"),
        (["joint_speed=1", "joint_speed=2"], "--guard: joint_speed comes twice (1 and 2); give it once"),
        (
            ["joint_speed=0.3", "reset_speed=0.5"],
            "--guard: The limits reset_speed of 0.5 and joint_speed of 0.3 contradict each other: reset_speed is at "
            "most joint_speed.",
        ),
    ],
)
def test_a_guard_that_is_refused(texts, message):
    with pytest.raises(SettingsError) as caught:
        read_guards(texts)
    assert str(caught.value) == message


def test_an_environment_without_a_robot_says_so():
    with pytest.raises(SettingsError) as caught:
        EnvLocation(robot="ws://a:1").robot_kwargs("CartPole-v1", {})
    assert str(caught.value) == (
        "CartPole-v1 has no robot that --robot could exchange; serve it next to the robot with "
        "bam-serve --env CartPole-v1, and give --transport"
    )
