"""The frozen policy of an offline learner."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from bam_train.trainers.frozen_network import FrozenNetwork, Normalised, action_head, pack, to
from bam_train.trainers.offline.training_data import LIMIT, Normaliser


class OfflinePolicy(FrozenNetwork):
    """From raw observations to actions: normalise, the learner's network, then squash or choose.

    Args:
        scores: A module, or a function of normalised observations (n, inputs), that computes scores (n, k).
        normaliser: That of the learner.
        observation_space: The environment's.
        action_space: The environment's.
        tanh: Whether the scores of a Box are to be squashed to [-1, 1].
    """

    def __init__(
        self,
        scores: nn.Module | Callable[[torch.Tensor], torch.Tensor],
        normaliser: Normaliser,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *,
        tanh: bool,
    ) -> None:
        super().__init__(observation_space)
        own = copy.deepcopy(scores).cpu().eval().requires_grad_(False) if isinstance(scores, nn.Module) else scores
        self.network, start = own, 0
        self.normalised = Normalised(normaliser.mean, normaliser.deviation, LIMIT)
        for key, leaf in self.leaves.items():
            part = slice(start, start + int(np.prod(leaf.shape)))
            start = part.stop
            moments = normaliser.mean[part].reshape(leaf.shape), normaliser.deviation[part].reshape(leaf.shape)
            self.moments[key] = moments
        self.head = action_head(action_space, tanh=tanh, scale=True, clip=True)

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """Scores (n, k) float32 of raw observations."""
        flat = torch.cat([to(one, torch.float64).flatten(1) for one in observation], 1)
        return self.network(to(self.normalised(flat), torch.float32))

    def members(self) -> tuple[bytes, bytes]:
        """The ONNX file, and golden observations with the actions that torch computes for them."""
        observations = self.golden_observations()
        with torch.no_grad():
            actions = self(*map(torch.as_tensor, observations.values())).numpy()
        return self.onnx_file(), pack(observations, actions)
