"""Examine a live robot by listening: its description, topics, types and messages, and the link to it.

No command is sent. Pings have a topic of their own, so that the robot receives nothing.

Longer than most files: messages and pings are collected by one subscription.
"""

import math
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, LinkLost, ProtocolError
from bam_envs.core.robot import RobotSpec
from bam_envs.core.timing import BUSY, Deadline, Pacer, least_lateness
from bam_envs.live.bringup import TIMEOUT, TopicTypes, least_interval, robot_info, tagged_sinks
from bam_envs.live.command_proof import CommandProof, needed_proof, robot_identity
from bam_envs.live.state import Letter, Mailbox, SourceAge, concerns
from bam_envs.robots.linked import LinkProfile
from bam_envs.ros.codec import DESCRIPTION_TOPIC, RobotInfo, decode_source
from bam_envs.ros.messages import same_type
from bam_envs.ros.profile_tables import RobotProfile, Sink, Source
from bam_envs.rosbridge.client import RosbridgeLink

Array = NDArray[np.float64]
LISTEN = 0.5
"""Shortest time for which messages are collected [s]."""
DESCRIPTION, DESCRIPTION_TYPE = DESCRIPTION_TOPIC, "std_msgs/String"
"""The topic on which a robot publishes its URDF, latched."""
TOOL_POSE = ("tool_position", "tool_quaternion")
"""Optional signals of an arm: the pose of its tool, as its controller measures it."""
PING_TOPIC = "/bam/ping"
"""Where pings are published and subscribed (std_msgs/String)."""
_RETRY = 0.1
"""Time between two questions for the type of a topic, and between two pings before the first echo [s]."""
_AGES = 3
"""Duration of the collection, in multiples of the longest allowed age of a state."""
_LAST_ECHOES = 1.0
"""Longest wait for the last echoes [s]."""
_MIN_ECHOES = 10
"""Minimum number of echoes for quantiles."""


@dataclass(frozen=True)
class Reading:
    """The messages of one source. k is the number of readable ones."""

    source: Source
    count: int
    """Number of its messages."""
    arrived: Array
    """When each arrived [s, monotonic clock]. Shape: (k,)."""
    stamps: tuple[float | None, ...]
    """The stamp of each [s, clock of the sender]; None without one. Length: k."""
    delays: Array
    """Age of each at its arrival [s], by its stamp; 0 without a stamp. Shape: (k,)."""
    values: Array
    """The values of each [SI]. Shape: (k, size)."""
    new: int
    """Number of those with a new stamp; a repeated stamp repeats an old measurement."""
    rate: float
    """Those a second [Hz]; 0 for fewer than two."""
    ages: Array
    """Age of the newest message at each tick that began in time, or at all if none did [s]."""
    error: str
    """Error of the first unreadable message; "" for none."""

    @property
    def unread(self) -> int:
        """Number of unreadable messages."""
        return self.count - len(self.arrived)


@dataclass(frozen=True)
class Inspection:
    """The collected messages of a robot and the types of its topics, which are named without the namespace."""

    profile: RobotProfile
    info: RobotInfo | None
    """The robot's description of itself; None if it has none."""
    sources: tuple[Source, ...]
    """Topics of the task's signals, and of the tool's pose if the profile has it."""
    sinks: tuple[Sink, ...]
    """Topics, actions and services of the task's commands."""
    types: Mapping[str, str] | None
    """Type of each topic on the server, and of each action and service of a command; empty if the server does not know
    it; None without an answer."""
    letters: Mapping[str, Sequence[Letter]]
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
    ticks: Array = field(default_factory=lambda: np.empty(0))
    """When a task would have read the state [s, monotonic clock], once a period."""
    late: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))
    """Which of the ticks began late, which is this computer's fault and not the robot's."""
    trips: Array = field(default_factory=lambda: np.empty(0))
    """Round trip of each ping, in order [s]; NaN for a lost ping; empty if the server echoes none. Shape: (pings,)."""
    copies: int = 0
    """Number of echoes that arrived more than once."""
    namespace: str = ""
    """Prefix of its topics on the server, such as /bam_001."""

    @cached_property
    def readings(self) -> Mapping[str, Reading]:
        """The messages of each source, by its signal."""
        return {source.signal: self._reading(source) for source in self.sources}

    @property
    def is_lockstep(self) -> bool:
        """Whether the robot's time advances with commands only, so that its states have neither rate nor age."""
        return self.info is not None and self.info.lockstep

    @property
    def busy(self) -> str:
        """How busy this computer was, in words; empty if few ticks came late."""
        count, late = len(self.ticks), int(self.late.sum())
        return f"this computer is busy: {late} of {count} ticks came late" if late > BUSY * count else ""

    @property
    def lost(self) -> float:
        """Share of lost pings; 1 without pings."""
        return float(np.isnan(self.trips).mean()) if len(self.trips) else 1.0

    @property
    def round_trips(self) -> Array:
        """Round trips of the pings that came back [s]."""
        return self.trips[np.isfinite(self.trips)]

    def _reading(self, source: Source) -> Reading:
        tracker, size = SourceAge(self.wall_ahead), len(self.profile.signal(source.signal).labels)
        arrived, delays, stamps, values, new = list[float](), list[float](), list[float | None](), [], list[float]()
        letters = [one for one in self.letters.get(source.topic, ()) if concerns(source, one.message)]
        error = ""
        for letter in letters:
            try:
                tracker.look(letter, source.topic, self.server_offset)
                values.append(decode_source(source, letter.message, size))
            except ProtocolError as problem:
                error = error or str(problem)
                continue
            if tracker.stamp is None or not stamps or tracker.stamp != stamps[-1]:
                new.append(letter.arrived)
            arrived.append(letter.arrived)
            delays.append(tracker.at(letter.arrived))
            stamps.append(tracker.stamp)
        times, late = np.array(arrived), np.array(delays)
        ticks = self.ticks if self.late.all() else self.ticks[~self.late]
        newest = np.searchsorted(times, ticks, side="right") - 1
        ages = (ticks - (times - late)[newest])[newest >= 0] if arrived else np.empty(0)
        rate = (len(new) - 1) / (new[-1] - new[0]) if len(new) > 1 and new[-1] > new[0] else 0.0
        rows = np.array(values).reshape(-1, size)
        return Reading(source, len(letters), times, tuple(stamps), late, rows, len(new), rate, ages, error)


def measured_link(trips: Array, copies: int, state: Reading, about: str = "") -> LinkProfile:
    """A measured link as a profile for simulations; `about` describes the measurement.

    The delay of one direction is the round trip minus half the median, so that each direction has all of the jitter.
    The delay of a state is its age by its stamp, if it has one. Both directions have the same loss.

    Args:
        trips: See `Inspection.trips`.
        copies: See `Inspection.copies`.
        state: The messages of a source.
        about: For people.

    Raises:
        InvalidValue: Too few pings came back.
    """
    is_lost = np.isnan(trips)
    round_trips = trips[~is_lost]
    if len(round_trips) < _MIN_ECHOES:
        raise InvalidValue(f"{len(round_trips)} pings came back, and quantiles need {_MIN_ECHOES}. Measure for longer.")
    one_way = np.maximum(round_trips - np.median(round_trips) / 2, 0.0)
    states = np.maximum(state.delays, round_trips.min() / 2) if state.delays.any() else one_way
    runs = [len(list(run)) for lost, run in groupby(is_lost) if lost]
    loss = 1 - math.sqrt(1 - is_lost.mean())
    command, state_delay = (np.quantile(way, np.linspace(0, 1, 101)).round(6).tolist() for way in (one_way, states))
    burst = float(np.mean(runs)) if runs else 1.0
    nulls, doubled = state.unread / max(1, state.count), copies / len(trips)
    return LinkProfile(command, state_delay, loss, loss, burst, doubled, nulls, about)


def inspect_robot(
    link: RosbridgeLink,
    profile: RobotProfile,
    spec: RobotSpec,
    *,
    listen: float | None = None,
    timeout: float = TIMEOUT,
    pings: bool = False,
) -> Inspection:
    """Listen to a robot; moves nothing.

    Args:
        link: A connected link; its new topics and subscriptions remain.
        profile: The topics of the robot.
        spec: Signals and commands of the task.
        listen: Time for which messages are collected after the first of each topic [s]; None: three times the longest
            allowed age of a state, at least `LISTEN`.
        timeout: Longest wait for the first message of each topic, for a missing topic, and for the first echo [s].
        pings: Whether to send a ping every period.

    Raises:
        LinkLost: The link dropped.
        ProtocolError: The robot's description of itself cannot be read.
        InvalidValue: The robot is another one than the link's endpoint names.
    """
    narrowed, endpoint = profile.narrowed(spec.command.labels), link.endpoint
    required = tuple(profile.source(signal.name) for signal in spec.signals)
    extra = tuple(source for source in profile.state if source.signal in TOOL_POSE and source not in required)
    longest = max((source.max_age or profile.max_age) for source in required)
    listen = max(LISTEN, _AGES * longest) if listen is None else listen
    epoch, info = link.epoch, robot_info(link)
    sinks = (tagged_sinks(narrowed, None) if info is not None else None) or narrowed.sinks()
    sinks = tuple(form for sink in sinks for form in sink.forms)
    topical = [sink for sink in sinks if sink.topic]
    needed = {entry.topic: entry.type for entry in (*required, *topical)}
    wanted = {**needed, **{source.topic: source.type for source in extra}, DESCRIPTION: DESCRIPTION_TYPE}
    asked = TopicTypes(link, profile, timeout)
    types = _types(link, asked, wanted, needed, timeout)
    if types is not None:
        offered = {sink.address: asked.offered(link.namespace + sink.address, sink) for sink in sinks if not sink.topic}
        types = {**types, **offered}
    identity = robot_identity(endpoint, profile, info)
    inbox = Mailbox(keeps_all=True)
    are_echoed = pings and _are_echoed(link, inbox, timeout)
    unheard, start = {sink.topic for sink in topical}, time.monotonic()
    for topic, expected in wanted.items():
        kind = expected if types is None else types[topic]
        if topic in unheard or not same_type(kind or "", expected):
            unheard.add(topic)
            continue
        least = least_interval(profile, spec.period, topic, describes_itself=info is not None)
        least = 0 if topic == DESCRIPTION else least
        name, listener, length = link.namespace + topic, inbox.listener(topic), 1 if least else 0
        link.subscribe(name, kind, listener, throttle_ms=least, queue_length=length)
    awaited = {source.topic for source in required} - unheard
    inbox.wait_for(lambda slots: awaited <= slots.keys() or not link.is_up, timeout)
    measured = _measure(link, inbox, spec.period, listen, pings=are_echoed)
    if not link.is_up or link.epoch != epoch:
        raise LinkLost(f"{link.url}: the link dropped while the robot's topics were checked.")
    letters = {topic: tuple(inbox.letters[topic]) for topic in wanted.keys() - unheard}
    seconds, ahead = time.monotonic() - start, time.time() - time.monotonic()
    source = next((one for one in required if one.signal == "joint_position"), None)
    mine = [one.message for one in letters.get(source.topic, ()) if concerns(source, one.message)] if source else []
    proof = needed_proof(link, info, narrowed, sinks, endpoint, identity, mine[-1] if mine else None)
    facts = letters, seconds, ahead, link.clock_offset, proof, identity
    return Inspection(profile, info, (*required, *extra), sinks, types, *facts, **measured, namespace=link.namespace)


def _types(
    link: RosbridgeLink, types: TopicTypes, wanted: Mapping[str, str], needed: Mapping[str, str], timeout: float
) -> Mapping[str, str] | None:
    """Types of the `wanted` topics; waits for the `needed` ones, because the discovery of nodes takes time."""
    deadline, found = Deadline(timeout), {topic: types.type_of(link.namespace + topic) for topic in wanted}
    while types.answers and not all(found[topic] for topic in needed) and not deadline.passed:
        time.sleep(_RETRY)
        found |= {topic: types.type_of(link.namespace + topic) for topic in needed if not found[topic]}
    return found if types.answers else None


def _are_echoed(link: RosbridgeLink, inbox: Mailbox, timeout: float) -> bool:
    """Send pings until the first echo; False without one within `timeout` [s]."""
    topic = link.namespace + PING_TOPIC
    link.advertise(topic, "std_msgs/String")
    link.subscribe(topic, "std_msgs/String", inbox.listener(PING_TOPIC))
    for _ in range(max(1, round(timeout / _RETRY))):  # a bridge loses messages until its nodes know each other
        link.publish(topic, {"data": secrets.token_hex(4)})
        if inbox.wait_for(lambda slots: PING_TOPIC in slots, _RETRY):
            return True
    return False


def _measure(link: RosbridgeLink, inbox: Mailbox, period: float, seconds: float, *, pings: bool) -> dict[str, Any]:
    """Tick for `seconds` while messages come, with a ping in each tick; the fields of `Inspection` about that.

    A busy computer, which misses ticks, takes longer for the fewest pings.
    """
    name, sent, ticks, late = secrets.token_hex(4), dict[str, float](), list[float](), list[bool]()
    pacer, enough = Pacer(period), Deadline(seconds)
    pacer.start()
    while link.is_up and not (enough.passed and (len(sent) >= _MIN_ECHOES or not pings)):
        late.append(pacer.wait() > least_lateness(period))
        ticks.append(time.monotonic())
        if pings:
            ping = f"{name} {len(sent)}"
            sent[ping] = time.monotonic()
            link.publish(link.namespace + PING_TOPIC, {"data": ping})

    def echoes() -> dict[str, list[float]]:
        found: dict[str, list[float]] = {}
        for letter in inbox.letters[PING_TOPIC]:
            ping = str(letter.message.get("data")) if isinstance(letter.message, Mapping) else ""
            if ping in sent:
                found.setdefault(ping, []).append(letter.arrived)
        return found

    inbox.wait_for(lambda slots: len(echoes()) == len(sent), _LAST_ECHOES)
    found = echoes()
    trips = np.array([found.get(ping, [math.nan])[0] - at for ping, at in sent.items()])
    copies = sum(len(arrived) - 1 for arrived in found.values())
    return {"ticks": np.array(ticks), "late": np.array(late, np.bool_), "trips": trips, "copies": copies}
