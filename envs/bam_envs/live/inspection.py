"""Inspect a live robot by listening only: its description, topics, types and messages. No command is sent."""

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from bam_envs.core.errors import LinkLost
from bam_envs.core.robot import RobotSpec
from bam_envs.core.timing import Deadline
from bam_envs.live.bringup import TIMEOUT, TopicTypes, ask, tagged_sinks
from bam_envs.live.command_proof import CommandProof, needed_proof
from bam_envs.live.robot_identity import robot_identity
from bam_envs.live.state import Letter
from bam_envs.ros.codec import INFO_SERVICE, RobotInfo, read_info
from bam_envs.ros.messages import same_type
from bam_envs.ros.profile_tables import RobotProfile, Sink, Source
from bam_envs.rosbridge.bus import Caller, Listener, Message
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint

LISTEN = 0.5
"""Shortest time for which messages are collected [s]."""
DESCRIPTION, DESCRIPTION_TYPE = "/robot_description", "std_msgs/String"
"""The topic on which a robot publishes its URDF, latched."""
TOOL_POSE = ("tool_position", "tool_quaternion")
"""Optional signals of an arm: the pose of its tool, as its controller measures it."""
_RETRY = 0.1
"""Time between two questions for the type of a topic [s]."""
_AGES = 3
"""Duration of the collection, in multiples of the longest allowed age of a state."""


@dataclass(frozen=True)
class Inspection:
    """The collected messages of a robot and the types of its topics, which are named without the namespace."""

    info: RobotInfo | None
    """The robot's description of itself; None if it has none."""
    sources: tuple[Source, ...]
    """Topics of the task's signals, and of the tool's pose if the profile has it."""
    sinks: tuple[Sink, ...]
    """Topics of the task's commands."""
    types: Mapping[str, str] | None
    """Type of each topic on the server, empty if the server does not know it; None without an answer."""
    letters: Mapping[str, tuple[Letter, ...]]
    """Messages of each topic, in order."""
    seconds: float
    """Time for which messages were collected [s]."""
    wall_ahead: float = 0.0
    """The local wall clock minus the local monotonic clock [s]."""
    server_offset: float | None = None
    """The local wall clock minus the server's [s]; None if the server does not report its time."""
    proof: CommandProof | None = None
    """The proof of the commands of a real arm; None for any other robot."""
    identity: str = ""
    """Serial number or name of the robot; empty if neither is known."""


@dataclass
class _Inbox:
    """Collects messages by topic; its listeners run on the network thread."""

    letters: dict[str, list[Letter]] = field(default_factory=dict)
    changed: threading.Condition = field(default_factory=threading.Condition)

    def listener(self, topic: str) -> Listener:
        letters = self.letters.setdefault(topic, [])

        def listen(message: Message, caller: Caller) -> None:
            with self.changed:
                letters.append(Letter(message, time.monotonic(), len(letters) + 1))
                self.changed.notify_all()

        return listen


def inspect_robot(
    endpoint: Endpoint, profile: RobotProfile, spec: RobotSpec, *, listen: float | None = None, timeout: float = TIMEOUT
) -> Inspection:
    """Listen to a robot over a connection of its own, which is closed afterwards; moves nothing.

    Args:
        endpoint: Its address.
        profile: Its topics.
        spec: Signals and commands of the task.
        listen: Time for which messages are collected after the first of each topic [s]; None: three times the longest
            allowed age of a state, at least `LISTEN`.
        timeout: Longest wait for the first message of each topic, and for a missing topic [s].

    Raises:
        NoServer: There is no usable server.
        LinkLost: The link dropped.
        ProtocolError: The robot's description of itself cannot be read.
        InvalidValue: The robot is another one than the endpoint names.
    """
    narrowed = profile.narrowed(spec.command.labels)
    required = tuple(profile.source(signal.name) for signal in spec.signals)
    extra = tuple(source for source in profile.state if source.signal in TOOL_POSE and source not in required)
    longest = max((source.max_age or profile.max_age) for source in required)
    listen = max(LISTEN, _AGES * longest) if listen is None else listen
    link = RosbridgeLink(endpoint, name="contract")
    try:
        link.connect()
        service = link.namespace + INFO_SERVICE
        answer = ask(link, service)
        info = None if answer is None else read_info(answer.get("message"), service)
        sinks = (tagged_sinks(narrowed, None) if info is not None else None) or narrowed.sinks()
        needed = {entry.topic: entry.type for entry in (*required, *sinks)}
        wanted = {**needed, **{source.topic: source.type for source in extra}, DESCRIPTION: DESCRIPTION_TYPE}
        types = _types(link, TopicTypes(link, profile, timeout), wanted, needed, timeout)
        identity = robot_identity(endpoint, profile, info)
        proof = needed_proof(link, info, narrowed, sinks, endpoint, identity)
        inbox = _Inbox()
        start = _listen(link, inbox, wanted, {sink.topic for sink in sinks}, types)
        awaited = {source.topic for source in required} & inbox.letters.keys()
        with inbox.changed:
            inbox.changed.wait_for(lambda: all(inbox.letters[topic] for topic in awaited) or not link.is_up, timeout)
            inbox.changed.wait_for(lambda: not link.is_up, listen)
            letters = {topic: tuple(collected) for topic, collected in inbox.letters.items()}
        if not link.is_up:
            raise LinkLost(f"{link.url}: the link dropped while the robot's topics were checked.")
        seconds = time.monotonic() - start
        ahead = time.time() - time.monotonic()
        every, offset = (*required, *extra), link.clock_offset
        return Inspection(info, every, sinks, types, letters, seconds, ahead, offset, proof, identity)
    finally:
        link.close()


def _types(
    link: RosbridgeLink, types: TopicTypes, wanted: Mapping[str, str], needed: Mapping[str, str], timeout: float
) -> Mapping[str, str] | None:
    """Types of the `wanted` topics; waits for the `needed` ones, because the discovery of nodes takes time."""
    deadline, found = Deadline(timeout), {topic: types.type_of(link.namespace + topic) for topic in wanted}
    while types.answers and not all(found[topic] for topic in needed) and not deadline.passed:
        time.sleep(_RETRY)
        found |= {topic: types.type_of(link.namespace + topic) for topic in needed if not found[topic]}
    return found if types.answers else None


def _listen(
    link: RosbridgeLink, inbox: _Inbox, wanted: Mapping[str, str], sinks: set[str], types: Mapping[str, str] | None
) -> float:
    """Subscribe to the `wanted` topics other than commands; returns the time on the monotonic clock [s]."""
    for topic, expected in wanted.items():
        kind = expected if types is None else types[topic]
        if topic not in sinks and kind and same_type(kind, expected):
            link.subscribe(link.namespace + topic, kind, inbox.listener(topic))
    return time.monotonic()
