"""Layers of a frozen policy that depend on the environment's spaces alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn


class Layer(nn.Module):  # type: ignore[misc]
    """A torch module; torch has no types here."""


class OneHot(Layer):
    """A Discrete, (n,), or MultiDiscrete, (n, k): a one-hot code of each number, side by side."""

    def __init__(self, space: spaces.Discrete[Any] | spaces.MultiDiscrete) -> None:
        super().__init__()
        counts = np.ravel(space.n if isinstance(space, spaces.Discrete) else space.nvec)
        starts = np.ravel(space.start)
        columns = np.repeat(np.arange(len(counts)), counts)
        values = np.concatenate([np.arange(count) + start for count, start in zip(counts, starts, strict=True)])
        self.columns, self.values = torch.as_tensor(columns), torch.as_tensor(values)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Encode whole numbers."""
        x = x.long()
        x = x.unsqueeze(1) if x.ndim == 1 else x.flatten(1)
        return (x.index_select(1, self.columns) == self.values).float()


class Choice(Layer):
    """The best of each group of scores, counted from ``start``: Discrete gives (n,), MultiDiscrete (n, k)."""

    def __init__(self, space: spaces.Discrete[Any] | spaces.MultiDiscrete) -> None:
        super().__init__()
        self.single = isinstance(space, spaces.Discrete)
        self.counts: list[int] = [int(space.n)] if isinstance(space, spaces.Discrete) else space.nvec.tolist()
        self.dtype = torch.int64 if self.single else torch_dtype(space.dtype)
        self.starts, self.shifted = torch.as_tensor(np.asarray(space.start)), bool(np.any(space.start))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Choose."""
        if self.single:
            best = x.argmax(1)
        else:
            best = torch.cat([group.argmax(1, keepdim=True) for group in x.split(self.counts, dim=1)], 1)
        return to(best + self.starts if self.shifted else best, self.dtype)

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        """How clear the choice is: the least distance of a best score from the second."""
        gaps = [group.topk(2)[0] for group in scores.split(self.counts, dim=1) if group.shape[1] > 1]
        return torch.stack([gap[:, 0] - gap[:, 1] for gap in gaps]).amin(0) if gaps else torch.ones(len(scores))


def zeros(observation: Mapping[str, Any], is_dict: bool) -> dict[str, torch.Tensor]:
    """Two rows of zeros for every array of an observation, by the name of the frozen policy's input."""
    return {
        f"observation.{key}" if is_dict else "observation": torch.zeros(
            (2, *(space.shape or ())), dtype=torch_dtype(space.dtype)
        )
        for key, space in observation.items()
    }


def to(x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Cast, without leaving a node in the graph where there is nothing to do."""
    return x if x.dtype == dtype else x.to(dtype)


def torch_dtype(dtype: Any) -> torch.dtype:
    """Return torch's name for a NumPy dtype."""
    return torch.as_tensor(np.zeros((), dtype)).dtype
