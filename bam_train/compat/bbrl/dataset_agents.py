"""Agents that write batches of a dataset at time 0.

Differences from BBRL's agents of the same names: `ShuffledDatasetAgent` works; a batch with fewer values than there are
names is an error; a batch may be a mapping or one tensor; neither draws from torch's random numbers when it is made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from bam_envs.core.validation import NonNegativeInt, check
from bam_train.errors import LoopError
from bam_train.loop.agent import Agent

if TYPE_CHECKING:
    from typing_extensions import Self


class _DatasetAgent(Agent):
    """Writes batches, on the device of the agent (`to`); refuses batches with fewer values than names."""

    reads = ()

    def __init__(self, output_names: Sequence[str]) -> None:
        super().__init__()
        self.output_names = self.writes = tuple(output_names)
        self.ghost_params = torch.nn.Parameter(torch.empty(0))

    def _write(self, values: Sequence[Any]) -> None:
        for name, value in zip(self.output_names, values, strict=True):
            self.set((name, 0), torch.as_tensor(value).to(self.ghost_params.device))

    def _values(self, batch: Any) -> list[Any]:
        """The values of a tuple, a mapping or one tensor for the names."""
        names = self.output_names
        if isinstance(batch, Mapping):
            missing = [name for name in names if name not in batch]
            if missing:
                raise LoopError(f"The dataset has no {missing[0]!r}; its items have {', '.join(map(repr, batch))}.")
            return [batch[name] for name in names]
        values = [batch] if isinstance(batch, (torch.Tensor, np.ndarray)) else list(batch)
        if len(values) < len(names):
            raise LoopError(f"output_names: expected as many as the dataset has values ({len(values)}), found {names}.")
        return values[: len(names)]


class DataLoaderAgent(_DatasetAgent):
    """Writes the next batch of a data loader at each call; after the last one, `finished` is True.

    ::

        agent(workspace)
        while not agent.finished():
            ...
            agent(workspace)

    Args:
        dataloader: A ``torch.utils.data.DataLoader``, or another iterable that can be iterated repeatedly.
        output_names: Variables for the values of a batch, B x ... each; further values are ignored.
    """

    def __init__(self, dataloader: Any, output_names: Sequence[str] = ("x", "y")) -> None:
        super().__init__(output_names)
        self.dataloader = dataloader
        self.reset()

    def reset(self) -> None:
        """Restart with the first batch."""
        self.iter = iter(self.dataloader)
        self._finished = False

    def finished(self) -> bool:
        """Whether there was no batch for the last call, which wrote nothing."""
        return self._finished

    def forward(self, **kwargs: Any) -> None:
        """Write the next batch at time 0."""
        if self._finished:
            return
        for batch in self.iter:
            self._write(self._values(batch))
            return
        self._finished = True


class ShuffledDatasetAgent(_DatasetAgent):
    """Writes items of a dataset at each call, drawn uniformly with replacement.

    Args:
        dataset: A ``torch.utils.data.Dataset`` with a length, whose items are tuples of tensors or numbers.
        batch_size: The number of items of each batch.
        output_names: Variables for the values of an item, batch_size x ... each; further values are ignored.
    """

    def __init__(self, dataset: Any, batch_size: int, output_names: Sequence[str] = ("x", "y")) -> None:
        super().__init__(output_names)
        self.dataset = dataset
        self.batch_size = batch_size
        self._rng: np.random.Generator | None = None

    def seed(self, seed: int | None = None) -> Self:
        """Draw from the agent's own generator from now on, instead of torch's; None seeds it at random."""
        self._rng = np.random.default_rng(check(seed, NonNegativeInt | None, "seed", LoopError))
        return self

    def forward(self, **kwargs: Any) -> None:
        """Write a batch at time 0."""
        size, count = len(self.dataset), self.batch_size
        if not size:
            raise LoopError("The dataset is empty: there is nothing to draw from.")
        drawn = torch.randint(size, (count,)) if self._rng is None else self._rng.integers(size, size=count)
        items = [self._values(self.dataset[int(k)]) for k in drawn]
        self._write([torch.stack([torch.as_tensor(value) for value in column]) for column in zip(*items, strict=True)])
