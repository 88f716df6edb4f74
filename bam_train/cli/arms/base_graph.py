"""The profile of a described base as its live graph has it: odometry, lasers, and where its speeds go.

The topics are those of the shipped profile of the base, or the usual ones. Where one of them is not there, the topic of
its type with the likeliest name is taken, and a note says so.
"""

from dataclasses import replace
from typing import TypeVar

from bam_envs.core.errors import InvalidValue
from bam_envs.core.wording import listed
from bam_envs.robots.base_description import BaseDescription
from bam_envs.robots.profile import load_profile, shipped_profiles, usual_profile
from bam_envs.ros.messages import same_type
from bam_envs.ros.profile_tables import RobotProfile, Sink, Source
from bam_train.cli.arms.live_graph import LiveGraph, Row, entry_row

Entry = TypeVar("Entry", Source, Sink)
_VELOCITY, _POSE = "base_velocity", "base_pose"
_TWISTS = ("geometry_msgs/Twist", "geometry_msgs/TwistStamped")


class BaseGraphProfile:
    """The tables of a profile of the base `robot` in `graph`.

    Raises:
        InvalidValue: The graph has no odometry, or takes no speeds.
    """

    is_known = True

    def __init__(self, robot: BaseDescription, graph: LiveGraph) -> None:
        self.robot, self.graph = robot, graph
        self.notes: list[str] = []
        """What was assumed, or left out."""
        shipped = (load_profile(name) for name in shipped_profiles())
        own = next((one for one in shipped if one.robot == robot.name), None)
        usual = usual_profile(robot.spec())
        model = own or usual
        sources = self._sources(model, usual)
        self.table: Row = {
            **({} if own is None else {"extends": own.name}),
            "name": robot.name,
            "kind": "base",
            "robot": robot.name,
            "max_age": model.max_age,
            "command_timeout": model.command_timeout,
            **({} if model.watchdog is None else {"watchdog": model.watchdog}),
            "state": [entry_row(source) for source in sources],
            "commands": {mode: [entry_row(sink)] for mode, sink in self._sinks(model).items()},
        }
        if own is None:
            self.notes.append(f"its drive is taken to stop {model.watchdog:g} s after the last command (watchdog)")

    def _sources(self, model: RobotProfile, usual: RobotProfile) -> list[Source]:
        """Where each signal comes from; a pose that has no topic of its own comes with the odometry."""
        odometry = self._placed(model.source(_VELOCITY), _VELOCITY)
        if odometry is None:
            raise self._lacking(model.source(_VELOCITY).type, "its speed")
        found = [odometry]
        for source in (one for one in model.state if one.signal != _VELOCITY):
            placed = self._placed(source, source.signal)
            if placed is None and source.signal == _POSE:
                placed = replace(usual.source(_POSE), topic=odometry.topic)
                self.notes.append(f"{_POSE}: nobody publishes {source.topic}, and {odometry.topic} is used")
            if placed is None:
                self.notes.append(f"{source.signal}: nobody publishes {source.topic}, which bam/avoidance needs")
            else:
                found.append(placed)
        return found

    def _sinks(self, model: RobotProfile) -> dict[str, Sink]:
        """Where the speeds go, by the modes of `model` whose topics are there, or to the likeliest topic."""
        sinks = {mode: rows[0] for mode, rows in model.commands.items()}
        kinds = {mode: self.graph.topics.get(sink.topic, "") for mode, sink in sinks.items()}
        known = {mode: found for mode, sink in sinks.items() if (found := sink.of_type(kinds[mode])) is not None}
        if known:
            return known
        mode, sink = next(iter(sinks.items()))
        for kind in _TWISTS:
            placed = self._placed(sink.of_type(kind) or sink, "speeds")
            if placed is not None:
                return {mode: placed}
        raise self._lacking(" or ".join(_TWISTS), "its commands")

    def _placed(self, entry: Entry, what: str) -> Entry | None:
        """`entry` at its topic, or at the likeliest one of its type; None if there is none."""
        offered = [name for name, kind in self.graph.topics.items() if same_type(kind, entry.type)]
        if entry.topic in offered:
            return entry
        offered.sort(key=lambda name: (not name.endswith(entry.topic.rpartition("/")[2]), len(name), name))
        if not offered:
            return None
        others = f" ({listed(offered[1:])} would be of that type too)" if offered[1:] else ""
        self.notes.append(f"{what}: {entry.topic} is not there, and {offered[0]} is used{others}")
        return replace(entry, topic=offered[0])

    def _lacking(self, kind: str, what: str) -> InvalidValue:
        return InvalidValue(
            f"{self.graph.url}: no topic of {kind} for {what}; there are {listed(sorted(self.graph.topics))}. Is the "
            f"driver of {self.robot.name} running, and is its namespace in the address (ws://host:9090/a200_0000)?"
        )
