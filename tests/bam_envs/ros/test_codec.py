"""States and commands as messages: exact dicts, exact numbers, exact complaints."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bam_envs.core.errors import ProtocolError
from bam_envs.core.robot import RobotState
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import JOINTS
from bam_envs.ros.codec import RobotInfo, decode_command, decode_source, encode_state, read_info
from bam_envs.ros.freshness import Tag, Tagger, read_tag, signature
from bam_envs.ros.interfaces import complete
from tests.bam_envs.making import encode_command

STAMP = {"sec": 12, "nanosec": 500_000_000}
TAG = Tag("me", 1, 7, 100.0, 100.1)
ARM, BASE = load_profile("ur5e"), load_profile("mir100")
PROFILES = {"ur5e": ARM, "mir100": BASE}
FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)


def state_of(profile, rng, rows=1):
    lows = {one.name: 0.1 if "scan" in one.name else -1.0 for one in profile.signals}  # what is nearer is cut
    signals = {one.name: rng.uniform(lows[one.name], 1, (rows, len(one.labels))) for one in profile.signals}
    return RobotState(signals, np.zeros(rows), np.zeros((rows, len(profile.command.labels))))


def joint_states(**changes):
    names = list(reversed(JOINTS))
    message = {"header": {"stamp": STAMP, "frame_id": ""}, "name": names}
    message |= {"position": [5.0, 4.0, 3.0, 2.0, 1.0, 0.0], "velocity": [0.5, 0.4, 0.3, 0.2, 0.1, 0], "effort": []}
    return message | changes


def decode_state(profile, messages):
    """Signal -> its numbers, from the message that holds it."""
    return {
        name: decode_source(profile.source(name), message, len(profile.signal(name).labels))
        for name, message in messages.items()
    }


def complaint(message, signal="joint_position", profile=ARM):
    with pytest.raises(ProtocolError) as caught:
        decode_state(profile, {signal: message})
    return str(caught.value)


@pytest.mark.parametrize("name", PROFILES)
def test_states_are_messages_of_their_types_and_come_back_exactly(name):
    profile = PROFILES[name]
    state = state_of(profile, np.random.default_rng(3), rows=3)
    envelopes = encode_state(profile, state, 1, STAMP, "tag")
    messages = {topic: complete(kind, message) for topic, kind, message in envelopes}
    assert all(messages[topic]["header"] == message["header"] for topic, _, message in envelopes if "header" in message)
    signals = {source.signal: messages[source.topic] for source in profile.state if source.topic in messages}
    decoded = decode_state(profile, signals)
    assert list(decoded) == list(state.signals)
    for signal, values in decoded.items():
        through_quaternion = 1e-15 if signal == "base_pose" else 0.0
        np.testing.assert_allclose(values, state.signals[signal][1], rtol=0, atol=through_quaternion)


def test_messages_of_an_arm():
    state = state_of(ARM, np.random.default_rng(0))
    del state.signals["tool_position"], state.signals["tool_quaternion"], state.signals["object_position"]
    messages = {topic: message for topic, _, message in encode_state(ARM, state, 0, STAMP, "hello")}
    assert list(messages) == ["/gripper/joint_states", "/object_pose", "/joint_states"]
    places = [JOINTS.index(name) for name in sorted(JOINTS)]
    assert messages["/joint_states"] == {
        "header": {"stamp": STAMP, "frame_id": "hello"},
        "name": sorted(JOINTS),
        "position": state.signals["joint_position"][0, places].tolist(),
        "velocity": state.signals["joint_velocity"][0, places].tolist(),
    }
    w, x, y, z = state.signals["object_quaternion"][0].tolist()
    assert messages["/object_pose"] == {
        "header": {"stamp": STAMP, "frame_id": "base_link"},
        "pose": {"orientation": {"w": w, "x": x, "y": y, "z": z}},
    }


def test_messages_of_a_base():
    state = state_of(BASE, np.random.default_rng(0))
    messages = {topic: message for topic, _, message in encode_state(BASE, state, 0, STAMP, "hello")}
    assert list(messages) == ["/robot_pose", "/f_scan", "/b_scan", "/odom"]
    assert messages["/odom"]["header"]["frame_id"] == "hello"
    assert messages["/f_scan"]["ranges"] == [0.0] * 30 + state.signals["f_scan"][0].tolist() + [0.0] * 10
    assert messages["/b_scan"]["ranges"] == [0.0] * 10 + state.signals["b_scan"][0].tolist() + [0.0] * 20
    assert len(messages["/f_scan"]["ranges"]) == len(messages["/b_scan"]["ranges"]) == 541
    assert messages["/f_scan"]["range_max"] == 29.0


def test_joints_are_found_by_name():
    decoded = decode_state(ARM, {"joint_position": joint_states(), "joint_velocity": joint_states()})
    np.testing.assert_array_equal(decoded["joint_position"], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_array_equal(decoded["joint_velocity"], [0.0, 0.1, 0.2, 0.3, 0.4, 0.5])


FOUR = [name for name in JOINTS if name != "elbow_joint"]
LENGTH = "position must have 6 numbers, one for each name, not"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"name": FOUR, "position": [0.0] * 5}, f"elbow_joint missing; found: {', '.join(FOUR)}."),
        (
            {"name": [*JOINTS, "finger_joint"], "position": [0.0] * 7},
            f"finger_joint not expected; expected: {', '.join(JOINTS)}. "
            "List the names of others in ignore of the profile.",
        ),
        ({"name": [*JOINTS, "elbow_joint"]}, "elbow_joint comes twice in name."),
        ({"position": [0.0] * 5}, f"{LENGTH} 5 numbers."),
        ({"position": []}, "position must have 6 numbers, one for each name, not 0 numbers."),
        ({"position": None}, f"{LENGTH} None."),
        ({"position": "123456"}, f"{LENGTH} '123456'."),
        ({"name": "abc"}, "name must be a list of names, not 'abc'."),
        ({"name": [1]}, "name must be a list of names, not [1]."),
        ({"name": []}, f"{', '.join(JOINTS)} missing; found: no name."),
        *(
            ({"position": [0.0, 0.0, bad, 0, 0, 0]}, f"position of wrist_1_joint must be a finite number, not {found}.")
            for bad, found in [
                *((None, "None"), (math.nan, "nan"), (-math.inf, "-inf"), ("1.0", "'1.0'"), (True, "True")),
                *(([1.0], "[1.0]"), (10**400, "100000000000000000...0000000000000000000")),
            ]
        ),
    ],
)
def test_joint_states_that_are_refused(changes, text):
    assert complaint(joint_states(**changes)) == f"/joint_states: {text}"


@pytest.mark.parametrize(
    ("message", "signal", "text"),
    [
        ([1], "joint_position", "/joint_states: a message must be an object with fields, not [1]."),
        ({"data": 1}, "joint_position", "/joint_states: the field name is missing; found: data."),
        (
            {"pose": {"position": {"x": 1.0, "z": 0.0}}},
            "object_position",
            "/object_pose: the field pose.position.y is missing; found: x, z.",
        ),
        ({"pose": {"position": 3}}, "object_position", "/object_pose: the field pose.position.x is missing; found: 3."),
    ],
)
def test_other_messages(message, signal, text):
    assert complaint(message, signal) == text


def test_stamped_or_not():
    half = math.sin(math.pi / 4)
    pose = {"position": {"x": 1, "y": 2.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": half, "w": half}}
    for message in (pose, {"header": {"stamp": STAMP, "frame_id": "map"}, "pose": pose}):
        decoded = decode_state(BASE, {"base_pose": message})["base_pose"]
        np.testing.assert_allclose(decoded, [1.0, 2.0, math.pi / 2], rtol=0, atol=1e-15)


def test_rays():
    ranges = [0.0] * 30 + [1.0] * 501 + [0.0] * 10
    # Nothing seen, and nearer and farther than a scanner measures, as robo-gym's robot server and simulators have it.
    ranges[30:37] = [None, math.nan, math.inf, 0.0, 0.01, 30.0, 1e9]
    decoded = decode_state(BASE, {"f_scan": {"ranges": ranges}})["f_scan"]
    np.testing.assert_array_equal(decoded, [29.0] * 3 + [0.05] * 2 + [29.0] * 2 + [1.0] * 494)
    assert complaint({"ranges": ranges[1:]}, "f_scan", BASE) == "/f_scan: ranges must have 541 numbers, not 540."
    ranges[40] = "far"
    assert complaint({"ranges": ranges}, "f_scan", BASE) == "/f_scan: ranges[40] must be a finite number, not 'far'."
    assert complaint({"ranges": "far"}, "f_scan", BASE) == "/f_scan: ranges must be a list of numbers, not 'far'."


@pytest.mark.parametrize(
    ("name", "mode"), [("ur5e", "position"), ("ur5e", "trajectory"), ("mir100", "velocity"), ("mir100", "stamped")]
)
@given(data=st.data())
def test_commands_come_back_exactly(name, mode, data):
    profile = PROFILES[name]
    spec = profile.spec()
    size = len(spec.command.labels)
    command = np.array(data.draw(st.lists(FINITE, min_size=size, max_size=size)))
    received = np.full(size, np.nan)
    for topic, kind, message in encode_command(profile, spec, command, TAG, mode):
        places, values, tag, _ = decode_command(profile, spec, topic, complete(kind, message))
        received[places] = values
        assert tag == (None if kind == "geometry_msgs/Twist" else TAG)
    np.testing.assert_array_equal(received, command)


YAW = """
name: turret
kind: arm
period: 0.1
command: {labels: [turn, lift], units: [rad, m], low: -3, high: 3, max_rate: 1}
signals: [{name: turn, labels: [turn, lift], units: [rad, m], low: -3, high: 3}]
state: [{signal: turn, topic: /turret, type: std_msgs/Float64MultiArray, field: data}]
commands:
  pose:
    - topic: /go
      type: geometry_msgs/PoseStamped
      labels: [turn, lift]
      fields: [yaw(pose.orientation), pose.position.z]
"""


@given(data=st.data())
def test_what_is_signed_is_what_is_read_after_any_bridge(data):
    """Some keep 64 bits, some types have 32; angles travel as quaternions."""
    profile, mode, narrow = data.draw(
        st.sampled_from([(ARM, "position", True), (ARM, "trajectory", False), (BASE, "stamped", False)])
    )
    spec, tagger = profile.spec(), Tagger(session="4f1c", key=bytes(32))
    size = len(spec.command.labels)
    command = np.array(data.draw(st.lists(st.floats(-1e9, 1e9), min_size=size, max_size=size)))
    tag = tagger.next(1, 0.1)
    for topic, kind, message in encode_command(profile, spec, command, tag, mode, sign=tagger.sign):
        if narrow:
            message["data"] = np.float32(message["data"]).astype(float).tolist()
        _, _, received, content = decode_command(profile, spec, topic, complete(kind, message))
        assert received.mac == signature(bytes(32), received, topic, content)
        assert len(received.mac) == 32
        assert received == replace(read_tag(tag.to_text()), mac=received.mac)


def test_a_signed_angle(tmp_path):
    path, tagger = tmp_path / "turret.yaml", Tagger(key=bytes(32))
    path.write_text(YAW)
    profile = load_profile(path)
    for turn in np.linspace(-3.0, 3.0, 101):
        (envelope,) = encode_command(
            profile, profile.spec(), np.array([turn, 0.3]), tagger.next(1, 0.1), sign=tagger.sign
        )
        decoded = decode_command(profile, profile.spec(), "/go", json.loads(json.dumps(envelope[2])))
        assert decoded.tag.mac == signature(bytes(32), decoded.tag, "/go", decoded.content)


def test_commands_of_an_arm():
    command = np.arange(7.0)
    gripper, joints = encode_command(ARM, ARM.spec(), command, TAG)
    assert gripper == (
        "/gripper/commands",
        "std_msgs/Float64MultiArray",
        {"layout": {"dim": [{"label": TAG.to_text(), "size": 1, "stride": 1}], "data_offset": 0}, "data": [6.0]},
    )
    assert joints[0] == "/forward_position_controller/commands"
    assert joints[2]["data"] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert all(type(value) is float for value in joints[2]["data"])
    _, trajectory = encode_command(ARM, ARM.spec(), command, TAG, "trajectory", ros1=True)
    assert trajectory[2] == {
        "header": {"stamp": {"secs": 0, "nsecs": 0}, "frame_id": TAG.to_text()},
        "joint_names": list(JOINTS),
        "points": [
            {
                "positions": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
                "velocities": [0.0] * 6,
                "accelerations": [],
                "effort": [],
                "time_from_start": {"secs": 0, "nsecs": 100_000_000},
            }
        ],
    }


def test_commands_of_a_base():
    assert encode_command(BASE, BASE.spec(), np.array([0.5, -0.7]), TAG) == [
        (
            "/cmd_vel",
            "geometry_msgs/Twist",
            {"linear": {"x": 0.5, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": -0.7}},
        )
    ]


def refused_command(topic, message):
    with pytest.raises(ProtocolError) as caught:
        decode_command(ARM, ARM.spec(), topic, message)
    return str(caught.value)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"data": [0.0] * 5}, f"data must have 6 ({', '.join(JOINTS)}) numbers, not 5."),
        ({"data": [0.0, None, 0, 0, 0, 0]}, "data[1] must be a finite number, not None."),
        ({"data": [0.0, 0, 0, 0, 0, math.nan]}, "data[5] must be a finite number, not nan."),
        ({"data": ["0.0", 0, 0, 0, 0, 0]}, "data[0] must be a finite number, not '0.0'."),
        ({"data": [True, 0, 0, 0, 0, 0]}, "data[0] must be a finite number, not True."),
        ({"data": 0.0}, "data must be a list of numbers, not 0.0."),
        ({}, "the field data is missing; found: ."),
        (None, "a message must be an object with fields, not None."),
    ],
)
def test_commands_that_are_refused(message, text):
    topic = "/forward_position_controller/commands"
    assert refused_command(topic, message) == f"{topic}: {text}"


@pytest.mark.parametrize(
    ("names", "points", "text"),
    [
        (JOINTS, [[0.0] * 6] * 2, "points must be a list of 1 point, not 2."),
        (JOINTS[:5], [[0.0] * 6], f"wrist_3_joint missing; found: {', '.join(JOINTS[:5])}."),
        (JOINTS, [[0.0] * 5], "positions must have 6 numbers, one for each name, not 5 numbers."),
    ],
)
def test_trajectories_that_are_refused(names, points, text):
    topic = "/scaled_joint_trajectory_controller/joint_trajectory"
    message = {"joint_names": list(names), "points": [{"positions": one} for one in points]}
    assert refused_command(topic, message) == f"{topic}: {text}"
    assert refused_command("/elsewhere", {}) == "/elsewhere: ur5e takes no command on this topic."


def test_trajectories_are_ordered_by_name():
    topic = "/scaled_joint_trajectory_controller/joint_trajectory"
    message = {"joint_names": list(reversed(JOINTS)), "points": [{"positions": [5, 4, 3, 2, 1, 0]}]}
    places, values, tag, _ = decode_command(ARM, ARM.spec(), topic, message)
    assert dict(zip(places, values.tolist(), strict=True)) == {0: 0.0, 1: 1.0, 2: 2.0, 3: 3.0, 4: 4.0, 5: 5.0}
    assert tag is None


def test_units_of_the_robot(tmp_path):
    path = tmp_path / "mm.yaml"
    path.write_text(
        """
name: lift
kind: arm
period: 0.1
command: {labels: [left, right], units: m, low: 0, high: 2, max_rate: 1}
signals: [{name: height, labels: [left, right], units: m, low: 0, high: 2}]
state:
  - signal: height
    topic: /lift
    type: std_msgs/Float64MultiArray
    field: data
    scale: [0.001, -0.001]
    offset: [0, 1]
commands:
  lift: [{topic: /go, type: std_msgs/Float64MultiArray, labels: [left, right], scale: [0.001, -0.001], offset: [0, 1]}]
"""
    )
    profile = load_profile(path)
    decoded = decode_state(profile, {"height": {"data": [250, 250.0]}})
    np.testing.assert_allclose(decoded["height"], [0.25, 0.75], rtol=1e-15)
    ((_, _, message),) = encode_command(profile, profile.spec(), np.array([0.25, 0.75]), None)
    np.testing.assert_allclose(message["data"], [250.0, 250.0], rtol=1e-15)
    assert message["layout"]["dim"][0]["label"] == ""
    np.testing.assert_allclose(decode_command(profile, profile.spec(), "/go", message)[1], [0.25, 0.75], rtol=1e-15)


def test_info():
    info = RobotInfo("ur5e", simulated=True, lockstep=True, period=0.05, text="a box")
    assert read_info(info.to_json(), "/bam/robot") == info
    assert read_info('{"name": "x", "more": 1}', "/bam/robot") == RobotInfo("x")
    for text in (None, "", "[]", "{}", '{"name": 3}'):
        with pytest.raises(ProtocolError) as caught:
            read_info(text, "/bam/robot")
        assert str(caught.value).startswith("/bam/robot: the answer must describe the robot, not ")


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("simulated", '"false"', "simulated: expected true or false, found 'false'"),
        ("simulated", "1", "simulated: expected true or false, found 1"),
        ("simulated", "null", "simulated: expected true or false, found None"),
        ("lockstep", '"no"', "lockstep: expected true or false, found 'no'"),
        ("period", '"0.05"', "period: expected a number above 0, found '0.05'"),
        ("period", "0", "period: expected a number above 0, found 0"),
        ("watchdog", "-1", "watchdog: expected a number of at least 0, found -1"),
        ("text", "[1]", "text: expected text, found [1]"),
    ],
)
def test_info_of_the_wrong_kind_is_not_believed(field, value, text):
    with pytest.raises(ProtocolError) as caught:
        read_info(f'{{"name": "x", "{field}": {value}}}', "/bam/robot")
    assert str(caught.value) == f"/bam/robot: {text}"


@pytest.mark.parametrize(("period", "nanoseconds"), [(0.05, 100_000_000), (0.1, 200_000_000)])
def test_a_trajectory_that_reaches_over_more_than_a_period(period, nanoseconds):
    profile = load_profile("ur5e_trajectory")
    spec = replace(profile.spec(), period=period)
    _, (_, _, message) = encode_command(profile, spec, np.arange(7.0) / 100, None, "trajectory")
    assert message["points"][0]["time_from_start"] == {"sec": 0, "nanosec": nanoseconds}


def posed(frame):
    header = {} if frame is None else {"header": {"stamp": STAMP, "frame_id": frame}}
    place = {"x": 0.4, "y": -0.2, "z": 0.1}
    return header | {"pose": {"position": place, "orientation": {"w": 0.5, "x": 0.1, "y": -0.3, "z": 0.8}}}


@pytest.mark.parametrize("frame", ["base_link", "/base_link"])
def test_a_pose_in_the_frame_of_the_profile(frame):
    signals = decode_state(load_profile("ur5e"), {"object_position": posed(frame)})
    assert signals["object_position"].tolist() == [0.4, -0.2, 0.1]


@pytest.mark.parametrize(("frame", "found"), [("base", "'base'"), ("", "''"), (None, "None"), (7, "7")])
def test_a_pose_in_another_frame_or_in_none_is_refused(frame, found):
    assert complaint(posed(frame), "object_quaternion") == (
        f"/object_pose: header.frame_id must be 'base_link', not {found}: a pose in another frame is another place "
        "(a UR's base is its base_link turned by 180 degrees about z). Publish it in base_link; if that frame has "
        "another name there, give the name under [frames] of the profile."
    )


def test_the_tool_pose_of_the_driver_is_turned_into_base_link():
    profile, message = load_profile("ur5e"), posed("base")
    signals = decode_state(profile, {"tool_position": message, "tool_quaternion": message})
    np.testing.assert_allclose(signals["tool_position"], [-0.4, 0.2, 0.1])
    np.testing.assert_allclose(signals["tool_quaternion"], [-0.8, 0.3, 0.1, 0.5])  # (0, 0, 0, 1) times it
    with pytest.raises(ProtocolError, match="frame_id must be 'base', not 'base_link'"):
        decode_state(profile, {"tool_position": posed("base_link")})


def test_a_served_pose_says_its_frame():
    profile = load_profile("ur5e")
    signals = {"object_position": np.zeros((1, 3)), "joint_position": np.zeros((1, 6))}
    messages = encode_state(profile, RobotState(signals, np.zeros(1), np.zeros((1, 7))), 0, STAMP, "tag")
    frames = [(topic, message["header"]["frame_id"]) for topic, _, message in messages]
    assert frames == [("/object_pose", "base_link"), ("/joint_states", "tag")]
