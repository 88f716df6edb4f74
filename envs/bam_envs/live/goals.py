"""Parts of a command that go to actions and services, such as a gripper's: sent when they change, awaited by nobody.

A robot that describes itself gets them over the connection of its commands, in their order. Any other gets them over a
connection of their own, because a bridge may read nothing else of a connection while a goal runs. A bridge of ROS 1 has
no goals: they go over the topics of actionlib.
"""

import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import BamEnvsError, LinkLost, RemoteError
from bam_envs.core.robot import SignalSpec
from bam_envs.ros.profile_tables import Sink
from bam_envs.rosbridge.actionlib import ENDS, goal_id
from bam_envs.rosbridge.bus import ABORTED, CANCELED, SUCCEEDED, Caller, Message
from bam_envs.rosbridge.ros_bus import Reply, RosBus, bare_reason

Array = NDArray[np.float64]
GOAL = "goal:"
"""How the ids of all goals and calls here begin."""
_STEP = 0.02
"""Least change of a number for which a goal is sent, as a share of its range; the ends of the range are always sent."""
_ANSWER_WITHIN = 10.0
"""Longest time that a service may take for its answer [s]."""
_ENDS = {CANCELED: "was canceled", ABORTED: "was aborted"}


class _Running(NamedTuple):
    """A goal, or a call of a service, without an answer."""

    identity: str
    name: str
    """The action or service, with its namespace."""
    since: float
    """When it was sent [s, monotonic clock]."""


def form_for(sink: Sink, command: Array, spec: SignalSpec) -> Sink:
    """The form of `sink` for `command` (m,): the one that closes below half of the range of its width."""
    at = spec.labels.index(sink.labels[0])
    return sink.forms[-1] if command[at] < (spec.low[at] + spec.high[at]) / 2 else sink


class Goals:
    """Sends the newest numbers to actions and services, and reports those that fail.

    Args:
        link: The connection that carries them.
        command: The numbers of a command.
        namespace: Before each name.
        report: Called with the error of a goal or call that failed, on the network thread.
    """

    def __init__(
        self, link: RosBus, command: SignalSpec, namespace: str, report: Callable[[BamEnvsError], object]
    ) -> None:
        self.link, self._command, self._namespace, self._report = link, command, namespace, report
        self._lock = threading.Lock()
        # By the labels of the numbers: what was sent, or is to be sent next; what has no answer yet; and the request to
        # send after that.
        self._last: dict[tuple[str, ...], Array] = {}
        self._running: dict[tuple[str, ...], _Running] = {}
        self._next: dict[tuple[str, ...], tuple[Sink, dict[str, Any]]] = {}

    def prepare(self, sinks: Iterable[Sink]) -> None:
        """Declare the topics of actionlib for the actions of `sinks`, if the bridge is one of ROS 1."""
        if not self._is_ros1:
            return
        for sink in (form for one in sinks for form in one.forms if form.action):
            name = self._namespace + sink.action
            self.link.advertise(f"{name}/goal", f"{sink.type}ActionGoal")
            self.link.advertise(f"{name}/cancel", "actionlib_msgs/GoalID")
            self.link.subscribe(f"{name}/result", f"{sink.type}ActionResult", partial(self._ended, sink))

    @property
    def _is_ros1(self) -> bool:
        return self.link.ros == "ros1"

    def _ended(self, sink: Sink, message: Message, caller: Caller) -> None:
        """The result of a goal of actionlib, perhaps of somebody else's."""
        status: Any = message.get("status")
        status = status if isinstance(status, Mapping) else {}
        identity: Any = status.get("goal_id")
        if isinstance(identity, Mapping) and isinstance(identity.get("id"), str):
            end = ENDS.get(status.get("status", 0), status.get("status"))
            self._took(sink, identity["id"], {"status": end, "values": message.get("result")})

    def send(self, sink: Sink, values: Array, message: dict[str, Any]) -> None:
        """Send the `message` with the numbers `values` (k,) [SI], if they are news; never waits.

        A goal replaces the one that runs; a request waits for the answer to the one before, and only the newest does.
        `LinkLost` if the link is down.
        """
        with self._lock:
            if not self._is_news(sink, values):
                return
            self._last[sink.labels] = values.copy()
            running = self._running.get(sink.labels)
            if sink.service and running is not None:
                self._next[sink.labels] = sink, message
                if time.monotonic() - running.since > _ANSWER_WITHIN:
                    self._fail(sink, f"has not answered for {_ANSWER_WITHIN:g} s")
                return
            if running is not None:
                self._cancel(running)
            self._ask(sink, message)

    def cancel(self) -> None:
        """Cancel the goals that run, and forget what was sent: the next numbers are sent again. Never raises."""
        with self._lock:
            running, self._running = self._running, {}
            self._last, self._next = {}, {}
            for one in running.values():
                self._cancel(one)

    def _is_news(self, sink: Sink, values: Array) -> bool:
        last = self._last.get(sink.labels)
        if last is None:
            return True
        at = [self._command.labels.index(label) for label in sink.labels]
        low, high = np.array(self._command.low)[at], np.array(self._command.high)[at]
        moved = np.abs(values - last) > _STEP * (high - low)
        ends = (values != last) & ((values <= low) | (values >= high))
        return bool((moved | ends).any())

    def _ask(self, sink: Sink, message: dict[str, Any]) -> None:
        identity, name = f"{GOAL}{secrets.token_hex(8)}", self._namespace + sink.address  # unique among all clients
        kind = sink.type.replace("/", "/action/" if sink.action else "/srv/")
        request: dict[str, Any] = {"id": identity, "args": message}
        if sink.action:
            request |= {"op": "send_action_goal", "action": name, "action_type": kind, "feedback": False}
        else:
            request |= {"op": "call_service", "service": name, "type": kind, "timeout": _ANSWER_WITHIN}
        self._running[sink.labels] = _Running(identity, name, time.monotonic())
        if sink.action and self._is_ros1:
            self.link.publish(f"{name}/goal", {"goal_id": goal_id(identity), "goal": message})
            return
        self.link.ask_soon(request, partial(self._took, sink, identity))

    def _cancel(self, running: "_Running") -> None:
        if self._is_ros1:
            self.link.publish_soon(f"{running.name}/cancel", goal_id(running.identity))
            return
        self.link.send_soon({"op": "cancel_action_goal", "id": running.identity, "action": running.name})

    def _took(self, sink: Sink, identity: str, reply: Reply) -> None:
        with self._lock:
            running = self._running.get(sink.labels)
            if running is None or running.identity != identity:  # it was replaced, or canceled
                return
            del self._running[sink.labels]
            trouble = _trouble(sink, self.link.url, reply)
            if trouble:
                self._fail(sink, trouble)
            elif sink.labels in self._next:
                self._ask(*self._next.pop(sink.labels))

    def _fail(self, sink: Sink, trouble: str) -> None:
        last = self._last.pop(sink.labels)
        self._next.pop(sink.labels, None)
        asked = ", ".join(f"{label} {value:.3g}" for label, value in zip(sink.labels, last.tolist(), strict=True))
        what = f"the {'action' if sink.action else 'service'} {self._namespace}{sink.address}"
        self._report(RemoteError(f"{self.link.url}: {what} {trouble} ({asked}). Look at the gripper and its driver."))


def _trouble(sink: Sink, url: str, reply: Reply) -> str:
    """Why a goal or a call failed, for a text that begins with its name; empty if it did not."""
    if isinstance(reply, BamEnvsError):
        return f"{'lost its connection' if isinstance(reply, LinkLost) else 'failed'}: {bare_reason(url, reply)}"
    values = reply.get("values")
    fields = values if isinstance(values, Mapping) else {}
    said = str(fields.get("error") or fields.get("message") or ("" if fields else values or ""))
    text = f": {said.rstrip('.')}" if said else ""
    if reply.get("result") is False:
        return f"refused its {'goal' if sink.action else 'request'}{text}"
    if sink.service:
        return f"failed{text}" if fields.get("success") is False else ""
    # A gripper that holds something has not reached its goal: control_msgs/GripperCommand says that it is stalled.
    status = reply.get("status", SUCCEEDED)
    is_held = fields.get("stalled") is True or fields.get("reached_goal") is True
    if status == SUCCEEDED or is_held:
        return ""
    return f"ended: its goal {_ENDS.get(status, f'has the status {status}')}{text}"
