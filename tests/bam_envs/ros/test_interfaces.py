import math

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.ros.definitions import DEFINITIONS
from bam_envs.ros.interfaces import complete, normal_name, request_type, require_plain, response_type, variants

STAMP = {"sec": 0, "nanosec": 0}
HEADER = {"stamp": STAMP, "frame_id": ""}
SERVICES = [line.split(":")[0] for line in DEFINITIONS.splitlines() if "->" in line]
MESSAGES = [line.split(":")[0] for line in DEFINITIONS.splitlines() if line and "->" not in line]


def refusal(kind, message):
    with pytest.raises(InvalidValue) as caught:
        complete(kind, message)
    return str(caught.value)


@pytest.mark.parametrize("kind", MESSAGES + [part(one) for one in SERVICES for part in (request_type, response_type)])
def test_each_type_has_defaults_that_fit_it(kind):
    default = complete(kind, {})
    assert variants(kind)
    assert complete(kind, default) == default


def test_names_of_both_ros_mean_the_same():
    assert normal_name("std_msgs/msg/String") == "std_msgs/String"
    assert normal_name("std_srvs/srv/Trigger") == "std_srvs/Trigger"
    assert [normal_name(name) for name in ("std_msgs/String", "a/msg")] == ["std_msgs/String", "a/msg"]
    assert request_type("std_srvs/srv/SetBool") == "std_srvs/SetBoolRequest"


@pytest.mark.parametrize("name", ["String", "a/b/c", "", "a/", "/b", "a b/c", None, 3, "é/b", "a" * 300 + "/b"])
def test_other_names_are_refused(name):
    with pytest.raises(InvalidValue, match=r"^Type: expected a name such as 'std_msgs/String', found "):
        normal_name(name)


def test_what_is_left_out_is_filled_in():
    assert complete("geometry_msgs/msg/PoseStamped", {"pose": {"position": {"x": 1}}}) == {
        "header": HEADER,
        "pose": {"position": {"x": 1.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
    }
    assert complete("sensor_msgs/CameraInfo", {})["k"] == [0.0] * 9
    assert complete("sensor_msgs/CompressedImage", {}) == {"header": HEADER, "format": "", "data": b""}


def test_both_spellings_of_time_are_kept():
    assert complete("std_msgs/Header", {"stamp": {"secs": 3}})["stamp"] == {"secs": 3, "nsecs": 0}
    assert complete("std_msgs/Header", {"stamp": {"sec": 3}})["stamp"] == {"sec": 3, "nanosec": 0}
    assert complete("std_msgs/Header", {"seq": 7}) == {"seq": 7, "stamp": STAMP, "frame_id": ""}
    assert complete("sensor_msgs/CameraInfo", {"K": [1.0] * 9})["K"] == [1.0] * 9
    found = refusal("std_msgs/Header", {"stamp": {"secs": 3, "nanosec": 1}})
    assert found == "std_msgs/Header.stamp: expected only the fields sec, nanosec, found 'secs'."


@pytest.mark.parametrize("data", [b"\x00\xff", "AP8=", [0, 255], bytearray(b"\x00\xff"), memoryview(b"\x00\xff")])
def test_bytes_come_in_several_forms(data):
    assert complete("std_msgs/UInt8MultiArray", {"data": data})["data"] == b"\x00\xff"


def test_one_or_a_list_where_both_are_allowed():
    image = {"format": "jpeg", "data": b"x"}
    one = complete("bam_msgs/GymFeedback", {"color_img": image})["color_img"]
    assert complete("bam_msgs/GymFeedback", {"color_img": [image]})["color_img"] == [one]


def test_the_message_that_came_is_not_changed():
    message = {"data": [1, 2]}
    checked = complete("std_msgs/Float64MultiArray", message)
    checked["data"].append(3.0)
    assert message == {"data": [1, 2]}
    assert all(type(value) is float for value in checked["data"])


@pytest.mark.parametrize("data", [[1, 2], [1, 2.5], [2.5, 1], [2**64, 0.5], [-0.0]])
def test_integers_where_floats_are_expected_become_floats(data):
    checked = complete("std_msgs/Float64MultiArray", {"data": data})["data"]
    assert checked == data
    assert {type(value) for value in checked} == {float}


def test_fields_that_a_type_does_not_have_can_be_ignored():
    kind = "bam_msgs/GymAPIRequest"
    message = {"seed": 3, "newer": None, "header": {"newer": 1}, "action": [{"continuous_action": [1], "newer": []}]}
    plain = {"seed": 3, "header": {}, "action": [{"continuous_action": [1]}]}
    assert complete(kind, message, lenient=True) == complete(kind, plain)
    with pytest.raises(InvalidValue) as caught:
        complete(kind, {"seed": "3", "newer": 1}, lenient=True)
    assert str(caught.value) == "bam_msgs/GymAPIRequest.seed: expected an integer (int64), found '3'."


ARRAY, TWIST, THING = "std_msgs/Float64MultiArray", "geometry_msgs/Twist", "my_msgs/Thing"
BASE64 = ".data: expected bytes as base64 or a list of integers in [0, 255], found "
FLOAT32, UINT8 = "std_msgs/Float32MultiArray", "std_msgs/UInt8MultiArray"
BITS = "expected a finite number of 32 bits, found"
EXPECTED = [
    (ARRAY, {"data": [1, math.nan]}, ".data[1]: expected a finite number, found nan."),
    (ARRAY, {"data": [1.0, math.inf]}, ".data[1]: expected a finite number, found inf."),
    (ARRAY, {"data": [math.inf, 1, -math.inf]}, ".data[0]: expected a finite number, found inf."),
    (ARRAY, {"data": [None]}, ".data[0]: expected a number, found None."),
    (ARRAY, {"data": [1, 2.5, True]}, ".data[2]: expected a number, found True."),
    (ARRAY, {"data": ["1"]}, ".data[0]: expected a number, found '1'."),
    (ARRAY, {"data": "1"}, ".data: expected a list, found '1'."),
    (ARRAY, {"data": None}, ".data: expected a list, found None."),
    (ARRAY, {"data": np.zeros(2)}, ".data: expected a list, found array([0., 0.])."),
    (ARRAY, {"data": [np.int64(1)]}, ".data[0]: expected a number, found np.int64(1)."),
    (ARRAY, {"data": [10**400]}, ".data[0]: expected a finite number, found "),
    (ARRAY, {"data": [1, -(10**400), 10**400]}, ".data[1]: expected a finite number, found "),
    (ARRAY, {"datas": []}, ": expected only the fields layout, data, found 'datas'."),
    (ARRAY, [], ": expected an object, found []."),
    (ARRAY, None, ": expected an object, found None."),
    (ARRAY, {"layout": {"dim": [{"size": -1}]}}, ".layout.dim[0].size: expected an integer in [0, 4294967295], found "),
    (FLOAT32, {"data": [0, 2**128]}, f".data[1]: {BITS} "),
    (FLOAT32, {"data": [0.0, -1e39]}, f".data[1]: {BITS} -1e+39."),
    (UINT8, {"data": [True]}, BASE64 + "[True]."),
    (UINT8, {"data": [256]}, BASE64 + "[256]."),
    (UINT8, {"data": "#"}, BASE64 + "'#'."),
    (TWIST, {"linear": {"x": "1"}}, ".linear.x: expected a number, found '1'."),
    (TWIST, {"linear": None}, ".linear: expected an object, found None."),
    ("std_msgs/Float32", {"data": 1e39}, f".data: {BITS} 1e+39."),
    ("std_msgs/UInt8", {"data": 256}, ".data: expected an integer in [0, 255], found 256."),
    ("std_msgs/Int32", {"data": 1.0}, ".data: expected an integer (int32), found 1.0."),
    ("std_msgs/Int32", {"data": True}, ".data: expected an integer (int32), found True."),
    ("std_msgs/Int8MultiArray", {"data": [127, 128]}, ".data[1]: expected an integer in [-128, 127], found 128."),
    ("std_msgs/Bool", {"data": 1}, ".data: expected true or false, found 1."),
    ("std_msgs/String", {"data": 1}, ".data: expected a text, found 1."),
    ("std_msgs/String", {"data": "\ud800"}, ".data: expected a text of whole characters, found '\\ud800'."),
    ("std_msgs/Empty", {"data": 1}, ": expected no fields, found 'data'."),
    ("sensor_msgs/CameraInfo", {"k": [0.0]}, ".k: expected a list of 9, found a list of 1."),
    ("sensor_msgs/JointState", {"name": ["a", 1]}, ".name[1]: expected a text, found 1."),
    ("sensor_msgs/JointState", {"name": ["\ud800"]}, ".name[0]: expected a text of whole characters"),
    (THING, {"a": [{"b": None}]}, ".a[0].b: expected a plain value, found None."),
    (THING, {"a": math.nan}, ".a: expected a finite number, found nan."),
    (THING, {"a": 2**64}, ".a: expected a number of 64 bits, found 18446744073709551616."),
    (THING, {"a": [1, 2**64]}, ".a[1]: expected a number of 64 bits, found 18446744073709551616."),
    (THING, {"a": [-(2**63) - 1]}, ".a[0]: expected a number of 64 bits, found -9223372036854775809."),
    (THING, {"a": object()}, ".a: expected a plain value, found <object"),
    (THING, {1: 2}, ": expected texts as names, found 1."),
]


@pytest.mark.parametrize(("kind", "message", "text"), EXPECTED)
def test_what_does_not_fit_is_named(kind, message, text):
    assert refusal(kind, message).startswith(kind + text)


def test_unknown_types_take_plain_values_as_they_are():
    message = {"a": [1, 2.5, "x", True, b"\x00", {"b": []}]}
    assert complete("my_msgs/msg/Thing", message) == message


def test_nesting_has_an_end():
    message = leaf = {}
    for _ in range(40):
        leaf["a"] = {}
        leaf = leaf["a"]
    assert "expected at most 32 lists and objects in one another, found {'a': {" in refusal("my_msgs/Thing", message)
    message["self"] = message
    assert "at most 32" in refusal("my_msgs/Thing", message)


@pytest.mark.parametrize("numbers", [[1.5], [1, 2]])
def test_numbers_are_no_nesting(numbers):
    for _ in range(31):
        numbers = [numbers]
    assert complete("my_msgs/Thing", {"a": numbers}) == {"a": numbers}
    assert "at most 32" in refusal("my_msgs/Thing", {"a": [numbers]})


def test_null_is_plain_outside_of_messages():
    require_plain({"id": None}, "Message")
    with pytest.raises(InvalidValue, match=r"^Message\.id: expected a finite number, found nan\.$"):
        require_plain({"id": math.nan}, "Message")


def test_texts_in_a_list():
    for names in (["a", "\u00e9"], ("a", "b")):
        assert complete("sensor_msgs/JointState", {"name": names})["name"] == list(names)
