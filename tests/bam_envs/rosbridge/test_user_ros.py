"""A link over a `roslibpy.Ros` of other code: a message is sent now or not at all there too."""

import threading

import pytest
import roslibpy

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer, RemoteError
from bam_envs.rosbridge.user_ros import UserRosLink, endpoint_of

STRING = "std_msgs/String"


@pytest.fixture
def ros(scripted):
    """A connected `roslibpy.Ros`, as other code makes it."""
    ros = roslibpy.Ros(scripted.url, headers={"Authorization": "Bearer secret"}, transport="asyncio")
    ros.run(10.0)
    yield ros
    ros.close()


@pytest.fixture
def link(ros):
    link = UserRosLink(ros)
    link.connect()
    yield link
    link.close()


@pytest.fixture
def lost(link):
    """The reasons of its losses, and an event."""
    down = threading.Event()
    down.reasons = []
    link.on_down(lambda error: (down.reasons.append(str(error)), down.set()))
    return down


def test_what_it_is_found_out_at_connect(scripted, ros, link):
    assert (link.is_up, link.epoch, link.ros, link.url) == (True, 1, "ros2", scripted.url)
    assert (endpoint_of(ros).token, endpoint_of(ros).url) == ("secret", scripted.url)


def test_topics_and_services(scripted, link, new_heard):
    first, second = new_heard(), new_heard()
    leave = link.subscribe("/pong", STRING, first, compression="cbor", throttle_ms=5)
    link.subscribe("/pong", STRING, second)
    asked = {"op": "subscribe", "id": "subscribe:/pong", "topic": "/pong", "type": STRING, "queue_length": 0}
    assert scripted.wait_for("subscribe", 2) == [{**asked, "throttle_rate": rate} for rate in (5, 0)]
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "1"}})
    assert (first.wait(), second.wait()) == ([{"data": "1"}], [{"data": "1"}])
    leave()
    link.advertise("/cmd", STRING)
    link.publish_all([("/cmd", {"data": "1"}), ("/cmd", {"data": "2"})])
    link.publish_soon("/cmd", {"data": "3"})
    assert [frame["msg"]["data"] for frame in scripted.wait_for("publish", 3)] == ["1", "2", "3"]
    with pytest.raises(InvalidValue, match="expected a finite number, found nan"):
        link.publish("/cmd", {"data": float("nan")})
    scripted.responses["/add"] = lambda args: {"sum": args["a"] + 1}
    assert link.call("/add", "a/B", {"a": 2}, 5.0) == {"sum": 3}
    with pytest.raises(RemoteError, match=r"^Service /nope does not exist$"):
        link.call("/nope", "a/B", {}, 5.0)
    scripted.responses["/silent"] = lambda args: None
    with pytest.raises(LinkLost, match=r"/silent did not answer in 0\.5 s; it may still be at it\.$"):
        link.call("/silent", "a/B", {}, 0.5)


def test_a_service_is_served(scripted, link):
    link.serve("/act", "std_srvs/Trigger", lambda request, caller: {"message": str(request["data"])})
    scripted.wait_for("advertise_service")
    scripted.send({"op": "call_service", "id": "7", "service": "/act", "args": {"data": 1}})
    answer = {"op": "service_response", "service": "/act", "id": "7", "values": {"message": "1"}, "result": True}
    assert scripted.wait_for("service_response") == [answer]


def test_nothing_is_kept_for_the_next_connection(scripted, ros, link, lost, heard):
    link.advertise("/cmd", STRING)
    link.subscribe("/pong", STRING, heard)
    scripted.responses["/step"] = lambda args: scripted.loop.call_soon(scripted.stopped.set) and None
    with pytest.raises(LinkLost) as raised:
        link.call("/step", "a/B", {}, 60.0)
    dropped = f"{scripted.url}: the link dropped: the connection of the roslibpy.Ros was closed."
    assert (str(raised.value), lost.reasons) == (dropped, [dropped])
    for number in range(5):
        with pytest.raises(LinkLost, match=r"Nothing was sent, and nothing is kept\.$"):
            link.publish("/cmd", {"data": f"stale {number}"})
    link.publish_soon("/cmd", {"data": "stale"})
    scripted.stop()
    scripted.frames.clear()
    scripted.start()
    link.wait_up(10.0)
    link.publish("/cmd", {"data": "new"})
    assert [frame["msg"] for frame in scripted.wait_for("publish")] == [{"data": "new"}]
    assert (link.epoch, [len(scripted.of(op)) for op in ("advertise", "subscribe")]) == (2, [1, 1])
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "1"}})
    assert heard.wait() == [{"data": "1"}]


def test_a_held_up_network_thread_sends_nothing_late(scripted, ros, link):
    link.advertise("/cmd", STRING)
    entered, leave = threading.Event(), threading.Event()
    roslibpy.Topic(ros, "/slow", STRING).subscribe(lambda message: (entered.set(), leave.wait(10.0)))
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/slow", "msg": {}})
    assert entered.wait(10.0)
    with pytest.raises(LinkLost, match=r"for 0\.5 s; nothing was sent\. A listener must return at once: do work in "):
        link.publish("/cmd", {"data": "late"})
    leave.set()
    link.publish("/cmd", {"data": "now"})
    assert [frame["msg"] for frame in scripted.wait_for("publish")] == [{"data": "now"}]


def test_close_leaves_the_users_connection(scripted, ros, heard):
    link = UserRosLink(ros)
    with pytest.raises(LinkLost, match=r"not connected yet: call connect\(\)"):
        link.publish("/cmd", {})
    link.connect()
    link.connect()
    link.advertise("/cmd", STRING)
    link.subscribe("/pong", STRING, heard)
    link.close()
    link.close()
    assert [frame["topic"] for frame in scripted.wait_for("unsubscribe")] == ["/pong"]
    assert [frame["topic"] for frame in scripted.wait_for("unadvertise")] == ["/cmd"]
    assert (link.is_up, ros.is_connected, scripted.connected) == (False, True, 1)
    with pytest.raises(LinkLost, match="it was closed; make a new one"):
        link.publish("/cmd", {})


def test_a_ros_that_cannot_be_used(scripted, ros, until, python):
    ros.close()
    until(lambda: not ros.is_connected)
    with pytest.raises(NoServer) as raised:
        UserRosLink(ros).connect()
    assert str(raised.value) == f"{scripted.url}: the roslibpy.Ros is not connected: call its run() before."
    with pytest.raises(InvalidValue) as raised:
        UserRosLink(5)
    assert str(raised.value) == "A live robot is an address, ws://host:port, or a roslibpy.Ros; found 5."
    code = """
import os, gymnasium as gym, roslibpy, bam_envs
ros = roslibpy.Ros(os.environ["BAM_TEST_URL"], transport="twisted")
try:
    gym.make("bam/pick-v0", robot=ros)
except ValueError as error:
    print(error)
"""
    assert python(code, BAM_TEST_URL=scripted.url).splitlines()[-1] == (
        "This process uses roslibpy's Twisted transport, and a live robot needs its asyncio transport: make each "
        'roslibpy.Ros with transport="asyncio", or call roslibpy.set_default_transport("asyncio") first.'
    )
