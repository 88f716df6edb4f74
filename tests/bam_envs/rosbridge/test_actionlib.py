"""Actions that a link offers over the topics of actionlib, as to a bridge of ROS 1."""

import pytest

from bam_envs.core.errors import RemoteError
from bam_envs.rosbridge.actionlib import goal_id
from bam_envs.rosbridge.bus import ABORTED, CANCELED, SUCCEEDED, Action
from bam_envs.rosbridge.server import BridgeServer

NAME, KIND = "/gripper/gripper_cmd", "control_msgs/GripperCommand"


@pytest.fixture
def server():
    with BridgeServer(port=0) as running:
        yield running


@pytest.fixture
def action(server, new_link, new_heard):
    """The goals that begin, and those that are to be cancelled."""
    link, begun, canceled = new_link(server), new_heard(), new_heard()

    def begin(goal):
        if goal.values["command"]["position"] > 1.0:
            raise RemoteError("It does not open so far.")
        begun(goal)

    offered = Action(NAME, KIND, begin, canceled)
    assert not link.act(offered)
    link.ros = "ros1"  # as a bridge of ROS 1 tells by its time
    assert link.act(offered)
    return begun, canceled


@pytest.fixture
def client(server, action, new_link, new_heard):
    """Publish on a topic of the action; what is heard on its others."""
    link, heard = new_link(server), {topic: new_heard() for topic in ("result", "feedback", "status")}
    for topic, kind in (("goal", f"{KIND}ActionGoal"), ("cancel", "actionlib_msgs/GoalID")):
        link.advertise(f"{NAME}/{topic}", kind)
    for topic, kind in (("result", f"{KIND}ActionResult"), ("feedback", f"{KIND}ActionFeedback")):
        link.subscribe(f"{NAME}/{topic}", kind, heard[topic])
    link.subscribe(f"{NAME}/status", "actionlib_msgs/GoalStatusArray", heard["status"])
    return (lambda topic, message: link.publish(f"{NAME}/{topic}", message)), heard


def goal(identity, position):
    return {"goal_id": goal_id(identity), "goal": {"command": {"position": position}}}


def status(identity, number, text=""):
    return {"goal_id": goal_id(identity), "status": number, "text": text}


def test_a_goal_begins_is_told_of_and_ends_once(action, client):
    (begun, _), (publish, heard) = action, client
    assert heard["status"].wait() == [{"status_list": []}]
    publish("goal", goal("a", 0.5))
    publish("goal", goal("a", 0.7))  # again, as after a cut
    publish("goal", goal("b", 2.0))
    assert heard["result"].wait() == [{"status": status("b", 5, "It does not open so far."), "result": {}}]
    one = begun.wait()[0]
    one.feedback({"position": 0.3})
    one.end(SUCCEEDED, {"reached_goal": True})
    one.end(ABORTED, {"reached_goal": False})
    assert heard["feedback"].wait() == [{"status": status("a", 1), "feedback": {"position": 0.3}}]
    assert heard["result"].wait(2)[1] == {"status": status("a", 3), "result": {"reached_goal": True}}
    assert heard["status"].wait(4) == [{"status_list": each} for each in ([], *[[status("a", 1)]] * 2, [])]
    assert [one.values for one in begun.messages] == [{"command": {"position": 0.5}}]


def test_goals_are_cancelled_by_their_id_or_all_together(action, client):
    (begun, canceled), (publish, heard) = action, client
    for identity in "abc":
        publish("goal", goal(identity, 0.5))
    begun.wait(3)
    publish("cancel", goal_id("b"))
    canceled.wait()[0].end(CANCELED, {})
    publish("cancel", goal_id(""))
    canceled.wait(3)
    assert [one.identity for one in canceled.messages] == ["b", "a", "c"]
    assert heard["result"].wait() == [{"status": status("b", 2), "result": {}}]
