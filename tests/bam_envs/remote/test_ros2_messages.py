import math
import sys
from array import array
from types import SimpleNamespace

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.remote.wire import ros2_node
from bam_envs.remote.wire.ros2_node import RclpyBus, interface, to_dict, to_message
from tests.raising import raising


def message_class(types, **defaults):
    """A class as ROS generates it: fields with defaults, and their types."""

    class Made(SimpleNamespace):
        def __init__(self):
            super().__init__(
                **{name: value() if isinstance(value, type) else value for name, value in defaults.items()}
            )

        @classmethod
        def get_fields_and_field_types(cls):
            return types

    return Made


Stamp = message_class({"sec": "int32", "nanosec": "uint32"}, sec=0, nanosec=0)
Header = message_class({"stamp": "builtin_interfaces/Time", "frame_id": "string"}, stamp=Stamp, frame_id="")
Everything = message_class(
    {
        "header": "std_msgs/Header",
        "values": "sequence<double>",
        "few": "sequence<float, 3>",
        "fixed": "double[2]",
        "names": "sequence<string>",
        "stamps": "sequence<builtin_interfaces/Time>",
        "data": "sequence<uint8>",
        "octets": "sequence<octet>",
        "octet": "octet",
        "flag": "boolean",
        "number": "double",
        "short": "string<5>",
        "count": "uint8",
    },
    header=Header,
    values=array("d"),
    few=array("f"),
    fixed=np.zeros(2),
    names=[],
    stamps=[],
    data=array("B"),
    octets=[],
    octet=b"\x00",
    flag=False,
    number=0.0,
    short="",
    count=0,
)
FULL = {
    "header": {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": "base"},
    "values": [1.0, 2.5],
    "few": [0.5],
    "fixed": [1.0, 2.0],
    "names": ["a", "b"],
    "stamps": [{"sec": 1, "nanosec": 2}],
    "data": b"\x01\xff",
    "octets": b"\x02\x03",
    "octet": 4,
    "flag": True,
    "number": 1.5,
    "short": "abc",
    "count": 200,
}


@pytest.fixture(autouse=True)
def packages(monkeypatch):
    """The interfaces above instead of those of ROS."""
    known = {"builtin_interfaces/Time": Stamp, "std_msgs/Header": Header}
    monkeypatch.setattr(ros2_node, "interface", lambda kind, family: known[kind])


def test_there_and_back():
    message = to_message(Everything, FULL, "/topic")
    assert message.header.stamp.sec == 5
    assert message.values == array("d", [1.0, 2.5])
    assert message.data == array("B", b"\x01\xff")
    assert message.octets == [b"\x02", b"\x03"]
    message.fixed = np.array(message.fixed)  # ROS makes it an array
    assert to_dict(message) == FULL


def test_what_is_not_given_is_as_ros_makes_it():
    assert to_dict(to_message(Everything, {"number": 2}, "/topic"))["number"] == 2.0
    assert to_dict(to_message(Header, {}, "/topic")) == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"nope": 1}, "/t has no field 'nope'; it has header, values, few, "),
        ({"number": math.nan}, "/t.number must be a finite double, not nan."),
        ({"number": math.inf}, "/t.number must be a finite double, not inf."),
        ({"number": "1"}, "/t.number must be a finite double, not '1'."),
        ({"number": True}, "/t.number must be a finite double, not True."),
        ({"number": None}, "/t.number must be a finite double, not None."),
        ({"values": [0.0, math.nan]}, "/t.values[1] must be a finite double, not nan."),
        ({"values": "12"}, "/t.values must be sequence<double>, not '12'."),
        ({"values": 1.0}, "/t.values must be sequence<double>, not 1.0."),
        ({"names": ["a", 1]}, "/t.names[1] must be a string, not 1."),
        ({"flag": 1}, "/t.flag must be a boolean, not 1."),
        ({"count": 256}, "/t.count must be a uint8, not 256."),
        ({"count": -1}, "/t.count must be a uint8, not -1."),
        ({"count": 1.5}, "/t.count must be a uint8, not 1.5."),
        ({"octet": 300}, "/t.octet must be a octet, not 300."),
        ({"header": 3}, "/t.header must be an object with the fields of std_msgs/Header, not 3."),
        ({"header": {"stamp": {"sec": 2**31}}}, "/t.header.stamp.sec must be a int32, not 2147483648."),
        ({"stamps": [{"sec": "x"}]}, "/t.stamps[0].sec must be a int32, not 'x'."),
    ],
)
def test_what_does_not_fit_is_refused_by_name(fields, text):
    with raising(InvalidValue, text, begins=True):
        to_message(Everything, fields, "/t")


def test_a_type_is_looked_up_by_any_of_its_names(monkeypatch):
    modules = {"json.decoder": SimpleNamespace(JSONDecoder="it")}
    monkeypatch.setattr(ros2_node.importlib, "import_module", lambda name: modules[name])
    for kind in ("json/JSONDecoder", "json/msg/JSONDecoder"):
        assert interface(kind, "decoder") == "it"


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("String", "A ROS type is called pkg/Type, not 'String'."),
        ("no_msgs/String", "no_msgs/String is in no package of this Python; source a ROS 2 workspace that has it."),
    ],
)
def test_a_type_that_is_not_there(kind, text):
    with raising(InvalidValue, text):
        interface(kind, "msg")


def test_rclpy_is_not_there(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with raising(
        InvalidValue,
        "A ROS 2 node needs rclpy, which this Python does not have. Source a ROS 2 installation, such as "
        "/opt/ros/jazzy/setup.bash, or run: pip install 'ros-jazzy-rclpy[fastrtps]' ",
        begins=True,
    ):
        RclpyBus().start()
