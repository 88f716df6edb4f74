"""What a live robot says of its being ready to move: topics that its profile lists, and the state of its controllers.

All of it is optional. A robot that does not say something is driven without, and `LiveReadiness.unknown` names it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bam_envs.core.errors import LinkLost, ProtocolError, RemoteError
from bam_envs.live.mailbox import Mailbox
from bam_envs.ros.profile_tables import Readiness, RobotProfile, Sink
from bam_envs.rosbridge.bus import Caller, Listener, Message

if TYPE_CHECKING:
    from bam_envs.live.bringup import TopicTypes
    from bam_envs.rosbridge.client import RosbridgeLink

FIRST_WITHIN = 0.3
"""Longest that what a robot says of itself once, and keeps for newcomers, is waited for [s]."""
_ANSWER_WITHIN = 2.0
_ACTIVE = ("active", "running")
"""How ROS 2 and ROS 1 call a controller that takes commands."""


class LiveReadiness:
    """Listens to `profile.readiness`, and asks for the controllers of `sinks`. Topics may be read from any thread.

    Args:
        profile: The robot.
        sinks: Where its commands go.
        types: Knows which topics the server may have.
    """

    def __init__(self, profile: RobotProfile, sinks: tuple[Sink, ...], types: TopicTypes) -> None:
        self._profile, self._types = profile, types
        self._controllers = tuple(dict.fromkeys(sink.controller for sink in sinks if sink.controller))
        self._mailbox = Mailbox()
        self._heard: tuple[Readiness, ...] = ()
        self._states: Mapping[str, str] | None = None
        self._answers = bool(self._controllers and profile.controllers)

    def begin(self, link: RosbridgeLink) -> None:
        """Listen to the topics that the server may have, wait a little for what is said once, ask for the controllers.

        On a later connection the link subscribes by itself.
        """
        if not self._heard:
            self._listen(link)
        topics = {one.topic for one in self._heard}
        self._mailbox.wait_for(lambda slots: topics <= slots.keys() or not link.is_up, FIRST_WITHIN)
        self._ask(link)

    def _listen(self, link: RosbridgeLink) -> None:
        self._heard = tuple(
            one for one in self._profile.readiness if self._types.may_be(link.namespace + one.topic, one.type)
        )
        for one in self._heard:
            link.subscribe(link.namespace + one.topic, one.type, self._listener(one.topic))

    def _listener(self, topic: str) -> Listener:
        def hear(message: Message, caller: Caller) -> None:
            self._mailbox.put([topic], message)

        return hear

    def owns(self, status: Mapping[str, Any], namespace: str) -> bool:
        """Whether a `status` of the server is about these topics: that it cannot pass on one of them is no error."""
        return status.get("id") in {f"subscribe:{namespace}{one.topic}" for one in self._heard}

    def forget(self) -> None:
        """What was heard may not hold any more: the link dropped."""
        self._mailbox.clear()

    def fault(self, *, moving: bool) -> str | None:
        """Why it is not ready, by the newest messages; None if nothing says so.

        Args:
            moving: Leave out measured numbers (`at_least`), which may dip while the robot moves.
        """
        letters = self._mailbox.newest()
        for one in self._heard:
            if one.topic in letters and not (moving and one.at_least is not None):
                trouble = one.trouble(letters[one.topic].message)
                if trouble is not None:
                    return f"{trouble} ({one.topic})"
        return None

    def not_ready(self, link: RosbridgeLink) -> str | None:
        """The same, with the controllers, which are asked for now."""
        said = self.fault(moving=False)
        if said is None:
            self._ask(link)
            said = self._controller_fault()
        return said

    def _ask(self, link: RosbridgeLink) -> None:
        """Learn the states of the controllers; who offers no such service is not asked again."""
        if not self._answers:
            return
        try:
            answer = link.call(link.namespace + self._profile.controllers, "", {}, _ANSWER_WITHIN)
        except (RemoteError, ProtocolError):
            self._answers = False
        except LinkLost:  # what was known is not known any more
            self._states = None
        else:
            self._states = _states_of(answer)

    def _controller_fault(self) -> str | None:
        if self._states is None:
            return None
        for name in self._controllers:
            state = self._states.get(name, "not loaded")
            if state not in _ACTIVE:
                return f"the controller {name} is {state}: ros2 control switch_controllers --activate {name}"
        return None

    @property
    def unknown(self) -> tuple[str, ...]:
        """Topics, and the service of the controllers, that said nothing that could be read."""
        letters = self._mailbox.newest()
        topics = (
            one.topic
            for one in self._profile.readiness
            if one.topic not in letters or one.value(letters[one.topic].message) is None
        )
        asked = bool(self._controllers and self._profile.controllers)
        return (*topics, *([self._profile.controllers] if asked and self._states is None else []))


def _states_of(answer: Mapping[str, Any]) -> dict[str, str] | None:
    """Name and state of each controller in the answer of ``list_controllers``; None if it is none."""
    rows = answer.get("controller")
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
        return None
    return {str(row.get("name")): str(row.get("state")) for row in rows}
