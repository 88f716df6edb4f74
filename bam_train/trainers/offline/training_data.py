"""Transitions of a data set as tensors that learners take: normalised observations, actions as codes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.spaces import leaves
from bam_envs.core.wording import brief
from bam_train.data import DataSet
from bam_train.errors import SettingsError

Array = NDArray[Any]
LIMIT = 10.0
"""Normalised observations end here, so that a value that was constant in the data cannot grow without bounds."""
_LEAST = 1e-3  # standard deviation of a value that was (almost) constant in the data


@dataclass
class TrainingBatch:
    """n transitions."""

    seen: torch.Tensor
    """Normalised observations. Shape: (n, inputs) float32."""
    action: torch.Tensor
    """Codes of the actions. Shape: (n, k) float32."""
    reward: torch.Tensor
    """In standard deviations of the recorded rewards. Shape: (n,)."""
    after: torch.Tensor
    """Normalised observations a step later. Shape: (n, inputs)."""
    terminal: torch.Tensor
    """1 where the task ended with the step, else 0. Shape: (n,)."""

    def __len__(self) -> int:
        return len(self.reward)

    def rows(self, index: torch.Tensor) -> TrainingBatch:
        """The transitions of an index."""
        return TrainingBatch(*(column[index] for column in self.columns()))

    def columns(self) -> tuple[torch.Tensor, ...]:
        """The tensors in the order of the fields."""
        return self.seen, self.action, self.reward, self.after, self.terminal

    def joined(self, other: TrainingBatch) -> TrainingBatch:
        """Both, one after the other."""
        return TrainingBatch(*(torch.cat(pair) for pair in zip(self.columns(), other.columns(), strict=True)))


class ActionCode:
    """Numbers for an action: of a Box from -1 to 1, of a Discrete one-hot.

    Args:
        space: The action space.

    Raises:
        SettingsError: It is neither a Discrete nor a bounded Box of float32.
    """

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.is_discrete = isinstance(space, spaces.Discrete)
        if isinstance(space, spaces.Discrete):
            self.size, self._start = int(space.n), int(space.start)
        elif isinstance(space, spaces.Box) and space.is_bounded("both") and space.dtype.kind == "f":  # type: ignore[union-attr]
            self.size = int(np.prod(space.shape))
            self._low, self._range = space.low.reshape(-1), (space.high - space.low).reshape(-1)
        else:
            raise SettingsError(
                f"data: expected a Discrete action space or a bounded Box of floats, found {brief(space)}"
            )

    def encode(self, actions: Array) -> torch.Tensor:
        """Shape: (n, ...) -> (n, size) float32."""
        if self.is_discrete:
            return torch.nn.functional.one_hot(torch.as_tensor(actions).long() - self._start, self.size).float()
        scaled = 2 * (actions.reshape(len(actions), -1) - self._low) / self._range - 1
        return torch.as_tensor(np.clip(scaled, -1, 1), dtype=torch.float32)

    def decode(self, codes: torch.Tensor, space: spaces.Space[Any]) -> Array:
        """Actions of the space. Shape: (n, size) -> (n, ...)."""
        if self.is_discrete:
            return np.asarray(codes.argmax(1).numpy() + self._start)
        actions = self._low + 0.5 * (codes.numpy() + 1) * self._range
        return np.asarray(actions.reshape(-1, *(space.shape or ())), space.dtype)


class Normaliser:
    """Mean and deviation of observations; Box and Dict of Boxes, flattened in the order of the keys."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.leaves = leaves(space)
        for key, leaf in self.leaves.items():
            if not isinstance(leaf, spaces.Box) or len(leaf.shape) > 2:
                what = f"observation {key!r}" if key else "observations"
                raise SettingsError(
                    f"data: {what}: expected a Box of numbers, found {brief(leaf)}; use --trainer rllib"
                )
        self.inputs = sum(int(np.prod(leaf.shape)) for leaf in self.leaves.values())
        self.mean, self.deviation = np.zeros(self.inputs), np.ones(self.inputs)

    def flat(self, observations: Any) -> Array:
        """Shape: (n, ...), of a Dict by key -> (n, inputs) float64."""
        each = [observations[key] if key else observations for key in self.leaves]
        flat: Array = np.concatenate([np.asarray(one, np.float64).reshape(len(one), -1) for one in each], 1)
        return flat

    def fit(self, observations: Any) -> None:
        """Take mean and deviation of observations."""
        flat = self.flat(observations)
        self.mean, self.deviation = flat.mean(0), np.maximum(flat.std(0), _LEAST)

    def __call__(self, observations: Any) -> torch.Tensor:
        """Normalise. Shape: (n, ...) -> (n, inputs) float32."""
        scaled = (self.flat(observations) - self.mean) / self.deviation
        return torch.as_tensor(np.clip(scaled, -LIMIT, LIMIT), dtype=torch.float32)


def read_batch(
    data: DataSet, indices: Sequence[int], normaliser: Normaliser, code: ActionCode, *, fit: bool
) -> tuple[TrainingBatch, float]:
    """All transitions of some episodes, and the deviation of their rewards; `fit` the normaliser to them first.

    Raises:
        SettingsError: A number is not finite.
    """
    steps = data.transitions(indices)
    if fit:
        normaliser.fit(steps.observations)
    numbers = (normaliser.flat(steps.observations), normaliser.flat(steps.next_observations), steps.rewards)
    if not all(np.isfinite(one).all() for one in (*numbers, np.asarray(steps.actions, np.float64))):
        raise SettingsError(f"data: {data.place} has a number that is not finite; find it with bam-data check")
    scale = float(steps.rewards.std()) or 1.0
    reward = torch.as_tensor(steps.rewards / scale, dtype=torch.float32)
    seen, after = normaliser(steps.observations), normaliser(steps.next_observations)
    return TrainingBatch(
        seen, code.encode(steps.actions), reward, after, torch.as_tensor(steps.terminals).float()
    ), scale
