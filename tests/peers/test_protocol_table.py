"""Every input that servers of rosbridge are known to treat differently, sent to ours and to one that is not.

Ours answers each of them, and passes no number on that is not finite; what the other one does is here for comparison.
"""

import contextlib
import json
import re
import time
from dataclasses import dataclass

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

BIG = 12_000_000
BEYOND = 17_000_000
LIMIT = 5.0


@dataclass(frozen=True)
class Answer:
    op: str = "status"
    text: str = ""
    """What the answer says, as a regular expression."""
    result: bool | None = None
    id: object = None

    def fits(self, message):
        said = message.get("msg", message.get("values", message.get("data", "")))
        return (
            message["op"] == self.op
            and (self.result is None or message["result"] is self.result)
            and (self.id is None or message.get("id") == self.id)
            and re.search(self.text, said if isinstance(said, str) else json.dumps(said)) is not None
        )


def call(service, **fields):
    return {"op": "call_service", "id": "1", "service": service, **fields}


def publish(topic, values):
    return {"op": "publish", "topic": topic, "msg": values}


def subscribe(topic, **fields):
    return {"op": "subscribe", "topic": topic, **fields}


def raw(number):
    return f'{{"op":"publish","topic":"/gripper/commands","msg":{{"data":[{number}]}}}}'


def done(text="", **fields):
    return Answer("service_response", text, True, **fields)


def failed(text="", **fields):
    return Answer("service_response", text, False, **fields)


NOTHING = None
"""No answer is due, or none comes; the next request is answered."""
# name: what is sent, the answer of ours, the answer of the other
TABLE = {
    "malformed JSON": ("{bad", Answer(text="expected JSON"), Answer(text="key must be a string")),
    "no op": ({"a": 1}, Answer(text="op: expected a text"), Answer(text="op must be")),
    "unknown op": ({"op": "nope"}, Answer(text="Unknown op 'nope'"), Answer(text="unknown operation: nope")),
    "a JSON array": ("[1,2]", Answer(text="expected an object"), Answer(text="must be an object")),
    "set_level": ({"op": "set_level", "level": "error"}, NOTHING, Answer(text="unknown operation")),
    "two objects in one frame": (
        json.dumps(call("/robot/set", args={"data": True})) * 2,
        Answer(text="expected one in a frame"),
        Answer(text="trailing characters"),
    ),
    "JSON in a binary frame": (
        json.dumps(call("/robot/set", args={"data": True})).encode(),
        done('"set"'),
        Answer(text="."),
    ),
    "an id that is an integer": (
        {**call("/robot/set", args={"data": True}), "id": 7},
        done('"set"', id=7),
        failed("id must be a string"),
    ),
    "an unknown service": (call("/nope"), failed("Service /nope does not exist"), failed("type is required")),
    "an unknown field in args": (call("/robot/set", args={"x": 1}), failed("'x'"), failed("no field x")),
    "a wrong type in args": (call("/robot/set", args={"data": "x"}), failed("true or false"), failed("field .*data")),
    "a time-out": (call("/robot/slow", timeout=0.2), failed("Timeout exceeded"), failed("Timeout exceeded")),
    "the wrong type of a topic": (
        subscribe("/joint_states", type="std_msgs/String"),
        Answer(text="/joint_states is of type sensor_msgs/JointState"),
        Answer(text="/joint_states has another type"),
    ),
    "an absent topic without type": (
        subscribe("/absent"),
        Answer(text="/absent does not exist yet; its type is needed"),
        Answer(text="type is required"),
    ),
    "a throttle rate with a fraction": (
        subscribe("/gripper/joint_states", throttle_rate=33.3),
        Answer("publish", "gripper_width|"),
        Answer(text="nonnegative integer"),
    ),
    "a throttle rate that is a text": (
        subscribe("/gripper/joint_states", throttle_rate="300"),
        Answer(text="throttle_rate: expected a number >= 0, found '300'"),
        Answer(text="nonnegative integer"),
    ),
    "an unknown field": (publish("/ping", {"x": 1}), Answer(text="found 'x'"), Answer(text="no field x")),
    "a wrong type": (publish("/ping", {"data": 1}), Answer(text="expected a text"), Answer(text="field .*data")),
    "NaN": (raw("NaN"), Answer(text="finite number.*found nan"), Answer(text="expected value")),
    "Infinity": (raw("Infinity"), Answer(text="found inf"), Answer(text="expected value")),
    "-Infinity": (raw("-Infinity"), Answer(text="found -inf"), Answer(text="invalid number")),
    "1e400": (raw("1e400"), Answer(text="finite number.*found inf"), Answer(text="out of range")),
    "null in a float": (raw("null"), Answer(text="expected a number, found None"), Answer(text="field .*data")),
    "a text in a float": (raw('"0.1"'), Answer(text="expected a number"), Answer(text="field .*data")),
    "true in a float": (raw("true"), Answer(text="expected a number, found True"), Answer(text="field .*data")),
    "compression png": (
        subscribe("/gripper/joint_states", compression="png"),
        Answer("png", "iVBORw0KGgo"),
        Answer("png", "iVBORw0KGgo"),
    ),
}


class Client:
    """A WebSocket and nothing else."""

    def __init__(self, socket):
        self._socket = socket

    def send(self, frame):
        self._socket.send(json.dumps(frame) if isinstance(frame, dict) else frame)

    def until(self, fits, limit=LIMIT):
        """All that comes up to the first message that fits."""
        deadline, messages = time.monotonic() + limit, []
        while True:
            messages.append(json.loads(self._socket.recv(timeout=max(0.0, deadline - time.monotonic()))))
            if fits(messages[-1]):
                return messages

    def is_usable(self):
        self.send({**call("/robot/set", args={"data": True}), "id": "usable"})
        return self.until(done(id="usable").fits)[-1]["values"]["success"]


@contextlib.contextmanager
def client_of(url):
    with connect(url, max_size=None, compression=None) as socket:
        yield Client(socket)


@pytest.fixture
def ours(our_robot):
    our_robot.received.clear()
    with client_of(our_robot.server.url) as client:
        yield client


@pytest.fixture
def other(rosbridge, robot_node):
    with client_of(rosbridge.url) as client:
        yield client


def require(client, frame, answer):
    client.send(frame)
    if answer is not NOTHING:
        client.until(answer.fits)
    assert client.is_usable()


@pytest.mark.parametrize("name", TABLE)
def test_ours_answers(name, ours):
    frame, answer, _ = TABLE[name]
    require(ours, frame, answer)


@pytest.mark.parametrize("name", TABLE)
def test_the_other_answers(name, other):
    frame, _, answer = TABLE[name]
    require(other, frame, answer)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e400", "null", '"0.1"', "true"])
def test_no_server_passes_on_what_is_no_finite_number(number, ours, other, our_robot, robot_node, wait_until):
    for client in (ours, other):
        client.send(raw(number))
        client.send(raw("0.05"))
        assert client.is_usable()
    assert our_robot.received == [0.05]
    wait_until(lambda: [entry["values"] for entry in robot_node.ask("report")["received"]], [[0.05]])


def test_publishing_without_advertising_works_where_the_topic_exists(ours, other):
    for client in (ours, other):
        client.send(subscribe("/pong", type="std_msgs/String"))
        assert client.is_usable()
        client.send(publish("/ping", {"data": "hello"}))
        client.until(lambda message: message["op"] == "publish" and message["msg"] == {"data": "hello"})


def test_a_client_may_call_what_it_offers_itself(ours, other):
    for client in (ours, other):
        client.send({"op": "advertise_service", "service": "/own", "type": "std_srvs/Trigger"})
        assert client.is_usable()
        client.send({**call("/own"), "id": "2"})
        asked = client.until(lambda message: message["op"] == "call_service")[-1]
        values = {"success": True, "message": "me"}
        client.send({"op": "service_response", "id": asked["id"], "service": "/own", "values": values, "result": True})
        assert client.until(done(id="2").fits)[-1]["values"] == values


def test_a_call_does_not_hold_back_what_comes_after_it(ours):
    ours.send({**call("/robot/slow"), "id": "slow"})
    assert ours.is_usable()
    assert ours.until(done().fits)[-1]["id"] == "slow"


def test_who_offers_a_service_dies_in_a_call(ours, our_robot):
    with client_of(our_robot.server.url) as provider:
        provider.send({"op": "advertise_service", "service": "/mortal", "type": "std_srvs/Trigger"})
        assert provider.is_usable()
        ours.send(call("/mortal"))
        provider.until(lambda message: message["op"] == "call_service")
    assert ours.until(failed("Service /mortal is gone").fits)
    require(ours, call("/mortal"), failed("Service /mortal does not exist"))


def test_a_handler_raises(ours):
    require(ours, call("/robot/fails"), failed("boom"))


def test_a_large_message_passes_and_one_beyond_the_limit_ends_only_its_connection(ours, our_robot):
    ours.send(subscribe("/pong", type="std_msgs/String"))
    ours.send(publish("/ping", {"data": "x" * BIG}))
    assert len(ours.until(lambda message: message["op"] == "publish")[-1]["msg"]["data"]) == BIG
    with client_of(our_robot.server.url) as greedy:
        greedy.send(publish("/ping", {"data": "x" * BEYOND}))
        with pytest.raises(ConnectionClosed) as closed:
            greedy.until(lambda message: False)
        assert closed.value.rcvd.code == 1009
    assert ours.is_usable()
