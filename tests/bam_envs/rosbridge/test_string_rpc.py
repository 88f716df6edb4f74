"""Requests over a pair of topics, on a bus inside this process."""

import json
import threading

import pytest

from bam_envs.core.errors import InvalidValue, LinkLost, NotInCommand, ProtocolError, RemoteError, SafetyStop
from bam_envs.ros.freshness import Tag
from bam_envs.rosbridge.bus import UNKNOWN_CALLER
from bam_envs.rosbridge.string_rpc import StringRpc, StringRpcService


class LocalBus:
    """Topics inside this process; `lose` topics lose that many messages, as a ROS graph's first ones are."""

    def __init__(self, lose=()):
        self.listeners, self.sent, self.lose, self.down, self.epoch = {}, [], list(lose), [], 1
        self.is_up = True

    def advertise(self, topic, kind, *, latch=False):
        assert kind == "std_msgs/String"

    def publish(self, topic, message):
        if not self.is_up:
            raise LinkLost("the link is down")
        self.sent.append((topic, message["data"]))
        if topic in self.lose:
            self.lose.remove(topic)
            return
        for listener in list(self.listeners.get(topic, ())):
            listener(message, UNKNOWN_CALLER)

    def subscribe(self, topic, kind, listener):
        self.listeners.setdefault(topic, []).append(listener)
        return lambda: self.listeners[topic].remove(listener)

    def on_down(self, callback):
        self.down.append(callback)

    def cut(self):
        for callback in self.down:
            callback("cut")


@pytest.fixture
def pair(stack):
    """A client, its bus and what the handler was asked, for a handler."""

    def make(handler, lose=()):
        asked, bus = [], LocalBus(lose)

        def record(payload, caller):
            asked.append(payload)
            return handler(payload)

        service, rpc = StringRpcService(bus, "/bam/scene", record).start(), StringRpc(bus, "/bam/scene")
        stack.callback(service.close)
        stack.callback(rpc.close)
        return rpc, bus, asked

    return make


@pytest.fixture
def replies():
    """The replies to raw requests: ``ask(bus, request)`` gives the next one."""

    def ask(bus, request):
        got, there = [], threading.Event()

        def listen(message, caller):
            got.append(json.loads(message["data"]))
            there.set()

        stop = bus.subscribe("/bam/scene/reply", "std_msgs/String", listen)
        bus.publish("/bam/scene/request", {"data": json.dumps(request)})
        assert there.wait(5)
        stop()
        return got[0]

    return ask


def tagged(sequence, epoch=1, lifetime=5.0, sent=1000.0):
    tag = Tag("abc", epoch, sequence, sent, sent + lifetime)
    return {"id": f"abc-{sequence}", "tag": tag.to_text(), "payload": {"n": sequence}}


def test_a_request_and_its_reply(pair):
    rpc, _, asked = pair(lambda payload: {"twice": payload["n"] * 2})
    assert rpc.call({"n": 21}, 5) == {"twice": 42}
    assert rpc.call({"n": 0.1}, 5) == {"twice": 0.2}
    assert asked == [{"n": 21}, {"n": 0.1}]


def test_lost_first_messages_are_said_again_and_executed_once(pair):
    rpc, _, asked = pair(lambda payload: {"n": payload["n"]}, lose=["/bam/scene/request", "/bam/scene/reply"])
    assert rpc.call({"n": 1}, 10) == {"n": 1}
    assert asked == [{"n": 1}]


def fail(payload):
    raise payload["error"]("no cube there")


@pytest.mark.parametrize(
    ("handler", "kind", "text"),
    [
        (lambda payload: fail({"error": RemoteError}), RemoteError, "no cube there"),
        (lambda payload: fail({"error": NotInCommand}), NotInCommand, "no cube there"),
        (lambda payload: 1 / 0, RemoteError, "/bam/scene failed: ZeroDivisionError: division by zero"),
        (
            lambda payload: {"x": float("nan")},
            RemoteError,
            "The reply of /bam/scene.payload.x: expected a finite number, found nan.",
        ),
    ],
)
def test_an_error_over_there_is_one_here(pair, caplog, handler, kind, text):
    rpc, _, _ = pair(handler)
    with pytest.raises(kind) as caught:
        rpc.call({}, 5)
    assert (type(caught.value), str(caught.value)) == (kind, text)


def test_a_stop_of_a_guard_over_there_is_a_stop_here(pair):
    text = "The robot was stopped by following (G23): elbow. When it is safe, resume the agent."
    stop = SafetyStop("following", text)

    def stopped(payload):
        raise stop

    rpc, _, _ = pair(stopped)
    with pytest.raises(SafetyStop) as caught:
        rpc.call({}, 5)
    assert (caught.value.guard, str(caught.value)) == ("following", text)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1, 2}])
def test_only_plain_finite_values_are_sent(pair, value):
    rpc, bus, _ = pair(lambda payload: {})
    with pytest.raises(InvalidValue, match=r"A request to /bam/scene\.payload\.x: expected a (plain|finite) "):
        rpc.call({"x": value}, 5)
    assert bus.sent == []


def test_nobody_answers(pair):
    rpc, bus, asked = pair(lambda payload: {}, lose=["/bam/scene/request"] * 9)
    text = r"^/bam/scene did not answer in 0.05 s; whether it did what was asked is unknown\.$"
    with pytest.raises(LinkLost, match=text):
        rpc.call({}, 0.05)
    bus.is_up = False
    with pytest.raises(LinkLost, match="the link is down"):
        rpc.call({}, 60)
    assert asked == []


def test_a_call_under_way_fails_when_the_link_drops(pair):
    begun, go_on = threading.Event(), threading.Event()

    def wait(payload):
        begun.set()
        go_on.wait(10)
        return {}

    rpc, bus, _ = pair(wait)
    threading.Thread(target=lambda: (begun.wait(10), bus.cut())).start()
    with pytest.raises(LinkLost, match="the link dropped while /bam/scene was to answer"):
        rpc.call({}, 60)
    go_on.set()


def test_old_requests_are_refused(pair, replies):
    _, bus, asked = pair(lambda payload: {"done": payload["n"]})
    for _ in range(2):  # what comes twice is executed once
        assert replies(bus, tagged(5)) == {"id": "abc-5", "payload": {"done": 5}}
    assert replies(bus, tagged(4))["error"] == "old message: number 4 after number 5"
    assert replies(bus, tagged(6, epoch=2)) == {"id": "abc-6", "payload": {"done": 6}}
    assert replies(bus, tagged(7, epoch=1))["error"] == "old connection: epoch 1, and epoch 2 is there"
    assert asked == [{"n": 5}, {"n": 6}]


def test_a_request_of_somebody_elses_client_has_no_tag(pair, replies):
    _, bus, _ = pair(lambda payload: {"done": payload["n"]})
    assert replies(bus, {"id": "x", "payload": {"n": 1}}) == {"id": "x", "payload": {"done": 1}}
    wrong = replies(bus, {"id": "y", "payload": [1]})
    assert wrong["error"] == "/bam/scene/request: payload must be an object, not list."


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ("{}", ": id must be a string, not NoneType."),
        ("[" + "{}," * 500_000 + "{}]", " must be a JSON object: expected at most 100000 values, found more."),
        (
            "[" * 1000 + "]" * 1000,
            " must be a JSON object: expected at most 32 lists and objects in one another, found",
        ),
    ],
)
def test_a_request_that_is_refused_at_the_topic(pair, data, text):
    _, bus, _ = pair(lambda payload: {})
    with pytest.raises(ProtocolError) as caught:
        bus.publish("/bam/scene/request", {"data": data})
    assert str(caught.value).startswith(f"/bam/scene/request{text}")


def test_closing_is_possible_twice(pair):
    rpc, bus, _ = pair(lambda payload: {})
    rpc.call({}, 5)
    rpc.close()
    rpc.close()
    assert bus.listeners["/bam/scene/reply"] == []
