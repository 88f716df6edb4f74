"""Against a real ROS 2 graph, on loopback and in a domain of its own; skipped where rclpy is not installed."""

import math
import threading

import pytest

from bam_envs.core.errors import InvalidValue, LinkLost, RemoteError
from bam_envs.remote.wire.ros2_node import RclpyBus
from bam_envs.rosbridge.bus import UNKNOWN_CALLER

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of what ROS imports


@pytest.fixture
def node(ros_domain):
    """Start a node."""
    nodes = []

    def start(name):
        nodes.append(RclpyBus(name, domain=ros_domain))
        nodes[-1].start()
        return nodes[-1]

    yield start
    for one in nodes:
        one.close()
        one.close()


class Box:
    """A listener that keeps what it hears."""

    def __init__(self):
        self.heard, self._news = [], threading.Condition()

    def __call__(self, message, caller):
        with self._news:
            self.heard.append((message, caller))
            self._news.notify_all()

    def wait(self, number=1, timeout=10.0):
        with self._news:
            assert self._news.wait_for(lambda: len(self.heard) >= number, timeout)
        return self.heard


def test_a_message_arrives_as_it_was_sent(node, until):
    speaker, hearer, box = node("speaker"), node("hearer"), Box()
    hearer.subscribe("/test/joints", "sensor_msgs/msg/JointState", box)
    speaker.advertise("/test/joints", "sensor_msgs/JointState")
    until(lambda: speaker.is_heard("/test/joints"))
    header = {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "tag"}
    speaker.publish("/test/joints", {"header": header, "name": ["a"], "position": [0.5]})
    expected = {"header": header, "name": ["a"], "position": [0.5], "velocity": [], "effort": []}
    assert box.wait() == [(expected, UNKNOWN_CALLER)]


def test_a_latched_message_waits_for_newcomers(node):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    speaker, hearer = node("speaker"), node("hearer")
    speaker.advertise("/test/latched", "std_msgs/String", latch=True)
    speaker.publish("/test/latched", {"data": "it"})
    box, quality = Box(), QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    hearer._node.create_subscription(String, "/test/latched", lambda message: box(message.data, None), quality)
    assert box.wait() == [("it", None)]


def test_who_unsubscribes_silences_nobody_else(node, until):
    speaker, hearer, one, other = node("speaker"), node("hearer"), Box(), Box()
    stop = hearer.subscribe("/test/topic", "std_msgs/String", one)
    hearer.subscribe("/test/topic", "std_msgs/String", other)
    speaker.advertise("/test/topic", "std_msgs/String")
    until(lambda: speaker.is_heard("/test/topic"))
    stop()
    speaker.publish("/test/topic", {"data": "it"})
    other.wait()
    assert one.heard == []


def test_what_does_not_fit_is_not_sent(node):
    speaker = node("speaker")
    speaker.advertise("/test/joints", "sensor_msgs/JointState")
    with pytest.raises(InvalidValue, match=r"/test/joints\.position\[0\] must be a finite double, not nan\."):
        speaker.publish("/test/joints", {"position": [math.nan]})
    with pytest.raises(LinkLost, match=r"/test/other is not advertised by the node speaker\."):
        speaker.publish("/test/other", {})


def test_a_listener_that_refuses_is_logged_once(node, caplog, until):
    speaker, hearer = node("speaker"), node("hearer")

    def refuse(message, caller):
        raise RemoteError("not now")

    box = Box()
    hearer.subscribe("/test/topic", "std_msgs/String", refuse)
    hearer.subscribe("/test/topic", "std_msgs/String", box)
    speaker.advertise("/test/topic", "std_msgs/String")
    until(lambda: speaker.is_heard("/test/topic"))
    speaker.publish("/test/topic", {"data": "it"})
    box.wait()
    speaker.publish("/test/topic", {"data": "it"})
    box.wait(2)
    assert caplog.messages == ["/test/topic: not now"]


def test_a_listener_that_fails_ends_no_topic(node, caplog, until):
    speaker, hearer, box = node("speaker"), node("hearer"), Box()

    def fail(message, caller):
        box(message, caller)
        raise ZeroDivisionError

    hearer.subscribe("/test/topic", "std_msgs/String", fail)
    speaker.advertise("/test/topic", "std_msgs/String")
    until(lambda: speaker.is_heard("/test/topic"))
    for number in (1, 2):
        speaker.publish("/test/topic", {"data": "it"})
        box.wait(number)
    assert any(text.endswith(": a listener failed") for text in caplog.messages)


def test_a_service_answers_and_topics_do_not_wait_for_it(node, until):
    server, client, box, go = node("server"), node("client"), Box(), threading.Event()

    def handle(request, caller):
        assert go.wait(10)
        return {"success": request["data"], "message": "done"}

    server.serve("/test/switch", "std_srvs/SetBool", handle)
    server.subscribe("/test/stop", "std_msgs/Empty", lambda message, caller: (box(message, caller), go.set()))
    client.advertise("/test/stop", "std_msgs/Empty")
    until(lambda: client.is_heard("/test/stop") and client.is_offered("/test/switch"))
    answers = []
    call = threading.Thread(
        target=lambda: answers.append(client.call("/test/switch", "std_srvs/SetBool", {"data": True}, 10.0))
    )
    call.start()
    client.publish("/test/stop", {})
    call.join(10)
    assert answers == [{"success": True, "message": "done"}]


def test_closing_ends_a_call_at_once(node, until):
    server, client, asked, go, lost = node("server"), node("client"), threading.Event(), threading.Event(), []

    def handle(request, caller):
        asked.set()
        assert go.wait(10)
        return {}

    def call():
        try:
            client.call("/test/slow", "std_srvs/Trigger", {}, 60.0)
        except LinkLost as error:
            lost.append(str(error))

    server.serve("/test/slow", "std_srvs/Trigger", handle)
    until(lambda: client.is_offered("/test/slow"))
    caller = threading.Thread(target=call)
    caller.start()
    assert asked.wait(10)
    client.close()
    caller.join(10)
    go.set()
    assert lost == ["/test/slow did not answer before this node was closed; whether it did what was asked is unknown."]


def test_a_service_that_fails_answers_too(node, caplog, until):
    server, client = node("server"), node("client")

    def fail(request, caller):
        raise RemoteError("it cannot")

    server.serve("/test/fails", "std_srvs/Trigger", fail)
    server.serve("/test/breaks", "std_srvs/Trigger", lambda request, caller: {"success": "yes"})
    until(lambda: client.is_offered("/test/fails") and client.is_offered("/test/breaks"))
    failed = client.call("/test/fails", "std_srvs/Trigger", {}, 10.0)
    assert failed == {"success": False, "message": "it cannot"}
    assert client.call("/test/breaks", "std_srvs/Trigger", {}, 10.0) == {
        "success": False,
        "message": "/test/breaks.success must be a boolean, not 'yes'.",
    }


def test_a_service_of_an_unknown_type_is_not_offered(node):
    server = node("server")
    server.serve("/test/unknown", "no_msgs/Nothing", lambda request, caller: {})
    assert server.refused == {
        "/test/unknown": "no_msgs/Nothing is in no package of this Python; source a ROS 2 workspace that has it."
    }


def test_a_service_that_is_not_there(node):
    client = node("client")
    with pytest.raises(
        LinkLost, match=r"/test/nobody did not answer in 0.1 s; whether it did what was asked is unknown"
    ):
        client.call("/test/nobody", "std_srvs/Trigger", {}, 0.1)


def test_it_ends_with_all_its_threads_and_may_begin_again(ros_domain):
    before = set(threading.enumerate())
    bus = RclpyBus("again", domain=ros_domain)
    bus.close()
    for _ in range(2):
        bus.start()
        bus.serve("/test/again", "std_srvs/Trigger", lambda request, caller: {"success": True})
        assert bus.call("/test/again", "std_srvs/Trigger", {}, 10.0)["success"] is True
        bus.close()
        with pytest.raises(LinkLost, match=r"The ROS 2 node again is not running\."):
            bus.subscribe("/test/topic", "std_msgs/String", Box())
    assert set(threading.enumerate()) == before
