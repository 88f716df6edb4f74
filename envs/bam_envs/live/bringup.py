"""Connect a live robot: read its description, check its topics and its readiness, and open a session.

A rosbridge server does not report a wrong topic or type. Each topic is therefore checked by its type, if the server
offers rosapi, and each source by its first message. Where another server or another robot answers, it is named.

Longer than most files: all that a client learns of a server before it may move the robot there.
"""

import math
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import closing, suppress
from functools import partial
from typing import Any

from bam_envs.arms.description import ArmDescription
from bam_envs.core.errors import BamEnvsError, LinkLost, NotReady, ProtocolError, RemoteError, StaleState
from bam_envs.core.robot import RobotSpec
from bam_envs.core.robot_models import find_model, known_models
from bam_envs.core.timing import Deadline
from bam_envs.live.state import LiveState, Mailbox
from bam_envs.ros.codec import INFO_SERVICE, RobotInfo, has_room, not_wanted, read_info
from bam_envs.ros.freshness import Tagger, read_tag
from bam_envs.ros.messages import bare_type, names_of, same_type, tag_text
from bam_envs.ros.profile_tables import Enable, Readiness, RobotProfile, Sink
from bam_envs.rosbridge.bus import Caller, Message, namespaces_with
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.ros_bus import RosBus, bare_reason
from bam_envs.rosbridge.sessions import LEASE_TOPIC, LEAVE, RENEW, SESSION_SERVICE, is_forbidden, read_session

TIMEOUT = 3.0
"""Longest wait for the answer of a service, and for a first message, unless the endpoint has a timeout [s]."""
_TRIES, _TRY_AGAIN = 3, 0.1
"""Number of calls of a service within `TIMEOUT`, and the time between two checks of a topic [s]."""
FIRST_WITHIN = 0.3
"""Longest wait for the latched topics that report whether the robot is ready [s]."""
_ANSWER_WITHIN = 2.0
_ENABLED_WITHIN = 10.0
"""Longest wait for the answer of a service that enables a robot [s]."""
_RIVAL_TIME = 1.0
"""How long after a command of somebody else a robot counts as driven by it [s]."""
_RENEW_EVERY, _RENEWAL_LIFE = 0.5, 1.0
"""Time between two renewals of the lease, and how long each is valid [s]; the robot's side waits for several of them
(`CommandLease`)."""
_STATES = 5
"""Number of states of a topic that should arrive per period, and within the age at which a state is too old."""
_JOINT_STATES = "sensor_msgs/JointState"
_NAMED_WITHIN, _OTHERS_WITHIN = 2.0, 0.2
"""Longest wait for the names of joints, and for those of the other publishers on a topic [s]."""
_ACTIVE = ("active", "running")
"""The states of a controller that takes commands, in ROS 2 and in ROS 1."""


def ask(
    link: RosBus, service: str, tries: int = _TRIES, *, request: Mapping[str, Any] | None = None
) -> dict[str, Any] | None:
    """Call `service`; None if it does not exist, `LinkLost` if it does not answer.

    `RemoteError` if this client may only watch.

    It is called several times: a ROS 2 bridge creates a client for each call, and loses an answer that comes before
    client and service have discovered each other.
    """
    try:
        return link.call(service, "", dict(request or {}), TIMEOUT / _TRIES)
    except RemoteError as error:
        if is_forbidden(error):
            raise
        return None  # there is no such service
    except LinkLost:
        if tries == 1 or not link.is_up:
            raise
        return ask(link, service, tries - 1, request=request)


def robot_info(link: RosBus) -> RobotInfo | None:
    """The robot's description of itself; None if it has none.

    Raises:
        ProtocolError: It cannot be read, or something without a robot is served there.
    """
    service = link.namespace + INFO_SERVICE
    answer = ask(link, service)
    return None if answer is None else read_info(answer.get("message"), f"{link.url}: {service}")


def enable(link: RosBus, services: Iterable[Enable], profile: RobotProfile, *, needed: bool) -> None:
    """Call `services` in their order; `NotReady` for the first that does not succeed, or is `needed` and absent."""
    for one in services:
        name = link.namespace + one.service
        try:
            response = link.call(name, "", dict(one.request), _ENABLED_WITHIN)
        except RemoteError as error:
            if not needed and "does not exist" in str(error):  # a served robot has no motors to enable
                continue
            why, remedy = f"failed: {bare_reason(link.url, error)}", f"or change it in the profile of {profile.name}"
        except LinkLost as error:
            why, remedy = f"is not known to have succeeded: {bare_reason(link.url, error)}", "and try again"
        else:
            why, remedy = one.trouble(response) or "", "and try again"
        if why:
            raise NotReady(
                f"{link.url}: {name}, which {one.does}, {why}. Look at the robot's driver, {remedy}. Nothing has moved."
            )


def info_by_profile(url: str, profile: RobotProfile, unknown: Iterable[str] = ()) -> RobotInfo:
    """A description of a robot at `url` that does not describe itself; `unknown` names its silent topics."""
    silent = ", ".join(name.rpartition("/")[2] for name in unknown)
    rest = f"; it does not report {silent}" if silent else ""
    return RobotInfo(
        profile.name,
        text=f"the robot at {url}, which does not describe itself (profile {profile.name}{rest})",
        watchdog=profile.watchdog,
    )


def least_interval(profile: RobotProfile, period: float, topic: str, *, describes_itself: bool) -> int:
    """Least time between two messages of a state topic to ask the server for [ms]; 0: each message.

    A driver may send 500 states a second, and the queues of a busy bridge delay them all. Where several publish on a
    topic, the bridge might always drop those of the same publisher. A robot that describes itself sends no more than is
    needed.
    """
    is_shared = any(source.partial for source in profile.state if source.topic == topic)
    return 0 if describes_itself or is_shared else int(1000 * min(period, profile.max_age) / _STATES)


def tagged_sinks(profile: RobotProfile, mode: str | None) -> tuple[Sink, ...] | None:
    """The sinks of `mode`, or of the first mode, whose topics have room for a tag; None if there are none."""
    modes = profile.commands.values() if mode is None else [profile.sinks(mode)]
    return next((sinks for sinks in modes if all(one.tag and has_room(one.type) for one in sinks if one.topic)), None)


class TopicTypes:
    """Asks a server for the types of its topics, if it offers rosapi; waits at most `timeout` [s] for each."""

    def __init__(self, link: RosBus, profile: RobotProfile, timeout: float) -> None:
        self._link, self._profile, self._timeout = link, profile, timeout
        self.answers = True
        """Whether the server offers rosapi, as far as is known."""

    def check(self, topic: str, expected: str) -> str:
        """The type of `topic` on the server, `expected` if it is unknown; `ProtocolError` for a different one."""
        kind = self.type_of(topic) or expected
        if not same_type(kind, expected):
            raise self._wrong_type(topic, expected, kind)
        return kind

    def may_be(self, topic: str, kind: str) -> bool:
        """Whether `topic` is of type `kind` on the server, or its type is unknown."""
        actual = self.type_of(topic)
        return same_type(actual, kind) if actual else not self.answers

    def check_listened(self, topic: str, sink: Sink) -> Sink:
        """`sink`, whose `topic` needs a subscriber, with the type that this has: its own, or see `Sink.of_type`."""
        deadline, expected = Deadline(self._timeout), sink.type
        while not self.type_of(topic) and self.answers:
            if deadline.passed:
                raise ProtocolError(
                    f"Nobody listens to {topic} ({expected}), which takes {', '.join(sink.labels)}. Is the controller "
                    f"active, and is the topic called so? Topics are in the profile of {self._profile.name}; "
                    f"this may be another robot than it describes.{namespaces_with(self._link, 'topics', sink.topic)}"
                )
            time.sleep(_TRY_AGAIN)  # nodes of a ROS graph take a while to discover each other
        kind = bare_type(self.type_of(topic) or expected)
        found = sink.of_type(kind)
        if found is None:
            raise self._wrong_type(topic, expected, kind)
        return found

    def check_offered(self, sink: Sink) -> None:
        """`ProtocolError` if it is known that nobody offers the action or the service of `sink`, or another type."""
        deadline, name = Deadline(self._timeout), self._link.namespace + sink.address
        what = "action" if sink.action else "service"
        while not (kind := self.offered(name, sink)):
            if deadline.passed:
                raise ProtocolError(
                    f"Nobody offers the {what} {name} ({sink.type}), which takes {', '.join(sink.labels)}: start the "
                    f"gripper's driver, or change `{what}` in the profile of {self._profile.name}."
                )
            time.sleep(_TRY_AGAIN)
        if bare_type(kind) != sink.type:
            raise self._wrong_type(name, sink.type, kind)

    def offered(self, name: str, sink: Sink) -> str:
        """The type of the action or service `name` on the server, that of `sink` if it is unknown; empty if absent."""
        what = "action" if sink.action else "service"
        try:  # a rosapi may lack any of the services
            if sink.action:  # many lack `action_type`
                servers = self._link.call("/rosapi/action_servers", "", {}, self._timeout).get("action_servers")
                if name not in (servers or ()):
                    return ""
            answer = self._link.call(f"/rosapi/{what}_type", "", {what: name}, self._timeout)
        except RemoteError:
            return sink.type
        return str(answer.get("type") or "")

    def _wrong_type(self, topic: str, expected: str, kind: str) -> ProtocolError:
        return ProtocolError(
            f"{topic} is a {kind} there, and {expected} was expected. "
            f"Correct the topic or its type in the profile of {self._profile.name}."
        )

    def type_of(self, topic: str) -> str:
        """The type of `topic` on the server; empty if it is unknown."""
        if not self.answers:
            return ""
        try:
            answer = self._link.call("/rosapi/topic_type", "rosapi/TopicType", {"topic": topic}, self._timeout)
        except RemoteError:  # the rosapi node does not run
            self.answers = False
            return ""
        kind = answer.get("type")
        return kind if isinstance(kind, str) else ""


def await_first(link: RosBus, state: LiveState, profile: RobotProfile, timeout: float) -> None:
    """Wait until every source has sent a message; `StaleState` names those that are silent after `timeout` [s]."""
    wanted = {source.signal: f"{link.namespace}{source.topic} ({source.type})" for source in state.sources}
    arrived = state.mailbox.wait_for(lambda slots: wanted.keys() <= slots.keys() or not link.is_up, timeout)
    if not link.is_up:
        raise LinkLost(f"{link.url}: the link dropped while the robot's topics were checked.")
    if arrived:
        return
    newest = state.mailbox.newest()
    silent = dict.fromkeys(topic for signal, topic in wanted.items() if signal not in newest)
    reports = [str(status.get("msg")) for status in link.statuses]
    raise StaleState(
        f"{', '.join(silent)}: no message in {timeout:g} s. Does it run, and is the topic called so? "
        f"Topics are in the profile of {profile.name}." + (f" The server reported: {reports[-1]}" if reports else "")
    )


class LiveReadiness:
    """Whether a robot is ready to move, by the topics in `profile.readiness` and the controllers of `sinks`.

    All of them are optional: a robot is driven without those that it does not report, which `unknown` names. A robot
    that somebody else commands is not ready; that is seen where commands have room for the tag of `session`.
    """

    def __init__(self, profile: RobotProfile, sinks: tuple[Sink, ...], types: TopicTypes, session: str) -> None:
        self._profile, self._types, self._sinks, self._session = profile, types, sinks, session
        self._begun = False
        self._rival, self._rival_at = "", -math.inf  # topic and time of the last command of somebody else
        self.mailbox = Mailbox()
        """Messages by topic; to be cleared when the link is down."""
        self._subscribed: tuple[Readiness, ...] = ()
        named = dict.fromkeys(sink.controller for sink in sinks if sink.controller)
        self._controllers = tuple(named) if profile.controllers else ()
        self._states: Mapping[str, str] | None = None  # of the controllers, by name
        self._answers = bool(self._controllers)  # whether the server has the service that lists them

    def begin(self, link: RosBus) -> None:
        """Subscribe to the topics, wait briefly for their latched messages, and query the controllers."""
        if not self._begun:  # on a later connection the link subscribes again by itself
            self._begun = True
            every = self._profile.readiness
            self._subscribed = tuple(one for one in every if self._types.may_be(link.namespace + one.topic, one.type))
            for one in self._subscribed:
                link.subscribe(link.namespace + one.topic, one.type, self.mailbox.listener(one.topic))
            for sink in (one for one in self._sinks if one.topic):
                kind = self._types.type_of(link.namespace + sink.topic) or sink.type
                if has_room(kind):
                    link.subscribe(link.namespace + sink.topic, kind, partial(self._on_command, sink.topic))
        topics = {one.topic for one in self._subscribed}
        self.mailbox.wait_for(lambda slots: topics <= slots.keys() or not link.is_up, FIRST_WITHIN)
        self._rival_at = -math.inf  # a ROS 2 bridge repeats commands of the last second to who subscribes
        self._query(link)

    def _on_command(self, topic: str, message: Message, caller: Caller) -> None:
        tag = read_tag(tag_text(message))
        if tag is None or tag.session != self._session:
            self._rival, self._rival_at = topic, time.monotonic()

    @property
    def has_rival(self) -> bool:
        """Whether somebody else has just commanded the robot."""
        return time.monotonic() - self._rival_at < _RIVAL_TIME

    def owns(self, status: Mapping[str, Any], namespace: str) -> bool:
        """Whether a `status` of the server is about these topics, which a server need not offer."""
        return status.get("id") in {f"subscribe:{namespace}{one.topic}" for one in self._subscribed}

    def fault(self, *, moving: bool) -> str | None:
        """Why the newest messages report that the robot is not ready, or None. Thread-safe.

        While it is `moving`, measured numbers (`at_least`) are ignored, because they may dip.
        """
        if self.has_rival:
            return f"somebody else commands the robot on {self._rival}; end the other program first"
        letters = self.mailbox.newest()
        for one in self._subscribed:
            if one.topic in letters and not (moving and one.at_least is not None):
                trouble = one.trouble(letters[one.topic].message)
                if trouble is not None:
                    return trouble
        return None

    def not_ready(self, link: RosBus) -> str | None:
        """As `fault`, including the controllers, whose states are queried now."""
        reason = self.fault(moving=False)
        if reason is not None:
            return reason
        self._query(link)
        for name in self._controllers:
            state = "active" if self._states is None else self._states.get(name, "not loaded")
            if state not in _ACTIVE:
                return f"the controller {name} is {state}: ros2 control switch_controllers --activate {name}"
        return None

    def _query(self, link: RosBus) -> None:
        """Query the states of the controllers; a server without that service is not queried again."""
        if not self._answers:
            return
        try:
            answer = link.call(link.namespace + self._profile.controllers, "", {}, _ANSWER_WITHIN)
        except (RemoteError, ProtocolError):
            self._answers = False
            return
        except LinkLost:  # the states may have changed
            self._states = None
            return
        listed: Any = answer.get("controller")
        readable = isinstance(listed, list) and all(isinstance(one, Mapping) for one in listed)
        self._states = {str(one.get("name")): str(one.get("state")) for one in listed} if readable else None

    @property
    def unknown(self) -> tuple[str, ...]:
        """Topics without a readable message, and the service of the controllers if its answer was unreadable."""
        letters = self.mailbox.newest()
        topics = (
            one.topic
            for one in self._profile.readiness
            if one.topic not in letters or one.value(letters[one.topic].message) is None
        )
        return (*topics, *([self._profile.controllers] if self._controllers and self._states is None else []))


class DrivingSession:
    """The session of a client: opened by a service call, left at the end.

    While the client drives, a separate thread renews the lease, so that a slow policy does not lose it.
    """

    def __init__(self) -> None:
        self.tagger = Tagger()
        """Signs messages for the open session; without one, as for robots without sessions, it signs nothing."""
        self._link: RosBus | None = None  # of the open session
        self._thread: threading.Thread | None = None
        self._left = threading.Event()

    def open(self, link: RosBus) -> None:
        """Leave the session that is open, and open a new one on `link` if the robot's side has sessions."""
        link.advertise(link.namespace + LEASE_TOPIC, "std_msgs/String")
        self.leave()
        answer = ask(link, link.namespace + SESSION_SERVICE)
        if answer is not None:
            self.tagger, self._link = read_session(answer, SESSION_SERVICE), link

    @property
    def is_driving(self) -> bool:
        """Whether the lease is renewed."""
        return self._thread is not None

    def drive(self) -> None:
        """Start to renew the lease."""
        if self._link is not None and self._thread is None:
            self._left = threading.Event()
            self._thread = threading.Thread(target=self._renew, args=(self._left,), name="bam-lease", daemon=True)
            self._thread.start()

    def leave(self) -> None:
        """Give the lease back at once. Idempotent; never raises."""
        self._left.set()
        if self._thread is not None:
            self._thread.join()
        self._send(LEAVE)
        self._link = self._thread = None

    def _renew(self, left: threading.Event) -> None:
        while not left.wait(_RENEW_EVERY):
            self._send(RENEW)

    def _send(self, word: str) -> None:
        link = self._link
        if link is None:
            return
        tag = self.tagger.next(link.epoch, _RENEWAL_LIFE)
        text = f"{word} {self.tagger.sign(tag, LEASE_TOPIC, word.encode())}"
        with suppress(BamEnvsError):  # a link that is down is reported by the next command
            link.publish(link.namespace + LEASE_TOPIC, {"data": text})


# ---- another server, or another robot


def what_answers(link: RosBus, wanted: str) -> str:
    """What the server of a link is instead of the `wanted` one, in a sentence; empty if it does not tell."""
    with suppress(BamEnvsError):
        answer = ask(link, link.namespace + INFO_SERVICE)
        return "" if answer is None else not_wanted(answer.get("message"), wanted)
    return ""


def what_answers_at(endpoint: Endpoint, wanted: str) -> str:
    """As `what_answers`, of the server at an address, to which nothing is connected yet."""
    with suppress(BamEnvsError), closing(RosbridgeLink(endpoint, name="recognition")) as link:
        link.connect()
        return what_answers(link, wanted)
    return ""


def another_robot(link: RosBus, spec: RobotSpec) -> str:
    """Which described arm the robot of a link is, in a sentence, if it lacks joints of the arm of `spec`; else empty.

    It is known by the names of its joints.
    """
    ours = [label for label, unit in zip(spec.command.labels, spec.command.units, strict=True) if unit == "rad"]
    if not ours or set(ours) <= (there := _measured_joints(link)):
        return ""
    arms = {name: find_model(name, ArmDescription).joint_names for name in known_models(ArmDescription)}
    fits = {name: joints for name, joints in sorted(arms.items()) if set(joints) <= there}
    names = [name for name, joints in fits.items() if len(joints) == max(map(len, fits.values()))]
    if not names:
        return ""
    return (
        f"this is another robot: joints {', '.join(fits[names[0]])}, and {spec.name} has {', '.join(ours)}. If it is "
        f"the right address, choose --robot-model {' or '.join(names)}, or a checkpoint for it."
    )


def _measured_joints(link: RosBus) -> set[str]:
    """The joints in the next messages of joint states in the namespace of a link, whatever their topics."""
    with suppress(BamEnvsError):  # a server without rosapi
        answer, inbox = link.call("/rosapi/topics", "rosapi/Topics", {}, _NAMED_WITHIN), Mailbox(keeps_all=True)
        rows = zip(map(str, answer.get("topics") or ()), map(str, answer.get("types") or ()), strict=False)
        topics = {topic for topic, kind in rows if same_type(kind, _JOINT_STATES)}
        topics = {topic for topic in topics if topic.startswith(f"{link.namespace}/")}
        for topic in sorted(topics):
            link.subscribe(topic, _JOINT_STATES, inbox.listener(topic))
        inbox.wait_for(lambda slots: topics <= slots.keys() or not link.is_up, _NAMED_WITHIN)
        inbox.wait_for(lambda slots: False, _OTHERS_WITHIN)
        letters = [letter for topic in topics for letter in tuple(inbox.letters[topic])]
        return {name for one in letters for name in names_of(one.message, "name", "joint states")}
    return set()
