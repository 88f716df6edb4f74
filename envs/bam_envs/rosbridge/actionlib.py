"""Actions over the topics of actionlib: a bridge of ROS 1 has no goals of its own."""

import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from bam_envs.core.errors import BamEnvsError, LinkLost, ProtocolError
from bam_envs.ros.messages import write_stamp
from bam_envs.rosbridge.bus import ABORTED, CANCELED, SUCCEEDED, Action, Bus, Caller, Goal, Message

ENDS = {2: CANCELED, 3: SUCCEEDED, 4: ABORTED, 5: ABORTED, 8: CANCELED}
"""The ends of a goal in actionlib_msgs/GoalStatus: preempted, succeeded, aborted, rejected, recalled."""
_ACTIVE, _REJECTED = 1, 5


def goal_id(identity: str) -> dict[str, Any]:
    """An actionlib_msgs/GoalID; the stamp 0 means that nothing but the id tells which goal it is."""
    return {"stamp": write_stamp(0.0, ros1=True), "id": identity}


class TopicGoal(Goal):
    """A goal that came over a topic."""

    def __init__(self, owner: "ActionTopics", identity: str, values: Message, caller: Caller) -> None:
        self.values, self.caller, self.identity, self._owner = values, caller, identity, owner

    def status(self, number: int = _ACTIVE, text: str = "") -> dict[str, Any]:
        """Its actionlib_msgs/GoalStatus."""
        return {"goal_id": goal_id(self.identity), "status": number, "text": text}

    def feedback(self, values: Message) -> None:
        """See `Goal`."""
        self._owner.tell("feedback", {"status": self.status(), "feedback": dict(values)})

    def end(self, status: int, values: Message) -> None:
        """See `Goal`."""
        number = next(one for one, end in ENDS.items() if end == status)
        self._owner.end(self, self.status(number), values)


class ActionTopics:
    """Offers `action` on `bus`: takes goals and their cancellations, and publishes status, feedback and results."""

    def __init__(self, bus: Bus, action: Action) -> None:
        self._bus, self._action, self._lock = bus, action, threading.Lock()
        self._goals: dict[str, TopicGoal] = {}  # those that run, by id
        name, kind = action.name, action.kind
        bus.advertise(f"{name}/result", f"{kind}ActionResult")
        bus.advertise(f"{name}/feedback", f"{kind}ActionFeedback")
        bus.advertise(f"{name}/status", "actionlib_msgs/GoalStatusArray", latch=True)
        bus.subscribe(f"{name}/goal", f"{kind}ActionGoal", self._on_goal)
        bus.subscribe(f"{name}/cancel", "actionlib_msgs/GoalID", self._on_cancel)
        self._tell_status()

    def tell(self, topic: str, message: Message) -> None:
        """Publish on one of the topics, if there is a link: a goal ends without one, too."""
        with suppress(LinkLost):
            self._bus.publish(f"{self._action.name}/{topic}", message)

    def end(self, goal: TopicGoal, status: Message, values: Message) -> None:
        """End a goal with its last status and its result, unless it has ended."""
        with self._lock:
            if self._goals.pop(goal.identity, None) is None:
                return
        self.tell("result", {"status": status, "result": dict(values)})
        self._tell_status()

    def _tell_status(self) -> None:
        self.tell("status", {"status_list": [one.status() for one in list(self._goals.values())]})

    def _on_goal(self, message: Message, caller: Caller) -> None:
        values = message.get("goal")
        goal = TopicGoal(self, _identity(message.get("goal_id")), values if isinstance(values, Mapping) else {}, caller)
        with self._lock:
            if goal.identity in self._goals:
                return
            self._goals[goal.identity] = goal
        try:
            self._action.begin(goal)
            self._tell_status()
        except BamEnvsError as error:
            self.end(goal, goal.status(_REJECTED, str(error)), {})

    def _on_cancel(self, message: Message, caller: Caller) -> None:
        """Cancel one goal, or every one for an empty id."""
        identity = _identity(message)
        for goal in list(self._goals.values()):
            if identity in ("", goal.identity):
                self._action.cancel(goal)


def _identity(message: object) -> str:
    identity = message.get("id") if isinstance(message, Mapping) else None
    if not isinstance(identity, str):
        raise ProtocolError(f"goal_id.id: expected a text, found {type(identity).__name__}.")
    return identity
