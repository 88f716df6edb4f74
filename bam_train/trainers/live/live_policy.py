"""The frozen policy of a live learner: an actor that remembers its last actions, and may explore.

A robot runs frozen policies, which draw no random numbers. So a policy that explores carries its noise: a table of
`TAPE` draws, of which each step takes the next. An episode begins at a place that follows from its first observation;
otherwise the noise of a step would be the same in all episodes of a candidate, and would be imitated like a skill.
"""

import copy
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from bam_envs.core.spaces import space_to_json
from bam_train.errors import SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.trainers.frozen_network import FrozenNetwork, action_head, pack
from bam_train.trainers.live.rlpd import Actor

TAPE = 512
"""Steps of noise in a policy, a power of two; after the last comes the first."""
_FINE = 1000.0  # parts of a number that make another beginning


class LivePolicy(FrozenNetwork):
    """A copy of an actor, from raw observations to actions; its state are the last actions, and a place in the noise.

    Args:
        actor: The actor.
        history: Last actions that it sees.
        observation_space: A Box.
        action_space: A Box with bounds.
        noise: Standard normal numbers for exploration, (TAPE, a); None for the deterministic policy.
    """

    def __init__(
        self,
        actor: Actor,
        history: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        noise: np.ndarray | None = None,
    ) -> None:
        super().__init__(observation_space)
        self.actor = copy.deepcopy(actor).cpu().eval().requires_grad_(False)
        self.head = action_head(action_space, tanh=True, scale=True, clip=True)
        self.kept = (history - 1) * action_space.shape[0]
        self.noise = None if noise is None else torch.as_tensor(noise, dtype=torch.float32)
        self.odd = torch.arange(1, 2 * int(np.prod(observation_space.shape)), 2, dtype=torch.float64)
        if history:
            self.state["actions"] = torch.zeros(2, history * action_space.shape[0])
        if noise is not None:
            self.state["place"] = torch.zeros(2, 1)  # 0: an episode begins; else 1 more than the place in the table

    def forward(self, *inputs: torch.Tensor) -> Any:
        """The action, and the next state."""
        observation, *state = inputs
        actions = state[0] if "actions" in self.state else None
        seen = observation.flatten(1) if actions is None else torch.cat([observation.flatten(1), actions], 1)
        mean, log_deviation = self.actor(seen)
        following = []
        place = torch.zeros(())
        if self.noise is not None:
            place = torch.where(state[-1] < 0.5, self._beginning(observation.flatten(1)), state[-1] - 1.0)
            mean = mean + self.noise.index_select(0, place[:, 0].long()) * log_deviation.exp()
        if actions is not None:
            following.append(torch.cat([torch.tanh(mean), actions[:, : self.kept]], 1))
        if self.noise is not None:
            place = place + 1.0
            following.append(place * (place < TAPE).float() + 1.0)
        action = self.head(mean)
        return (action, *following) if following else action

    def _beginning(self, observation: torch.Tensor) -> torch.Tensor:
        """A place in the table for the first observation, in whole numbers, which are exact everywhere. (n, 1)."""
        parts = (observation * _FINE).long().abs().double()
        total = (parts * self.odd).sum(1, keepdim=True)
        return (total - TAPE * (total / TAPE).long().double()).float()


def require_spaces(observed: Any, acted: Any) -> tuple[spaces.Box, spaces.Box]:
    """The spaces of observations and actions; raises SettingsError if they are not arrays of bounded numbers."""
    if not isinstance(observed, spaces.Box) or observed.dtype != np.float32:
        raise SettingsError(f"--learner: expected an observation space Box of float32, found {observed}")
    if not isinstance(acted, spaces.Box) or len(acted.shape) != 1 or not acted.is_bounded("both"):
        raise SettingsError(f"--learner: expected an action space Box of one axis with bounds, found {acted}")
    return observed, acted


def members(policy: LivePolicy, observed: spaces.Box, acted: spaces.Box) -> tuple[bytes, bytes]:
    """The ONNX file of a policy, and its golden actions: the steps of one episode, computed by torch."""
    observations = policy.golden_observations()
    state, actions = [one[:1] for one in policy.state.values()], []
    with torch.no_grad():
        for observation in observations[""]:
            outputs = policy(torch.as_tensor(observation)[None], *state)
            action, *state = outputs if isinstance(outputs, tuple) else (outputs,)
            actions.append(action[0].numpy())
    return policy.onnx_file(), pack(observations, np.stack(actions))


def frozen(policy: LivePolicy, observed: spaces.Box, acted: spaces.Box) -> FrozenPolicy:
    """The policy for evaluation."""
    return FrozenPolicy.from_graph(policy.onnx_file(), space_to_json(observed), space_to_json(acted))
