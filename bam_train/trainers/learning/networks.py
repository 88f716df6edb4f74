"""Layers of our learners, from observations to scores of actions; their optimiser; and their frozen policy."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn
from torch.nn import functional

from bam_envs.core.spaces import leaves
from bam_envs.core.wording import brief
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.trainers.frozen_network import KINDS, FrozenNetwork, Layer, OneHot, action_head, to

LIMIT = 10.0
"""Normalised numbers end here, so that a value that was constant cannot grow without bounds."""


def two_layers(inputs: int, width: int, outputs: int | None = None) -> nn.Sequential:
    """Two hidden layers, and a linear one if there are `outputs`."""
    layers = [nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()]
    return nn.Sequential(*layers, *([] if outputs is None else [nn.Linear(width, outputs)]))


class Ensemble(Layer):
    """`count` networks with two hidden layers, computed together. Shapes: (n, inputs) -> (count, n).

    Args:
        count: How many networks.
        inputs: Numbers that they see.
        width: Units of a hidden layer.
        normalises: Whether hidden layers have layer normalisation.
    """

    def __init__(self, count: int, inputs: int, width: int, *, normalises: bool = False) -> None:
        super().__init__()
        sizes = ((inputs, width), (width, width), (width, 1))

        def uniform(rows: int, columns: int, fan: int) -> nn.Parameter:
            return nn.Parameter((2 * torch.rand(count, rows, columns) - 1) / math.sqrt(fan))

        self.weights = nn.ParameterList(uniform(i, o, i) for i, o in sizes)
        first = (uniform(1, o, i) if normalises else nn.Parameter(torch.zeros(count, 1, o)) for i, o in sizes)
        self.biases = nn.ParameterList(first)
        hidden = 2 if normalises else 0
        self.scales = nn.ParameterList(nn.Parameter(torch.ones(count, 1, width)) for _ in range(hidden))
        self.shifts = nn.ParameterList(nn.Parameter(torch.zeros(count, 1, width)) for _ in range(hidden))

    def forward(self, *inputs: torch.Tensor, chosen: torch.Tensor | None = None) -> torch.Tensor:
        """Values of the `chosen` networks, or of all; they see the `inputs` (n, ...) side by side."""

        def of(parameters: nn.ParameterList, layer: int) -> torch.Tensor:
            return parameters[layer] if chosen is None else parameters[layer][chosen]

        x = torch.cat(inputs, 1).expand(len(of(self.weights, 0)), -1, -1)
        for layer in range(3):
            x = torch.baddbmm(of(self.biases, layer), x, of(self.weights, layer))
            if layer < len(self.scales):
                x = functional.layer_norm(x, x.shape[-1:]) * of(self.scales, layer) + of(self.shifts, layer)
            x = functional.relu(x) if layer < 2 else x
        return x.squeeze(-1)


class Descent(torch.optim.Adam):  # type: ignore[misc]
    """Adam for the `name`, which refuses a loss that is not finite."""

    def __init__(self, name: str, parameters: Iterable[Any], learning_rate: float, **options: Any) -> None:
        super().__init__(parameters, lr=learning_rate, **options)
        self._name, self._learning_rate = name, learning_rate

    def descend(self, loss: torch.Tensor, share: float = 1.0) -> float:
        """Update with a `share` of the learning rate; returns the loss.

        Raises:
            TrainingFailed: It is not finite.
        """
        value = float(loss.item())
        if not math.isfinite(value):
            raise TrainingFailed(f"the loss of the {self._name} is {value}: try a smaller learning_rate")
        self.param_groups[0]["lr"] = self._learning_rate * share
        self.zero_grad()
        loss.backward()
        self.step()
        return value


def cosine(done: float) -> float:
    """Share of the learning rate when a share `done` of the updates is over: it falls from 1 to 0 along a cosine."""
    return 0.5 * (1 + math.cos(math.pi * done))


@torch.no_grad()  # type: ignore[untyped-decorator] # torch is not typed here
def follow(average: nn.Module, newest: nn.Module, share: float) -> None:
    """Move the weights of `average` by `share` towards those of `newest`."""
    torch._foreach_lerp_([*average.parameters()], [*newest.parameters()], share)


class Images(Layer):
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
    """Numbers, (n, ...), normalised by their moments so far, see `learn`; in float64, and float32 in the end.

    Args:
        shape: Shape of the numbers.
        least: Standard deviation of a number that is (almost) constant.
    """

    def __init__(self, shape: tuple[int, ...], least: float) -> None:
        super().__init__()
        self.outputs, self.least = int(np.prod(shape)), least
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
        """Mean and standard deviation. Shape: (numbers,) float64 each."""
        count = self.count.clamp(min=1)
        mean = self.total / count
        return mean, (self.squares / count - mean * mean).clamp(min=self.least**2).sqrt()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalise."""
        mean, deviation = self.moments()
        return to(((to(x.flatten(1), torch.float64) - mean) / deviation).clamp(-LIMIT, LIMIT), torch.float32)


class Encoders(nn.ModuleList):  # type: ignore[misc]
    """The first layers for each array of an observation. Shapes: (n, ...), in the order of `keys` -> (n, outputs).

    Args:
        space: Observations, a Dict or one array.
        least: As of `Numbers`.
        channels: Of the first convolution of images; None refuses all but numbers.

    Raises:
        SettingsError: An array is of another kind.
    """

    def __init__(self, space: spaces.Space[Any], least: float, channels: int | None = None) -> None:
        super().__init__()
        self.keys, self.outputs = list(leaves(space)), 0
        for key, leaf in leaves(space).items():
            layer, outputs = _encoder(key, leaf, least, channels)
            self.append(layer)
            self.outputs += outputs

    def tensors(self, observations: Any) -> list[torch.Tensor]:
        """The arrays of observations (n, ...), of a Dict by key."""
        each = [observations[key] if key else observations for key in self.keys]
        return [torch.as_tensor(np.ascontiguousarray(one)) for one in each]

    def learn(self, observed: Iterable[torch.Tensor]) -> None:
        """Add observations (n, ...) to the moments of their numbers."""
        for layer, x in zip(self, observed, strict=True):
            if isinstance(layer, Numbers):
                layer.learn(x)

    def forward(self, *observed: torch.Tensor) -> torch.Tensor:
        """Encode all."""
        return torch.cat([layer(x) for layer, x in zip(self, observed, strict=True)], 1)


def _encoder(key: str, leaf: Any, least: float, channels: int | None) -> tuple[Any, int]:
    """The first layer for one array of an observation, and how many numbers it gives."""
    if channels is None and (not isinstance(leaf, spaces.Box) or len(leaf.shape) > 2):
        what = f"observation {key!r}" if key else "observations"
        raise SettingsError(f"data: {what}: expected a Box of numbers, found {brief(leaf)}; use --trainer rllib")
    if not isinstance(leaf, KINDS):
        raise SettingsError(f"observation {key!r}: expected arrays of numbers or images, found {leaf}")
    if isinstance(leaf, (spaces.Discrete, spaces.MultiDiscrete)):
        one_hot = OneHot(leaf)
        return one_hot, len(one_hot.values)
    if isinstance(leaf, spaces.Box) and len(leaf.shape) == 3 and leaf.is_bounded("both"):
        layer: Any = Images(leaf, channels or 0)
    else:
        layer = Numbers(leaf.shape or (), least)
    return layer, layer.outputs


class LearntPolicy(FrozenNetwork):
    """A copy of a learner's networks, from raw observations to actions.

    Args:
        encoders: From observations to numbers (n, inputs).
        network: From these to scores of actions (n, k).
        seen: The environment's observation space.
        acts: The environment's action space.
        tanh: Whether the scores of a Box are to be squashed to [-1, 1].
    """

    def __init__(self, encoders: Encoders, network: nn.Module, seen: Any, acts: Any, *, tanh: bool) -> None:
        super().__init__(seen)
        own = (copy.deepcopy(one).cpu().eval().requires_grad_(False) for one in (encoders, network))
        self.encoders, self.network = own
        for (key, leaf), layer in zip(self.leaves.items(), self.encoders, strict=True):
            if isinstance(layer, Numbers):
                mean, deviation = (one.numpy().reshape(leaf.shape) for one in layer.moments())
                self.moments[key] = mean, deviation
        self.head = action_head(acts, tanh=tanh, scale=True, clip=True)

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """Scores (n, k) float32 of raw observations."""
        return self.network(self.encoders(*observation))
