"""`RosbridgeLink` on a server that behaves."""

import re
import threading
import time

import pytest

from bam_envs.core.errors import InvalidValue, LinkLost, ProtocolError, RemoteError

STRING = "std_msgs/String"


def _published(server, topic):
    return [frame["msg"] for frame in server.of("publish") if frame["topic"] == topic]


def test_connect_is_done_when_a_request_is_answered(scripted, new_link):
    link = new_link(scripted, connect=False)
    assert (link.is_up, link.epoch, scripted.headers) == (False, 0, [])
    link.connect()
    assert (link.is_up, link.epoch) == (True, 1)
    assert {frame["service"] for frame in scripted.of("call_service")} == {"/rosapi/get_time"}


def test_a_refused_request_is_an_answer_too(scripted, new_link):
    del scripted.responses["/rosapi/get_time"]
    link = new_link(scripted)
    assert (link.is_up, link.ros, link.clock_offset) == (True, None, None)


def test_the_path_of_the_url_is_the_namespace_and_is_not_sent(scripted, new_link):
    link = new_link(f"{scripted.url}/lab/bam_001/")
    assert (link.url, link.namespace, scripted.headers) == (scripted.url, "/lab/bam_001", [("/", None)])


@pytest.mark.parametrize(
    ("spelling", "ros", "stamp"),
    [
        ({"secs": 900, "nsecs": 250_000_000}, "ros1", {"secs": 12, "nsecs": 250_000_000}),
        ({"sec": 900, "nanosec": 250_000_000}, "ros2", {"sec": 12, "nanosec": 250_000_000}),
    ],
)
def test_the_servers_clock_tells_which_ros_it_is_and_how_late(scripted, new_link, spelling, ros, stamp):
    scripted.responses["/rosapi/get_time"] = lambda args: {"time": spelling}
    link = new_link(scripted)
    assert (link.ros, link.stamp(12.25)) == (ros, stamp)
    assert link.clock_offset == pytest.approx(time.time() - 900.25, abs=10.0)


def test_without_a_clock_service_the_first_stamp_tells_which_ros_it_is(scripted, new_link, heard):
    scripted.responses["/rosapi/get_time"] = lambda args: "no"
    link = new_link(scripted)
    assert link.stamp(1.0) == {"sec": 1, "nanosec": 0}
    link.subscribe("/pose", "geometry_msgs/PoseStamped", heard)
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/pose", "msg": {"header": {"stamp": {"secs": 3, "nsecs": 4}}}})
    heard.wait()
    assert link.stamp(1.0) == {"secs": 1, "nsecs": 0}


def test_a_message_goes_out_as_it_is(scripted, link):
    link.advertise("/ping", "std_msgs/msg/String", latch=True)
    link.publish("/ping", {"data": "hello", "raw": b"\x00\xff"})
    advertised = {"op": "advertise", "id": "advertise:/ping", "topic": "/ping", "type": STRING, "latch": True}
    assert scripted.wait_for("publish") == [
        {"op": "publish", "topic": "/ping", "msg": {"data": "hello", "raw": "AP8="}}
    ]
    assert scripted.of("advertise") == [advertised]


def test_a_topic_must_be_advertised_and_keeps_its_type(link, heard):
    with pytest.raises(InvalidValue) as raised:
        link.publish("/ping", {})
    text = "Topic '/ping' was not advertised: call advertise(topic, type) before publish."
    assert str(raised.value) == text
    link.advertise("/ping", STRING)
    link.publish("/ping", {})
    link.subscribe("/pong", STRING, heard)
    for topic, use in (("/ping", link.advertise), ("/pong", lambda *kind: link.subscribe(*kind, heard))):
        with pytest.raises(InvalidValue) as raised:
            use(topic, "std_msgs/Int32")
        text = f"Topic '{topic}' is of type std_msgs/String here already; found 'std_msgs/Int32'."
        assert str(raised.value) == text


@pytest.mark.parametrize("value", [float("nan"), float("inf"), object(), {1, 2}])
def test_what_is_not_finite_and_plain_is_not_sent(scripted, link, value):
    link.advertise("/ping", "std_msgs/Float64MultiArray")
    with pytest.raises(InvalidValue, match=r"^message\.msg\.data\[1\]: expected "):
        link.publish("/ping", {"data": [1.0, value]})
    link.publish("/ping", {"data": [2.0]})
    scripted.wait_for("publish")
    assert _published(scripted, "/ping") == [{"data": [2.0]}]


def test_messages_are_sent_in_their_order_from_every_thread(scripted, link):
    link.advertise("/ping", "std_msgs/Int32")

    def publish(start):
        for number in range(start, start + 100):
            link.publish("/ping", {"data": number})

    threads = [threading.Thread(target=publish, args=(start,)) for start in (0, 1000, 2000)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    scripted.wait_for("publish", 300)
    sent = [message["data"] for message in _published(scripted, "/ping")]
    for start in (0, 1000, 2000):
        assert [number for number in sent if start <= number < start + 1000] == list(range(start, start + 100))


@pytest.mark.parametrize("more", [{}, {"compression": "cbor"}])
def test_a_subscription_asks_for_what_was_wanted(scripted, link, heard, more):
    link.subscribe("/pong", "std_msgs/msg/String", heard, throttle_ms=20, queue_length=1, **more)
    asked = {"op": "subscribe", "id": "subscribe:/pong", "topic": "/pong", "type": STRING}
    assert scripted.wait_for("subscribe") == [{**asked, "throttle_rate": 20, "queue_length": 1, **more}]


@pytest.mark.parametrize("value", [33.3, "300", -1, True])
def test_a_throttle_that_a_server_would_drop_in_silence_is_refused(link, heard, value):
    with pytest.raises(InvalidValue) as raised:
        link.subscribe("/pong", STRING, heard, throttle_ms=value)
    assert str(raised.value) == f"throttle_ms is {value!r}: expected a whole number, 0 or more."


def test_one_listener_leaves_and_the_others_stay(scripted, link, new_heard):
    first, second = new_heard(), new_heard()
    leave = link.subscribe("/pong", STRING, first)
    leave_too = link.subscribe("/pong", STRING, second)
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "1"}})
    first.wait(), second.wait()
    leave()
    leave()
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "2"}})
    assert second.wait(2) == [{"data": "1"}, {"data": "2"}]
    assert first.messages == [{"data": "1"}]
    assert (len(scripted.of("subscribe")), scripted.of("unsubscribe")) == (1, [])
    leave_too()
    assert scripted.wait_for("unsubscribe") == [{"op": "unsubscribe", "id": "subscribe:/pong", "topic": "/pong"}]


def test_the_fastest_listener_decides_the_throttle(scripted, link, heard):
    link.subscribe("/pong", STRING, heard, throttle_ms=100)
    link.subscribe("/pong", STRING, heard, throttle_ms=10)
    assert [frame["throttle_rate"] for frame in scripted.wait_for("subscribe", 2)] == [100, 10]


def test_a_listener_that_fails_silences_no_other(scripted, link, heard, caplog):
    def fail(message, caller):
        raise KeyError("bad listener")

    link.subscribe("/pong", STRING, fail)
    link.subscribe("/pong", STRING, heard)
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "1"}})
    assert heard.wait() == [{"data": "1"}]
    assert [record.getMessage() for record in caplog.records] == ["/pong: a listener failed"]


def test_a_listener_may_publish(scripted, link):
    link.advertise("/ping", STRING)
    link.subscribe("/pong", STRING, lambda message, caller: link.publish("/ping", message))
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "1"}})
    assert scripted.wait_for("publish") == [{"op": "publish", "topic": "/ping", "msg": {"data": "1"}}]


def test_a_call_gets_the_response(scripted, link):
    scripted.responses["/add"] = lambda args: {"sum": args["a"] + args["b"]}
    assert link.call("/add", "example_interfaces/srv/AddTwoInts", {"a": 1, "b": 2}, 5.0) == {"sum": 3}
    asked = scripted.of("call_service")[-1]
    assert (asked["type"], asked["timeout"]) == ("example_interfaces/AddTwoInts", 5.0)
    with pytest.raises(RemoteError, match=r"^Service /nope does not exist$"):
        link.call("/nope", "std_srvs/Trigger", {}, 5.0)
    scripted.responses["/add"] = lambda args: [1, 2]
    with pytest.raises(ProtocolError, match=r"^/add: expected a response with fields, found \[1, 2\]\.$"):
        link.call("/add", "a/B", {}, 5.0)


def test_an_error_status_with_the_id_of_a_call_ends_it(scripted, link):
    def refuse(args):
        scripted.send_soon({"op": "status", "level": "error", "msg": "type is required", "id": "call:1"})

    scripted.responses["/add"] = refuse
    with pytest.raises(RemoteError, match=r"^type is required$"):
        link.call("/add", "a/B", {}, 5.0)


def test_a_server_that_gives_a_call_up_is_no_refusal(scripted, link):
    """The service may still be at it; a bridge that was told no other time does so after 5 s."""
    scripted.responses["/slow"] = lambda args: "Timeout exceeded while waiting for service response"
    with pytest.raises(LinkLost) as caught:
        link.call("/slow", "std_srvs/Trigger", {}, 30.0)
    assert re.sub(r"after \d\.\d s", "after 0.0 s", str(caught.value)) == (
        f"{scripted.url}: the server gave up /slow after 0.0 s, and 30 s were asked for; it may still be at it. Start "
        "the bridge with default_call_service_timeout:=30.0, or use a pair of topics instead of the service "
        '(channel="topics").'
    )
    assert scripted.of("call_service")[-1]["timeout"] == 30.0


@pytest.mark.parametrize("timeout", [None, 0.0, -1.0, float("inf"), float("nan")])
def test_a_call_needs_a_time_limit(link, timeout):
    with pytest.raises(InvalidValue) as raised:
        link.call("/slow", "std_srvs/Trigger", {}, timeout)
    assert str(raised.value) == f"/slow: timeout is {timeout!r}: expected a time above 0 s, for a call can be lost."


def test_calls_from_many_threads_each_get_their_own_answer(scripted, link):
    scripted.responses["/echo"] = lambda args: args
    found = []

    def call(number):
        found.extend(
            link.call("/echo", "a/B", {"number": number + step}, 5.0)["number"] == number + step for step in range(30)
        )

    threads = [threading.Thread(target=call, args=(1000 * number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [True] * 240


def test_a_listener_may_not_wait_for_the_network(scripted, link, heard):
    def refusal(blocking):
        with pytest.raises(InvalidValue) as raised:
            blocking()
        return str(raised.value)

    def wait(message, caller):
        for blocking in (lambda: link.call("/add", "a/B", {}, 1.0), link.connect, lambda: link.wait_up(1.0)):
            heard(refusal(blocking))

    link.subscribe("/pong", STRING, wait)
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/pong", "msg": {}})
    assert heard.wait(3) == [
        f"{method}() waits for the network, and a listener called it on the network thread. "
        "Hand the work to another thread."
        for method in ("call", "connect", "wait_up")
    ]
