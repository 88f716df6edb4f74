"""Which robot is at an address, and what shows that commands of an arm reach the joints that are meant.

A message either names its joints, or depends on the order in which a controller lists them, which the robot's side is
asked for. A trajectory controller tells where it measures its joints, which must be where the profile reads them. Sign,
offset and unit show in a small motion (`SafeRobot.prove`), which is safe where a message says in which time a position
is to be reached. What was proved is remembered for the same robot with the same controllers.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import queue
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NotReady, ProtocolError, RemoteError
from bam_envs.core.location import config_folder, is_one_robot
from bam_envs.live import bringup
from bam_envs.ros.codec import RobotInfo, decode_source, from_si
from bam_envs.ros.messages import same_type
from bam_envs.ros.profile_tables import RobotProfile, Sink
from bam_envs.rosbridge.bus import Message
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.ros_bus import RosBus
from bam_envs.safety.first_motion import MOST

_LOG = logging.getLogger(__name__)
BOOL = 1
"""`type` of a boolean in rcl_interfaces/ParameterValue."""
ANSWER_WITHIN = 2.0
"""Longest wait for the answer of a service of the robot's side [s]."""
STATE = "control_msgs/JointTrajectoryControllerState"
"""Type of the topic on which a trajectory controller tells where its joints are."""


@dataclass(frozen=True)
class Controllers:
    """What a robot's side tells of the controllers that take its commands."""

    listed: tuple[Mapping[str, Any], ...]
    """The controllers by the service of `RobotProfile.controllers`; empty if it does not answer."""
    joints: Mapping[str, tuple[str, ...] | None]
    """Topic of a command whose numbers have no names -> its joints in the order of its controller; None: not told."""
    from_measured: tuple[str, ...] = ()
    """Controllers that begin each trajectory where the arm is measured, and so jerk it back with every command."""
    apart: str = ""
    """How one of them measures a joint elsewhere than the profile reads it; empty if that is not known of any."""

    def fault(self, profile: RobotProfile, sinks: Sequence[Sink]) -> str:
        """Why a command of `sinks` might reach another joint than is meant; empty if it cannot."""
        if self.apart:
            return self.apart
        for sink in sinks:
            if sink.topic not in self.joints:
                continue
            joints, sent = self.joints[sink.topic], ", ".join(sink.names)
            if joints is None:
                return (
                    f"nothing tells in which order {sink.topic} takes {sent}: the parameter joints of "
                    f"{_controller(sink)} cannot be read here{_remedy(profile)}"
                )
            if joints != sink.names:
                return (
                    f"{_controller(sink)} takes the joints in the order {', '.join(joints)}, and the profile "
                    f"{profile.name} sends {sent}: give the labels of {sink.topic} in that order"
                )
        return ""


def ask_controllers(link: RosBus, profile: RobotProfile, sinks: Sequence[Sink], joints: Any = None) -> Controllers:
    """Ask the robot's side about the controllers that take the commands of `sinks`. Moves nothing.

    `joints` is a message with the measured joints, with which they are compared; None: they are not.
    """
    answer = _ask(link, link.namespace + profile.controllers, "", {}) if profile.controllers else {}
    rows: Any = answer.get("controller")
    listed = tuple(one for one in rows if isinstance(one, Mapping)) if isinstance(rows, list) else ()
    order = {sink.topic: _joints(link, listed, _controller(sink)) for sink in sinks if not sink.is_named}
    timed = [sink for sink in sinks if sink.is_timed]
    from_measured = tuple(name for name in map(_controller, timed) if _begins_where_measured(link, name))
    apart = [] if joints is None else [_apart(link, profile, sink, joints) for sink in timed]
    return Controllers(listed, order, from_measured, next(filter(None, apart), ""))


def _controller(sink: Sink) -> str:
    """The controller of `sink`: as the profile says, or as its topic is called."""
    return sink.controller or sink.topic.strip("/").rpartition("/")[0]


def _parameters(link: RosBus, controller: str, *names: str) -> list[Any]:
    """The parameters of a controller of ROS 2 (rcl_interfaces/ParameterValue), in their order; empty if unknown."""
    service = f"{link.namespace}/{controller}/get_parameters"
    values: Any = _ask(link, service, "rcl_interfaces/srv/GetParameters", {"names": list(names)}).get("values")
    readable = isinstance(values, list) and all(isinstance(one, Mapping) for one in values)
    return values if readable else []


def _begins_where_measured(link: RosBus, controller: str) -> bool:
    """Whether it is known that a trajectory controller does not begin at its last set point."""
    found = _parameters(link, controller, "interpolate_from_desired_state", "open_loop_control")
    known = [one.get("bool_value") for one in found if one.get("type") == BOOL]
    return bool(known) and not any(known)


def _apart(link: RosBus, profile: RobotProfile, sink: Sink, joints: Any) -> str:
    """How the controller of `sink` measures a joint elsewhere than `profile` reads it in the message `joints`."""
    source, labels = profile.source("joint_position"), profile.signal("joint_position").labels
    base = f"{link.namespace}/{_controller(sink)}"
    names = (f"{base}/controller_state", f"{base}/state")
    types = {name: _ask(link, "/rosapi/topic_type", "rosapi/TopicType", {"topic": name}).get("type") for name in names}
    topics = [name for name, kind in types.items() if same_type(str(kind), STATE)]
    state = _first(link, topics[0], STATE) if topics else None
    try:
        here = dict(zip(labels, decode_source(source, joints, len(labels)).tolist(), strict=True))
        measured: Any = (state or {}).get("feedback") or (state or {})["actual"]
        there = dict(zip((state or {})["joint_names"], measured["positions"], strict=True))
        read = from_si(sink, np.array([here[label] for label in sink.labels]))
        gaps = {name: (float(there[name]), at) for name, at in zip(sink.names, read, strict=True)}
    except (KeyError, TypeError, ValueError, ProtocolError):  # it does not tell
        return ""
    for name, (theirs, ours) in gaps.items():
        if abs(theirs - ours) > MOST:
            return (
                f"{_controller(sink)} measures {name} at {theirs:.3f} rad, and the profile {profile.name} reads "
                f"{ours:.3f} rad: another joint, sign, offset or scale in the profile, or in the driver"
            )
    return ""


def _joints(link: RosBus, listed: Sequence[Mapping[str, Any]], controller: str) -> tuple[str, ...] | None:
    """The joints of `controller` in its own order: by its interfaces, by its parameter, or by rosapi; None: unknown."""
    if not controller:
        return None
    for row in listed:
        interfaces = row.get("required_command_interfaces")
        if row.get("name") == controller and isinstance(interfaces, list) and interfaces:
            return tuple(str(one).rpartition("/")[0] for one in interfaces)
    values = _parameters(link, controller, "joints")
    found: Any = values[0] if values else {}
    if not values:
        separator = "/" if link.ros == "ros1" else ":"
        name = {"name": f"{link.namespace}/{controller}{separator}joints"}
        text: Any = _ask(link, "/rosapi/get_param", "rosapi/GetParam", name).get("value")
        try:
            found = {"string_array_value": json.loads(text)} if isinstance(text, str) else {}
        except ValueError:
            found = {}
    joints = found.get("string_array_value")
    return tuple(map(str, joints)) if isinstance(joints, list) and joints else None


def _ask(link: RosBus, service: str, kind: str, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """The answer of a service of the robot's side; empty if it does not exist or cannot be read."""
    try:
        return link.call(service, kind, request, ANSWER_WITHIN)
    except LinkLost:
        if not link.is_up:
            raise
        return {}
    except BamEnvsError:
        return {}


def _remedy(profile: RobotProfile) -> str:
    named = [mode for mode, sinks in profile.commands.items() if all(sink.is_named for sink in sinks)]
    return f"; the mode {named[0]} of the profile {profile.name} names the joints" if named else ""


def needed_proof(
    link: RosBus,
    info: RobotInfo | None,
    profile: RobotProfile,
    sinks: Sequence[Sink],
    endpoint: Endpoint,
    identity: str | None = None,
    joints: Any = None,
) -> CommandProof | None:
    """The proof that a real arm needs before it moves; None for others, and for an arm of a live agent, which has it.

    Args:
        link: A connection to the robot's side, which is asked for its controllers.
        info: The robot's description of itself, if it has one.
        profile: The profile of the robot, narrowed to the commands of the task.
        sinks: The topics of its commands.
        endpoint: The address of the robot.
        identity: Its serial number or name, empty if neither is known; None: it is asked for.
        joints: The newest message with its measured joints; None: there is none.
    """
    if (info is not None and (info.simulated or info.agent)) or not _joint_labels(profile):
        return None
    identity = robot_identity(endpoint, profile, info) if identity is None else identity
    is_one = is_one_robot(endpoint.url, identity)
    return CommandProof(profile, sinks, ask_controllers(link, profile, sinks, joints), identity or endpoint.url, is_one)


class CommandProof:
    """The proof of one arm's commands; `SafeRobot.prove` makes it once a connection.

    Args:
        profile: The profile of the arm, narrowed to the commands of the task.
        sinks: The topics of its commands.
        controllers: What its side tells of the controllers.
        robot: The name by which the robot is known.
        is_one: Whether one robot only is known by that name; otherwise nothing is remembered.
    """

    def __init__(
        self,
        profile: RobotProfile,
        sinks: Sequence[Sink],
        controllers: Controllers,
        robot: str,
        is_one: bool = True,
    ) -> None:
        arm = [sink for sink in sinks if set(sink.labels) & set(_joint_labels(profile))]
        self.is_timed = all(sink.is_timed for sink in arm)
        """Whether a command says in which time it is to be reached."""
        self.is_done = False
        """Whether the commands were proved in this connection."""
        self.order_fault = controllers.fault(profile, arm)
        """Why a command might reach another joint than is meant; empty if it cannot."""
        self._robot, self._topics = robot, ", ".join(sink.topic for sink in arm)
        self.from_measured = controllers.from_measured
        """See `Controllers.from_measured`."""
        self._remedy, self.key = _timed_remedy(profile), _key(profile, arm, controllers, robot)
        """Digest of everything that a proof is about."""
        self._file = config_folder() / "proofs" / f"{self.key}.json" if is_one else None
        self.since = "" if self._file is None else _remembered(self._file)
        """When the commands were proved, as text; empty if they were not."""

    @property
    def is_known(self) -> bool:
        """Whether the commands were proved before, of this robot with these controllers."""
        return bool(self.since)

    @property
    def fault(self) -> str:
        """Why the commands cannot be proved without a motion that may be large; empty if they can, or were."""
        if self.order_fault or self.is_timed or self.is_known:
            return self.order_fault
        named = "" if self._file is not None else ", and name it with --robot-name, or that is not remembered"
        return (
            f"{self._topics} executes a position at once, so that a wrong sign or offset would swing the arm, and "
            f"nothing has shown them yet{self._remedy}{named}"
        )

    def require_provable(self) -> None:
        """`NotReady` if nothing may be sent."""
        if self.fault:
            raise NotReady(f"The commands of {self._robot} are not proved: {self.fault}. Nothing has moved.")

    def done(self, lag: float) -> None:
        """Remember that the commands are proved; `lag` is the measured delay of the arm behind them [s]."""
        self.is_done = True
        if self.is_known or self._file is None:
            return
        self.since = time.strftime("%Y-%m-%d %H:%M")
        try:
            _write(
                self._file, {"robot": self._robot, "topics": self._topics, "proved": self.since, "lag": round(lag, 4)}
            )
        except OSError as error:
            _LOG.warning("That the commands are proved is not remembered: %s: %s.", self._file, error.strerror or error)


def _joint_labels(profile: RobotProfile) -> list[str]:
    return [label for label, unit in zip(profile.command.labels, profile.command.units, strict=True) if unit == "rad"]


def _timed_remedy(profile: RobotProfile) -> str:
    timed = [mode for mode, sinks in profile.commands.items() if any(sink.is_timed for sink in sinks)]
    if timed:
        return (
            f": drive it once in the mode {timed[0]} of the profile {profile.name}, which proves them in a small motion"
        )
    return ": give the profile a mode with trajectory_msgs/JointTrajectory, and drive it once in that mode"


def _key(profile: RobotProfile, arm: Sequence[Sink], controllers: Controllers, robot: str) -> str:
    """Digest of the robot, its controllers, and how the profile reads its joints and writes its commands."""
    source = next((asdict(one) for one in profile.state if one.signal == "joint_position"), {})
    numbers = sorted(row for one in arm for row in zip(one.labels, one.names, one.scale, one.offset, strict=True))
    rows = ("name", "type", "required_command_interfaces")
    listed = sorted(json.dumps([row.get(key) for key in rows], default=str) for row in controllers.listed)
    text = json.dumps([robot, source, numbers, listed], default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _remembered(file: Path) -> str:
    try:
        found: Any = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ""
    return str(found.get("proved", "")) if isinstance(found, dict) else ""


def _write(file: Path, row: Mapping[str, Any]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=file.parent)
    with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
        json.dump(row, stream)
    os.replace(name, file)


# ---- which robot it is: its serial number or name, as it tells it, or else as its operator does

NAME_WITHIN = 1.5
"""Longest wait for the topic on which a robot repeats its name [s]."""


def robot_identity(endpoint: Endpoint, profile: RobotProfile, info: RobotInfo | None) -> str:
    """The serial number or name of the robot at `endpoint`; empty if neither is known.

    A robot without a description that tells it is asked as its profile says, over a connection of its own: with a ROS 2
    bridge, a service that does not answer holds up everything else on its connection.

    Raises:
        InvalidValue: It tells another one than `Endpoint.robot_name`.
        NoServer: There is no usable server.
    """
    told = "" if info is None else info.identity
    if not told and profile.identity and not (info is not None and info.simulated):
        link = RosbridgeLink(endpoint, name="identity")
        with closing(link):
            link.connect()
            told = _asked(link, profile)
    if told and endpoint.robot_name not in ("", told):
        raise InvalidValue(
            f"The robot at {endpoint.url} says that it is {told}, not {endpoint.robot_name}: correct the name, or the "
            "address. Nothing has moved."
        )
    return told or endpoint.robot_name


def _asked(link: RosbridgeLink, profile: RobotProfile) -> str:
    """What the first source of `profile` that has an answer tells; empty if none has."""
    types = bringup.TopicTypes(link, profile, bringup.TIMEOUT)
    for source in profile.identity:
        message: Any = None
        if source.topic and types.may_be(link.namespace + source.topic, source.type):
            message = _first(link, link.namespace + source.topic, source.type)
        elif source.service:
            with suppress(LinkLost, RemoteError):
                message = bringup.ask(link, link.namespace + source.service, request=source.request)
        if found := source.identity(message):
            return found
    return ""


def _first(link: RosBus, topic: str, kind: str) -> Message | None:
    """The first message on `topic` within `NAME_WITHIN`; None if there is none."""
    came: queue.SimpleQueue[Message] = queue.SimpleQueue()
    leave = link.subscribe(topic, kind, lambda message, caller: came.put(message))
    try:
        return came.get(timeout=NAME_WITHIN)
    except queue.Empty:
        return None
    finally:
        leave()
