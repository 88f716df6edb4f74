"""Contracts of rosetta, a bridge between LeRobot and ROS 2: read as the graph of a robot, and written of a profile.

A contract names topics, types and joints, as a live graph does; what it does not say is assumed in the same way. As in
rosetta, an unknown key is an error. What a profile has no use for is skipped (``qos``, ``align``, units of the data
set, sections of recordings and of teleoperation), except what would change the commands that are sent.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from bam_envs.core.errors import InvalidValue
from bam_envs.core.wording import brief, did_you_mean
from bam_envs.robots.profile import syntax_fault
from bam_envs.ros.messages import bare_type, has_header
from bam_envs.ros.profile_tables import RobotProfile, Sink, Source
from bam_train.cli.arms.live_graph import LiveGraph, Row

_IMAGES, _JOINTS = "observation.images.", "sensor_msgs/JointState"
_SIGNALS = ("joint_position", "gripper_width", "base_velocity")
"""What the state of a written contract has."""
_SOURCE = ("channel", "align", "select", "apply", "kind")
_CHANNEL = ("topic", "type", "qos", "dtype", "decoder", "encoder", "safety")
_TOP = (
    *("robot_type", "robot_interface", "fps", "observations", "actions", "tasks", "teleop", "adjunct"),
    *("rewards", "signals", "info", "complementary_data"),
)
_ANCHORS = "x-"
"""Start of the keys of a contract that hold YAML's anchors."""
_Entry = tuple[tuple[str, str], str, tuple[str, ...]]
"""Key and topic, type, and what is selected, of an entry of a section."""


def contract_graph(path: Path, robot: str) -> LiveGraph:
    """The topics, joints and cameras of a contract; a robot that it writes as ``so_101`` is called so101.

    Raises:
        InvalidValue: It cannot be read, or is no contract.
    """
    try:
        table: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
        told, sections = str(table["robot_type"]), ("observations", "actions")
        seen, acts = ([*_entries(table[name], f"{path}: {name}")] for name in sections)
        _require_known({key: 0 for key in table if not str(key).startswith(_ANCHORS)}, _TOP, f"{path}: ")
        topics = {one["topic"]: bare_type(one["type"]) for one in map(_channel, table.get("adjunct") or ())}
        topics |= {key[1]: bare_type(kind) for key, kind, _ in (*seen, *acts)}
    except OSError as error:
        raise InvalidValue(f"{path}: cannot be read: {error.strerror or error}. Check the name.") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise InvalidValue(f"{path}: is not YAML: {syntax_fault(error)}. Correct it there.") from error
    except (AttributeError, KeyError, TypeError) as error:
        lacks = f": no {error}" if isinstance(error, KeyError) else ""
        raise InvalidValue(
            f"{path}: not a contract of rosetta{lacks}. Give a YAML file with robot_type, and with observations and "
            "actions, which have channels with a topic and a type."
        ) from error
    for (_, topic), _, selected in acts:
        for one in selected:
            if one.startswith(("velocity.", "effort.")):
                text = f"the action on {topic} selects {one}, and the joints of an arm are commanded by position"
                raise InvalidValue(f"{path}: {text}. Name a topic of positions there, such as that of a trajectory.")
    states = [one for one in seen if bare_type(one[1]) == _JOINTS]
    cameras = tuple(
        {"name": key.removeprefix(_IMAGES), "topic": topic, "type": bare_type(kind), "optional": True}
        for (key, topic), kind, _ in seen
        if key.startswith(_IMAGES)
    )
    name = robot if told.replace("_", "") == robot.replace("_", "") else told
    joints = {topic: (names,) for topic, names in _joints(states).items()}
    return LiveGraph(str(path), topics, frozenset(), {}, "", (), joints, name, commands=_joints(acts), cameras=cameras)


def _entries(section: Row, where: str) -> Iterator[_Entry]:
    for key, rows in section.items():
        at = f"{where}.{key}: "
        for row in rows if isinstance(rows, list) else [rows]:
            channel = _channel(row)
            _require_known(row, _SOURCE, at)
            _require_known(channel, _CHANNEL, at)
            if where.endswith("actions"):
                _require_plain(row, channel, at)
            elif channel.get("decoder") and bare_type(str(channel["type"])) == _JOINTS:
                raise InvalidValue(f"{at}its decoder gives other numbers than the topic has. Leave it out.")
            selected = tuple(map(str, row.get("select") or ()))
            yield (str(key), str(channel["topic"])), str(channel["type"]), selected


def _require_known(table: Row, known: Sequence[str], at: str) -> None:
    for key in table:
        if key not in known:
            raise InvalidValue(f"{at}unknown key {brief(key)}. {did_you_mean(key, known)}")


def _require_plain(row: Row, channel: Row, at: str) -> None:
    """Refuse what would change the commands on their way: a profile sends them as they are."""
    if channel.get("encoder"):
        raise InvalidValue(f"{at}its encoder writes messages that a profile cannot. Name a topic that needs none.")
    for one in row.get("apply") or ():
        name = next(iter(one)) if isinstance(one, dict) else one
        if name != "rad2deg":
            raise InvalidValue(
                f"{at}apply has {brief(name)}, and a profile sends commands as they are. Leave it out, and give the "
                "limits to the robot's description."
            )


def _joints(entries: Sequence[_Entry]) -> dict[str, tuple[str, ...]]:
    """The joints of each topic, which ``position.JOINT`` selects; the name of a joint may have a point too."""
    found: dict[str, tuple[str, ...]] = {}
    for (_, topic), _, selected in entries:
        names = [one.partition(".")[2] or one for one in selected]
        found[topic] = tuple(dict.fromkeys((*found.get(topic, ()), *names)))
    return found


def _channel(row: Row) -> Row:
    channel: Row = row["channel"]
    return channel


def contract_text(profile: RobotProfile) -> str:
    """The contract of a robot: its state, its cameras, and its first command mode, in the units of its topics."""
    images = {
        f"{_IMAGES}{one.name}": {**_bound(one.topic, one.type), "apply": [{"resize": [480, 640]}]}
        for one in profile.cameras
        if not one.name.endswith("_depth")  # which rosetta does not read
    }
    sources = [one for one in profile.state if one.signal in _SIGNALS]
    state = [{**_bound(one.topic, one.type), "select": _select(one, one.field)} for one in sources]
    sinks = [one for one in profile.sinks() if one.topic]
    action = [
        {**_bound(one.topic, one.type, safety="zeros" if one.hold == "zero" else "hold"), "select": _select(one)}
        for one in sinks
    ]
    table = {"robot_type": profile.robot or profile.name, "robot_interface": "ros2", "fps": round(1 / profile.period)}
    table |= {"observations": {**images, "observation.state": state}, "actions": {"action": action}}
    return str(yaml.safe_dump(table, sort_keys=False))


def _bound(topic: str, kind: str, **more: str) -> Row:
    package, _, name = bare_type(kind).partition("/")
    timeline = "header" if has_header(kind) else "receive"
    channel = {"topic": topic, "type": f"{package}/msg/{name}", **more}
    return {"channel": channel, "align": {"strategy": "hold", "timeline": timeline}}


def _select(entry: Source | Sink, field: str = "position") -> list[str]:
    """Its numbers as rosetta selects them."""
    return [*entry.fields] or [f"{field}.{name}" for name in entry.names]
