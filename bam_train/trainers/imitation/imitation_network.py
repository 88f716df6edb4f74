"""The network of an imitator: images through small convolutions, numbers as they are, then two layers for both."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from bam_envs.core.spaces import leaves
from bam_train.errors import SettingsError
from bam_train.trainers.frozen_network import KINDS, FrozenNetwork, Layer, OneHot, action_head, pack, to

LIMIT = 10.0
"""Normalised numbers end here."""
_LEAST = 1e-2  # deviation of numbers that hardly change


class Encoder(Layer):
    """Images, (n, height, width, channels) or channels first, to positions in the image, (n, 2 channels).

    Each of the last channels is a map of where something is: its softmax over the image is a distribution, and its mean
    is where (a spatial softmax).
    """

    def __init__(self, space: spaces.Box, channels: int) -> None:
        super().__init__()
        self.channels_last = space.shape[2] < space.shape[0]
        height, width, colours = space.shape if self.channels_last else (*space.shape[1:], space.shape[0])
        self.low, self.range = float(space.low.min()), float(space.high.max()) - float(space.low.min())
        self.layers = nn.Sequential(
            nn.Conv2d(colours, channels, 5, 2, 2), nn.ReLU(),
            nn.Conv2d(channels, 2 * channels, 3, 2, 1), nn.ReLU(),
            nn.Conv2d(2 * channels, 2 * channels, 3, 1, 1),
        )  # fmt: skip
        rows, columns = (torch.linspace(-1, 1, (length + 3) // 4) for length in (height, width))
        grid = torch.stack([one.flatten() for one in torch.meshgrid(columns, rows, indexing="xy")], 1)
        self.register_buffer("grid", grid, persistent=False)
        self.outputs = 4 * channels

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Where things are, from -1 to 1."""
        x = x.permute(0, 3, 1, 2) if self.channels_last else x
        maps = self.layers((to(x, torch.float32) - self.low) * (2 / self.range) - 1)
        return (maps.reshape(-1, self.outputs // 2, len(self.grid)).softmax(2) @ self.grid).flatten(1)


class Numbers(Layer):
    """Numbers, (n, ...), normalised by their moments so far; see `learn`."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.outputs = int(np.prod(shape))
        for name in ("total", "squares"):
            self.register_buffer(name, torch.zeros(self.outputs, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def learn(self, x: torch.Tensor) -> None:
        """Add numbers to the moments."""
        x = x.flatten(1).double()
        self.count += len(x)
        self.total += x.sum(0)
        self.squares += (x * x).sum(0)

    def moments(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation. Shape: (numbers,) float32 each."""
        mean = self.total / self.count.clamp(min=1)
        deviation = (self.squares / self.count.clamp(min=1) - mean * mean).clamp(min=_LEAST**2).sqrt()
        return mean.float(), deviation.float()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalise."""
        mean, deviation = self.moments()
        return ((to(x.flatten(1), torch.float32) - mean) / deviation).clamp(-LIMIT, LIMIT)


class ImitationNetwork(Layer):
    """From observations by key to scores of actions, (n, k), and a guess at `guesses` numbers that the teacher sees."""

    def __init__(self, space: spaces.Space[Any], scores: int, guesses: int, channels: int, width: int) -> None:
        super().__init__()
        self.keys, self.encoders = list(leaves(space)), nn.ModuleList()
        inputs = 0
        for key, leaf in leaves(space).items():
            encoder, outputs = _encoder(key, leaf, channels)
            self.encoders.append(encoder)
            inputs += outputs
        self.body = nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.actor, self.guess = nn.Linear(width, scores), nn.Linear(width, max(1, guesses))
        self.seen = Numbers((guesses,))
        """Moments of what the teacher sees."""

    def learn_moments(self, observation: dict[str, torch.Tensor]) -> None:
        """Add observations (n, ...) to the moments of their numbers."""
        for key, encoder in zip(self.keys, self.encoders, strict=True):
            if isinstance(encoder, Numbers):
                encoder.learn(observation[key])

    def features(self, *observation: torch.Tensor) -> torch.Tensor:
        """The last hidden layer, for observations in the order of `keys`. Shape: (n, width)."""
        parts = [encode(one) for encode, one in zip(self.encoders, observation, strict=True)]
        return self.body(torch.cat(parts, 1))


def _encoder(key: str, leaf: Any, channels: int) -> tuple[nn.Module, int]:
    """The first layers for one array of an observation, and how many numbers they give."""
    if isinstance(leaf, (spaces.Discrete, spaces.MultiDiscrete)):
        one_hot = OneHot(leaf)
        return one_hot, len(one_hot.values)
    if not isinstance(leaf, KINDS):
        raise SettingsError(f"observation {key!r}: expected arrays of numbers or images, found {leaf}")
    if isinstance(leaf, spaces.Box) and len(leaf.shape) == 3 and leaf.is_bounded("both"):
        encoder = Encoder(leaf, channels)
        return encoder, encoder.outputs
    numbers = Numbers(leaf.shape or ())
    return numbers, numbers.outputs


class ImitationPolicy(FrozenNetwork):
    """The frozen policy: from raw observations to actions."""

    def __init__(self, network: ImitationNetwork, seen: spaces.Space[Any], acts: spaces.Space[Any]) -> None:
        super().__init__(seen)
        self.network = copy.deepcopy(network).cpu().eval().requires_grad_(False)
        for key, encoder in zip(self.network.keys, self.network.encoders, strict=True):
            if isinstance(encoder, Numbers):
                self.moments[key] = tuple(one.numpy().reshape(self.leaves[key].shape) for one in encoder.moments())
        self.head = action_head(acts, tanh=False, scale=True, clip=True)

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """Scores (n, k) float32 of raw observations."""
        return self.network.actor(self.network.features(*observation))

    def members(self) -> tuple[bytes, bytes]:
        """The ONNX file, and golden observations with the actions that torch computes for them."""
        observations = self.golden_observations()
        with torch.no_grad():
            actions = self(*map(torch.as_tensor, observations.values())).numpy()
        return self.onnx_file(), pack(observations, actions)
