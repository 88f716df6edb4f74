"""Connecting a live robot: who it is, and whether its topics are what the profile says.

A rosbridge server says nothing when a topic or type is wrong, so each is looked at by its effect: its type where the
server can tell it (rosapi), and the first message of every source.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from bam_envs.core.errors import InvalidValue, LinkLost, ProtocolError, RemoteError, StaleState
from bam_envs.live.state import LiveState
from bam_envs.ros.codec import INFO_SERVICE, RobotInfo, read_info
from bam_envs.ros.command_messages import has_room
from bam_envs.ros.messages import bare_type, same_type
from bam_envs.ros.profile_tables import RobotProfile, Sink

if TYPE_CHECKING:
    from bam_envs.rosbridge.client import RosbridgeLink

_ASK_AGAIN = 0.1
TIMEOUT = 3.0
"""Longest that a question to the server takes, and that a first message is waited for [s]."""
_LOOKS = 5
"""How many states of a topic are to come in a period, or in the time after which one is too old."""
_QUESTIONS = 3
"""How often a question is asked in that time."""


def ask_info(link: RosbridgeLink) -> RobotInfo | None:
    """What the robot says of itself; None if it says nothing, as somebody else's does."""
    service = link.namespace + INFO_SERVICE
    answer = ask(link, service)
    return None if answer is None else read_info(answer.get("message"), service)


def ask(link: RosbridgeLink, service: str, questions: int = _QUESTIONS) -> dict[str, Any] | None:
    """What `service`, which takes nothing, answers; None if there is no such service. Asked again where all is silent.

    A ROS 2 bridge makes a client for each call, and the answer is lost where it comes before the two have met.

    Raises:
        LinkLost: No answer.
    """
    try:
        return link.call(service, "", {}, TIMEOUT / _QUESTIONS)
    except RemoteError:  # there is no such service
        return None
    except LinkLost:
        if questions == 1 or not link.is_up:
            raise
        return ask(link, service, questions - 1)


def info_by_profile(url: str, profile: RobotProfile, unknown: Iterable[str] = ()) -> RobotInfo:
    """What is known of a robot at `url` that does not describe itself; `unknown` is where it might say more."""
    silent = ", ".join(name.rpartition("/")[2] for name in unknown)
    rest = f"; it does not say {silent}" if silent else ""
    known = f"profile {profile.name}: {', '.join(profile.command.labels)}"
    return RobotInfo(profile.name, text=f"the robot at {url}, which does not describe itself ({known}{rest})")


def tagged_sinks(profile: RobotProfile, way: str | None, info: RobotInfo) -> tuple[Sink, ...]:
    """Where to send commands so that they say who sent them when, if there is such a way.

    Raises:
        InvalidValue: The robot answers each command, and commands sent this `way` cannot be told apart.
    """
    ways = list(profile.commands) if way is None else [way]
    for one in ways:
        sinks = profile.sinks(one)
        if all(sink.tag and has_room(sink.type) for sink in sinks):
            return sinks
    if info.lockstep:
        raise InvalidValue(
            f"{info.name} goes on with each command, and its answers cannot be told apart: {ways[0]} of the profile of "
            f"{profile.name} has no room for a tag. Give it a way that has, such as stamped messages."
        )
    return profile.sinks(way)


def require_period(info: RobotInfo, period: float) -> None:
    """A robot in lockstep goes on by the task's `period` [s].

    Raises:
        InvalidValue: By another one.
    """
    if info.lockstep and info.period is not None and info.period != period:
        raise InvalidValue(
            f"{info.name} goes on {info.period:g} s with each command, and the task's period is {period:g} s. "
            "Serve the environment that the task is of."
        )


class TopicTypes:
    """Asks a server for the types of its topics, as long as it answers such questions.

    Args:
        link: To the server.
        profile: For texts.
    """

    def __init__(self, link: RosbridgeLink, profile: RobotProfile) -> None:
        self._link, self._profile, self._answers = link, profile, True

    def check(self, topic: str, expected: str) -> str:
        """The type to use for `topic`: the server's, or `expected` where it does not say.

        Raises:
            ProtocolError: `topic` has another type there.
        """
        found = self._found(topic)
        if found and not same_type(found, expected):
            raise self._misfit(topic, expected, found)
        return found or expected

    def may_be(self, topic: str, kind: str) -> bool:
        """Whether `topic` is of type `kind` there, or the server does not say."""
        found = self._found(topic)
        return same_type(found, kind) if found else not self._answers

    def _misfit(self, topic: str, expected: str, found: str) -> ProtocolError:
        return ProtocolError(
            f"{topic} is a {found} there, and {expected} was expected. "
            f"Correct the topic or its type in the profile of {self._profile.name}."
        )

    def check_listened(self, topic: str, sink: Sink) -> str:
        """As `check`, for the `topic` of `sink`, which somebody must listen to; stamped or not must be as expected.

        Raises:
            ProtocolError: `topic` has another type there, or nobody knows it.
        """
        deadline, expected = time.monotonic() + TIMEOUT, sink.type
        while not self._found(topic) and self._answers:
            if time.monotonic() > deadline:
                raise ProtocolError(
                    f"Nobody listens to {topic} ({expected}), which takes {', '.join(sink.labels)}. Is the controller "
                    f"active, and is the topic called so? Topics are in the profile of {self._profile.name}; "
                    "this may be another robot than it describes."
                )
            time.sleep(_ASK_AGAIN)  # nodes of a ROS graph find each other after a while
        found = self._found(topic) or expected
        if bare_type(found) != bare_type(expected):  # what is stamped is read like what is not, and written otherwise
            raise self._misfit(topic, expected, found)
        return found

    def _found(self, topic: str) -> str:
        """The type of `topic` there; empty if the server does not know, or does not say."""
        if not self._answers:
            return ""
        try:
            answer = self._link.call("/rosapi/topic_type", "rosapi/TopicType", {"topic": topic}, TIMEOUT)
        except RemoteError:  # rosapi is a node of its own, and does not run
            self._answers = False
            return ""
        kind = answer.get("type")
        return kind if isinstance(kind, str) else ""


def throttle(profile: RobotProfile, topic: str, period: float) -> int:
    """Least time between two states on `topic` that a bridge is asked for [ms].

    A driver may send 500 a second, and a busy bridge ages each that nobody looks at. A fifth of the `period` [s], or of
    the oldest that is acted on, costs no freshness that matters. Of several publishers on one topic it could be always
    the same one's messages that are left out, so such a topic comes whole.
    """
    if any(source.partial for source in profile.state if source.topic == topic):
        return 0
    return int(1000 * min(period, profile.max_age) / _LOOKS)


def await_first(link: RosbridgeLink, state: LiveState, profile: RobotProfile) -> None:
    """Wait until every source sent something.

    Raises:
        LinkLost: The link dropped.
        StaleState: One is silent; it names its topic, its type, and what the server said.
    """
    wanted = {source.signal for source in state.sources}
    arrived = state.mailbox.wait_for(lambda slots: wanted <= slots.keys() or not link.is_up, TIMEOUT)
    if not link.is_up:
        raise LinkLost(f"{link.url}: the link dropped while the robot's topics were looked at.")
    if arrived:
        return
    silent = dict.fromkeys(f"{link.namespace}{source.topic} ({source.type})" for source in state.silent())
    said = [str(status.get("msg")) for status in link.statuses]
    raise StaleState(
        f"{', '.join(silent)}: no message in {TIMEOUT:g} s. Does it run, and is the topic called so? "
        f"Topics are in the profile of {profile.name}." + (f" The server said: {said[-1]}" if said else "")
    )
