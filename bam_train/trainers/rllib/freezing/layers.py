"""The pieces of a frozen RLlib policy as torch modules: what encodes observations, the network, what makes actions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from bam_train.errors import PolicyError
from bam_train.trainers.rllib.freezing.parts import Array, Filter, PolicyParts, leaf_spaces


class Layer(nn.Module):  # type: ignore[misc]
    """A torch module; torch has no types here."""


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


class _OneHot(Layer):
    """A Discrete, (n,), or MultiDiscrete, (n, k): a one-hot code of each number, side by side."""

    def __init__(self, counts: Array, starts: Array) -> None:
        super().__init__()
        self.columns = torch.as_tensor(np.repeat(np.arange(len(counts)), counts))
        values = [np.arange(count) + start for count, start in zip(counts, starts, strict=True)]
        self.values = torch.as_tensor(np.concatenate(values))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x.long()
        x = x.unsqueeze(1) if x.ndim == 1 else x.flatten(1)
        return (x.index_select(1, self.columns) == self.values).float()


def encoder(parts: PolicyParts) -> nn.Module:
    """Return what turns the tuple of raw arrays into what RLlib's network takes, (n, ...) float32."""
    return _Observation(parts)


def _leaf(space: Any) -> nn.Module:
    if isinstance(space, spaces.Discrete):
        return _OneHot(np.array([space.n]), np.array([space.start]))
    if isinstance(space, spaces.MultiDiscrete):
        return _OneHot(space.nvec.ravel(), space.start.ravel())
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


def to(x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Cast, without leaving a node in the graph where there is nothing to do."""
    return x if x.dtype == dtype else x.to(dtype)


def torch_dtype(dtype: Any) -> torch.dtype:
    """Return torch's name for a NumPy dtype."""
    return torch.as_tensor(np.zeros((), dtype)).dtype


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


class _Choice(Layer):
    """The best of each group of scores, counted from ``starts``: Discrete gives (n,), MultiDiscrete (n, k)."""

    def __init__(self, counts: list[int], starts: Array, dtype: torch.dtype) -> None:
        super().__init__()
        self.counts, self.starts, self.dtype = counts, torch.as_tensor(starts), dtype
        self.single, self.shifted = np.ndim(starts) == 0, bool(np.any(starts))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.single:
            best = x.argmax(1)
        else:
            best = torch.cat([group.argmax(1, keepdim=True) for group in x.split(self.counts, dim=1)], 1)
        return to(best + self.starts if self.shifted else best, self.dtype)

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        gaps = [group.topk(2)[0] for group in scores.split(self.counts, dim=1) if group.shape[1] > 1]
        return torch.stack([gap[:, 0] - gap[:, 1] for gap in gaps]).amin(0) if gaps else torch.ones(len(scores))


def head(parts: PolicyParts) -> nn.Module:
    """Return what turns the network's output into an action of the environment's space."""
    space = parts.action_space
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        return _Continuous(space, parts)
    if isinstance(space, spaces.Discrete):
        return _Choice([int(space.n)], np.asarray(space.start), torch.int64)
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1:
        return _Choice(space.nvec.tolist(), space.start, torch_dtype(space.dtype))
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
