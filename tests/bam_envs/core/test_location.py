"""Where an environment runs."""

import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.location import HERE, Credentials, LiveRobot, Remote, addresses, location_of
from bam_envs.core.wording import as_flag
from bam_envs.live.building import live_robot
from bam_envs.remote.remote_env import open_transport
from bam_train.deploy.guard_table import read_guards
from bam_train.environments import with_live_robot
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
    ("options", "credentials", "message"),
    [
        (
            {"robot": "ws://a:1", "transport": "tcp://b:2"},
            {},
            "--robot and --transport exclude each other: the task runs here, or over there; give one",
        ),
        ({"profile": "ur5e"}, {}, "--profile describes a live robot; give its address with --robot too"),
        (
            {"transport": None},
            {"ca_file": "ca.pem"},
            "--ca-file is for a link, and the robot is simulated here; give --robot or --transport",
        ),
        ({}, {"token_file": "t"}, "--token-file is for a link, and the robot is simulated here; give --robot"),
        (
            {"robot": "ws://a:1"},
            {"ca_file": "ca.pem"},
            "--ca-file is for wss:// only, and ws://a:1 is without TLS; leave it out",
        ),
        (
            {"transport": "wss://a:1,tcp://b:2"},
            {"ca_file": "ca.pem"},
            "--ca-file is for wss:// only, and tcp://b:2 is without TLS; leave it out",
        ),
        (
            {"transport": ["tcp://a:1", "tcp://b:2", "tcp://a:1/"]},
            {},
            "--transport: tcp://a:1 comes twice, and an address is one environment; give it once",
        ),
        ({"transport": ","}, {}, "--transport: expected an address, found none; leave it out for the simulation here"),
        (
            {"guard": {"joint_speed": 0.3}},
            {},
            "--guard changes a limit of a live robot; give its address with --robot too",
        ),
        ({"timeout": 5.0}, {}, "--timeout limits the wait for an answer of --transport; leave it out"),
        ({"transport": "tcp://a:1", "timeout": 0.0}, {}, "--timeout: expected a number above 0, found 0.0"),
        (
            {"robot": "ws://a:1", "robot_name": "-"},
            {},
            "--robot-name: expected at most 64 letters, digits, blanks and . _ @ -, with a letter or digit at both "
            "ends, found '-'",
        ),
        (
            {"robot": "ws://a:1", "fast": True},
            {},
            "a live robot is driven at the rate that its policy was made for; leave out --fast",
        ),
        (
            {"robot": "ws://a:1", "i_know": True, "stage": "trial"},
            {},
            "--i-know is for --stage full alone; leave it out",
        ),
        (
            {"robot": "ws://a:1", "shadow": True, "unusual": "hold"},
            {},
            "--shadow sends nothing, and --unusual is about what is sent; leave --unusual out",
        ),
        (
            {"robot": LiveRobot("ws://a:1"), "profile": "ur5e"},
            {"token_file": "t"},
            "--profile is a field of the LiveRobot that --robot is; give it there",
        ),
    ],
)
def test_what_excludes_each_other_is_refused(options, credentials, message):
    with pytest.raises(SettingsError) as caught:
        location_of(options, Credentials(**credentials), as_flag, SettingsError)
    assert str(caught.value) == message


def test_the_three_locations():
    nothing = {"robot": None, "transport": None, "guard": (), "guards": {}, "stage": None, "shadow": False}
    assert (location_of({**nothing, "robot_name": "", "seed": 1}), HERE.text) == (HERE, "")
    credentials = Credentials("ca.pem")
    there = location_of({"transport": ["wss://a:1", "wss://b:2"], "timeout": 2.5}, credentials)
    assert (there, there.text) == (Remote(("wss://a:1", "wss://b:2"), credentials, 2.5), "wss://a:1, wss://b:2")
    guard = read_guards([" joint_speed = 0.3", "tool_speed=1e-1"])
    robot = location_of({"robot": "wss://a:1", "profile": "mine.toml", "guard": guard, "stage": "full"}, credentials)
    limits = {"joint_speed": 0.3, "tool_speed": 0.1}
    assert (robot, robot.text) == (LiveRobot("wss://a:1", credentials, "mine.toml", limits, "full"), "wss://a:1")
    assert location_of({"robot": robot}) is robot
    assert location_of({"robot": "ws://a:1", "shadow": True}) == LiveRobot("ws://a:1", stage="shadow")
    assert location_of({"robot": "ws://a:1", "trial": True}) == LiveRobot("ws://a:1", stage="trial")


def test_a_live_robot_is_as_it_is():
    robot = LiveRobot("ws://a:1", profile="mine.toml")
    given = {"randomize": True, "link": "wifi", "action_delay": 2, "max_episode_steps": 7}
    assert with_live_robot("bam/pick-v0", given, robot) == {"max_episode_steps": 7, "robot": robot}


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


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: live_robot("ws://HOST:PORT"), "'ws://HOST:PORT': HOST and PORT stand"),
        (lambda: live_robot("URL"), "'URL': URL stands"),
        (lambda: open_transport("ws://ADDRESS:9090/bam_001"), "'ws://ADDRESS:9090/bam_001': ADDRESS stands"),
        (lambda: open_transport("tcp://HOST:9091"), "'tcp://HOST:9091': HOST stands"),
    ],
)
def test_an_address_of_an_example_is_named(make, words):
    with pytest.raises(InvalidValue) as caught:
        make()
    assert str(caught.value) == f"{words} for what yours is, such as 10.0.0.5:9090 in ws://10.0.0.5:9090."


def test_an_environment_without_a_robot_says_so():
    with pytest.raises(SettingsError) as caught:
        with_live_robot("CartPole-v1", {}, LiveRobot("ws://a:1"))
    assert str(caught.value) == (
        "CartPole-v1 has no robot that --robot could exchange; serve it next to the robot with "
        "bam-serve --env CartPole-v1, and give --transport"
    )
