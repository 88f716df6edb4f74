"""Reads robot profiles: the topics of a live robot, the order and unit of its numbers, and their maximum age.

A profile is one TOML or YAML file; those in the folder ``profiles`` are shipped, and show every table. A file may start
from a shipped one (``extends = "ur5e"``), replace whole tables of it, rename topics (``[rename]``) and frames
(``[frames]``); ``ignore`` at its top lists names that may come with every source of names.

The types of the keys are those of the dataclasses here and in `bam_envs.ros.profile_tables`; the functions below check
the keys against each other.
"""

import importlib
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import yaml
from msgspec import Meta

from bam_envs.arms.description import ArmDescription
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.core.robot_models import Description, description_folders, find_model, known_models
from bam_envs.core.validation import AboveZero, Finite, NonEmpty, NonNegative, Positive, check, read_table, type_hints
from bam_envs.robots.base_description import base_model
from bam_envs.robots.ur5e import arm_spec
from bam_envs.ros.codec import LISTED_TYPES
from bam_envs.ros.messages import bare_type, has_header
from bam_envs.ros.profile_tables import (
    CameraSource,
    Enable,
    IdentitySource,
    ImageType,
    Readiness,
    RobotProfile,
    Sink,
    Source,
    Topic,
)
from bam_envs.safety.guard import BOUNDS, Limits, is_base

tomllib: Any = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

Table = dict[str, Any]
Age = Annotated[float, Meta(gt=0, le=BOUNDS["max_age"][1])]
"""Maximum age of states and commands [s]."""
T = TypeVar("T")
Typed = TypeVar("Typed", Source, Sink, CameraSource, Readiness, Enable)
Converted = TypeVar("Converted", Source, Sink)
_PLACES = ("topic", "action", "service")
"""The keys of a table that say where something is."""
_STATES = "sensor_msgs/JointState"
_SUFFIXES = (".toml", ".yaml", ".yml")
_SHIPPED = resources.files("bam_envs.robots") / "profiles"
_AGES = {"arm": 0.1, "base": 0.5}
_AXES = {"linear_velocity": "linear.x", "lateral_velocity": "linear.y", "angular_velocity": "angular.z"}
_CAMERAS: tuple[Table, ...] = tuple(
    {"name": f"{name}{depth}", "topic": f"/{name}_camera/{topic}", "type": kind, "optional": True}
    for depth, topic, kind in (
        ("", "color/image_raw/compressed", "sensor_msgs/CompressedImage"),
        ("_depth", "depth/image_raw", "sensor_msgs/Image"),
    )
    for name in ("front", "wrist")
)
"""Cameras of an arm whose profile names none; each is read only for a task that looks through it."""
_ROBOTS: dict[str, Callable[[], RobotSpec]] = {"ur5e": lambda: arm_spec("ur5e", with_object=True)}


@dataclass(frozen=True)
class _File:
    """The keys of a file."""

    name: NonEmpty
    kind: Literal["arm", "base"]
    robot: NonEmpty = ""
    extends: NonEmpty = ""
    period: Positive | None = None
    max_age: Age | None = None
    command_timeout: Age | None = None
    watchdog: NonNegative | None = None
    controllers: NonEmpty = ""
    ignore: tuple[NonEmpty, ...] = ()
    limits: Mapping[str, Finite] = field(default_factory=dict)
    rename: Mapping[str, Topic] = field(default_factory=dict)
    frames: Mapping[str, str] = field(default_factory=dict)
    signals: tuple[Table, ...] = ()
    command: Table | None = None
    state: tuple[Table, ...] = ()
    commands: dict[str, list[Table]] = field(default_factory=dict)
    cameras: tuple[Table, ...] = ()
    readiness: tuple[Table, ...] = ()
    identity: tuple[Table, ...] = ()
    enable: tuple[Table, ...] = ()


@dataclass(frozen=True)
class _Signal:
    """A signal in a file; one unit and one limit may stand for all of its numbers."""

    labels: tuple[NonEmpty, ...]
    units: tuple[NonEmpty, ...]
    low: tuple[Finite, ...]
    high: tuple[Finite, ...]
    name: NonEmpty = "command"
    max_rate: tuple[Finite, ...] = ()
    max_acceleration: tuple[AboveZero, ...] = ()
    max_jerk: tuple[AboveZero, ...] = ()


def load_profile(name_or_path: str | Path) -> RobotProfile:
    """The profile of that name beside the descriptions of robots, the shipped one, or the one in a file, checked.

    A described robot without a profile has the usual topics: `usual_profile`. `UnknownName` carries the closest match
    to a name, `InvalidValue` names the error in a file.
    """
    name = str(name_or_path)
    if len(Path(name).parts) == 1 and (own := own_profile(name)) is not None:
        return _profile(str(own), _table_at(own))
    if name not in shipped_profiles() and name in known_models():
        return usual_profile(_named_robot("robot profile", name))
    return _profile(*_read_file(name))


def fitting_profile(name_or_path: str | Path, spec: RobotSpec) -> RobotProfile:
    """As `load_profile`, for the robot of `spec`; `InvalidValue` for that of another robot, with those that fit."""
    profile, ours = load_profile(name_or_path), _moved(spec)
    if (profile.kind == "base") == is_base(spec) and set(ours) <= set(_moved(profile)):
        return profile
    tables = [name for name in (*shipped_profiles(), spec.name) if name in shipped_profiles() or own_profile(name)]
    found = {name: load_profile(name) for name in tables}
    fits = [
        name for name, one in found.items() if ours == _moved(one) and (one.kind == "arm" or one.robot == spec.name)
    ]
    remedy = f"Leave it out for the usual topics, or write one: bam-robots profile {spec.name} --from URL."
    remedy = f"Profiles that fit: {', '.join(fits)}." if fits else remedy
    raise InvalidValue(
        f"The profile {name_or_path} is that of another robot: it has {', '.join(_moved(profile))}, and "
        f"{spec.name} has {', '.join(ours)}. {remedy}"
    )


def _moved(robot: RobotSpec | RobotProfile) -> tuple[str, ...]:
    """The joints of an arm, or the axes of a base."""
    return tuple(at for at, unit in zip(robot.command.labels, robot.command.units, strict=True) if unit != "m")


def read_profile(text: str, where: str) -> RobotProfile:
    """The profile in the text of a file; `where`, which ends in the suffix of its language, begins errors."""
    return _profile(where, _merged(_parsed(where, text), where))


def profile_for(spec: RobotSpec) -> RobotProfile:
    """The profile of the robot of `spec`, narrowed to the commands of `spec`.

    It is the file ``profiles/NAME.toml`` beside the descriptions of robots (`write_profile` writes it there), else the
    shipped one of that robot, else the shipped one of Universal Robots' arms that takes these commands (the first that
    takes more, if there is none). A described robot without one has the usual topics of ROS 2: `usual_profile`.
    """
    labels = spec.command.labels
    if (own := own_profile(spec.name)) is not None:
        return _profile(str(own), _table_at(own)).narrowed(labels)
    tables = {name: _read_file(name) for name in shipped_profiles()}
    same = [one for one in tables.values() if one[1].get("robot") == spec.name and spec.name not in _ROBOTS]
    if is_base(spec) and set(labels) <= _AXES.keys() and not same:
        return usual_profile(spec)
    others = [one for one in tables.values() if one[1].get("robot") in _ROBOTS]
    for profile in sorted((_profile(*one) for one in same or others), key=lambda one: one.command.labels != labels):
        if labels and set(labels) <= set(profile.command.labels):
            return profile.narrowed(labels)
    joints = next((one.labels for one in spec.signals if one.name == "joint_position"), ())
    if joints and labels == (*joints, "gripper_width"):
        return usual_profile(spec)
    raise InvalidValue(f"No shipped profile takes the commands of {spec.name}. Give its file: profile='my_robot.toml'.")


def described_spec(name: Any, *, with_object: bool = False) -> RobotSpec:
    """The signals of a described arm, with those of an object or without, or of a described base."""
    robot = find_model(name, Description)
    return robot.spec(with_object=with_object) if isinstance(robot, ArmDescription) else base_model(robot).spec()


def own_profile(name: str) -> Any:
    """The file ``profiles/NAME.toml`` in the first folder of robot descriptions that has one, or None."""
    files = (folder / "profiles" / f"{name}.toml" for folder in description_folders())
    return next((file for file in files if file.is_file()), None)


def usual_profile(spec: RobotSpec) -> RobotProfile:
    """Topics of a described robot as ROS 2 usually names them.

    Those of a base are ``/odom``, ``/cmd_vel`` (TwistStamped) and one for each laser. Those of an arm are as
    ros2_control names them: joint states, and a controller of joint trajectories. Its commands name their joints, so
    that the order in the controller does not matter.
    """
    if is_base(spec):
        return _usual_base(spec)
    joints, command = spec.command.labels[:-1], spec.command
    topics = {"joint_position": "position", "joint_velocity": "velocity"}
    states: list[Table] = [
        {"signal": name, "topic": "/joint_states", "type": _STATES, "field": field, "names": list(joints)}
        for name, field in topics.items()
    ]
    gripper, topic = "gripper_width", "/gripper/joint_states"
    states.append({"signal": gripper, "topic": topic, "type": _STATES, "field": "position", "names": [gripper]})
    pose: Table = {"topic": "/object_pose", "type": "geometry_msgs/PoseStamped", "frame": "base_link"}
    for signal, part, axes in (("object_position", "position", "xyz"), ("object_quaternion", "orientation", "wxyz")):
        states.append({**pose, "signal": signal, "fields": [f"pose.{part}.{axis}" for axis in axes]})
    known = {signal.name for signal in spec.signals}
    sink: Table = {"type": "trajectory_msgs/JointTrajectory", "controller": "joint_trajectory_controller"}
    sink |= {"topic": "/joint_trajectory_controller/joint_trajectory", "labels": list(joints), "reach_periods": 2.0}
    width: Table = {"topic": "/gripper/commands", "type": "std_msgs/Float64MultiArray", "labels": [gripper]}
    table: Table = {
        "name": spec.name,
        "kind": "arm",
        "period": spec.period,
        "max_age": 0.1,
        "controllers": "/controller_manager/list_controllers",
        "signals": [_as_table(signal) for signal in spec.signals if signal.labels],
        "command": {**_as_table(command), "max_rate": list(command.max_rate or ())},
        "state": [state for state in states if state["signal"] in known],
        "commands": {"trajectory": [{**width, "hold": "last"}, {**sink, "hold": "measured"}]},
    }
    del table["command"]["name"]
    return _profile(f"usual profile of {spec.name}", table)


def _usual_base(spec: RobotSpec) -> RobotProfile:
    speeds = [_AXES[label] for label in spec.command.labels]
    odometry: Table = {"topic": "/odom", "type": "nav_msgs/Odometry"}
    pose = [f"pose.pose.{part}" for part in ("position.x", "position.y")]
    states: list[Table] = [
        {**odometry, "signal": "base_velocity", "fields": [f"twist.twist.{speed}" for speed in speeds]},
        {**odometry, "signal": "base_pose", "fields": [*pose, "yaw(pose.pose.orientation)"]},
    ]
    for scanner in spec.body.scanners if spec.body is not None else ():
        scan: Table = {"topic": f"/{scanner.signal}", "type": "sensor_msgs/LaserScan", "field": "ranges"}
        (low, high), ((first, second), last) = scanner.range, (scanner.bearings[:2], scanner.bearings[-1])
        step = second - first
        ends = {"angle_min": first - scanner.hidden[0] * step, "angle_max": last + scanner.hidden[1] * step}
        constants = {**ends, "angle_increment": step, "range_min": low, "range_max": high}
        scan |= {"skip": list(scanner.hidden), "missing": high, "within": [low, high], "constants": constants}
        states.append({**scan, "signal": scanner.signal})
    known, command = {signal.name for signal in spec.signals}, spec.command
    sink: Table = {"topic": "/cmd_vel", "type": "geometry_msgs/TwistStamped", "labels": list(command.labels)}
    table: Table = {
        "name": spec.name,
        "kind": "base",
        "period": spec.period,
        "watchdog": 0.5,  # of ros2_control's drives and of a Create 3
        "signals": [_as_table(signal) for signal in spec.signals],
        "command": {**_as_table(command), "max_rate": list(command.max_rate or ())},
        "state": [state for state in states if state["signal"] in known],
        "commands": {"velocity": [{**sink, "fields": [f"twist.{speed}" for speed in speeds], "hold": "zero"}]},
    }
    del table["command"]["name"]
    return replace(_profile(f"usual profile of {spec.name}", table), body=spec.body)


def _as_table(signal: SignalSpec) -> Table:
    return {key: list(value) if key != "name" else value for key, value in vars(signal).items() if value is not None}


def shipped_profiles() -> list[str]:
    """Names of the profiles that are shipped, sorted."""
    return sorted(entry.name.removesuffix(".toml") for entry in _SHIPPED.iterdir() if entry.name.endswith(".toml"))


def _read_file(name: str) -> tuple[str, Table]:
    """The name for errors of the profile `name`, or of that file, and its table, merged with what it extends."""
    path = Path(name)
    if path.suffix not in _SUFFIXES and len(path.parts) == 1:
        if name not in shipped_profiles():
            raise UnknownName("robot profile", name, shipped_profiles())
        return f"{name}.toml", _table_at(_SHIPPED / f"{name}.toml")
    return str(path), _table_at(path)


def _table_at(path: Any) -> Table:
    """The table in the file `path`, merged with the profile that it extends."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        choices = ", ".join(shipped_profiles())
        raise InvalidValue(
            f"There is no robot profile {path}. Give the path of a file, or one of: {choices}."
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidValue(f"The robot profile {path} cannot be read: {error}.") from error
    where = str(path) if isinstance(path, Path) else path.name
    return _merged(_parsed(where, text), where)


def _merged(table: Table, where: str) -> Table:
    """`table` with the keys of the profile that it extends."""
    if "extends" not in table:
        return table
    extends = check(table["extends"], NonEmpty, f"{where}: extends")
    if Path(extends).suffix in _SUFFIXES:
        choices = ", ".join(shipped_profiles())
        raise InvalidValue(f"{where}: extends must be a shipped profile ({choices}), not {extends!r}.")
    return {**_read_file(extends)[1], **table}


def _parsed(where: str, text: str) -> Table:
    """The table in `text`, TOML or YAML as the name `where` ends."""
    language = "TOML" if where.endswith(".toml") else "YAML"
    try:
        data = tomllib.loads(text) if language == "TOML" else yaml.safe_load(text)
    except (ValueError, RecursionError, yaml.YAMLError) as error:  # YAML's dates and numbers are left to Python's
        raise InvalidValue(f"{where} is not {language}: {syntax_fault(error)}. Correct it there.") from error
    table: Table = check(data, Table, where)
    if "dead_man" in table:  # the former name of command_timeout
        if "command_timeout" in table:
            raise InvalidValue(f"{where}: command_timeout comes twice: dead_man is its former name. Give one of them.")
        table["command_timeout"] = table.pop("dead_man")
    return table


def syntax_fault(error: Exception) -> str:
    """What a parser of TOML or YAML did not understand, and the line, without the text around it."""
    mark = getattr(error, "problem_mark", None)
    if mark is None:
        return " ".join(str(error).split())
    return f"{getattr(error, 'problem', '')} (at line {mark.line + 1}, column {mark.column + 1})"


def _profile(where: str, table: Table) -> RobotProfile:
    """The profile in `table`, which the file `where` holds."""
    file = _row(_File, table, where)
    try:
        Limits.of(file.limits)
    except (UnknownName, InvalidValue) as error:
        raise InvalidValue(f"{where}: limits: {error}") from error
    if file.kind == "base" and file.watchdog == 0.0:
        raise InvalidValue(
            f"{where}: watchdog = 0 means that the base keeps driving when commands stop, and such a base is not "
            "driven: give its drive a time-out of 0.5 s or less, and set it here."
        )
    spec = _robot(where, file)
    if is_base(spec) != (file.kind == "base"):
        raise InvalidValue(f"{where}: kind is {file.kind}, and its commands are those of the other kind, arm or base.")
    state = _state(where, file, spec)
    if file.kind == "arm" and "cameras" not in table:
        file = replace(file, cameras=_CAMERAS)
    commands = {mode: _sinks(where, mode, rows, spec.command) for mode, rows in file.commands.items()}
    if not commands:
        raise InvalidValue(f"{where}: at least one command mode is needed, such as [[commands.position]].")
    cameras, readiness = [], []
    for row, at in _rows(f"{where}: cameras", file.cameras):
        cameras.append(_typed(CameraSource, row, at))
        check(cameras[-1].type, ImageType, f"{at}: type")
    for row, at in _rows(f"{where}: readiness", file.readiness):
        readiness.append(entry := _typed(Readiness, row, at))
        if bool(entry.ready) == (entry.at_least is not None):
            raise InvalidValue(f"{at}: give either ready (the values with which it can move) or at_least.")
    identity = [_identity(row, at) for row, at in _rows(f"{where}: identity", file.identity)]
    enable = [_typed(Enable, row, at) for row, at in _rows(f"{where}: enable", file.enable)]
    sinks = [sink for mode in commands.values() for sink in mode]
    entries: list[Source | Sink | CameraSource | Readiness | Enable] = [*state, *cameras, *readiness, *sinks, *enable]
    every = [one for entry in entries for one in (entry.forms if isinstance(entry, Sink) else (entry,))]
    names = {getattr(entry, key, "") for entry in every for key in _PLACES}
    _require_known(f"{where}: rename", "topic", file.rename, names - {""})

    def renamed(entry: Typed) -> Typed:
        found: dict[str, Any] = {key: file.rename.get(getattr(entry, key, "")) for key in _PLACES}
        changed = {key: name for key, name in found.items() if name is not None}
        # A topic of another name belongs to another controller.
        other: dict[str, Any] = {"controller": ""} if changed and isinstance(entry, Sink) else {}
        if isinstance(entry, Sink) and entry.closing is not None:
            closer = entry.closing.action
            other["closing"] = replace(entry.closing, action=file.rename.get(closer, closer))
        return replace(entry, **changed, **other)

    return RobotProfile(
        name=file.name,
        kind=file.kind,
        robot=file.robot,
        signals=tuple(signal for source in state for signal in spec.signals if signal.name == source.signal),
        command=spec.command,
        state=tuple(map(renamed, state)),
        commands={mode: tuple(map(renamed, sinks)) for mode, sinks in commands.items()},
        period=spec.period,
        max_age=file.max_age or _AGES[file.kind],
        command_timeout=file.command_timeout or _AGES[file.kind],
        limits=file.limits,
        cameras=tuple(map(renamed, cameras)),
        readiness=tuple(map(renamed, readiness)),
        identity=tuple(identity),
        enable=tuple(map(renamed, enable)),
        controllers=file.controllers,
        watchdog=file.watchdog,
        body=spec.body,
    )


def _identity(row: Table, where: str) -> IdentitySource:
    source = _row(IdentitySource, row, where)
    if bool(source.service) == bool(source.topic) or bool(source.topic) != bool(source.type):
        raise InvalidValue(f"{where}: give either service, or topic and type.")
    try:
        re.compile(source.pattern)
    except re.error as error:
        raise InvalidValue(f"{where}: pattern is not a regular expression: {error}.") from error
    return replace(source, type=bare_type(source.type))


def _robot(where: str, file: _File) -> RobotSpec:
    """Signals, command and period: of the robot that the file names, and of its own tables."""
    base = _named_robot(where, file.robot) if file.robot else None
    signals = [_signal(row, at) for row, at in _rows(f"{where}: signals", file.signals)]
    command = None if file.command is None else _signal(file.command, f"{where}: command")
    if base is None and (command is None or file.period is None):
        raise InvalidValue(f"{where}: give robot (a name of bam-robots list), or [command] with max_rate, and period.")
    if command is not None and (command.name != "command" or command.max_rate is None):
        raise InvalidValue(f"{where}: command needs max_rate, and takes no name.")
    every = [*(base.signals if base else ()), *signals]
    _require_once(where, "signal", [signal.name for signal in every])
    final = command or base.command  # type: ignore[union-attr]
    period = file.period or base.period  # type: ignore[union-attr]
    return RobotSpec(file.name, tuple(every), final, period, body=base.body if base else None)


def _named_robot(where: str, name: str) -> RobotSpec:
    """The UR5e that profiles are shipped for, or any described robot."""
    if name in _ROBOTS:
        return _ROBOTS[name]()
    _require_known(where, "robot", [name], {*_ROBOTS, *known_models()})
    return described_spec(name, with_object=True)


def _signal(row: Table, where: str) -> SignalSpec:
    signal = _row(_Signal, row, where)
    size = len(signal.labels)
    _require_once(where, "label", signal.labels)
    if size == 0:
        raise InvalidValue(f"{where}: labels must name at least one number.")
    units, low, high = (_each(where, key, getattr(signal, key), size) for key in ("units", "low", "high"))
    if not all(least < most for least, most in zip(low, high, strict=True)):
        raise InvalidValue(f"{where}: low must be below high.")
    given = {key: getattr(signal, key) for key in ("max_rate", "max_acceleration", "max_jerk")}
    limits = {key: _each(where, key, values, size) for key, values in given.items() if values}
    return SignalSpec(signal.name, signal.labels, units, low, high, **limits)


def _state(where: str, file: _File, spec: RobotSpec) -> list[Source]:
    """The sources, in the order of the signals of `spec`, with the names to ignore and the frames of the whole file."""
    sizes = {signal.name: len(signal.labels) for signal in spec.signals}
    sources: dict[str, Source] = {}
    for row, at in _rows(f"{where}: state", file.state):
        source = _typed(Source, row, at)
        _require_known(at, "signal", [source.signal], sizes)
        if source.signal in sources:
            raise InvalidValue(f"{at}: {source.signal} has a source already.")
        sources[source.signal] = _checked_source(at, source, sizes[source.signal])
    if not sources:
        raise InvalidValue(f"{where}: at least one [[state]] table is needed.")
    framed = {source.topic for source in sources.values() if source.frame}
    _require_known(f"{where}: frames", "topic with a frame", file.frames, framed)
    state = [sources[name] for name in sizes if name in sources]
    for place, source in enumerate(state):
        known = (*source.names, *source.ignore)
        beside = [name for one in state if one.topic == source.topic for name in (*one.names, *one.ignore)]
        others = dict.fromkeys(name for name in (*beside, *file.ignore) if name not in known) if source.names else ()
        frame = file.frames.get(source.topic, source.frame)
        state[place] = replace(source, ignore=(*source.ignore, *others), frame=frame)
    return state


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
    check(source.max_age, Age | None, f"{where}: max_age")
    if source.within is not None and source.within[0] > source.within[1]:
        raise InvalidValue(f"{where}: within must be two numbers, the least first, not {list(source.within)}.")
    if source.frame and not has_header(source.type):
        raise InvalidValue(f"{where}: frame needs a type with a header, such as {source.type}Stamped.")
    return _converted(where, source, size)


def _sinks(where: str, mode: str, rows: list[Table], command: SignalSpec) -> tuple[Sink, ...]:
    """The sinks of one command mode; together they take every number of the command once."""
    where = f"{where}: commands.{mode}"
    sinks: list[Sink] = []
    for row, at in _rows(where, rows):
        sink = _typed(Sink, row, at)
        if sum(bool(getattr(sink, key)) for key in _PLACES) != 1:
            raise InvalidValue(f"{at}: give one of {', '.join(_PLACES)}.")
        if not sink.topic:  # what a gripper holds, it holds without another goal
            if sink.hold != "last" and "hold" in row:
                raise InvalidValue(f"{at}: hold of an action or a service is last: a halt cancels it.")
            sink = replace(sink, hold="last", tag=False)
            units = dict(zip(command.labels, command.units, strict=True))
            for label in sink.labels:
                if units.get(label, "m") != "m":  # a motion needs a stream of commands
                    raise InvalidValue(f"{at}: only a gripper may be an action or a service; {label} needs a topic.")
        size = len(sink.labels)
        for key, values in (("names", sink.names), ("fields", sink.fields)):
            if values and len(values) != size:
                raise InvalidValue(f"{at}: {key} must have {size} values, not {len(values)}.")
        if not sink.fields and not (sink.topic and sink.type in LISTED_TYPES):
            raise InvalidValue(f"{at}: {sink.type} needs fields; only {', '.join(sorted(LISTED_TYPES))} do without.")
        if sink.constants and not sink.fields:
            raise InvalidValue(f"{at}: constants need fields.")
        if sink.rate is not None and (sink.is_timed or not sink.topic or command.units[0] != "rad"):
            raise InvalidValue(f"{at}: rate is for positions of an arm that are executed at once.")
        if sink.closing is not None:
            if not sink.action or size != 1:
                raise InvalidValue(f"{at}: closing needs an action with one label.")
            sink = replace(sink, closing=replace(sink.closing, type=bare_type(sink.closing.type)))
        sinks.append(_converted(at, replace(sink, names=sink.names or sink.labels), size))
    labels = [label for sink in sinks for label in sink.labels]
    _require_once(where, "label", labels)
    if set(labels) != set(command.labels):
        raise InvalidValue(f"{where}: labels must be {', '.join(command.labels)}, not {', '.join(labels)}.")
    _require_once(where, "topic", [sink.address for sink in sinks])
    if not sinks[-1].topic:
        raise InvalidValue(f"{where}: the last table must have a topic, because it completes a command.")
    return tuple(sinks)


def _row(kind: type[T], row: Table, where: str) -> T:
    """A table as a dataclass; where a list of values is expected, a single value is a list of one."""
    lists = [
        key for key, hint in type_hints(kind).items() if get_args(hint)[-1:] == (...,) and Table not in get_args(hint)
    ]
    listed = {key: [value] if key in lists and not isinstance(value, list) else value for key, value in row.items()}
    return read_table(kind, listed, where)


def _typed(kind: type[Typed], row: Table, where: str) -> Typed:
    """A table with a type, which becomes ``pkg/Type``."""
    entry = _row(kind, row, where)
    return replace(entry, type=bare_type(entry.type))


def _rows(where: str, tables: Iterable[Table]) -> list[tuple[Table, str]]:
    """The tables of a list, each with its place for errors."""
    return [(table, f"{where}[{number}]") for number, table in enumerate(tables)]


def _converted(where: str, entry: Converted, size: int) -> Converted:
    """`entry` with a scale and an offset for each number."""
    if 0.0 in entry.scale:
        raise InvalidValue(f"{where}: scale must not be 0.")
    scale, offset = (_each(where, key, getattr(entry, key), size) for key in ("scale", "offset"))
    return replace(entry, scale=scale, offset=offset)


def _each(where: str, key: str, values: tuple[Any, ...], size: int) -> tuple[Any, ...]:
    """`values`, one for each of `size` numbers; a single one stands for all."""
    if len(values) not in (1, size):
        raise InvalidValue(f"{where}: {key} must have 1 or {size} values, not {len(values)}.")
    return values * size if len(values) == 1 else values


def _require_once(where: str, what: str, names: Iterable[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InvalidValue(f"{where}: the {what} {name!r} comes twice.")
        seen.add(name)


def _require_known(where: str, what: str, names: Iterable[str], known: Iterable[str]) -> None:
    known = set(known)
    for name in names:
        if name not in known:
            raise InvalidValue(f"{where}: {UnknownName(what, name, known)}")
