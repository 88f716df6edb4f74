"""Read plain finite numbers from ROS messages, and write them: message dicts only, no profile, no socket.

Every error names the field, what was expected and what was found.
"""

import math
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.core.wording import brief
from bam_envs.ros.interfaces import variants

Array = NDArray[np.float64]
Message = Mapping[str, Any]
_YAW = re.compile(r"yaw\((.+)\)")
_NANO = 1_000_000_000
_OBJECT = (dict, Mapping)  # dict first: a check for Mapping takes ten times as long


@cache
def has_header(kind: str) -> bool:
    """Whether messages of type `kind` have a stamp and a frame_id."""
    fields = {field.name for spelling in variants(bare_type(kind)) for field in spelling}
    return "header" in fields or kind.endswith("Stamped")


def same_type(one: str, other: str) -> bool:
    """Whether two types are equal, ignoring ``/msg/`` and ``Stamped``."""
    return bare_type(one).removesuffix("Stamped") == bare_type(other).removesuffix("Stamped")


def bare_type(kind: str) -> str:
    """The type without ``/msg/``, ``/action/`` and ``/srv/``: ``pkg/Type``."""
    return "/".join(part for part in kind.split("/") if part not in ("msg", "action", "srv"))


def require_message(message: object, where: str) -> Message:
    """`message`, which must be an object with fields."""
    if not isinstance(message, _OBJECT):
        raise ProtocolError(f"{where}: a message must be an object with fields, not {brief(message)}.")
    return message


_FIRST = "[0]"
"""Ends a step of a path that is a list, of which the first is meant."""


def value_at(message: Message, path: str, where: str) -> Any:
    """The value at `path`, e.g. ``pose.position.x`` or ``command.position[0]``, the first of a list.

    In a stamped message, `path` is that of the unstamped type.
    """
    steps = path.split(".")
    value: Any = message
    if steps[0] not in message and len(message) == 2 and "header" in message:  # a PoseStamped: a header and a Pose
        body = next(part for name, part in message.items() if name != "header")
        value = body if isinstance(body, _OBJECT) else message
    for step in steps:
        name = step.removesuffix(_FIRST)
        if not isinstance(value, _OBJECT) or name not in value:
            found = ", ".join(map(str, value)) if isinstance(value, _OBJECT) else brief(value)
            raise ProtocolError(f"{where}: the field {path} is missing; found: {found}.")
        value = value[name]
        if name != step:
            if not isinstance(value, (list, tuple)) or not value:
                raise ProtocolError(f"{where}: {name} must be a list with a value, not {brief(value)}.")
            value = value[0]
    return value


@cache
def _quaternion(path: str) -> tuple[str, ...]:
    """For ``yaw(path)`` the paths of x, y, z, w; empty for any other path."""
    angle = _YAW.fullmatch(path)
    return () if angle is None else tuple(f"{angle.group(1)}.{axis}" for axis in "xyzw")


def number_at(message: Message, path: str, where: str) -> float:
    """The finite number at `path`; for ``yaw(path)`` the angle about z [rad] of the quaternion there."""
    quaternion = _quaternion(path)
    if not quaternion:
        return number(value_at(message, path, where), f"{where}: {path}")
    x, y, z, w = (number_at(message, axis, where) for axis in quaternion)
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def number(value: object, where: str, *, missing: float | None = None) -> float:
    """`value`, which must be a plain finite number; null, NaN and infinities become `missing`, if it is given."""
    if missing is not None and (value is None or (isinstance(value, float) and not math.isfinite(value))):
        return missing
    if isinstance(value, (float, int, np.integer, np.floating)) and not isinstance(value, bool):
        try:
            result = float(value)
        except OverflowError:
            result = math.inf
        if math.isfinite(result):
            return result
    raise ProtocolError(f"{where} must be a finite number, not {brief(value)}.")


def numbers(value: object, where: str, *, names: Sequence[str] = (), missing: float | None = None) -> Array:
    """The list `value` of plain finite numbers, which may have `names`; shape (k,). For `missing` see `number`."""
    if isinstance(value, np.ndarray) and value.ndim == 1:
        value = value.tolist()
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes, bytearray)):
        raise ProtocolError(f"{where} must be a list of numbers, not {brief(value)}.")
    if set(map(type, value)) == {float} and math.isfinite(sum(value)):  # nearly always; a finite sum has finite terms
        return np.array(value)
    places = [f"{where} of {name}" for name in names] or [f"{where}[{place}]" for place in range(len(value))]
    checked = [number(one, place, missing=missing) for one, place in zip(value, places, strict=True)]
    return np.array(checked, dtype=np.float64)


def names_of(message: Message, field: str, where: str) -> list[str]:
    """The list of names in `field`, each once."""
    names = value_at(message, field, where)
    if not isinstance(names, Sequence) or isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise ProtocolError(f"{where}: {field} must be a list of names, not {brief(names)}.")
    for name in names if len(set(names)) < len(names) else ():
        if names.count(name) > 1:
            raise ProtocolError(f"{where}: {name} comes twice in {field}.")
    return list(names)


def numbers_of(
    names: Sequence[str],
    message: Message,
    field: str,
    found: list[str],
    where: str,
    ignore: Sequence[str] = (),
    missing: float | None = None,
) -> Array:
    """The numbers of `names` in the list `field`, which has one for each of the names `found`; shape (k,).

    Other names are allowed only if they are in `ignore`. For `missing` see `number`.
    """
    if absent := [name for name in names if name not in found]:
        raise ProtocolError(f"{where}: {', '.join(absent)} missing; found: {', '.join(found) or 'no name'}.")
    if extra := [name for name in found if name not in names and name not in ignore]:
        raise ProtocolError(
            f"{where}: {', '.join(extra)} not expected; expected: {', '.join(names)}. "
            f"List the names of others in ignore of the profile."
        )
    values = value_at(message, field, where)
    if not isinstance(values, (list, tuple, np.ndarray)) or len(values) != len(found):
        length = f"{len(values)} numbers" if isinstance(values, (list, tuple, np.ndarray)) else brief(values)
        raise ProtocolError(f"{where}: {field} must have {len(found)} numbers, one for each name, not {length}.")
    place = dict(zip(found, values, strict=True))
    return numbers([place[name] for name in names], f"{where}: {field}", names=names, missing=missing)


def require_frame(frame: str, message: Message, where: str) -> None:
    """Refuse a `message` whose header names another frame, or none; ROS 1 may write a slash before it."""
    header = message.get("header")
    found = header.get("frame_id") if isinstance(header, _OBJECT) else None
    if found == frame or (isinstance(found, str) and found.lstrip("/") == frame):
        return
    raise ProtocolError(
        f"{where}: header.frame_id must be {frame!r}, not {brief(found)}: a pose in another frame is another place "
        f"(a UR's base is its base_link turned by 180 degrees about z). Publish it in {frame}; if that frame has "
        f"another name there, give the name under [frames] of the profile."
    )


def put_at(message: dict[str, Any], path: str, value: Any) -> None:
    """Write `value` at `path`; at ``yaw(path)`` the quaternion of that angle about z."""
    quaternion = _quaternion(path)
    if quaternion:
        for axis, part in zip(quaternion, (0.0, 0.0, math.sin(value / 2), math.cos(value / 2)), strict=True):
            put_at(message, axis, part)
        return
    *above, name = path.split(".")
    for step in above:
        message = message.setdefault(step, {})
    message[name.removesuffix(_FIRST)] = [value] if name.endswith(_FIRST) else value


def read_stamp(message: Message, where: str) -> float | None:
    """The stamp of a message [s], in the spelling of ROS 1 or ROS 2; None without one, or if it is 0."""
    header = message.get("header")
    stamp = header.get("stamp") if isinstance(header, _OBJECT) else None
    if stamp is None:
        return None
    require_message(stamp, f"{where}: header.stamp")
    names = ("secs" if "secs" in stamp else "sec", "nsecs" if "nsecs" in stamp else "nanosec")
    if not stamp.keys() >= {*names}:
        raise ProtocolError(f"{where}: header.stamp must have {' and '.join(names)}; found: {', '.join(stamp)}.")
    seconds, nano = (number(stamp[name], f"{where}: header.stamp.{name}") for name in names)
    if seconds < 0 or not 0 <= nano < _NANO:
        raise ProtocolError(f"{where}: header.stamp must be seconds and nanoseconds, not {brief(stamp)}.")
    return seconds + nano / _NANO or None


def write_stamp(seconds: float, *, ros1: bool = False) -> dict[str, int]:
    """A stamp [s] in the spelling of ROS 2, or ROS 1."""
    whole = math.floor(seconds)
    nano = min(round((seconds - whole) * _NANO), _NANO - 1)
    return {"secs": whole, "nsecs": nano} if ros1 else {"sec": whole, "nanosec": nano}


def tag_text(message: Message) -> object:
    """The text that may be a tag: ``header.frame_id``, or the label of the first dimension of an array."""
    header, layout = message.get("header"), message.get("layout")
    if isinstance(header, _OBJECT):
        return header.get("frame_id")
    dimensions = layout.get("dim") if isinstance(layout, _OBJECT) else None
    if isinstance(dimensions, Sequence) and dimensions and isinstance(dimensions[0], _OBJECT):
        return dimensions[0].get("label")
    return None
