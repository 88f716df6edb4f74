"""`RosbridgeLink` on the embedded server: both ends are ours."""

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, RemoteError
from bam_envs.rosbridge.server import BridgeServer

STRING = "std_msgs/String"


@pytest.fixture
def server():
    with BridgeServer(port=0) as running:
        yield running


def test_a_service_of_one_link_is_called_by_another(server, new_link):
    provider, caller = new_link(server), new_link(server)
    assert (caller.is_up, caller.ros, abs(caller.clock_offset) < 0.5) == (True, "ros2", True)
    provider.serve("/act", "std_srvs/Trigger", lambda request, caller: {"success": True, "message": "from the link"})
    provider.call("/rosapi/get_time", "rosapi/GetTime", {}, 5.0)
    assert caller.call("/act", "std_srvs/Trigger", {}, 5.0) == {"success": True, "message": "from the link"}
    provider.close()
    with pytest.raises(RemoteError):
        caller.call("/act", "std_srvs/Trigger", {}, 5.0)


@pytest.mark.parametrize(
    ("kind", "message", "name"),
    [
        ("sensor_msgs/LaserScan", {"ranges": [1.0, 2.5]}, "ranges"),
        ("sensor_msgs/Image", {"data": bytes(range(256)), "width": 16, "height": 16}, "data"),
    ],
)
def test_arrays_come_in_cbor(server, new_link, heard, kind, message, name):
    server.advertise("/large", kind, latch=True)
    server.publish("/large", message)
    new_link(server).subscribe("/large", kind, heard, compression="cbor")
    found = heard.wait()[0][name]
    assert (found.tolist() if isinstance(found, np.ndarray) else found) == message[name]


def test_several_messages_with_one_hand_over(server, new_link, heard):
    for topic in ("/a", "/b"):
        server.subscribe(topic, STRING, heard)
    link = new_link(server)
    for topic in ("/a", "/b"):
        link.advertise(topic, STRING)
    for bad, text in (({"data": float("nan")}, "nan"), (("/c", {}), "advertise")):
        second = bad if isinstance(bad, tuple) else ("/b", bad)
        with pytest.raises(InvalidValue, match=text):
            link.publish_all([("/a", {"data": "nothing of it"}), second])
    link.publish_all([("/a", {"data": "1"}), ("/b", {"data": "2"}), ("/a", {"data": "3"})])
    assert heard.wait(3) == [{"data": "1"}, {"data": "2"}, {"data": "3"}]


def test_a_listener_answers_before_what_comes_next(server, new_link, heard):
    server.advertise("/pong", STRING)

    def answer(message, caller):
        server.publish_all([("/pong", message), ("/pong", {"data": "and"})])

    server.subscribe("/ping", STRING, answer)
    link = new_link(server)
    link.subscribe("/pong", STRING, heard)
    link.advertise("/ping", STRING)
    link.publish_all([("/ping", {"data": "1"}), ("/ping", {"data": "2"})])
    assert [message["data"] for message in heard.wait(4)] == ["1", "and", "2", "and"]
