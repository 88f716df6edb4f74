"""Commands as messages of each type that can carry one, and back: raw numbers of one sink, no units.

A type that holds a list of numbers has a function to write it and one to read it here; all others are written and read
field by field (``fields`` of the sink).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.core.wording import brief
from bam_envs.ros.messages import (
    has_header,
    names_of,
    number_at,
    numbers,
    put_at,
    require_message,
    require_names,
    value_at,
    write_stamp,
)
from bam_envs.ros.profile_tables import Sink

Array = NDArray[np.float64]
Message = Mapping[str, Any]
_ARRAYS = ("std_msgs/Float64MultiArray", "std_msgs/Float32MultiArray")
_JOINTS = "sensor_msgs/JointState"
_TRAJECTORY = "trajectory_msgs/JointTrajectory"
LISTED_TYPES = frozenset({*_ARRAYS, _JOINTS, _TRAJECTORY})
"""Types of commands that are lists of numbers; those of all other types need `fields`."""


def has_room(kind: str) -> bool:
    """Whether a message of type `kind` has a field for a tag."""
    return kind in _ARRAYS or has_header(kind)


def write_command(sink: Sink, values: list[float], text: str, period: float, *, ros1: bool = False) -> dict[str, Any]:
    """The message that carries raw numbers.

    Args:
        sink: Where it goes.
        values: In the order of the sink's labels.
        text: The tag, or nothing; left out where the type has no room for one.
        period: Time between two commands [s].
        ros1: Whether stamps are spelled as in ROS 1.
    """
    header = {"stamp": write_stamp(0.0, ros1=ros1), "frame_id": text}  # the stamp 0 means at once
    names = list(sink.names)
    if sink.fields:
        return _write_fields(sink, values, header)
    if sink.type in _ARRAYS:
        dimension = {"label": text, "size": len(values), "stride": len(values)}
        return {"layout": {"dim": [dimension], "data_offset": 0}, "data": values}
    if sink.type == _JOINTS:
        return {"header": header, "name": names, "position": values, "velocity": [], "effort": []}
    reached = write_stamp(sink.reach_at(period), ros1=ros1)
    point = {"positions": values, "velocities": [], "accelerations": [], "effort": [], "time_from_start": reached}
    return {"header": header, "joint_names": names, "points": [point]}


def _write_fields(sink: Sink, values: list[float], header: dict[str, Any]) -> dict[str, Any]:
    stamped = has_header(sink.type)
    message: dict[str, Any] = {"header": header} if stamped else {}
    if sink.type in ("geometry_msgs/Twist", "geometry_msgs/TwistStamped"):  # all six numbers, whichever are commanded
        twist = {part: dict.fromkeys("xyz", 0.0) for part in ("linear", "angular")}
        message.update({"twist": twist} if stamped else twist)
    for path, value in zip(sink.fields, values, strict=True):
        put_at(message, path, value)
    return message


def read_command(sink: Sink, message: Message) -> Array:
    """The raw numbers in `message`, in the order of the labels of `sink`. Shape: (k,).

    Raises:
        ProtocolError: It is not such a message, or a number is not finite.
    """
    if sink.fields:
        return np.array([number_at(message, path, sink.topic) for path in sink.fields])
    if sink.type in _ARRAYS:
        return _read_array(sink, message)
    if sink.type == _JOINTS:
        return _named(sink, message, names_of(message, "name", sink.topic), "position")
    names, points = names_of(message, "joint_names", sink.topic), value_at(message, "points", sink.topic)
    if not isinstance(points, list) or len(points) != 1:
        found = f"{len(points)}" if isinstance(points, list) else brief(points)
        raise ProtocolError(f"{sink.topic}: points must be a list of 1 point, not {found}.")
    return _named(sink, require_message(points[0], f"{sink.topic}: points[0]"), names, "positions")


def _read_array(sink: Sink, message: Message) -> Array:
    values = numbers(value_at(message, "data", sink.topic), f"{sink.topic}: data")
    if len(values) != len(sink.labels):
        expected = f"{len(sink.labels)} ({', '.join(sink.labels)})"
        raise ProtocolError(f"{sink.topic}: data must have {expected} numbers, not {len(values)}.")
    return values


def _named(sink: Sink, message: Message, names: list[str], field: str) -> Array:
    """The numbers of `field`, which come in the order of `names`, in the order of the sink."""
    require_names(sink.names, names, sink.topic)
    values = numbers(value_at(message, field, sink.topic), f"{sink.topic}: {field}")
    if len(values) != len(names):
        raise ProtocolError(f"{sink.topic}: {field} must have {len(names)} numbers, not {len(values)}.")
    return values[[names.index(name) for name in sink.names]]
