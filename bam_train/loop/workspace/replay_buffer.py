"""A ring buffer of transitions, or of longer sequences, from which off-policy algorithms draw batches.

Differences from BBRL's `ReplayBuffer`:

- One `put` of more than `max_size` items keeps the newest `max_size`; BBRL's raises or overwrites its own items.
- A `put` that does not fit is refused before anything changes; BBRL's stores a part of it.
- `to` applies to items that are put and drawn later too, and returns the buffer. NumPy workspaces are accepted.
"""

from __future__ import annotations

import torch

from bam_train.errors import LoopError
from bam_train.loop.workspace.variables import unknown_variable
from bam_train.loop.workspace.workspace import Workspace


class ReplayBuffer:
    """Holds the newest `max_size` (at least 1) items; an item is T times of every variable.

    The first `put` fixes the names, T, shapes and dtypes.

    Attributes:
        variables: Name to tensor, max_size x T x ...; items from `size()` on are zeros.
        position: The item that the next `put` writes first.
        is_full: Whether `max_size` items have been put in.
    """

    def __init__(self, max_size: int, device: torch.device | str = torch.device("cpu")) -> None:  # noqa: B008 - a value
        self.max_size = int(max_size)
        if self.max_size < 1:
            raise LoopError(f"max_size: expected at least 1, found {max_size}.")
        self.device = torch.device(device)
        self.variables: dict[str, torch.Tensor] = {}
        self.position = 0
        self.is_full = False

    def put(self, workspace: Workspace) -> None:
        """Add the N columns of a workspace (T x N x ..., such as transitions, where T is 2) as N items, detached.

        They replace the oldest items of a full buffer.

        Raises:
            LoopError: A variable that the buffer has is missing.
            LoopError: Another T, shape or dtype than the first `put`.
            LoopError: A variable that the buffer does not have, columns that differ in number, or no variable.
        """
        if not workspace.variables:
            raise LoopError("The workspace is empty: there is nothing to put into the replay buffer.")
        items: dict[str, torch.Tensor] = {}
        for name in workspace:  # N x T x ...
            value = torch.as_tensor(workspace.get_full(name)).detach().to(self.device)
            if value.ndim < 2:
                raise LoopError(
                    f"{name!r} in the replay buffer: expected T x N x ..., found shape {tuple(value.shape)}."
                )
            items[name] = value.transpose(0, 1)
        count = workspace.batch_size() or 0
        if self.variables:
            self._require_alike(items)
        else:
            self.variables = {
                name: torch.zeros((self.max_size, *value.shape[1:]), dtype=value.dtype, device=self.device)
                for name, value in items.items()
            }
        kept = min(count, self.max_size)
        places = (torch.arange(kept, device=self.device) + self.position + count - kept) % self.max_size
        for name, value in items.items():
            self.variables[name][places] = value[count - kept :]
        self.is_full = self.is_full or self.position + count >= self.max_size
        self.position = (self.position + count) % self.max_size

    def size(self) -> int:
        """The number of items that can be drawn."""
        return self.max_size if self.is_full else self.position

    def get_shuffled(self, batch_size: int) -> Workspace:
        """A workspace (T x batch_size x ...) of items drawn uniformly, with replacement; one draw for all variables.

        Draws from torch's global generator: the same ``torch.manual_seed`` gives the same items as BBRL's.
        """
        size = self.size()
        if not size:
            raise LoopError("The replay buffer is empty: put transitions into it before drawing from it.")
        chosen = torch.randint(low=0, high=size, size=(batch_size,), device=self.device)
        workspace = Workspace()
        for name, value in self.variables.items():
            workspace.set_full(name, value.index_select(0, chosen).transpose(0, 1))
        return workspace

    def to(self, device: torch.device | str) -> ReplayBuffer:
        """Move present and later items to a device; returns the buffer."""
        self.device = torch.device(device)
        self.variables = {name: value.to(self.device) for name, value in self.variables.items()}
        return self

    def _require_alike(self, items: dict[str, torch.Tensor]) -> None:
        for name in self.variables:
            if name not in items:
                raise unknown_variable(name, items)
        for name, value in items.items():
            if name not in self.variables:
                has = ", ".join(map(repr, sorted(self.variables)))
                raise LoopError(f"{name!r} is not in the replay buffer, which has {has} since the first put.")
            kept = self.variables[name]
            for what, expected, found in (
                ("time size", kept.shape[1], value.shape[1]),
                ("shape", tuple(kept.shape[2:]), tuple(value.shape[2:])),
                ("dtype", kept.dtype, value.dtype),
            ):
                if expected != found:
                    raise LoopError(f"{name!r} in the replay buffer: expected {what} {expected}, found {found}.")
