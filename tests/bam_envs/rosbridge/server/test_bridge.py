import base64
import io
import json
import math

import cbor2
import pytest
from PIL import Image

from bam_envs.core.errors import InvalidValue, NotInCommand, RemoteError
from bam_envs.rosbridge.bus import ABORTED, CANCELED, SUCCEEDED, Action, Caller
from bam_envs.rosbridge.encoding import split
from bam_envs.rosbridge.server.bridge import Bridge
from bam_envs.rosbridge.server.client_session import Call, Send, ServerOptions
from tests.bam_envs.rosbridge.server.test_fuzz import receive

JOINTS, FLOATS, TEXT, TRIGGER, SET_BOOL = (
    "sensor_msgs/JointState",
    "std_msgs/Float64MultiArray",
    "std_msgs/String",
    "std_srvs/Trigger",
    "std_srvs/SetBool",
)


class Peers:
    """A bridge, clients that keep what they get, and a clock that is set by hand."""

    def __init__(self, limits=None):
        self.now = 100.0
        self.bridge = Bridge(limits, clock=lambda: 1_700_000_000.25)
        self.got = {}
        self.pending = []

    def client(self, name="a"):
        session = self.bridge.open(Caller(name, "here"))
        self.got[session] = []
        return session

    def say(self, session, *messages, **message):
        """Send messages; returns what this client got since, as objects."""
        for one in [*messages, *([message] if message else [])]:
            receive(self.bridge, session, one if isinstance(one, (str, bytes)) else json.dumps(one), self.now)
        return self.take(session)

    def take(self, session):
        self.work()
        got, self.got[session] = self.got[session], []
        return [json.loads(frame) if packet.text else cbor2.loads(frame) for packet in got for frame in packet.frames]

    def work(self):
        """Do what the bridge wants done; handlers only when `run` is called."""
        for event in self.bridge.events():
            if isinstance(event, Send):
                if event.session in self.got:
                    self.got[event.session].append(event.packet)
            else:
                assert isinstance(event, Call)
                self.pending.append(event)

    def run(self):
        """Let the handlers answer."""
        self.work()
        while self.pending:
            call = self.pending.pop(0)
            self.bridge.services.finish(call, self.bridge.services.packed_answer(call))
            self.work()

    def call(self, session, **more):
        """Call a service of this process, let the handlers answer; what the client got."""
        got = self.say(session, op="call_service", service="/s", **more)
        self.run()
        return got + self.take(session)

    def wait(self, seconds):
        self.now += seconds
        self.bridge.tick(self.now)


@pytest.fixture
def peers():
    return Peers()


def status(text, **more):
    return [{"op": "status", "level": "error", "msg": text, **more}]


def response(values, result, service="/s", **more):
    return [{"op": "service_response", "service": service, "values": values, "result": result, **more}]


def published(topic, message):
    return {"op": "publish", "topic": topic, "msg": message}


def text(value):
    return {"data": value}


# Everything is answered, and the connection is usable afterwards: the inputs of which real servers were measured.


SERVED = "Clients cannot offer actions to this server; offer a service, or a pair of topics."
LET_IN = "The op auth is for the first message of a web page; this client has been let in already."
NUMBER = "std_msgs/Float64MultiArray.data[0]: expected a"


@pytest.mark.parametrize(
    ("title", "fields", "told"),
    [
        ("", "x", "Message: expected JSON: Expecting value: line 1 column 1 (char 0)."),
        ("", "[]", "Message: expected an object, found []."),
        ("", b"\xa1\x00\x01", "Message: expected text in UTF-8: invalid start byte at byte 0."),
        ("", '{"op": "a"}{"op": "a"}', "Message: expected one in a frame, found more after it."),
        ("", "{}", "message: op: expected a text, found None."),
        ("", '{"op": 3}', "message: op: expected a text, found 3."),
        ("set_level", '"level": "loud"', "level: expected one of none, error, warning, info, found 'loud'."),
        ("subscribe", '"topic": "/new"', "Topic /new does not exist yet; its type is needed."),
        ("subscribe", '"topic": "/t", "type": "a/B"', "Topic /t is of type std_msgs/String, found 'a/B'."),
        ("subscribe /t", '"throttle_rate": "300"', "throttle_rate: expected a number >= 0, found '300'."),
        ("subscribe /t", '"throttle_rate": 1e400', "throttle_rate: expected a number >= 0, found inf."),
        ("subscribe /t", '"queue_length": -1', "queue_length: expected a number >= 0, found -1."),
        ("subscribe /t", '"compression": "raw"', "compression: expected one of none, png, cbor, found 'raw'."),
        ("subscribe /t", '"fragment_size": 0', "fragment_size: expected an integer >= 1, found 0."),
        ("subscribe /a b", '"type": "a/B"', "Name: expected one such as '/joint_states', found '/a b'."),
        ("subscribe /t", '"id": {}', "id: expected a text or an integer, found {}."),
        ("subscribe /t", '"id": 1e400', "id: expected a text or an integer, found inf."),
        ("subscribe /t", f'"id": {10**19}', f"id: expected an integer of 53 bits, found {10**19}."),
        ("unsubscribe", '"topic": "/t"', "Topic /t was not subscribed so by this client."),
        ("advertise", '"topic": "/t", "type": "a/B"', "Topic /t is of type std_msgs/String, found 'a/B'."),
        ("advertise /u", '"a": 0', "type: expected a text, found None."),
        ("advertise /u", '"type": "Bool"', "Type: expected a name such as 'std_msgs/String', found 'Bool'."),
        ("unadvertise", '"topic": "/u"', "Topic /u was not advertised so by this client."),
        ("publish", '"topic": "/u", "msg": {}', "Topic /u does not exist; advertise it with its type first."),
        ("publish /t", '"msg": {"b": ""}', "std_msgs/String: expected only the fields data, found 'b'."),
        ("publish /t", '"msg": {"data": 1}', "std_msgs/String.data: expected a text, found 1."),
        ("publish /f", '"msg": {"data": [NaN]}', f"{NUMBER} finite number, found nan."),
        ("publish /f", '"msg": {"data": [Infinity]}', f"{NUMBER} finite number, found inf."),
        ("publish /f", '"msg": {"data": [1e400]}', f"{NUMBER} finite number, found inf."),
        ("publish /f", '"msg": {"data": [null]}', f"{NUMBER} number, found None."),
        ("publish /f", '"msg": {"data": [true]}', f"{NUMBER} number, found True."),
        ("unadvertise_service", '"service": "/s"', "Service /s is not offered by this client."),
        ("advertise_service", '"service": "/s", "type": "a/B"', "Service /s is offered by this server already."),
        ("service_response", '"id": "7"', "Nobody waits for a response with the id '7'."),
        ("auth", '"mac": ""', LET_IN),
        ("advertise_action", '"action": "/a"', SERVED),
    ],
)
def test_what_does_not_work_is_said_at_once(peers, title, fields, told):
    peers.bridge.subscribe("/t", TEXT, lambda message, caller: None)
    peers.bridge.subscribe("/f", FLOATS, lambda message, caller: pytest.fail("it must not get through"))
    peers.bridge.serve("/s", TRIGGER, lambda request, caller: {})
    client, (op, _, topic) = peers.client(), title.partition(" ")
    named = f'"topic": "{topic}", ' if topic else ""
    frame = f'{{"op": "{op}", {named}{fields}}}' if op else fields
    (answer,) = peers.say(client, frame)
    assert (answer["op"], answer["level"]) == ("status", "error")
    assert answer["msg"] == (f"{title}: {told}" if op else told)
    peers.say(client, op="call_service", service="/s", id=1)
    peers.run()
    assert peers.take(client) == response({"success": False, "message": ""}, True, id=1)


# Actions.

GRIP, GRIPPER = "control_msgs/action/GripperCommand", "/gripper/gripper_cmd"


@pytest.fixture
def goals(peers):
    """The goals of the action `GRIPPER` that have begun; a cancelled one ends so."""
    begun = []

    def begin(goal):
        if goal.values["command"]["position"] < 0:
            raise NotInCommand("Another client drives.")
        begun.append(goal)

    peers.bridge.act(Action(GRIPPER, GRIP, begin, lambda goal: goal.end(CANCELED, {"stalled": True})))
    return begun


def send_goal(peers, client, position=0.8, **more):
    request = {"action": GRIPPER, "action_type": GRIP, "id": "g", "args": {"command": {"position": position}}}
    return peers.say(client, {"op": "send_action_goal", **request, **more})


def gripper_values(**more):
    return {"position": 0.0, "effort": 0.0, "stalled": False, "reached_goal": False, **more}


def result(values, status, *, fits=True, **more):
    return {
        "op": "action_result",
        "action": GRIPPER,
        "id": "g",
        "values": values,
        "status": status,
        "result": fits,
    } | more


def test_a_goal_of_an_action_has_feedback_if_wanted_and_one_result(peers, goals):
    client, quiet = peers.client(), peers.client("b")
    assert send_goal(peers, client, feedback=True) == send_goal(peers, quiet) == []
    assert [goal.values for goal in goals] == [{"command": {"position": 0.8, "max_effort": 0.0}}] * 2
    assert [goal.caller.name for goal in goals] == ["a", "b"]
    for goal in goals:
        goal.feedback({"position": 0.4})
        goal.end(SUCCEEDED, {"position": 0.8, "reached_goal": True})
        goal.end(ABORTED, {})
        goal.feedback({})
    done = result(gripper_values(position=0.8, reached_goal=True), 4)
    feedback = {"op": "action_feedback", "action": GRIPPER, "id": "g", "values": gripper_values(position=0.4)}
    assert peers.take(client) == [feedback, done]
    assert peers.take(quiet) == [done]


def test_a_goal_is_cancelled_by_its_client_or_when_it_leaves(peers, goals):
    client, other = peers.client(), peers.client("b")
    send_goal(peers, client)
    assert peers.say(other, op="cancel_action_goal", action=GRIPPER, id="g") == peers.take(client) == []
    done = result(gripper_values(stalled=True), 5)
    assert peers.say(client, op="cancel_action_goal", action=GRIPPER, id="g") == [done]
    ended = []
    peers.bridge.act(Action("/b", GRIP, lambda goal: None, ended.append))
    send_goal(peers, other, action="/b")
    peers.bridge.lost(other)
    assert [goal.caller.name for goal in ended] == ["b"]


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"action": "/a"}, "Action /a does not exist"),
        ({"action_type": "x/Y"}, f"Action {GRIPPER} is a control_msgs/GripperCommand, not a x/Y."),
        ({"action_type": None}, "action_type: expected a text, found None."),
        ({"args": {"speed": 1}}, "control_msgs/GripperCommandGoal: expected only the fields command, found 'speed'."),
        ({"position": -1.0}, "Another client drives."),
    ],
)
def test_a_goal_that_cannot_run_is_rejected_by_its_result(peers, goals, more, reason):
    client = peers.client()
    expected = result(reason, 6, fits=False, action=more.get("action", GRIPPER))
    assert send_goal(peers, client, **more) == [expected]
    assert goals == []


def test_actions_are_listed(peers, goals):
    answers = [
        peers.say(peers.client(), op="call_service", service=f"/rosapi/{name}", args=args)[0]["values"]
        for name, args in (("action_servers", {}), ("action_type", {"action": GRIPPER}))
    ]
    assert answers == [{"action_servers": [GRIPPER]}, {"type": "control_msgs/GripperCommand"}]


def test_an_operation_that_nobody_knows_and_levels_of_status(peers):
    client = peers.client()
    assert peers.say(client, {"op": "set_level", "level": "none"}, {"op": "dance"}) == []
    (answer,) = peers.say(client, {"op": "set_level", "level": "info"}, {"op": "dance", "id": 4})
    assert answer["msg"].startswith("dance: Unknown op 'dance'; expected one of advertise, ")
    assert (answer["op"], answer["id"]) == ("status", 4)


# Topics.


def test_a_topic_ends_with_its_last_user(peers):
    first, second = peers.client(), peers.client()
    peers.say(first, op="advertise", topic="/t", type=TEXT, id=1)
    peers.say(first, op="advertise", topic="/t", type=TEXT, id=2)
    peers.say(second, op="subscribe", topic="t", type=TEXT)
    assert peers.say(first, op="publish", topic="/t", msg=text("x")) == []
    assert peers.take(second) == [published("t", text("x"))]
    peers.say(first, op="unadvertise", topic="/t", id=1)
    peers.say(second, op="unsubscribe", topic="/t")
    assert peers.bridge.topics.get("/t") is not None
    peers.say(first, op="unadvertise", topic="/t")
    assert peers.bridge.topics.get("/t") is None


def test_a_client_gets_each_message_once(peers):
    client = peers.client()
    peers.say(client, op="subscribe", topic="/t", type=TEXT, id="1")
    peers.say(client, op="subscribe", topic="/t", type=TEXT, id="2", compression="png")
    assert [one["op"] for one in peers.say(client, op="publish", topic="/t", msg=text("x"))] == ["png"]
    peers.say(client, op="unsubscribe", topic="/t", id="2")
    assert peers.say(client, op="publish", topic="/t", msg=text("x")) == [published("/t", text("x"))]
    peers.say(client, op="unsubscribe", topic="/t", id="1")
    assert peers.bridge.topics.get("/t") is None


@pytest.mark.parametrize(("queue", "kept"), [({}, "d"), ({"queue_length": 2}, "cd")])
def test_a_throttled_client_gets_the_newest_in_order_when_it_is_time(peers, queue, kept):
    client = peers.client()
    peers.say(client, op="subscribe", topic="/t", type=TEXT, throttle_rate=33.3, **queue)
    first = peers.say(client, *[{"op": "publish", "topic": "/t", "msg": text(one)} for one in "abcd"])
    assert first == [published("/t", text("a"))]
    for one in kept:
        assert peers.bridge.next_deadline == pytest.approx(peers.now + 0.0333, abs=5e-4)
        peers.wait(0.0331)
        assert peers.take(client) == []
        peers.wait(0.0003)
        assert peers.take(client) == [published("/t", text(one))]
    assert peers.bridge.next_deadline == math.inf


def test_a_topic_of_the_rate_that_is_asked_for_loses_nothing(peers):
    client = peers.client()
    peers.say(client, op="subscribe", topic="/t", type=TEXT, throttle_rate=10)
    count = 0
    for tick in range(100):
        peers.now = 200.0 + tick * 0.01 + (0.002 if tick % 3 else 0.0)
        count += len(peers.say(client, op="publish", topic="/t", msg=text("x")))
        deadline = peers.bridge.next_deadline
        if deadline < math.inf:
            peers.bridge.tick(deadline)
            count += len(peers.take(client))
    assert count == 100


def test_packing_is_done_once_for_all_and_the_queue_length_goes_with_it(peers):
    for number in range(3):
        peers.say(peers.client(str(number)), op="subscribe", topic="/t", type=TEXT, queue_length=3)
    peers.bridge.advertise("/t", TEXT)
    peers.bridge.publish(peers.bridge.publication("/t", text("x")), 0.0)
    events = peers.bridge.events()
    assert len({id(event.packet) for event in events}) == 1
    assert [(event.keep, event.packet.stream) for event in events] == [(3, "/t")] * 3


def test_compressions(peers):
    png, cbor, parts = (peers.client(name) for name in "abc")
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    whole = published("/j", {"header": header, "name": ["a"], "position": [1.5], "velocity": [], "effort": []})
    peers.say(png, op="subscribe", topic="/j", type=JOINTS, compression="png")
    peers.say(cbor, op="subscribe", topic="/j", type=JOINTS, compression="cbor")
    peers.say(parts, op="subscribe", topic="/j", type=JOINTS, fragment_size=50)
    (image,) = peers.say(png, op="publish", topic="/j", msg={"name": ["a"], "position": [1.5]})
    assert json.loads(Image.open(io.BytesIO(base64.b64decode(image["data"]))).tobytes()) == whole
    assert peers.take(cbor)[0]["msg"]["position"].tag == 86
    fragments = peers.take(parts)
    assert json.loads("".join(one["data"] for one in fragments)) == whole
    assert [(one["num"], one["total"]) for one in fragments] == [(0, 3), (1, 3), (2, 3)]


def test_a_latched_message_waits_for_newcomers_as_long_as_its_publisher(peers):
    first, second, third = (peers.client(name) for name in "abc")
    peers.say(first, op="advertise", topic="/t", type=TEXT, latch=True)
    peers.say(first, op="publish", topic="/t", msg=text("old"))
    peers.say(first, op="publish", topic="/t", msg=text("new"))
    assert peers.say(second, op="subscribe", topic="/t", type=TEXT) == [published("/t", text("new"))]
    heard = []
    peers.bridge.subscribe("/t", TEXT, lambda message, caller: heard.append((message, caller.name)))
    assert heard == [(text("new"), "a")]
    peers.bridge.lost(first)
    assert peers.say(third, op="subscribe", topic="/t", type=TEXT) == []


# This process.


@pytest.mark.parametrize(
    ("reason", "text"),
    [
        ("client b is in command", "/a/cmd: client b is in command"),
        ("/a/cmd: data must have 6 numbers, not 1.", "/a/cmd: data must have 6 numbers, not 1."),
        ("/cmd: data must have 6 numbers, not 1.", "/a/cmd: data must have 6 numbers, not 1."),
        ("/other: it is busy", "/a/cmd: /other: it is busy"),
    ],
)
def test_a_listener_may_refuse_and_the_topic_is_told_once(peers, reason, text):
    def refuse(message, caller):
        raise NotInCommand(reason)

    heard = []
    peers.bridge.subscribe("/a/cmd", FLOATS, refuse)
    peers.bridge.subscribe("/a/cmd", FLOATS, lambda message, caller: heard.append(message))
    answer = peers.say(peers.client(), op="publish", topic="/a/cmd", msg={"data": [1]})
    assert answer == status(text)
    assert len(heard) == 1


def test_a_listener_that_breaks_silences_nobody(peers, caplog):
    heard = []
    peers.bridge.subscribe("/cmd", FLOATS, lambda message, caller: {}["missing"])
    peers.bridge.subscribe("/cmd", FLOATS, lambda message, caller: heard.append(message))
    answer = peers.say(peers.client(), op="publish", topic="/cmd", msg={"data": [1]})
    assert answer == status("/cmd: The receiver failed; see its log.")
    assert len(heard) == 1
    assert "/cmd: a listener failed" in caplog.text


@pytest.mark.parametrize(
    ("mistake", "told"),
    [
        (lambda bridge: bridge.advertise("/t", "a/B"), "Topic /t is of type std_msgs/String, found 'a/B'."),
        (lambda bridge: bridge.publication("/u", {}), "Topic /u does not exist; advertise it with its type first."),
        (lambda bridge: bridge.publication("/t", {"data": 1}), "std_msgs/String.data: expected a text, found 1."),
        (lambda bridge: bridge.publication("a b", {}), "Name: expected one such as '/joint_states', found 'a b'."),
        (
            lambda bridge: bridge.serve("/rosapi/topics", TRIGGER, print),
            "Service /rosapi/topics is offered by this server already.",
        ),
    ],
)
def test_mistakes_of_this_process_are_values(peers, mistake, told):
    peers.bridge.advertise("/t", TEXT)
    with pytest.raises(InvalidValue) as caught:
        mistake(peers.bridge)
    assert str(caught.value) == told


def test_who_left_is_told(peers, caplog):
    left, client = [], peers.client("c")
    peers.bridge.on_leave(lambda caller: {}["missing"])
    peers.bridge.on_leave(left.append)
    peers.bridge.lost(client)
    assert left == [Caller("c", "here")]
    assert "a callback failed" in caplog.text


# Services.


def test_arguments_may_have_no_names(peers):
    peers.bridge.serve("/s", SET_BOOL, lambda request, caller: {"success": request["data"]})
    client = peers.client()
    assert peers.call(client, args=[True]) == response({"success": True, "message": ""}, True)
    assert peers.call(client, args=[True, 1]) == response("args: expected an object, found [True, 1].", False)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        ({"args": {"datum": 1}}, "std_srvs/SetBoolRequest: expected only the fields data, found 'datum'."),
        ({"args": {"data": "yes"}}, "std_srvs/SetBoolRequest.data: expected true or false, found 'yes'."),
        ({"args": {"data": math.nan}}, "std_srvs/SetBoolRequest.data: expected true or false, found nan."),
        ({"timeout": math.inf}, "timeout: expected a number >= 0, found inf."),
        ({"compression": "zip"}, "compression: expected one of none, png, cbor, found 'zip'."),
        ({"timeout": "soon"}, "timeout: expected a number >= 0, found 'soon'."),
        ({"service": "/s s"}, "Name: expected one such as '/joint_states', found '/s s'."),
    ],
)
def test_a_wrong_call_is_answered_by_a_response(peers, call, told):
    peers.bridge.serve("/s", SET_BOOL, lambda request, caller: {})
    message = {"op": "call_service", "service": "/s", "id": 1, **call}
    assert peers.say(peers.client(), message) == response(told, False, message["service"], id=1)


def boom(request, caller):
    raise ValueError("boom")


def refuse(request, caller):
    raise RemoteError("no")


@pytest.mark.parametrize(
    ("handler", "told"),
    [
        (refuse, "no"),
        (boom, "Service /s failed: ValueError: boom"),
        (lambda *_: {"success": 1}, "std_srvs/TriggerResponse.success: expected true or false, found 1."),
        (lambda *_: 3, "std_srvs/TriggerResponse: expected an object, found 3."),
        (lambda *_: {"message": "x" * 1000}, "The response of /s has 1094 bytes, and 1000 is the most."),
    ],
)
def test_a_handler_that_fails_or_answers_wrongly_is_an_answer(caplog, handler, told):
    peers = Peers(ServerOptions(max_message=1000))
    peers.bridge.serve("/s", TRIGGER, handler)
    assert peers.call(peers.client()) == response(told, False)


@pytest.mark.parametrize("is_own", [False, True])
def test_a_client_offers_a_service(peers, is_own):
    robot = peers.client("robot")
    client = robot if is_own else peers.client("c")
    peers.say(robot, op="advertise_service", service="s", type="std_srvs/srv/SetBool")
    (call,) = peers.say(client, op="call_service", service="/s", args={"data": True}, id=9) + peers.take(robot)
    assert call == {"op": "call_service", "service": "s", "args": {"data": True}, "id": call["id"]}
    said = peers.say(robot, op="service_response", id=call["id"], service="s", values={"success": True}, result=True)
    assert said + peers.take(client) == response({"success": True, "message": ""}, True, id=9)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ({"result": False, "values": "no"}, "no"),
        ({"result": False, "values": {}}, "Service /s failed and gave no reason."),
        ({"result": "yes", "values": {}}, "Service /s failed and gave no reason."),
        ({"result": True, "values": {"success": "yes"}}, None),
    ],
)
def test_a_client_s_service_fails(peers, answer, told):
    robot, client = peers.client("robot"), peers.client("c")
    peers.say(robot, op="advertise_service", service="/s", type=TRIGGER)
    peers.say(client, op="call_service", service="/s")
    (call,) = peers.take(robot)
    reply = peers.say(robot, {"op": "service_response", "id": call["id"], "service": "/s", **answer})
    if told is None:
        wrong = "std_srvs/TriggerResponse.success: expected true or false, found 'yes'."
        told = f"Service /s answered wrongly: {wrong}"
        assert reply == status(f"service_response /s: Response of /s: {wrong}", id=call["id"])
    assert peers.take(client) == response(told, False)


def test_a_silent_service_is_answered_for(peers):
    robot, client = peers.client("robot"), peers.client("c")
    peers.say(robot, op="advertise_service", service="/s", type=TRIGGER)
    peers.say(client, op="call_service", service="/s", timeout=0.5)
    peers.say(client, op="call_service", service="/s")
    late = peers.take(robot)[0]
    (told,) = peers.say(client, op="service_response", id=late["id"], service="/s", values={}, result=True)
    assert told["op"] == "status"  # only the one who was asked may answer
    assert peers.bridge.next_deadline == 100.5
    peers.wait(0.5)
    assert peers.take(client) == response("Timeout exceeded: service /s did not answer in 0.5 s.", False)
    assert peers.bridge.next_deadline == 130.0
    peers.wait(29.5)
    assert peers.take(client) == response("Timeout exceeded: service /s did not answer in 30 s.", False)
    (told,) = peers.say(robot, op="service_response", id=late["id"], service="/s", values={}, result=True)
    assert told["msg"] == f"service_response /s: Nobody waits for a response with the id '{late['id']}'."


def test_a_service_of_a_client_that_came_back_takes_the_place_of_the_old_one(peers):
    old, new, client = (peers.client(name) for name in "abc")
    for robot in (old, new):
        peers.say(robot, op="advertise_service", service="/s", type=TRIGGER)
    peers.say(client, op="call_service", service="/s")
    assert peers.take(old) == status("Service /s is offered by another client now.")
    assert len(peers.take(new)) == 1
    peers.bridge.lost(old)
    assert peers.bridge.services.get("/s").provider is new


def test_an_answer_for_someone_who_left_is_dropped(peers):
    peers.bridge.serve("/s", TRIGGER, lambda request, caller: {})
    client = peers.client()
    peers.say(client, op="call_service", service="/s")
    peers.bridge.lost(client)
    peers.run()
    assert peers.got[client] == []


def test_calls_wait_their_turn_and_expired_ones_are_not_done():
    peers, done = Peers(ServerOptions(at_once=2, calls=5)), []
    peers.bridge.serve("/s", TRIGGER, lambda request, caller: done.append(1) or {})
    client = peers.client()
    for _ in range(5):
        assert peers.say(client, op="call_service", service="/s", timeout=1) == []
    assert len(peers.pending) == 2
    assert peers.say(client, op="call_service", service="/s") == response(
        "At most 5 calls may be unanswered; wait for an answer first.", False
    )
    peers.wait(1.0)
    assert len(peers.take(client)) == 5
    peers.run()
    assert done == []


def test_rosapi(peers):
    peers.bridge.advertise("/t", TEXT)
    peers.bridge.serve("/s", TRIGGER, lambda request, caller: {})
    client = peers.client()

    def ask(name, **args):
        (answer,) = peers.say(client, op="call_service", service=f"/rosapi/{name}", args=args)
        assert answer["result"]
        return answer["values"]

    assert ask("get_time") == {
        "time": {"sec": 1_700_000_000, "nanosec": 250_000_000, "secs": 1_700_000_000, "nsecs": 250_000_000}
    }
    assert ask("topics") == {"topics": ["/t"], "types": [TEXT]}
    assert ask("topic_type", topic="/t") == {"type": TEXT}
    assert ask("topic_type", topic="/u") == {"type": ""}
    assert "/s" in ask("services")["services"]
    assert ask("service_type", service="s") == {"type": TRIGGER}
    assert ask("service_type", service="/u") == {"type": ""}
    (answer,) = peers.say(client, op="call_service", service="/rosapi/topic_type", args={})
    assert answer["values"] == "topic: expected a text, found ''."


# Fragments and limits.


def test_a_message_in_fragments_is_done_once_it_is_whole(peers):
    client = peers.client()
    parts = split(json.dumps({"op": "call_service", "service": "/no", "id": 3}), 10, "f")
    assert peers.say(client, *reversed(parts)) == response("Service /no does not exist", False, "/no", id=3)
    assert peers.bridge.next_deadline == math.inf
    assert peers.say(client, op="fragment", id="f", data="x", num=0, total=2) == []
    assert peers.bridge.next_deadline == 110.0
    peers.wait(10.0)
    assert peers.take(client) == status("Fragments of 'f' did not all come in time.")
    assert peers.bridge.next_deadline == math.inf


def test_fragments_hold_no_fragments(peers):
    inner = json.dumps({"op": "fragment", "id": "g", "data": "{}", "num": 0, "total": 1})
    answer = peers.say(peers.client(), op="fragment", id="f", data=inner, num=0, total=1)
    assert answer == status("A fragment must not hold fragments.")


def test_who_holds_most_in_fragments_gives_way(peers):
    peers = Peers(ServerOptions(unfinished=10_000))
    small, great, new = (peers.client(name) for name in "abc")
    for client, size in ((small, 1000), (great, 8000), (new, 2000)):
        peers.say(client, op="fragment", id="f", num=0, total=2, data="x" * size)
    assert [peers.take(one) for one in (small, new)] == [[], []]
    assert peers.take(great) == status("All unfinished fragments hold more than 10000 bytes.")
    assert peers.say(new, op="fragment", id="f", num=1, total=2, data="")[0]["msg"].startswith("Message: expected JSON")


def test_a_reserved_topic_is_for_those_whom_the_check_lets(peers):
    """Else anybody could say what the guards of the robot did."""

    def check(caller):
        if caller.name != "driver":
            raise NotInCommand("Topic /status is for the client in command.")

    peers.bridge.reserve("/status", check)
    listener, liar, driver = peers.client("a"), peers.client("b"), peers.client("driver")
    peers.say(listener, op="subscribe", topic="/status", type=TEXT)
    for client, expected in ((liar, status("publish: Topic /status is for the client in command.")), (driver, [])):
        peers.say(client, op="advertise", topic="/status", type=TEXT)
        assert peers.say(client, op="publish", topic="/status", msg={"data": client.caller.name}) == expected
    assert [one["msg"] for one in peers.take(listener)] == [{"data": "driver"}]


def test_what_this_process_publishes_nobody_else_does(peers):
    """Else a client could say where the robot is."""
    peers.bridge.advertise("/joint_states", JOINTS)
    listener, liar = peers.client("a"), peers.client("b")
    peers.say(listener, op="subscribe", topic="/joint_states")
    text = "Topic /joint_states is published by this server alone; its clients may subscribe."
    assert peers.say(liar, op="advertise", topic="/joint_states", type=JOINTS) == status(f"advertise: {text}")
    said = peers.say(liar, op="publish", topic="/joint_states", msg={"position": [1.0]})
    assert said == status(f"publish: {text}")
    assert peers.take(listener) == []


@pytest.mark.parametrize(
    ("op", "what"),
    [
        ({"op": "advertise", "topic": "/t{}", "type": TEXT}, "advertisements"),
        ({"op": "subscribe", "topic": "/t{}", "type": TEXT}, "subscriptions"),
        ({"op": "advertise_service", "service": "/t{}", "type": TRIGGER}, "services"),
    ],
)
def test_a_client_has_limits(op, what):
    peers = Peers(ServerOptions(topics=3, services=3))
    client = peers.client()
    for number in range(3):
        assert peers.say(client, {name: value.format(number) for name, value in op.items()}) == []
    (told,) = peers.say(client, {name: value.format(3) for name, value in op.items()})
    assert told["msg"].endswith(f"A client may have at most 3 {what}.")


def test_what_is_refused_leaves_nothing_behind(peers):
    client = peers.client()
    peers.say(client, op="advertise", topic="/t", type=TEXT, id=[])
    peers.say(client, op="subscribe", topic="/t", type=TEXT, compression="zip")
    assert list(peers.bridge.topics) == []
