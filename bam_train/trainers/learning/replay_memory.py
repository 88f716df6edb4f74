"""Transitions as tensors that learners draw batches from, and actions as numbers."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.wording import brief
from bam_train.errors import SettingsError
from bam_train.trainers.frozen_network import action_head

Array = NDArray[Any]


class Batch(SimpleNamespace):
    """Columns of n transitions by name. Shape: (n, ...) each."""

    def joined(self, other: Batch) -> Batch:
        """Both, one after the other."""
        return Batch(**{name: torch.cat([column, vars(other)[name]]) for name, column in vars(self).items()})


class ReplayMemory:
    """The newest `size` transitions, as columns; the first `add` fixes their names, shapes and dtypes."""

    def __init__(self, size: int) -> None:
        self.size, self.added = size, 0
        self._columns: dict[str, torch.Tensor] = {}  # of fewer rows than `size`, as long as fewer are needed

    def __len__(self) -> int:
        return min(self.added, self.size)

    def add(self, **columns: Any) -> None:
        """Add n transitions in place of the oldest. Shape: (n, ...) each, arrays or tensors."""
        count = len(next(iter(columns.values())))
        rows = (torch.arange(max(0, count - self.size), count) + self.added) % self.size
        for name, column in columns.items():
            new = torch.as_tensor(column)[-self.size :]
            kept = self._columns.get(name, new[:0])
            if len(kept) < min(self.size, self.added + count):
                more = min(self.size, max(2 * len(kept), self.added + count)) - len(kept)
                kept = torch.cat([kept, torch.zeros((more, *new.shape[1:]), dtype=new.dtype)])
            kept[rows] = new
            self._columns[name] = kept
        self.added += count

    def rows(self, index: Any) -> Batch:
        """The transitions of an index, or a slice."""
        return Batch(**{name: column[index] for name, column in self._columns.items()})

    def draw(self, count: int) -> Batch:
        """Random transitions, of at least one."""
        return self.rows(torch.randint(len(self), (count,)))

    def columns(self) -> dict[str, torch.Tensor]:
        """All transitions by column, with which `load` restores them."""
        return vars(self.rows(slice(len(self))))

    def load(self, columns: Mapping[str, Any], added: int) -> None:
        """Restore the result of `columns`, after `added` transitions.

        Raises:
            ValueError: There are not as many as a memory of this size has then.
        """
        if columns:
            self.add(**columns)
        if len(self) != min(added, self.size):
            raise ValueError(f"expected {min(added, self.size)} transitions, found {len(self)}")
        self.added = added


class ActionCode:
    """Numbers for an action: of a Box from -1 to 1, of a Discrete one-hot.

    Args:
        space: The action space.

    Raises:
        SettingsError: It is neither a Discrete nor a bounded Box of floats.
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
        self._head = action_head(space, tanh=False, scale=True, clip=True)

    def encode(self, actions: Array) -> torch.Tensor:
        """Shape: (n, ...) -> (n, size) float32."""
        if self.is_discrete:
            return torch.nn.functional.one_hot(torch.as_tensor(actions).long() - self._start, self.size).float()
        scaled = 2 * (actions.reshape(len(actions), -1) - self._low) / self._range - 1
        return torch.as_tensor(np.clip(scaled, -1, 1), dtype=torch.float32)

    def decode(self, codes: torch.Tensor) -> Array:
        """Actions of the space. Shape: (n, size) -> (n, ...)."""
        return np.asarray(self._head(codes).numpy())
