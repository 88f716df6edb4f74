"""Taking over a robot from its live agent, over requests on `AGENT_TOPIC`.

A request is ``{"do": "look" | "take" | "hand_back", "who": name}``. To look shows who drives; to take asks for the
lease, and pauses the policy; to hand back ends the lease, and the agent's setting says whether the policy goes on.
"""

import getpass
import json
import socket
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import BamEnvsError, NotInCommand
from bam_envs.ros.codec import AGENT_STEP_TOPIC, AGENT_TOPIC
from bam_envs.ros.freshness import Tagger
from bam_envs.rosbridge.ros_bus import RosBus
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

    def __init__(self, link: RosBus, tagger: Tagger) -> None:
        self._link, self._rpc = link, StringRpc(link, link.namespace + AGENT_TOPIC, tagger)
        self.taken = False
        """Whether this client drives."""
        self.guards: dict[str, dict[str, Any]] = {}
        """Number, and commands altered, ticks held and stops, of each guard of the agent that acted on this client's
        commands, by name; known once the robot was handed back."""
        self._is_watched = False  # whether a learner wants the steps
        self._step = 0

    def look(self) -> None:
        """Raise `NotInCommand` if somebody else drives; the policy does not count."""
        answer = self._call("look")
        if answer.get("owner") is not None:
            raise NotInCommand(f"{self._link.url}: {answer.get('refusal')}")

    def take(self) -> None:
        """Take over; the policy is paused. Raises `NotInCommand` if somebody else drives, or nobody can now."""
        answer = self._call("take")
        self.taken, self._step = True, 0
        self._is_watched = answer.get("learner") is True
        if self._is_watched:
            self._link.advertise(self._link.namespace + AGENT_STEP_TOPIC, "std_msgs/String")

    def tell_step(
        self,
        observation: NDArray[np.float32],
        action: NDArray[np.float32],
        reward: float,
        next_observation: NDArray[np.float32],
        *,
        terminated: bool,
        success: bool,
    ) -> None:
        """Publish the numbers of a step on `AGENT_STEP_TOPIC`, as JSON, if the agent has a learner."""
        if self.taken and self._is_watched:
            arrays = {"observation": observation, "action": action, "next_observation": next_observation}
            row = {name: np.asarray(array, np.float64).tolist() for name, array in arrays.items()}
            row |= {"reward": reward, "terminated": terminated, "success": success, "step": self._step}
            self._link.publish_soon(self._link.namespace + AGENT_STEP_TOPIC, {"data": json.dumps(row)})
        self._step += 1

    def hand_back(self) -> str:
        """End the lease, if this client has it, and return the agent's state then; "" if it is unknown.

        Never raises; the agent ends the lease by itself when the link is cut.
        """
        state = ""
        if self.taken and self._link.is_up:
            with suppress(BamEnvsError):
                answer = self._call("hand_back")
                state, self.guards = str(answer.get("state", "")), answer.get("guards", {})
        self.taken = False
        self._rpc.close()
        return state

    def _call(self, do: str) -> dict[str, Any]:
        return self._rpc.call({"do": do, "who": person()}, _ANSWER)
