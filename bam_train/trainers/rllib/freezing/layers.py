"""The pieces of a frozen RLlib policy as torch modules: what encodes observations, the network, what makes actions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from bam_train.errors import PolicyError
from bam_train.trainers.freezing.layers import Choice, Layer, OneHot, to
from bam_train.trainers.rllib.freezing.parts import Filter, PolicyParts, leaf_spaces

# Observation


class _Observation(Layer):
    """What RLlib's connectors do: one-hot, flatten, normalise in float64, float32."""

    def __init__(self, parts: PolicyParts) -> None:
        super().__init__()
        leaves = leaf_spaces(parts.observation_space)
        _require_flat(parts, leaves)
        self.leaves = nn.ModuleList(_leaf(leaf) if parts.flatten else nn.Identity() for leaf in leaves.values())
        self.flatten = parts.flatten
        early, late = (parts.filter, None) if parts.filter_first else (None, parts.filter)
        shape = (-1,) if parts.flatten else _only(leaves).shape
        self.early = nn.Identity() if early is None else _Normalised(early, _only(leaves).shape)
        self.late = nn.Identity() if late is None else _Normalised(late, shape)

    def forward(self, tensors: tuple[torch.Tensor, ...]) -> torch.Tensor:
        encoded = [leaf(self.early(tensor)) for leaf, tensor in zip(self.leaves, tensors, strict=True)]
        return to(self.late(encoded[0] if len(encoded) == 1 else torch.cat(encoded, 1)), torch.float32)


class _Normalised(Layer):
    """clip((x - offset) / divisor, -limit, limit) in float64, then back to the type it came in."""

    def __init__(self, given: Filter, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.offset, self.divisor = (torch.as_tensor(part.reshape(shape)) for part in (given.offset, given.divisor))
        self.limit = given.limit or None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = (to(x, torch.float64) - self.offset) / self.divisor
        return to(y if self.limit is None else y.clamp(-self.limit, self.limit), x.dtype)


class _Numbers(Layer):
    """A Box or MultiBinary as one vector, float32."""

    def __init__(self, dimensions: int) -> None:
        super().__init__()
        self.dimensions = dimensions

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x.unsqueeze(1) if self.dimensions == 0 else x.flatten(1) if self.dimensions > 1 else x
        return to(x, torch.float32)


def encoder(parts: PolicyParts) -> nn.Module:
    """Return what turns the tuple of raw arrays into what RLlib's network takes, (n, ...) float32."""
    return _Observation(parts)


def _leaf(space: Any) -> nn.Module:
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return OneHot(space)
    return _Numbers(len(space.shape))


def _only(leaves: dict[str, Any]) -> Any:
    return next(iter(leaves.values()))


def _require_flat(parts: PolicyParts, leaves: dict[str, Any]) -> None:
    """Refuse what RLlib's own networks do not take, and what normalising would round to whole numbers."""
    floats = all(isinstance(leaf, spaces.Box) and np.issubdtype(leaf.dtype, np.floating) for leaf in leaves.values())
    single = isinstance(parts.observation_space, spaces.Box)
    if not parts.flatten and not single:
        kind = type(parts.observation_space).__name__
        raise PolicyError(f"observation: a {kind} without FlattenObservations cannot be frozen")
    early = parts.filter is not None and (parts.filter_first or not parts.flatten)
    if early and not (single and floats):
        raise PolicyError("observation: MeanStdFilter of anything but a Box of floats cannot be frozen")


# Action


class _Continuous(Layer):
    """Squash if asked to, then stretch from [-1, 1] to the bounds or clip to them, as RLlib's connector does."""

    def __init__(self, space: spaces.Box, parts: PolicyParts) -> None:
        super().__init__()
        self.dtype = torch.float64 if space.dtype == np.float64 else torch.float32
        self.low, self.high = (torch.as_tensor(bound).to(self.dtype) for bound in (space.low, space.high))
        self.half = (self.high - self.low) / 2.0
        bounded = bool(np.isfinite(space.low).all() and np.isfinite(space.high).all())
        self.stretch = parts.normalize_actions and bounded
        self.clip = self.stretch or (parts.clip_actions and not parts.normalize_actions)
        self.squash = parts.squash

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = torch.tanh(x) if self.squash else x
        if self.stretch:
            x = self.low + to(x + 1.0, self.dtype) * self.half
        x = to(x, self.dtype)
        return torch.maximum(torch.minimum(x, self.high), self.low) if self.clip else x

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        return torch.ones(len(scores))


def head(parts: PolicyParts) -> nn.Module:
    """Return what turns the network's output into an action of the environment's space."""
    space = parts.action_space
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        return _Continuous(space, parts)
    if isinstance(space, spaces.Discrete) or (isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1):
        return Choice(space)
    expected = "a Box of floats with one axis, a Discrete or a MultiDiscrete"
    raise PolicyError(f"action space {space} cannot be frozen; expected {expected}")


def outputs_of(parts: PolicyParts) -> int:
    """How many numbers the action is made of: means, or a score for every choice."""
    space = parts.action_space
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    if isinstance(space, spaces.MultiDiscrete):
        return int(space.nvec.sum())
    return math.prod(space.shape or ())
