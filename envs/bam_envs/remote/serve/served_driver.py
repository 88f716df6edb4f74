"""What a robot's driver offers beside topics of states and commands, for a served robot, under the same names.

That is a gripper as an action or a service, services that enable the arm, the list of controllers, and the URDF.
"""

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.description import ArmDescription
from bam_envs.core.errors import NotReady
from bam_envs.core.robot import RobotSpec, RobotState
from bam_envs.ros.codec import DESCRIPTION_TOPIC, from_si
from bam_envs.ros.interfaces import response_type, variants
from bam_envs.ros.messages import number_at
from bam_envs.ros.profile_tables import Enable, RobotProfile, Sink
from bam_envs.rosbridge.bus import ABORTED, CANCELED, SUCCEEDED, Action, Bus, Caller, Goal, Message

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Take = Callable[[str, Message, Caller], Mapping[str, float]]
"""Takes a command at an address, a goal or the request of a service, and returns its numbers by label [SI]; a
`BamEnvsError` refuses it."""
_REACHED = 0.001
"""Distance from its goal at which a gripper has reached it [m]."""
_STALLED, _STILL = 0.4, 2e-4
"""Time after which a gripper that moves no further holds something [s], and the motion that counts as none [m]."""
_CONTROLLERS = {
    "trajectory_msgs/JointTrajectory": "joint_trajectory_controller/JointTrajectoryController",
    "std_msgs/Float64MultiArray": "position_controllers/JointGroupPositionController",
    "sensor_msgs/JointState": "crisp_controllers/JointImpedanceController",
    "control_msgs/GripperCommand": "position_controllers/GripperActionController",
    "control_msgs/ParallelGripperCommand": "parallel_gripper_action_controller/GripperActionController",
}
"""The controller of ros2_control that takes commands of a type."""
_HOLDING = ("control_msgs/GripperCommand", "control_msgs/ParallelGripperCommand")
"""Actions that succeed where the gripper holds something."""


class _Grip:
    """A goal of a gripper that runs."""

    def __init__(self, goal: Goal, sink: Sink, width: float, column: tuple[str, int]) -> None:
        self.goal, self.sink, self.width = goal, sink, width
        self._column, self._since, self._at = column, math.inf, math.nan

    def advance(self, state: RobotState) -> bool:
        """Report how far the gripper is; True if that ends the goal."""
        now, at = float(state.stamp[0]), float(state.signals[self._column[0]][0, self._column[1]])
        if not abs(at - self._at) <= _STILL or now < self._since:
            self._since, self._at = now, at
        reached, stalled = abs(at - self.width) <= _REACHED, now - self._since >= _STALLED
        values, holds = self._values(at, reached, stalled), stalled and self.sink.type in _HOLDING
        if "epsilon" in self.goal.values:  # of franka_msgs/Grasp
            low, high = (number_at(self.goal.values, f"epsilon.{end}", "") for end in ("inner", "outer"))
            holds = stalled and self.width - low <= at <= self.width + high
        if not (reached or stalled):
            self.goal.feedback(_only(values, f"{self.sink.type}Feedback"))
            return False
        values |= {"success": reached or holds, "error": "" if reached or holds else "it does not move any further"}
        self.goal.end(SUCCEEDED if reached or holds else ABORTED, _only(values, f"{self.sink.type}Result"))
        return True

    def cancel(self, state: RobotState | None) -> None:
        """End it before the gripper is there."""
        values = {} if state is None else self._values(float(state.signals[self._column[0]][0, self._column[1]]))
        self.goal.end(CANCELED, _only({**values, "error": "canceled"}, f"{self.sink.type}Result"))

    def _values(self, width: float, reached: bool = False, stalled: bool = False) -> dict[str, Any]:
        (position,) = from_si(self.sink, np.array([width]))
        state = {"position": [position]}  # of ParallelGripperCommand
        found = {"position": position, "state": state, "current_width": width}
        return {**found, "stalled": stalled, "reached_goal": reached}


class ServedDriver:
    """The actions and services of one served robot.

    Args:
        spec: The robot.
        profile: Its names.
        bus: Where they are offered.
        namespace: Prefix of every name.
        take: Takes the commands of goals and requests.
        description: The arm, for its URDF; None: there is none.
    """

    def __init__(
        self,
        spec: RobotSpec,
        profile: RobotProfile,
        bus: Bus,
        namespace: str,
        take: Take,
        description: ArmDescription | None,
    ) -> None:
        self._spec, self._profile, self._bus, self._namespace, self._take = spec, profile, bus, namespace, take
        self._description = description
        self._enabled: set[str] = set()
        self._grips: dict[str, _Grip] = {}  # goals that run, by the label of their number
        self._state: RobotState | None = None

    def start(self) -> None:
        """Offer everything."""
        for sink in self._profile.sinks_by_address.values():
            name = self._namespace + sink.address
            if sink.action:
                if not self._bus.act(Action(name, sink.type, partial(self._begin, sink), self._cancel)):
                    _log.warning(
                        "%s (%s) is not offered: only bam-serve's own server and bridges of ROS 1 have actions",
                        name,
                        sink.type,
                    )
            elif sink.service:
                self._bus.serve(name, sink.type, partial(self._request, sink))
        for one in self._profile.enable:
            self._bus.serve(self._namespace + one.service, one.type, partial(self._enable, one))
        if self._profile.controllers:
            kind = "controller_manager_msgs/ListControllers"
            rows = [*self._controllers()]
            self._bus.serve(self._namespace + self._profile.controllers, kind, lambda *_: {"controller": rows})
        if self._description is not None:
            self._bus.advertise(self._namespace + DESCRIPTION_TOPIC, "std_msgs/String", latch=True)
            self._bus.publish(self._namespace + DESCRIPTION_TOPIC, {"data": urdf_of(self._description)})

    def require_enabled(self) -> None:
        """`NotReady` unless every service that enables the robot was called."""
        missing = [one.service for one in self._profile.enable if one.service not in self._enabled]
        if missing:
            raise NotReady(f"{self._profile.name} takes no command before {', '.join(missing)} was called.")

    @property
    def targets(self) -> dict[str, float]:
        """Where goals that run want the numbers of a command, by their labels [SI]."""
        return {label: grip.width for label, grip in self._grips.items()}

    def advance(self, state: RobotState) -> None:
        """Report the progress of goals, and end those that are reached."""
        self._state = state
        for label, grip in [*self._grips.items()]:
            if grip.advance(state) and self._grips.get(label) is grip:
                del self._grips[label]

    def cancel(self) -> None:
        """End every goal that runs."""
        while self._grips:
            self._grips.popitem()[1].cancel(self._state)

    def _begin(self, sink: Sink, goal: Goal) -> None:
        """Begin a goal; it replaces the one that runs."""
        ((label, width),) = self._take(sink.address, goal.values, goal.caller).items()
        signals = ((one.name, one.labels.index(label)) for one in self._spec.signals if label in one.labels)
        before, self._grips[label] = self._grips.get(label), _Grip(goal, sink, width, next(signals))
        if before is not None:
            before.cancel(self._state)

    def _cancel(self, goal: Goal) -> None:
        """End a goal, and stop its gripper where it is."""
        for label, grip in [*self._grips.items()]:
            if grip.goal is goal:
                del self._grips[label]
                grip.cancel(self._state)

    def _request(self, sink: Sink, request: Message, caller: Caller) -> Message:
        """Take a command that is the request of a service."""
        self._take(sink.address, request, caller)
        return _only({"success": True, "ret": 0}, response_type(sink.type))

    def _enable(self, one: Enable, request: Message, caller: Caller) -> Message:
        """Remember that `one` was called; another request takes that back."""
        wanted = all(request.get(key) == value for key, value in one.request.items())
        (self._enabled.add if wanted else self._enabled.discard)(one.service)
        ready = one.ready[0]
        whole = isinstance(ready, float) and ready.is_integer()
        return _only({one.field: int(ready) if whole else ready, "message": ""}, response_type(one.type))

    def _controllers(self) -> Iterator[dict[str, Any]]:
        """The controllers of all command modes; those of the first one are active."""
        yield _controller("joint_state_broadcaster", "joint_state_broadcaster/JointStateBroadcaster", [], active=True)
        measured = {source.signal: source.names for source in self._profile.state}
        active = self._profile.sinks()
        for sink in self._profile.sinks_by_address.values():
            if sink.controller:
                joints = sink.names if sink.topic else measured.get(sink.labels[0], sink.names)
                kind = _CONTROLLERS.get(sink.type, sink.type)
                interfaces = [f"{name}/position" for name in joints]
                yield _controller(sink.controller, kind, interfaces, active=sink in active, rate=sink.rate)


def _controller(
    name: str, kind: str, interfaces: list[str], *, active: bool, rate: float | None = None
) -> dict[str, Any]:
    """One row of controller_manager_msgs/ControllerState; the rate 0 is that of the controller manager."""
    state, claimed = ("active", interfaces) if active else ("inactive", [])
    required = {"required_command_interfaces": interfaces, "claimed_interfaces": claimed}
    return {"name": name, "state": state, "type": kind, "update_rate": round(rate or 0), **required}


def _only(values: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """The `values` that a message of type `kind` has; all of them if the type is unknown."""
    fields = {one.name for fields in variants(kind) for one in fields}
    return {name: value for name, value in values.items() if name in fields or not fields}


def urdf_of(arm: ArmDescription) -> str:
    """The URDF of a described arm: its joints with limits, from ``base_link`` on, the frame ``tool``, and a finger."""
    robot, parent = ElementTree.Element("robot", name=arm.name), "base_link"
    ElementTree.SubElement(robot, "link", name=parent)
    placements = [*arm.chain.placements, arm.chain.tool_placement]
    for at, placement in enumerate(placements):
        row = arm.joints[at] if at < arm.num_joints else None
        name, kind = ("tool_joint", "fixed") if row is None else (row.name, "revolute")
        child = "tool" if row is None else f"link_{at + 1}"
        ElementTree.SubElement(robot, "link", name=child)
        joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
        ElementTree.SubElement(joint, "origin", xyz=_text(placement[:3, 3]), rpy=_text(_angles(placement)))
        if row is not None:
            ElementTree.SubElement(joint, "axis", xyz=_text(arm.chain.axes[at]))
            limits = {"lower": row.low, "upper": row.high, "velocity": row.velocity, "effort": row.effort}
            ElementTree.SubElement(joint, "limit", {key: repr(value) for key, value in limits.items()})
        parent = child
    ElementTree.SubElement(robot, "link", name="finger")
    finger = ElementTree.SubElement(robot, "joint", name="finger_joint", type="prismatic")
    ElementTree.SubElement(finger, "parent", link=parent)
    ElementTree.SubElement(finger, "child", link="finger")
    ElementTree.SubElement(finger, "axis", xyz="1 0 0")  # along which the pads close
    ElementTree.SubElement(finger, "limit", lower="0", upper=repr(arm.gripper.open / 2), velocity="1", effort="1")
    return ElementTree.tostring(robot, encoding="unicode")


def _text(vector: Array) -> str:
    return " ".join(repr(float(one)) for one in vector)


def _angles(pose: Array) -> Array:
    """Roll, pitch and yaw [rad] of a pose (4, 4), as URDF has them: about the fixed x, then y, then z axis."""
    pitch = math.atan2(-pose[2, 0], math.hypot(pose[0, 0], pose[1, 0]))
    if math.hypot(pose[0, 0], pose[1, 0]) < 1e-9:  # roll and yaw are about the same axis
        return np.array([math.atan2(-pose[1, 2], pose[1, 1]), pitch, 0.0])
    return np.array([math.atan2(pose[2, 1], pose[2, 2]), pitch, math.atan2(pose[1, 0], pose[0, 0])])
