"""`RosbridgeLink` as a `roslibpy.Ros`: roslibpy's own classes work on it, and nothing that they send is kept."""

import threading

import pytest
import roslibpy

from bam_envs.core.errors import InvalidValue, LinkLost

STRING = "std_msgs/String"


def _cut(server, link):
    """Stop the server, and wait until the link is down."""
    down = threading.Event()
    link.on_down(lambda error: down.set())
    server.stop()
    assert down.wait(10.0)


def test_a_topic_is_declared_again_and_sends_now_or_not_at_all(scripted, link, heard):
    topic = roslibpy.Topic(link, "/chat", STRING)
    topic.subscribe(heard)
    topic.publish({"data": "1", "at": roslibpy.Time(1, 2)})
    assert scripted.wait_for("publish")[0]["msg"] == {"data": "1", "at": {"secs": 1, "nsecs": 2}}
    before = [scripted.of(op) for op in ("subscribe", "advertise")]
    with pytest.raises(InvalidValue, match=r"^message\.msg\.data: expected a finite number, found nan\.$"):
        topic.publish({"data": float("nan")})
    _cut(scripted, link)
    with pytest.raises(LinkLost, match=r"Nothing was sent, and nothing is kept\.$"):
        topic.publish({"data": "stale"})
    scripted.frames.clear()
    scripted.start()
    link.wait_up(10.0)
    scripted.send({"op": "publish", "topic": "/chat", "msg": {"data": "2"}})
    assert heard.wait() == [{"data": "2"}]
    topic.publish({"data": "3"})
    assert [frame["msg"]["data"] for frame in scripted.wait_for("publish")] == ["3"]
    assert [scripted.of(op) for op in ("subscribe", "advertise")] == before
    topic.unsubscribe()
    assert scripted.wait_for("unsubscribe")[0]["id"] == before[0][0]["id"]


def test_a_service_is_called_and_served(scripted, link, until):
    scripted.responses["/add"] = lambda args: {"sum": args["a"] + 1}
    service = roslibpy.Service(link, "/add", "a/B")
    assert dict(service.call(roslibpy.ServiceRequest({"a": 2}), timeout=5.0)) == {"sum": 3}
    with pytest.raises(roslibpy.core.ServiceException, match="Service /nope does not exist"):
        roslibpy.Service(link, "/nope", "a/B").call(roslibpy.ServiceRequest(), timeout=5.0)
    roslibpy.Service(link, "/mine", "a/B").advertise(lambda request, response: response.update(x=request["x"]) or True)
    scripted.wait_for("advertise_service")
    scripted.send({"op": "call_service", "id": "7", "service": "/mine", "args": {"x": 1}})
    answer = {"op": "service_response", "service": "/mine", "id": "7", "values": {"x": 1}, "result": True}
    assert scripted.wait_for("service_response") == [answer]
    scripted.responses["/add"] = lambda args: scripted.loop.call_soon(scripted.stopped.set) and None
    with pytest.raises(roslibpy.core.ServiceException, match="the link dropped: the server closed it with code 1001"):
        service.call(roslibpy.ServiceRequest(), timeout=60.0)
    until(lambda: not link.is_connected)
    with pytest.raises(LinkLost, match=r"Nothing was sent, and nothing is kept\.$"):
        service.call(roslibpy.ServiceRequest(), timeout=5.0)


def test_a_goal_of_an_action_has_feedback_and_a_result_and_ends_with_the_link(scripted, link, new_heard):
    results, news, errors = new_heard(), new_heard(), new_heard()
    client = roslibpy.ActionClient(link, "/gripper", "control_msgs/action/GripperCommand")
    goal = client.send_goal(roslibpy.Goal({"command": {"position": 0.1}}), results, news, errors)
    sent = scripted.wait_for("send_action_goal")[0]
    assert (sent["id"], sent["args"], sent["feedback"]) == (goal, {"command": {"position": 0.1}}, True)
    scripted.send({"op": "action_feedback", "id": goal, "action": "/gripper", "values": {"position": 0.05}})
    assert dict(news.wait()[0]) == {"position": 0.05}
    client.cancel_goal(goal)
    assert scripted.wait_for("cancel_action_goal")[0]["id"] == goal
    done = {"op": "action_result", "id": goal, "action": "/gripper", "status": 4, "result": True}
    scripted.send({**done, "values": {"reached_goal": True}})
    client.wait_goal(goal, 10.0)
    assert dict(results.wait()[0]) == {"status": roslibpy.core.GoalStatus.SUCCEEDED, "values": {"reached_goal": True}}
    client.send_goal(roslibpy.Goal(), results, news, errors)
    scripted.wait_for("send_action_goal", 2)
    scripted.drop()
    lost = errors.wait()[0]
    assert lost["status"] is roslibpy.core.GoalStatus.UNKNOWN
    assert "the link dropped: the connection was cut" in lost["values"]


def test_it_connects_only_when_it_is_told_and_says_when_it_is_ready(scripted, new_link, heard):
    link = new_link(scripted, connect=False)
    link.on_ready(lambda: heard("ready"), run_in_thread=False)
    assert (link.is_connected, heard.messages, scripted.headers) == (False, [], [])
    link.run()
    assert (link.is_connected, heard.wait()) == (True, ["ready"])
    link.on_ready(lambda: heard("ready already"), run_in_thread=False)
    assert heard.messages == ["ready", "ready already"]
    link.terminate()
    assert not link.is_connected


@pytest.mark.parametrize("name", ["close", "ready", "error", "/nobody"])
def test_no_message_is_taken_for_an_event(scripted, link, new_heard, name):
    events, heard = new_heard(), new_heard()
    for event in ("close", "ready", "error"):
        link.on(event, events)
    link.subscribe("/pong", STRING, heard)
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": name, "msg": {}}, {"op": "publish", "topic": "/pong", "msg": {}})
    heard.wait()
    assert events.messages == []
