"""States and commands as ROS messages and back, according to a profile: pure functions on dicts and arrays.

Command types that hold a list of numbers are encoded here one by one; all others go field by field.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.core.robot import RobotSpec, RobotState
from bam_envs.core.validation import NonNegative, Positive, RobotName, read_table
from bam_envs.core.wording import brief
from bam_envs.ros.freshness import Tag, read_tag
from bam_envs.ros.messages import (
    has_header,
    names_of,
    number_at,
    numbers,
    numbers_of,
    put_at,
    require_frame,
    require_message,
    tag_text,
    value_at,
    write_stamp,
)
from bam_envs.ros.profile_tables import Content, RobotProfile, Sink, Source

Array = NDArray[np.float64]
Message = Mapping[str, Any]
Envelope = tuple[str, str, dict[str, Any]]  # topic, type, message
Sign = Callable[[Tag, str, bytes], str]  # the text of a tag on a topic with that content; `Tagger.sign` is one
INFO_SERVICE = "/bam/robot"  # describes a served robot (std_srvs/Trigger; `RobotInfo` in its message)
SERVES, A_POLICY = "serves", "a policy"  # where there is no robot: the key of what is served there, and a policy
AGENT_TOPIC = "/bam/agent"
"""Requests to the live agent of a robot: who drives, take over, hand back; see `bam_envs.live.take_over`."""
AGENT_STEP_TOPIC = "/bam/agent/step"
"""The steps of the environment of whoever has taken over from a live agent, for a learner (std_msgs/String of JSON)."""
DESCRIPTION_TOPIC = "/robot_description"  # the URDF of the robot (std_msgs/String), latched
HALT_TOPIC = "/bam/halt"  # stops a served robot (std_msgs/Empty)
STATUS_TOPIC = "/bam/status"  # what the guards did in each tick (std_msgs/String of JSON), sent by the client
SCENE_TOPIC = "/bam/scene"
"""Sets the scene of a simulated robot for an episode, by requests on ``…/request`` and replies on ``…/reply``."""
_ARRAYS = ("std_msgs/Float64MultiArray", "std_msgs/Float32MultiArray")
_JOINTS = "sensor_msgs/JointState"
LISTED_TYPES = frozenset({*_ARRAYS, _JOINTS, "trajectory_msgs/JointTrajectory"})
"""Types of commands that are lists of numbers; those of all other types need `fields`."""


def has_room(kind: str) -> bool:
    """Whether a message of type `kind` has a field for a tag."""
    return kind in _ARRAYS or has_header(kind)


@dataclass(frozen=True)
class RobotInfo:
    """A robot's description of itself."""

    name: str
    simulated: bool = False  # whether no real robot moves
    lockstep: bool = False  # whether its time advances only with commands, one period each
    period: Positive | None = None  # time between two commands [s], if reported
    text: str = ""  # one line for people
    watchdog: NonNegative | None = None  # time after which it stops by itself without a command [s], if known
    agent: bool = False  # whether a live agent drives it, from which a person takes over (`AGENT_TOPIC`)
    identity: RobotName = ""  # its serial number, or the name that its operator gave; empty if neither is known

    def to_json(self) -> str:
        """The text for the answer of `INFO_SERVICE`."""
        return json.dumps(asdict(self))


def read_info(text: object, where: str) -> RobotInfo:
    """The `RobotInfo` in `text`, without keys of a newer version.

    Raises:
        ProtocolError: Something without a robot is served there, or it is no description.
    """
    data = _table_in(text)
    if isinstance(data.get(SERVES), str):
        raise ProtocolError(f"{where}: {not_wanted(text, 'robot')}")
    if not isinstance(data.get("name"), str):
        raise ProtocolError(f"{where}: the answer must describe the robot, not {brief(text)}.")
    known = {key: data[key] for key in RobotInfo.__dataclass_fields__ if key in data}
    return read_table(RobotInfo, known, where, ProtocolError)


def not_wanted(text: object, wanted: str) -> str:
    """What a server is by its answer of `INFO_SERVICE`, instead of the one that was `wanted`, and what takes it.

    Empty if the answer does not tell.
    """
    data = _table_in(text)
    served, name = data.get(SERVES), data.get("name")
    if served == A_POLICY:
        what, use = "a policy server", "give its address as --policy-server"
    elif isinstance(served, str):
        what, use = f"the environment {brief(served)}", "give its address as --transport"
    elif not isinstance(name, str):
        return ""
    elif data.get("agent"):
        what, use = f"a live agent (bam-agent) with {name}", "push to it with bam-push; --robot takes over from it"
    else:
        what, use = f"the robot {name}", "give its address as --robot"
    return f"that is {what}, and no {wanted}; {use}."


def _table_in(text: object) -> dict[str, Any]:
    try:
        data = json.loads(text) if isinstance(text, str) else None
    except ValueError:
        data = None
    return data if isinstance(data, dict) else {}


def decode_source(source: Source, message: object, size: int) -> Array:
    """The `size` numbers [SI] of one signal, shape (size,). `ProtocolError` names topic, field or joint, and value."""
    where = source.topic
    content = require_message(message, where)
    if source.fields:
        raw = np.array([number_at(content, path, where) for path in source.fields])
    elif source.names:
        names = names_of(content, "name", where)
        raw = numbers_of(source.names, content, source.field, names, where, source.ignore, source.missing)
    else:
        raw = numbers(value_at(content, source.field, where), f"{where}: {source.field}", missing=source.missing)
        first, last = source.skip
        if len(raw) != size + first + last:
            raise ProtocolError(f"{where}: {source.field} must have {size + first + last} numbers, not {len(raw)}.")
        raw = raw[first : first + size]
    if source.frame:
        require_frame(source.frame, content, where)
    return _to_si(source, raw if source.within is None else np.clip(raw, *source.within))


def _to_si(entry: Content, raw: Array) -> Array:
    return np.asarray(raw * entry.scale + entry.offset)


def from_si(entry: Content, values: Array) -> list[float]:
    """The numbers on the wire for `values` [SI]. Shape: (k,)."""
    return list(((values - entry.offset) / entry.scale).tolist())


def encode_state(
    profile: RobotProfile, state: RobotState, env_id: int, stamp: Mapping[str, int], tag: str = ""
) -> list[Envelope]:
    """The messages that a served robot publishes for one environment of `state`; missing signals are left out.

    `stamp` has the spelling of ROS 1 or ROS 2. `tag`, the `Tag.echo` of the command that this state answers, goes into
    ``frame_id`` of the last message, which shows that all messages have arrived.
    """
    messages: dict[tuple[str, tuple[str, ...]], Envelope] = {}
    read = {name for source in profile.state for name in source.names}
    lists: dict[tuple[str, tuple[str, ...]], dict[str, dict[str, float]]] = {}  # of named numbers: by field and name
    for source in profile.state:
        if source.signal not in state.signals:
            continue
        # Drivers send the numbers of several joints in one message; publishers that share a topic, in their own.
        key = (source.topic, source.names if source.partial or not source.names else ())
        if key not in messages:
            header = {"header": {"stamp": dict(stamp), "frame_id": source.frame}} if has_header(source.type) else {}
            messages[key] = (source.topic, source.type, {**header, **source.constants})
        message, raw = messages[key][2], from_si(source, state.signals[source.signal][env_id])
        if source.fields:
            for path, value in zip(source.fields, raw, strict=True):
                put_at(message, path, value)
        elif source.names:
            values = lists.setdefault(key, {}).setdefault(source.field, {})
            values.update(zip(source.names, raw, strict=True))
            if len(raw) == 1:  # the other joints of a gripper move with the one that is read
                values.update(dict.fromkeys((name for name in source.ignore if name not in read), raw[0]))
        else:
            first, last = source.skip
            message[source.field] = [0.0] * first + raw + [0.0] * last
    for key, fields in lists.items():
        names = sorted({name for values in fields.values() for name in values})  # as the broadcaster of ros2_control
        messages[key][2]["name"] = names
        messages[key][2].update({field: [values.get(name, 0.0) for name in names] for field, values in fields.items()})
    stamped = [one for one in messages.values() if has_header(one[1]) and not one[2]["header"]["frame_id"]]
    if not stamped:
        return list(messages.values())
    stamped[0][2]["header"]["frame_id"] = tag
    return [envelope for envelope in messages.values() if envelope is not stamped[0]] + [stamped[0]]


def encode_sink(
    sink: Sink,
    spec: RobotSpec,
    command: Array,
    tag: Tag | None,
    *,
    sign: Sign | None = None,
    ros1: bool = False,
    reach: float | None = None,
) -> Envelope:
    """The message with the part of `command` (m,) [SI] for `sink`, with `tag`, which `sign` signs.

    `reach` is the time in which a trajectory's point is to be reached [s], at any speed; None: as the sink has it.
    """
    at_rest = reach is None and sink.is_spline(spec.period)
    reach = sink.reach_at(spec.period) if reach is None else reach
    raw, text = from_si(sink, command[_places(sink, spec)]), ""
    if tag is not None and sink.tag:
        content: list[float] | Array = raw
        if any("(" in path for path in sink.fields):  # an angle is written as a quaternion, and read with rounding
            content = _read_command(sink, _write_command(sink, raw, "", reach))
        text = tag.to_text() if sign is None else sign(tag, sink.address, _signed(content))
    return sink.address, sink.type, _write_command(sink, raw, text, reach, ros1=ros1, at_rest=at_rest)


def _write_command(
    sink: Sink, values: list[float], text: str, reach: float, *, ros1: bool = False, at_rest: bool = False
) -> dict[str, Any]:
    """The message that carries raw numbers, in the order of the sink's labels, the `text` of a tag, and `reach` [s]."""
    header = {"stamp": write_stamp(0.0, ros1=ros1), "frame_id": text}  # the stamp 0 means at once
    names = list(sink.names)
    if sink.fields:
        stamped = has_header(sink.type)
        message: dict[str, Any] = {"header": header} if stamped else {}
        if sink.type in ("geometry_msgs/Twist", "geometry_msgs/TwistStamped"):  # all six fields, commanded or not
            twist = {part: dict.fromkeys("xyz", 0.0) for part in ("linear", "angular")}
            message.update({"twist": twist} if stamped else twist)
        for path, constant in sink.constants.items():
            put_at(message, path, constant)
        for path, value in zip(sink.fields, values, strict=True):
            put_at(message, path, value)
        return message
    if sink.type in _ARRAYS:
        dimension = {"label": text, "size": len(values), "stride": len(values)}
        return {"layout": {"dim": [dimension], "data_offset": 0}, "data": values}
    if sink.type == _JOINTS:
        return {"header": header, "name": names, "position": values, "velocity": [], "effort": []}
    reached = write_stamp(reach, ros1=ros1)
    speeds = [0.0] * len(values) if at_rest else []
    point = {"positions": values, "velocities": speeds, "accelerations": [], "effort": [], "time_from_start": reached}
    return {"header": header, "joint_names": names, "points": [point]}


def _places(sink: Sink, spec: RobotSpec) -> list[int]:
    return [spec.command.labels.index(label) for label in sink.labels]


def _signed(raw: list[float] | Array) -> bytes:
    """The signed content of a command: its raw numbers (k,) in 32 bits, since some types have no more."""
    with np.errstate(over="ignore"):
        return np.asarray(raw, dtype="<f4").tobytes()


class Decoded(NamedTuple):
    """A decoded command message."""

    places: list[int]  # indices of its numbers in the command
    values: Array  # its numbers (k,) [SI]
    tag: Tag | None  # its tag, if it has one
    content: bytes  # the signed content; empty without a signature


def decode_command(profile: RobotProfile, spec: RobotSpec, topic: str, message: object) -> Decoded:
    """The command in a message on `topic`, a goal or a request; `ProtocolError` if it differs from the profile."""
    sink = profile.sinks_by_address.get(topic)
    if sink is None:
        raise ProtocolError(f"{topic}: {profile.name} takes no command on this topic.")
    content = require_message(message, topic)
    raw, tag = _read_command(sink, content), read_tag(tag_text(content))
    signed = _signed(raw) if tag is not None and tag.mac else b""
    return Decoded(_places(sink, spec), _to_si(sink, raw), tag, signed)


def _read_command(sink: Sink, message: Message) -> Array:
    """The raw numbers in `message`, in the order of the labels of `sink`. Shape: (k,)."""
    where = sink.address
    if sink.fields:
        return np.array([number_at(message, path, where) for path in sink.fields])
    if sink.type in _ARRAYS:
        values = numbers(value_at(message, "data", where), f"{where}: data")
        if len(values) != len(sink.labels):
            expected = f"{len(sink.labels)} ({', '.join(sink.labels)})"
            raise ProtocolError(f"{where}: data must have {expected} numbers, not {len(values)}.")
        return values
    if sink.type == _JOINTS:
        return numbers_of(sink.names, message, "position", names_of(message, "name", where), where)
    points = value_at(message, "points", where)
    if not isinstance(points, list) or len(points) != 1:
        found = f"{len(points)}" if isinstance(points, list) else brief(points)
        raise ProtocolError(f"{where}: points must be a list of 1 point, not {found}.")
    point = require_message(points[0], f"{where}: points[0]")
    return numbers_of(sink.names, point, "positions", names_of(message, "joint_names", where), where)
