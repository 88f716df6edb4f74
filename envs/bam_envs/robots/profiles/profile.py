"""Robot profiles: which topics a live robot has, in which order and unit its numbers come, how old they may be.

A profile is one TOML or YAML file; ``profiles/ur5e.toml`` and ``profiles/mir100.toml`` are shipped and show every
table. A file may start from another (``extends = "ur5e"``), replace whole tables of it, rename topics (``[rename]``)
and frames (``[frames]``); ``ignore`` at its top lists names that may come with every source of names.

Longer than other modules because it is one list of what each key must be.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.robots.mir100 import base_spec
from bam_envs.robots.profiles.files import read_profile, shipped_profiles
from bam_envs.robots.ur5e import arm_spec
from bam_envs.ros.command_messages import LISTED_TYPES
from bam_envs.ros.messages import has_header
from bam_envs.ros.profile_tables import IMAGE_TYPES, CameraSource, Readiness, RobotProfile, Sink, Source
from bam_envs.ros.typed_table import read_table, require_known, require_table, require_tables
from bam_envs.safety.guard import BOUNDS, Limits

__all__ = ["CameraSource", "RobotProfile", "Sink", "Source", "load_profile", "profile_for", "shipped_profiles"]

Table = Mapping[str, Any]
Topical = TypeVar("Topical", Source, Sink, CameraSource, Readiness)
_TYPE = re.compile(r"([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)")
_TOPIC = re.compile(r"(/[A-Za-z]\w*)+")
_AGES = {"arm": 0.1, "base": 0.5}
_ROBOTS: dict[str, Callable[[], RobotSpec]] = {
    "ur5e": lambda: arm_spec("ur5e", with_object=True),
    "mir100": base_spec,
}


def load_profile(name_or_path: str | Path) -> RobotProfile:
    """The shipped profile of that name, or the one in a TOML or YAML file, checked.

    Raises:
        UnknownName: No profile of that name is shipped; it carries the closest match.
        InvalidValue: There is no such file, or something in it is not as it must be; it names file and key.
    """
    where, table = read_profile(str(name_or_path))
    return _profile(where, table)


def profile_for(spec: RobotSpec) -> RobotProfile:
    """The shipped profile that takes the commands of `spec`; else the first that takes more, narrowed to them.

    Raises:
        InvalidValue: There is none, or it would be sent a part of a message.
    """
    labels, shipped = spec.command.labels, [load_profile(name) for name in shipped_profiles()]
    for profile in shipped:
        if profile.command.labels == labels:
            return profile
    for profile in shipped:
        if labels and set(labels) <= set(profile.command.labels):
            return profile.narrowed(labels)
    raise InvalidValue(f"No shipped profile takes the commands of {spec.name}. Give its file: profile='my_robot.toml'.")


@dataclass(frozen=True)
class _Head:
    """The plain keys of a file."""

    name: str
    kind: Literal["arm", "base"]
    robot: str = ""
    period: float | None = None
    max_age: float | None = None
    command_timeout: float | None = None
    limits: Mapping[str, float] = field(default_factory=dict)
    rename: Mapping[str, str] = field(default_factory=dict)
    frames: Mapping[str, str] = field(default_factory=dict)
    ignore: tuple[str, ...] = ()
    controllers: str = ""


@dataclass(frozen=True)
class _Signal:
    """A signal as a file writes it: one unit and one limit may stand for all of its numbers."""

    labels: tuple[str, ...]
    units: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    name: str = "command"
    max_rate: tuple[float, ...] = ()


_TABLES = ("signals", "command", "state", "commands", "cameras", "readiness")


def _profile(where: str, table: Table) -> RobotProfile:
    """The profile in `table`, which the file `where` holds."""
    require_known(table, [*_Head.__dataclass_fields__, *_TABLES, "extends"], where)
    head = read_table(_Head, {key: value for key, value in table.items() if key not in _TABLES}, where)
    _require_positive(where, {"period": head.period})
    _require_age(where, head.max_age)
    _require_age(where, head.command_timeout, "command_timeout")
    _require_limits(where, head.limits)
    spec = _robot(where, head, table)
    state = tuple(_ignoring(source, head.ignore) for source in _state(where, table, spec))
    state = _framed(where, head.frames, state)
    commands = _commands(where, table, spec.command)
    cameras = tuple(_checked_camera(at, _topical(CameraSource, row, at)) for row, at in _rows(where, table, "cameras"))
    readiness = tuple(
        _checked_readiness(at, _topical(Readiness, row, at)) for row, at in _rows(where, table, "readiness")
    )
    sinks = [sink for way in commands.values() for sink in way]
    new_name = _renaming(where, head.rename, [*state, *cameras, *readiness, *sinks])
    return RobotProfile(
        name=head.name,
        kind=head.kind,
        signals=tuple(signal for source in state for signal in spec.signals if signal.name == source.signal),
        command=spec.command,
        state=tuple(map(new_name, state)),
        commands={way: tuple(map(new_name, sinks)) for way, sinks in commands.items()},
        period=spec.period,
        max_age=head.max_age or _AGES[head.kind],
        command_timeout=head.command_timeout or _AGES[head.kind],
        limits=head.limits,
        cameras=tuple(map(new_name, cameras)),
        readiness=tuple(map(new_name, readiness)),
        controllers=head.controllers,
    )


def _require_positive(where: str, numbers: Mapping[str, float | None]) -> None:
    for key, number in numbers.items():
        if number is not None and number <= 0:
            raise InvalidValue(f"{where}: {key} must be above 0, not {number:g}.")


def _require_age(where: str, age: float | None, key: str = "max_age") -> None:
    """States that are older mean nothing any more, nor do commands (`command_timeout`)."""
    _, top, unit = BOUNDS["max_age"]
    _require_positive(where, {key: age})
    if age is not None and age > top:
        raise InvalidValue(f"{where}: {key} may be {top:g} {unit} at most, not {age:g}.")


def _require_limits(where: str, limits: Mapping[str, float]) -> None:
    try:
        Limits.of(limits)
    except (UnknownName, InvalidValue) as error:
        raise InvalidValue(f"{where}: limits: {error}") from error


def _rows(where: str, table: Table, key: str, above: str = "") -> list[tuple[Any, str]]:
    """The tables of the list `key`, and how errors call each; `above` is the name of `table` in the file."""
    rows = require_tables(table.get(key, []), f"{where}: {above}{key}")
    return [(row, f"{where}: {above}{key}[{number}]") for number, row in enumerate(rows)]


def _robot(where: str, head: _Head, table: Table) -> RobotSpec:
    """Signals, command and period: of the robot that the file names, and of its own tables."""
    if head.robot and head.robot not in _ROBOTS:
        raise InvalidValue(f"{where}: {UnknownName('robot', head.robot, _ROBOTS)}")
    signals = [_signal(row, at) for row, at in _rows(where, table, "signals")]
    command = _signal(table["command"], f"{where}: command") if "command" in table else None
    base = _ROBOTS[head.robot]() if head.robot else None
    if base is None and (command is None or head.period is None):
        raise InvalidValue(f"{where}: give robot ({', '.join(_ROBOTS)}), or [command] with max_rate, and period.")
    if command is not None and (command.name != "command" or command.max_rate is None):
        raise InvalidValue(f"{where}: command needs max_rate, and takes no name.")
    every = [*(base.signals if base else ()), *signals]
    _require_once(where, "signal", [signal.name for signal in every])
    final = command or base.command  # type: ignore[union-attr]
    return RobotSpec(head.name, tuple(every), final, head.period or base.period)  # type: ignore[union-attr]


def _signal(row: object, where: str) -> SignalSpec:
    signal = read_table(_Signal, row, where)
    size = len(signal.labels)
    _require_once(where, "label", list(signal.labels))
    if size == 0 or not signal.name:
        raise InvalidValue(f"{where}: labels must name at least one number.")
    units, low, high = (_each(where, key, getattr(signal, key), size) for key in ("units", "low", "high"))
    if not all(least < most for least, most in zip(low, high, strict=True)):
        raise InvalidValue(f"{where}: low must be below high.")
    rate = _each(where, "max_rate", signal.max_rate, size) if signal.max_rate else None
    return SignalSpec(signal.name, signal.labels, units, low, high, rate)


def _each(where: str, key: str, values: tuple[Any, ...], size: int) -> tuple[Any, ...]:
    """`values`, one for each of `size` numbers; a single one stands for all."""
    if len(values) not in (1, size):
        raise InvalidValue(f"{where}: {key} must have 1 or {size} values, not {len(values)}.")
    return values * size if len(values) == 1 else values


def _require_once(where: str, what: str, names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InvalidValue(f"{where}: the {what} {name!r} comes twice.")


def _topical(kind: type[Topical], row: object, where: str) -> Topical:
    """A table with a topic and a type, which become absolute and ``pkg/Type``."""
    entry = read_table(kind, row, where)
    if not _TOPIC.fullmatch(entry.topic):
        raise InvalidValue(f"{where}: topic must be an absolute name such as /joint_states, not {entry.topic!r}.")
    match = _TYPE.fullmatch(entry.type)
    if match is None:
        raise InvalidValue(f"{where}: type must be such as sensor_msgs/JointState, not {entry.type!r}.")
    return replace(entry, type="/".join(match.groups()))


def _state(where: str, table: Table, spec: RobotSpec) -> tuple[Source, ...]:
    """The sources, in the order of the signals of `spec`."""
    sizes = {signal.name: len(signal.labels) for signal in spec.signals}
    sources: dict[str, Source] = {}
    for row, at in _rows(where, table, "state"):
        source = _topical(Source, row, at)
        if source.signal not in sizes:
            raise InvalidValue(f"{at}: {UnknownName('signal', source.signal, sizes)}")
        if source.signal in sources:
            raise InvalidValue(f"{at}: {source.signal} has a source already.")
        sources[source.signal] = _checked_source(at, source, sizes[source.signal])
    if not sources:
        raise InvalidValue(f"{where}: at least one [[state]] table is needed.")
    return tuple(sources[name] for name in sizes if name in sources)


def _checked_source(where: str, source: Source, size: int) -> Source:
    if bool(source.field) == bool(source.fields):
        raise InvalidValue(f"{where}: give either field (where the list is) or fields (where each number is).")
    if source.fields and len(source.fields) != size:
        raise InvalidValue(f"{where}: fields must name {size} places, not {len(source.fields)}.")
    if source.names and (source.fields or len(source.names) != size):
        raise InvalidValue(f"{where}: names must name the {size} numbers of field, not {len(source.names)}.")
    if (source.partial or source.ignore) and not source.names:
        raise InvalidValue(f"{where}: partial and ignore need names.")
    _require_once(where, "name", [*source.names, *source.ignore])
    _require_age(where, source.max_age)
    if source.frame and not has_header(source.type):
        raise InvalidValue(f"{where}: frame needs a type with a header, such as {source.type}Stamped.")
    return replace(source, **_conversion(where, source, size))


def _ignoring(source: Source, names: tuple[str, ...]) -> Source:
    """`source`, which has nothing to do with `names` that are not its own."""
    others = tuple(name for name in names if name not in (*source.names, *source.ignore))
    return replace(source, ignore=(*source.ignore, *others)) if source.names else source


def _framed(where: str, frames: Mapping[str, str], state: tuple[Source, ...]) -> tuple[Source, ...]:
    """The sources, with what `frames` calls the frames of their topics."""
    framed = {source.topic for source in state if source.frame}
    for topic in frames:
        if topic not in framed:
            raise InvalidValue(f"{where}: frames: {UnknownName('topic with a frame', topic, framed)}")
    return tuple(replace(source, frame=frames.get(source.topic, source.frame)) for source in state)


def _conversion(where: str, entry: Source | Sink, size: int) -> dict[str, Any]:
    """Scale and offset, one for each number."""
    if 0.0 in entry.scale:
        raise InvalidValue(f"{where}: scale must not be 0.")
    return {key: _each(where, key, getattr(entry, key), size) for key in ("scale", "offset")}


def _commands(where: str, table: Table, command: SignalSpec) -> dict[str, tuple[Sink, ...]]:
    """Each way of sending a command; together its sinks take every number once."""
    ways = require_table(table.get("commands", {}), f"{where}: commands")
    if not ways:
        raise InvalidValue(f"{where}: at least one way of sending commands is needed, such as [[commands.position]].")
    return {way: _way(where, ways, way, command) for way in ways}


def _way(where: str, ways: Table, way: str, command: SignalSpec) -> tuple[Sink, ...]:
    sinks = tuple(_checked_sink(at, _topical(Sink, row, at)) for row, at in _rows(where, ways, way, "commands."))
    labels = [label for sink in sinks for label in sink.labels]
    _require_once(f"{where}: commands.{way}", "label", labels)
    if set(labels) != set(command.labels):
        raise InvalidValue(
            f"{where}: commands.{way}: labels must be {', '.join(command.labels)}, not {', '.join(labels)}."
        )
    _require_once(f"{where}: commands.{way}", "topic", [sink.topic for sink in sinks])
    return sinks


def _checked_sink(where: str, sink: Sink) -> Sink:
    size = len(sink.labels)
    for key, values in (("names", sink.names), ("fields", sink.fields)):
        if values and len(values) != size:
            raise InvalidValue(f"{where}: {key} must have {size} values, not {len(values)}.")
    if not sink.fields and sink.type not in LISTED_TYPES:
        raise InvalidValue(f"{where}: {sink.type} needs fields; only {', '.join(sorted(LISTED_TYPES))} do without.")
    _require_positive(where, {"reach": sink.reach, "reach_periods": sink.reach_periods})
    return replace(sink, names=sink.names or sink.labels, **_conversion(where, sink, size))


def _checked_camera(where: str, camera: CameraSource) -> CameraSource:
    if camera.type not in IMAGE_TYPES:
        raise InvalidValue(f"{where}: type must be one of {', '.join(IMAGE_TYPES)}, not {camera.type!r}.")
    _require_positive(where, {"max_age": camera.max_age})
    return camera


def _checked_readiness(where: str, entry: Readiness) -> Readiness:
    if bool(entry.ready) == (entry.at_least is not None):
        raise InvalidValue(f"{where}: give either ready (the values with which it can move) or at_least.")
    return entry


def _renaming(
    where: str, names: Mapping[str, str], entries: list[Source | Sink | CameraSource | Readiness]
) -> Callable[[Topical], Topical]:
    """Gives an entry the new name of its topic."""
    topics = {entry.topic for entry in entries}
    for old, new in names.items():
        if old not in topics:
            raise InvalidValue(f"{where}: rename: {UnknownName('topic', old, topics)}")
        if not _TOPIC.fullmatch(new):
            raise InvalidValue(f"{where}: rename: {old} must become an absolute name such as /ur/state, not {new!r}.")

    def rename(entry: Topical) -> Topical:
        if entry.topic not in names:
            return entry
        # Who takes commands on a topic of another name is another controller.
        other: dict[str, Any] = {"controller": ""} if isinstance(entry, Sink) else {}
        return replace(entry, topic=names[entry.topic], **other)

    return rename
