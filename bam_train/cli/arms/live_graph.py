"""A live graph, and the profile of a described arm as it has it: topics, joints, controllers, gripper, services.

rosapi tells what there is, and the controller manager which controllers take which joints. What neither tells, such as
the unit of a gripper's joint or the request of a service, is that of a shipped profile with the same names; else it is
assumed, and a note says so.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass
from typing import Any

from bam_envs.arms.description import ArmDescription
from bam_envs.core.errors import InvalidValue, LinkLost, RemoteError
from bam_envs.core.wording import listed
from bam_envs.live.bringup import TIMEOUT, robot_info
from bam_envs.live.examination import DESCRIPTION
from bam_envs.live.state import Letter, Mailbox
from bam_envs.robots.profile import load_profile, shipped_profiles
from bam_envs.ros.messages import bare_type
from bam_envs.ros.profile_tables import RobotProfile, Sink, Source
from bam_envs.rosbridge.client import RosbridgeLink
from bam_train.settings import toml_text

_STATES, _TRAJECTORY, _ARRAY = "sensor_msgs/JointState", "trajectory_msgs/JointTrajectory", "std_msgs/Float64MultiArray"
_LISTEN = 1.0
"""Time for which joint states are collected after the first [s]: several publishers may share a topic."""
_WIDTH = "gripper_width"
_GOALS = {
    "control_msgs/GripperCommand": "command.position",
    "control_msgs/ParallelGripperCommand": "command.position[0]",  # since ROS 2 Jazzy
    "franka_msgs/Move": "width",
}
"""Actions that move a gripper, and where the number is in their goals; the first that is offered is used."""
_TOPICS = {_TRAJECTORY: ("{}/joint_trajectory", "trajectory"), _ARRAY: ("{}/commands", "position")}
"""Types of the commands of controllers: the topic of a controller, and the name of the command mode."""
_ACTIVE = ("active", "running")
_ROS1_GOAL = "ActionGoal"
_FASTEST = 100
"""Greatest rate at which a controller that holds its set points gets some [Hz]: more is a burden for a bridge."""
Row = dict[str, Any]


@dataclass(frozen=True)
class LiveGraph:
    """What a robot's side offers, without the namespace of its address."""

    url: str
    topics: Mapping[str, str]
    """Type of each topic, ``pkg/Type``."""
    services: frozenset[str]
    actions: Mapping[str, str]
    """Type of each action; empty if it is not told."""
    manager: str
    """The service that lists the controllers; empty: there is none."""
    controllers: tuple[Mapping[str, Any], ...]
    """Its answer."""
    joints: Mapping[str, tuple[tuple[str, ...], ...]]
    """Names in the joint states of each topic, once for each publisher."""
    name: str = ""
    """What the robot calls itself, or its profile; empty: it does not tell."""
    urdf: tuple[Letter, ...] = ()
    """Its URDF, as it came."""
    commands: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Joints that topics of commands take, in their order, where a contract says them."""
    cameras: tuple[Row, ...] = ()
    """Its cameras, where a contract says them."""


def read_graph(link: RosbridgeLink) -> LiveGraph:
    """Ask rosapi and the controller manager, and listen to joint states. Moves nothing.

    Raises:
        InvalidValue: rosapi does not run there.
        LinkLost: The link dropped.
    """

    def ours(names: Iterable[Any]) -> list[str]:
        beneath = (str(name) for name in names if str(name).startswith(f"{link.namespace}/"))
        return [name.removeprefix(link.namespace) for name in beneath]

    try:
        answer = link.call("/rosapi/topics", "rosapi/Topics", {}, TIMEOUT)
    except RemoteError as error:
        raise InvalidValue(
            f"{link.url}: rosapi, which tells what there is, does not run there. Start it beside the bridge: "
            "ros2 run rosapi rosapi_node."
        ) from error
    kinds = dict(zip(answer.get("topics") or (), map(bare_type, answer.get("types") or ()), strict=False))
    topics = {name: kinds[link.namespace + name] for name in ours(kinds)}
    services = frozenset(ours(_ask(link, "services").get("services") or ()))
    actions = {
        name: bare_type(str(_ask(link, "action_type", action=link.namespace + name).get("type") or ""))
        for name in ours(_ask(link, "action_servers").get("action_servers") or ())
    }
    goals = {name: kind for name, kind in topics.items() if kind.endswith(_ROS1_GOAL)}  # of actionlib, in ROS 1
    actions |= {name.removesuffix("/goal"): kind.removesuffix(_ROS1_GOAL) for name, kind in goals.items()}
    manager = next((name for name in sorted(services) if name.endswith("/list_controllers")), "")
    rows: Any = link.call(link.namespace + manager, "", {}, TIMEOUT).get("controller") if manager else ()
    controllers = tuple(row for row in rows or () if isinstance(row, Mapping))
    info = robot_info(link)
    name = "" if info is None else info.name
    joints, urdf = _heard(link, topics)
    return LiveGraph(link.url, topics, services, actions, manager, controllers, joints, name, urdf)


def _ask(link: RosbridgeLink, service: str, **request: str) -> Mapping[str, Any]:
    """The answer of a service of rosapi; empty if this version does not have it."""
    try:
        return link.call(f"/rosapi/{service}", "", request, TIMEOUT)
    except RemoteError:
        return {}


def _heard(
    link: RosbridgeLink, topics: Mapping[str, str]
) -> tuple[dict[str, tuple[tuple[str, ...], ...]], tuple[Letter, ...]]:
    """The names in the joint states of each topic, and the URDF."""
    inbox = Mailbox(keeps_all=True)
    read = {name: kind for name, kind in topics.items() if kind == _STATES or name == DESCRIPTION}
    ends = [link.subscribe(link.namespace + name, kind, inbox.listener(name)) for name, kind in read.items()]
    inbox.wait_for(lambda slots: bool(slots.keys() - {DESCRIPTION}) or not link.is_up, TIMEOUT if read else 0.0)
    inbox.wait_for(lambda slots: not link.is_up, _LISTEN)
    for end in ends:
        end()
    if not link.is_up:
        raise LinkLost(f"{link.url}: the link dropped while its joint states were read.")
    states = [name for name in inbox.newest() if name != DESCRIPTION]
    heard = {name: [letter.message.get("name") or () for letter in inbox.letters[name]] for name in states}
    joints = {name: tuple(dict.fromkeys(tuple(map(str, one)) for one in names)) for name, names in heard.items()}
    return joints, tuple(inbox.letters[DESCRIPTION])


class GraphProfile:
    """The tables of a profile of `arm` in `graph`.

    Raises:
        InvalidValue: The graph has not what the arm needs, or more than one of it; the text says which.
    """

    def __init__(self, arm: ArmDescription, graph: LiveGraph) -> None:
        self.robot, self.arm, self.graph = arm, arm, graph
        self.notes: list[str] = []
        """What was assumed, or left out."""
        shipped = [load_profile(name) for name in shipped_profiles()]
        arms = [one for one in shipped if one.kind == "arm"]
        labels = (*arm.joint_names, _WIDTH)
        self._known = sorted(arms, key=lambda one: (one.robot != arm.name, one.command.labels != labels))
        same = [one for one in self._known if one.robot == arm.name or one.command.labels == labels]
        self._base = next((one for one in same if one.readiness or one.identity), None)
        self._topic, self._names = self._arm_states()
        self._gripper, template = self._gripper_state()
        self.is_known = template is not None
        """Whether the unit of the gripper's joint is known."""
        sinks = self._sinks(template)
        self.table: Row = {
            "name": arm.name,
            "kind": "arm",
            "robot": arm.name,
            "max_age": 0.1,
            "command_timeout": 0.1,
            **({"controllers": graph.manager} if graph.manager else {}),
            "state": [*self._state_rows(), *self._object_rows()],
            "commands": sinks,
            "enable": [*self._enabling()],
            "limits": next((dict(one.limits) for one in self._known if one.robot == arm.name), {}),
            **({"cameras": [*graph.cameras]} if graph.cameras else {}),
        }
        if self._base is not None:  # what a graph need not show: whether the robot is ready, and which one it is
            self.table = {"extends": self._base.name, **self.table}
            optional = [source for source in self._base.state if source.optional]
            self.table["state"] += [entry_row(source) for source in optional]

    # ---- states

    def _arm_states(self) -> tuple[str, dict[str, str]]:
        """The topic of the joint states, and the name there of each joint of the description."""
        heard = {topic: {name for names in one for name in names} for topic, one in self.graph.joints.items()}
        order = sorted(heard, key=lambda topic: (topic != "/joint_states", len(topic)))
        for topic in order:
            names = _named(self.arm.joint_names, heard[topic])
            if names:
                return topic, names
        if not heard:
            raise InvalidValue(
                f"{self.graph.url}: no joint states came in {TIMEOUT:g} s. Is the driver of {self.arm.name} running?"
            )
        topic = max(order, key=lambda one: len(heard[one] & set(self.arm.joint_names)))
        missing = [name for name in self.arm.joint_names if name not in heard[topic]]
        raise InvalidValue(
            f"{self.graph.url}: {topic} has no {', '.join(missing)} of {self.arm.name}; it has "
            f"{', '.join(sorted(heard[topic]))}. Is another arm there? Else correct the names in its description."
        )

    def _gripper_state(self) -> tuple[Row, RobotProfile | None]:
        """The source of the gripper's width, and the shipped profile that has a gripper with the same joint."""
        joint = self.arm.gripper.joint
        topics = [self._topic, *(one for one in sorted(self.graph.joints) if one != self._topic)]
        found = {topic: _affixed(joint, self._names, self.graph.joints[topic]) for topic in topics}
        topic = next((one for one in topics if found[one]), None)
        if topic is None:
            every = sorted({name for sets in self.graph.joints.values() for names in sets for name in names})
            raise InvalidValue(
                f"{self.graph.url}: no joint states have {joint}, the gripper of {self.arm.name}; they have "
                f"{', '.join(every)}. Start the gripper's driver, or correct gripper.joint in the description."
            )
        row: Row = {"signal": _WIDTH, "topic": topic, "type": _STATES, "field": "position", "names": [found[topic]]}
        template = next((one for one in self._known if joint in _width_source(one).names), None)
        if template is None:
            self.notes.append(f"{joint} is taken for the gripper's width in m; else give its source scale and offset")
            return row, None
        source = _width_source(template)
        for key, value in zip(("scale", "offset"), self._converted(template, source.scale, source.offset), strict=True):
            row |= {key: value} if value is not None else {}
        return row | ({"max_age": source.max_age} if source.max_age is not None else {}), template

    def _converted(
        self, template: RobotProfile, scale: Sequence[float], offset: Sequence[float]
    ) -> tuple[float | None, float | None]:
        """Scale and offset of a known gripper's joint for the width of this one; None for the defaults."""
        share = self.arm.gripper.open / template.signal(_WIDTH).high[0] if offset[-1] else 1.0
        return (scale[-1] * share if scale[-1] != 1.0 else None), (offset[-1] * share if offset[-1] else None)

    def _state_rows(self) -> Iterator[Row]:
        names, sets = list(self._names.values()), self.graph.joints[self._topic]
        partial = {"partial": True} if len(sets) > 1 else {}
        for what in ("position", "velocity"):
            row = {"signal": f"joint_{what}", "topic": self._topic, "type": _STATES, "field": what, "names": names}
            yield {**row, **partial}
        beside = {name for one in self.graph.joints[self._gripper["topic"]] for name in one}
        others = sorted(beside - {*names, *self._gripper["names"]})
        if len(self.graph.joints[self._gripper["topic"]]) > 1:
            self._gripper["partial"] = True
        yield self._gripper | ({"ignore": others} if others else {})

    def _object_rows(self) -> Iterator[Row]:
        if self.graph.topics.get("/object_pose") != "geometry_msgs/PoseStamped":
            self.notes.append("nobody publishes /object_pose (geometry_msgs/PoseStamped), which picking needs")
        row: Row = {"topic": "/object_pose", "type": "geometry_msgs/PoseStamped", "frame": "base_link"}
        for signal, part, axes in (("position", "position", "xyz"), ("quaternion", "orientation", "wxyz")):
            yield {"signal": f"object_{signal}", **row, "fields": [f"pose.{part}.{axis}" for axis in axes]}

    # ---- commands

    def _sinks(self, template: RobotProfile | None) -> dict[str, list[Row]]:
        """The command modes, the one of the active controller first."""
        modes: dict[str, list[Row]] = {}
        gripper: Row | None = None
        for mode, row in self._arm_sinks(template):
            if _WIDTH in row["labels"]:
                modes[mode] = [row]
                continue
            gripper = gripper or self._gripper_sink(template)
            modes[mode] = [gripper, row]
        return modes

    def _arm_sinks(self, template: RobotProfile | None) -> Iterator[tuple[str, Row]]:
        """Mode and row of each kind of controller that takes the arm's joints."""
        rows = self._controllers() if self.graph.controllers else self._topics_alone()
        taking: dict[str, list[tuple[str, str, list[str], bool]]] = {}  # by type: controller, topic, joints, is active
        for controller, kind, topic, joints, is_active in rows:
            taking.setdefault(kind, []).append((controller, topic, joints, is_active))
        active = [name for some in taking.values() for name, *_, is_active in some if is_active]
        every = [name for some in taking.values() for name, *_ in some]
        if not every:
            raise InvalidValue(
                f"{self.graph.url}: no controller there takes all joints of {self.arm.name} ({', '.join(self._names)}) "
                "by joint trajectories or positions. Load one, such as joint_trajectory_controller."
            )
        if not active:
            raise InvalidValue(
                f"{self.graph.url}: none of the controllers of {self.arm.name} is active ({', '.join(every)}): "
                f"ros2 control switch_controllers --activate {every[0]}"
            )
        if len(active) > 1:
            raise InvalidValue(
                f"{self.graph.url}: {listed(active)} are active and take the same joints. Stop all but one: "
                f"ros2 control switch_controllers --deactivate {active[1]}"
            )
        for kind, some in sorted(taking.items(), key=lambda one: not any(is_active for *_, is_active in one[1])):
            some.sort(key=lambda one: not one[-1])
            controller, topic, joints, is_active = some[0]
            for other, *_ in some[1:]:
                self.notes.append(f"{other} takes the same joints, and is not active: {controller} is used")
            if not is_active:
                self.notes.append(f"{controller} is not active now")
            yield self._armentry_row(controller, kind, topic, joints, template)

    def _armentry_row(
        self, controller: str, kind: str, topic: str, joints: list[str], template: RobotProfile | None
    ) -> tuple[str, Row]:
        """Mode and row of one controller."""
        label_of = {name: label for label, name in self._names.items()} | {self._gripper["names"][0]: _WIDTH}
        labels = [label_of[name] for name in joints]
        row: Row = {"topic": topic, "type": kind, "labels": labels}
        row |= {"controller": controller} if controller else {}
        row |= {"names": joints} if joints != labels else {}
        if _WIDTH in labels and template is not None:
            for key, usual in (("scale", 1.0), ("offset", 0.0)):
                value = self._gripper.get(key, usual)
                row[key] = [value if label == _WIDTH else usual for label in labels]
        rates = [one.get("update_rate") for one in self.graph.controllers if one.get("name") == controller]
        if kind == _ARRAY and isinstance(rate := next(iter(rates), 0), int) and rate > 0:  # it holds its set points
            row["rate"] = float(min(rate, _FASTEST))
        row |= {"reach_periods": 2.0} if kind == _TRAJECTORY else {}
        modes = ((mode, sinks[-1]) for one in self._known for mode, sinks in one.commands.items())
        shipped = next((mode for mode, sink in modes if sink.topic == topic), "")
        return shipped or _TOPICS.get(kind, ("", "joints"))[1], row

    def _controllers(self) -> Iterator[tuple[str, str, str, list[str], bool]]:
        """Controller, type and topic of its commands, its joints, whether it is active; of all that take the arm's."""
        wanted, jaw = set(self._names.values()), self._gripper["names"][0]
        for row in self.graph.controllers:
            name, kind = str(row.get("name")), str(row.get("type"))
            interfaces: Any = row.get("required_command_interfaces") or row.get("claimed_interfaces") or ()
            named = [str(one).rpartition("/") for one in interfaces]
            joints = list(dict.fromkeys(joint for joint, _, what in named if what != "velocity"))
            if "JointImpedanceController" in kind:
                command, topic = _STATES, "/target_joint"
            else:
                command = _TRAJECTORY if "JointTrajectoryController" in kind else _ARRAY
                topic = _TOPICS[command][0].format(f"/{name}")
            taken = wanted <= set(joints) <= wanted | {jaw}
            if taken and bare_type(self.graph.topics.get(topic, "")) == command:
                yield name, command, topic, joints, row.get("state") in _ACTIVE

    def _topics_alone(self) -> Iterator[tuple[str, str, str, list[str], bool]]:
        """The same by the names of topics, where nothing lists the controllers."""
        if self.graph.commands:
            yield from (
                ("", self.graph.topics[topic], topic, [*names], True) for topic, names in self.graph.commands.items()
            )
            return
        self.notes.append("nothing lists the controllers: which joints each takes is assumed")
        for topic, kind in self.graph.topics.items():
            if kind == _TRAJECTORY and "gripper" not in topic:
                yield "", kind, topic, list(self._names.values()), True

    def _gripper_sink(self, template: RobotProfile | None) -> Row:
        """Where the gripper's width goes."""
        known = [] if template is None else [one for one in template.sinks() if one.labels == (_WIDTH,)]
        for sink in known:
            if all(map(self._offers, sink.forms)):
                return entry_row(sink) | self._joint_unit(sink.type)
        for kind, place in _GOALS.items():
            actions = sorted(name for name, one in self.graph.actions.items() if one == kind)
            if actions:
                row: Row = {"action": actions[0], "type": kind, "labels": [_WIDTH], "fields": [place]}
                if kind == "control_msgs/ParallelGripperCommand":
                    row["constants"] = {"command.name[0]": self._gripper["names"][0]}
                row |= self._joint_unit(kind)
                self.notes += [f"{other} is offered too, and not used" for other in actions[1:]]
                return row
        topics = sorted(one for one, kind in self.graph.topics.items() if kind == _ARRAY and "gripper" in one)
        if not topics:
            offered = ", ".join([*self.graph.actions]) or "no action at all"
            raise InvalidValue(
                f"{self.graph.url}: nobody offers the gripper of {self.arm.name}: no action of "
                f"{', '.join(_GOALS)}, and no topic of a gripper; there is {offered}. Start the gripper's driver."
            )
        return {"topic": topics[0], "type": _ARRAY, "labels": [_WIDTH], "hold": "last"}

    def _joint_unit(self, kind: str) -> Row:
        """Scale and offset of a goal of type `kind`, if its number is the position of the gripper's joint."""
        keys = ("scale", "offset") if kind.startswith("control_msgs/") else ()
        return {key: self._gripper[key] for key in keys if key in self._gripper}

    def _offers(self, sink: Sink) -> bool:
        if sink.action:
            return self.graph.actions.get(sink.action) in (sink.type, "")
        return self.graph.topics.get(sink.topic) == sink.type if sink.topic else sink.service in self.graph.services

    def _enabling(self) -> Iterator[Row]:
        """The services of a shipped profile that are all offered here."""
        for one in self._known:
            if one.enable and {row.service for row in one.enable} <= self.graph.services:
                yield from ({**asdict(row), "request": dict(row.request)} for row in one.enable)
                return


def _width_source(profile: RobotProfile) -> Source:
    return profile.source(_WIDTH)


def _named(joints: Sequence[str], heard: set[str]) -> dict[str, str]:
    """The name of each joint among those that are `heard`: its own, or all with one prefix and suffix; else empty."""
    fits = []
    for name in sorted(heard, key=len):
        before, found, behind = name.partition(joints[0])
        if found and all(f"{before}{joint}{behind}" in heard for joint in joints):
            fits.append({joint: f"{before}{joint}{behind}" for joint in joints})
    exact = [one for one in fits if one == dict(zip(joints, joints, strict=True))]
    return exact[0] if exact else fits[0] if len(fits) == 1 else {}


def _affixed(joint: str, names: Mapping[str, str], sets: Iterable[Sequence[str]]) -> str:
    """The name of the gripper's `joint` among `sets` of names: its own, or with the affixes of the arm's; or empty."""
    heard = {name for one in sets for name in one}
    first, there = next(iter(names.items()))
    before, _, behind = there.partition(first)
    return next((one for one in (joint, f"{before}{joint}{behind}") if one in heard), "")


def entry_row(entry: Source | Sink) -> Row:
    """A table of a profile that gives `entry`."""
    usual: Row = {one.name: one.default if one.default is not MISSING else None for one in fields(entry)}
    row: Row = {}
    for name, value in ((one.name, getattr(entry, one.name)) for one in fields(entry)):
        plain: Any = list(value) if isinstance(value, tuple) else dict(value) if isinstance(value, Mapping) else value
        plain = asdict(value) if is_dataclass(value) and not isinstance(value, type) else plain
        if name in ("scale", "offset"):
            if set(value) != set(usual[name]):
                row[name] = plain if len(set(plain)) > 1 else plain[0]
        elif plain not in (usual[name], [], {}) and not (name == "names" and value == getattr(entry, "labels", None)):
            row[name] = plain
    return {key: value for key, value in row.items() if key not in ("tag", "ignore")}


def profile_toml(profile: Any) -> str:
    """The text of the profile's file, its notes as comments at the head."""
    table, lines = profile.table, [f"# {profile.robot.title}, as {profile.graph.url} offers it."]
    lines += [f"# {note}." for note in profile.notes]
    lines += ["", *(f"{key} = {toml_text(value)}" for key, value in table.items() if isinstance(value, (str, float)))]
    if table["kind"] == "arm" and not profile.graph.manager:
        lines.append('# controllers = "/controller_manager/list_controllers"   # nothing there lists them')
    tables = [("state", row) for row in table["state"]]
    tables += [(f"commands.{mode}", row) for mode, rows in table["commands"].items() for row in rows]
    tables += [(name, row) for name in ("enable", "cameras") for row in table.get(name, ())]
    for name, row in tables:
        lines += ["", f"[[{name}]]", *(f"{key} = {toml_text(value)}" for key, value in row.items())]
        if row.get("signal") == _WIDTH and not profile.is_known:
            lines += ["# scale = 1.0   # width in m = position of the joint x scale + offset", "# offset = 0.0"]
    if table.get("limits"):
        lines += ["", "[limits]", *(f"{key} = {toml_text(value)}" for key, value in table["limits"].items())]
    return "\n".join(lines) + "\n"
