"""Commands as messages of each type that can carry one, and back: raw numbers of one sink, no units.

A type that holds a list of numbers is a row of two small tables here; all others are written and read field by field
(``fields`` of the sink).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.ros.messages import (
    has_header,
    names_of,
    number_at,
    numbers,
    put_at,
    require_message,
    require_names,
    shown,
    value_at,
    write_stamp,
)
from bam_envs.ros.profile_tables import Sink

Array = NDArray[np.float64]
Message = Mapping[str, Any]
_AXES = ("x", "y", "z")
_TWIST = {"linear": dict.fromkeys(_AXES, 0.0), "angular": dict.fromkeys(_AXES, 0.0)}


@dataclass(frozen=True)
class _Draft:
    """What goes into a message."""

    sink: Sink
    values: list[float]
    """Raw numbers, in the order of the sink's labels."""
    text: str
    """The tag, or nothing."""
    period: float
    """Time between two commands [s]."""
    ros1: bool
    """How stamps are spelled."""

    def header(self) -> dict[str, Any]:
        """The stamp 0: it means at once."""
        return {"stamp": write_stamp(0.0, ros1=self.ros1), "frame_id": self.text}


def has_room(kind: str) -> bool:
    """Whether a message of type `kind` has a field for a tag."""
    return kind in _LABELLED or has_header(kind)


def write_command(sink: Sink, values: list[float], text: str, period: float, *, ros1: bool = False) -> dict[str, Any]:
    """The message that carries the raw `values` of `sink`, and the tag `text` where its type has room for one."""
    draft = _Draft(sink, values, text, period, ros1)
    return _write_fields(draft) if sink.fields else _WRITERS[sink.type](draft)


def read_command(sink: Sink, message: Message) -> Array:
    """The raw numbers in `message`, in the order of the labels of `sink`. Shape: (k,).

    Raises:
        ProtocolError: It is not such a message, or a number is not finite.
    """
    if sink.fields:
        return np.array([number_at(message, path, sink.topic) for path in sink.fields])
    return _READERS[sink.type](sink, message)


def _write_array(draft: _Draft) -> dict[str, Any]:
    size = len(draft.values)
    dimension = {"label": draft.text, "size": size, "stride": size}
    return {"layout": {"dim": [dimension], "data_offset": 0}, "data": draft.values}


def _write_joints(draft: _Draft) -> dict[str, Any]:
    names = list(draft.sink.names)
    return {"header": draft.header(), "name": names, "position": draft.values, "velocity": [], "effort": []}


def _write_trajectory(draft: _Draft) -> dict[str, Any]:
    """One point."""
    point = {"positions": draft.values, "velocities": [], "accelerations": [], "effort": []}
    timed = {**point, "time_from_start": write_stamp(draft.sink.reach_at(draft.period), ros1=draft.ros1)}
    return {"header": draft.header(), "joint_names": list(draft.sink.names), "points": [timed]}


def _write_fields(draft: _Draft) -> dict[str, Any]:
    sink = draft.sink
    message: dict[str, Any] = {"header": draft.header()} if has_header(sink.type) else {}
    if sink.type in ("geometry_msgs/Twist", "geometry_msgs/TwistStamped"):
        twist = {part: dict(axes) for part, axes in _TWIST.items()}
        message.update({"twist": twist} if has_header(sink.type) else twist)
    for path, value in zip(sink.fields, draft.values, strict=True):
        put_at(message, path, value)
    return message


def _read_array(sink: Sink, message: Message) -> Array:
    values = numbers(value_at(message, "data", sink.topic), f"{sink.topic}: data")
    if len(values) != len(sink.labels):
        expected = f"{len(sink.labels)} ({', '.join(sink.labels)})"
        raise ProtocolError(f"{sink.topic}: data must have {expected} numbers, not {len(values)}.")
    return values


def _read_joints(sink: Sink, message: Message) -> Array:
    return _named(sink, message, names_of(message, "name", sink.topic), "position")


def _read_trajectory(sink: Sink, message: Message) -> Array:
    names, points = names_of(message, "joint_names", sink.topic), value_at(message, "points", sink.topic)
    if not isinstance(points, list) or len(points) != 1:
        found = f"{len(points)}" if isinstance(points, list) else shown(points)
        raise ProtocolError(f"{sink.topic}: points must be a list of 1 point, not {found}.")
    return _named(sink, require_message(points[0], f"{sink.topic}: points[0]"), names, "positions")


def _named(sink: Sink, message: Message, names: list[str], field: str) -> Array:
    """The numbers of `field`, which come in the order of `names`, in the order of the sink."""
    require_names(sink.names, names, sink.topic)
    values = numbers(value_at(message, field, sink.topic), f"{sink.topic}: {field}")
    if len(values) != len(names):
        raise ProtocolError(f"{sink.topic}: {field} must have {len(names)} numbers, not {len(values)}.")
    return values[[names.index(name) for name in sink.names]]


_WRITERS: dict[str, Callable[[_Draft], dict[str, Any]]] = {
    "std_msgs/Float64MultiArray": _write_array,
    "std_msgs/Float32MultiArray": _write_array,
    "sensor_msgs/JointState": _write_joints,
    "trajectory_msgs/JointTrajectory": _write_trajectory,
}
_READERS: dict[str, Callable[[Sink, Message], Array]] = {
    "std_msgs/Float64MultiArray": _read_array,
    "std_msgs/Float32MultiArray": _read_array,
    "sensor_msgs/JointState": _read_joints,
    "trajectory_msgs/JointTrajectory": _read_trajectory,
}
_LABELLED = ("std_msgs/Float64MultiArray", "std_msgs/Float32MultiArray")
LISTED_TYPES = frozenset(_WRITERS)
"""Types of commands that are lists of numbers; those of all other types need `fields`."""
