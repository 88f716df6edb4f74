"""Taking over a robot from its live agent, over requests on `AGENT_TOPIC`.

A request is ``{"do": "look" | "take" | "hand_back", "who": name}``. To look shows who drives; to take asks for the
lease, and pauses the policy; to hand back ends the lease, and the agent's setting says whether the policy goes on.
"""

import getpass
import socket
from contextlib import suppress
from typing import Any

from bam_envs.core.errors import BamEnvsError, NotInCommand
from bam_envs.ros.codec import AGENT_TOPIC
from bam_envs.ros.freshness import Tagger
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.string_rpc import StringRpc

_ANSWER = 3.0  # longest wait for an answer [s]


def person() -> str:
    """The name of who runs this process, for other people: ``anna@laptop``."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without an entry, as in a container
        user = "somebody"
    return f"{user}@{socket.gethostname()}"


class TakeOver:
    """The lease of one client on a robot that a live agent drives."""

    def __init__(self, link: RosbridgeLink, tagger: Tagger) -> None:
        self._link, self._rpc = link, StringRpc(link, link.namespace + AGENT_TOPIC, tagger)
        self.taken = False
        """Whether this client drives."""

    def look(self) -> None:
        """Raise `NotInCommand` if somebody else drives; the policy does not count."""
        answer = self._call("look")
        if answer.get("owner") is not None:
            raise NotInCommand(f"{self._link.url}: {answer.get('refusal')}")

    def take(self) -> None:
        """Take over; the policy is paused. Raises `NotInCommand` if somebody else drives, or nobody can now."""
        self._call("take")
        self.taken = True

    def hand_back(self) -> None:
        """End the lease, if this client has it. Never raises; the agent ends it by itself when the link is cut."""
        if self.taken and self._link.is_up:
            with suppress(BamEnvsError):
                self._call("hand_back")
        self.taken = False
        self._rpc.close()

    def _call(self, do: str) -> dict[str, Any]:
        return self._rpc.call({"do": do, "who": person()}, _ANSWER)
