"""States and commands as ROS messages and back, as a profile says: pure functions on dicts and arrays.

A live robot reads states and writes commands; a served one writes states and reads commands.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.core.robot import RobotSpec, RobotState
from bam_envs.core.validation import Positive, read_table
from bam_envs.core.wording import brief
from bam_envs.ros.command_messages import read_command, write_command
from bam_envs.ros.freshness import Tag, read_tag
from bam_envs.ros.messages import (
    has_header,
    names_of,
    number,
    number_at,
    numbers,
    put_at,
    require_frame,
    require_message,
    require_names,
    tag_text,
    usual_numbers,
    value_at,
)
from bam_envs.ros.profile_tables import RobotProfile, Sink, Source

Array = NDArray[np.float64]
Message = Mapping[str, Any]
Envelope = tuple[str, str, dict[str, Any]]
"""Topic, type, message."""
Sign = Callable[[Tag, str, bytes], str]
"""The text of a tag on a topic with that content; `Tagger.sign` is one."""
INFO_SERVICE = "/bam/robot"
"""Where a served robot says what it is (std_srvs/Trigger; `RobotInfo` in its message)."""
HALT_TOPIC = "/bam/halt"
"""Where a served robot hears that it must stop (std_msgs/Empty)."""
SCENE_TOPIC = "/bam/scene"
"""Where a simulated robot is told how an episode begins, by requests on ``request`` and replies on ``reply`` below."""


@dataclass(frozen=True)
class RobotInfo:
    """What a robot says of itself."""

    name: str
    """Its name."""
    simulated: bool = False
    """Whether nothing real moves."""
    lockstep: bool = False
    """Whether its time goes on only with commands, one period each."""
    period: Positive | None = None
    """Time between two commands [s], if it says."""
    text: str = ""
    """One line for people."""

    def to_json(self) -> str:
        """As it travels."""
        return json.dumps(asdict(self))


def read_info(text: object, where: str) -> RobotInfo:
    """The `RobotInfo` that `text` is; keys of a newer version are left out.

    Raises:
        ProtocolError: It is something else. Any text is true in Python, and what is simulated may be moved unasked.
    """
    try:
        data = json.loads(text) if isinstance(text, str) else None
    except ValueError:
        data = None
    if not isinstance(data, dict) or not isinstance(data.get("name"), str):
        raise ProtocolError(f"{where}: it must say what robot it is, and says {brief(text)}.")
    known = {key: data[key] for key in RobotInfo.__dataclass_fields__ if key in data}
    return read_table(RobotInfo, known, where, ProtocolError)


def decode_state(profile: RobotProfile, messages: Mapping[str, object]) -> dict[str, Array]:
    """Each signal's numbers [SI] from the message that holds it.

    Args:
        profile: The robot.
        messages: Signal -> the newest message of its topic.

    Returns:
        Signal -> numbers. Shape: (k,).

    Raises:
        ProtocolError: A message is not what the profile says; it names topic, field or joint, expected and found.
    """
    return {
        signal: decode_source(profile.source(signal), message, len(profile.signal(signal).labels))
        for signal, message in messages.items()
    }


def decode_source(source: Source, message: object, size: int) -> Array:
    """The `size` numbers [SI] of one signal. Shape: (size,). Errors as in `decode_state`."""
    where = source.topic
    content = require_message(message, where)
    if source.fields:
        raw = np.array([number_at(content, path, where) for path in source.fields])
    elif source.names:
        raw = _by_name(source, content, where)
    else:
        raw = _in_order(source, content, where, size)
    if source.frame:
        require_frame(source.frame, content, where)
    return _to_si(source, raw if source.within is None else np.clip(raw, *source.within))


def _in_order(source: Source, message: Message, where: str, size: int) -> Array:
    values = numbers(value_at(message, source.field, where), f"{where}: {source.field}", missing=source.missing)
    first, last = source.skip
    if len(values) != size + first + last:
        raise ProtocolError(f"{where}: {source.field} must have {size + first + last} numbers, not {len(values)}.")
    return values[first : first + size]


def _by_name(source: Source, message: Message, where: str) -> Array:
    """The numbers of the names of `source`, whatever their order in the message."""
    usual = usual_numbers(message.get(source.field)) if message.get("name") == list(source.names) else None
    if usual is not None and len(usual) == len(source.names):
        return usual
    found = names_of(message, "name", where)
    require_names(source.names, found, where, source.ignore)
    values = value_at(message, source.field, where)
    if isinstance(values, (list, tuple)) and not values:
        raise ProtocolError(f"{where}: {source.field} is empty, and {source.signal} is read from it.")
    if not isinstance(values, (list, tuple, np.ndarray)) or len(values) != len(found):
        length = f"{len(values)} numbers" if isinstance(values, (list, tuple, np.ndarray)) else brief(values)
        raise ProtocolError(f"{where}: {source.field} must have {len(found)} numbers, one for each name, not {length}.")
    place = {name: values[index] for index, name in enumerate(found)}
    return np.array(
        [_joint(place[name], f"{where}: {source.field} of {name}", source.missing) for name in source.names]
    )


def _joint(value: object, where: str, missing: float | None) -> float:
    return float(numbers([value], where, missing=missing)[0]) if missing is not None else number(value, where)


def _to_si(entry: Source | Sink, raw: Array) -> Array:
    if entry.is_si:
        return raw
    values: Array = raw * np.array(entry.scale) + np.array(entry.offset)
    return values


def _from_si(entry: Source | Sink, values: Array) -> list[float]:
    raw = values if entry.is_si else (values - np.array(entry.offset)) / np.array(entry.scale)
    numbers: list[float] = raw.tolist()
    return numbers


@cache
def _places(labels: tuple[str, ...], command: tuple[str, ...]) -> list[int]:
    """Where `labels` are among those of a command."""
    return [command.index(label) for label in labels]


def encode_state(
    profile: RobotProfile, state: RobotState, row: int, stamp: Mapping[str, int], tag: str = ""
) -> list[Envelope]:
    """The messages that a served robot publishes of one row of `state`.

    Args:
        profile: The robot; signals that `state` has not are left out.
        state: Of all rows.
        row: Which row.
        stamp: When, as ROS 1 or ROS 2 writes it.
        tag: `Tag.echo` of the command that this state is the answer to; it goes into ``frame_id`` of the last of the
            messages, which is one without a frame, so that with it everything has arrived.
    """
    messages: dict[tuple[str, tuple[str, ...]], Envelope] = {}
    for source in profile.state:
        if source.signal not in state.signals:
            continue
        key = (source.topic, source.names)
        if key not in messages:
            messages[key] = (source.topic, source.type, _new_state(source, stamp))
        _write_source(messages[key][2], source, state.signals[source.signal][row])
    stamped = [one for one in messages.values() if has_header(one[1]) and not one[2]["header"]["frame_id"]]
    if not stamped:
        return list(messages.values())
    stamped[0][2]["header"]["frame_id"] = tag
    return [envelope for envelope in messages.values() if envelope is not stamped[0]] + [stamped[0]]


def _new_state(source: Source, stamp: Mapping[str, int]) -> dict[str, Any]:
    header = {"header": {"stamp": dict(stamp), "frame_id": source.frame}} if has_header(source.type) else {}
    return {**header, **source.constants}


def _write_source(message: dict[str, Any], source: Source, values: Array) -> None:
    """Write the numbers [SI] of one signal into `message`, which may hold those of others already."""
    raw = _from_si(source, values)
    if source.fields:
        for path, value in zip(source.fields, raw, strict=True):
            put_at(message, path, value)
    elif source.names:
        message["name"], message[source.field] = list(source.names), raw
    else:
        first, last = source.skip
        message[source.field] = [0.0] * first + raw + [0.0] * last


def encode_command(
    profile: RobotProfile,
    spec: RobotSpec,
    command: Array,
    tag: Tag | None,
    mode: str | None = None,
    *,
    sign: Sign | None = None,
    ros1: bool = False,
) -> list[Envelope]:
    """The messages that send `command`, in the order in which they must be sent.

    Args:
        profile: The robot.
        spec: Labels of the command, and the period.
        command: Finite numbers [SI]. Shape: (m,).
        tag: Who sends it when, for how long it means anything.
        mode: Way of sending it; None is the default.
        sign: Makes the text of `tag`; None: without a signature.
        ros1: Whether stamps are spelled as in ROS 1.

    Raises:
        InvalidValue: A number is not finite.
    """
    if command.shape != (len(spec.command.labels),) or not np.isfinite(command).all():
        raise InvalidValue(f"A command must be {len(spec.command.labels)} finite numbers, not {command.tolist()}.")
    return [encode_sink(sink, spec, command, tag, sign=sign, ros1=ros1) for sink in profile.sinks(mode)]


def encode_sink(
    sink: Sink, spec: RobotSpec, command: Array, tag: Tag | None, *, sign: Sign | None = None, ros1: bool = False
) -> Envelope:
    """The message that sends the part of `command` (m,) that goes to `sink`. Arguments as of `encode_command`."""
    raw = _from_si(sink, command[_places(sink.labels, spec.command.labels)])
    text = _tag_text(sink, raw, tag, sign, spec.period)
    return sink.topic, sink.type, write_command(sink, raw, text, spec.period, ros1=ros1)


def _tag_text(sink: Sink, raw: list[float], tag: Tag | None, sign: Sign | None, period: float) -> str:
    if tag is None or not sink.tag:
        return ""
    if sign is None:
        return tag.to_text()
    if any("(" in path for path in sink.fields):  # an angle is written as a quaternion, and read with rounding
        return sign(tag, sink.topic, _content(read_command(sink, write_command(sink, raw, "", period))))
    return sign(tag, sink.topic, _content(raw))


def _content(raw: list[float] | Array) -> bytes:
    """What is signed of a command: its numbers as they are in the message, in 32 bits, since some types have no more.

    Args:
        raw: In the order of the sink's labels.
    """
    with np.errstate(over="ignore"):
        return np.asarray(raw, dtype="<f4").tobytes()


class Decoded(NamedTuple):
    """A message that commands."""

    places: list[int]
    """Where its numbers are in the command."""
    values: Array
    """Its numbers [SI]."""
    tag: Tag | None
    """Its tag, if it has one."""
    content: bytes
    """What a signature in the tag is for; empty without one."""


def decode_command(profile: RobotProfile, spec: RobotSpec, topic: str, message: object) -> Decoded:
    """What a message on `topic` commands.

    Raises:
        ProtocolError: The message is not what the profile says, or no command comes on `topic`.
    """
    sink = profile.sinks_by_topic.get(topic)
    if sink is None:
        raise ProtocolError(f"{topic}: no command of {profile.name} comes here.")
    content = require_message(message, topic)
    raw, tag = read_command(sink, content), read_tag(tag_text(content))
    signed = _content(raw) if tag is not None and tag.mac else b""
    return Decoded(list(_places(sink.labels, spec.command.labels)), _to_si(sink, raw), tag, signed)
