"""A ring of transitions (or of longer pieces of time) that off-policy algorithms draw batches from.

Differences from BBRL's `ReplayBuffer`:

- One `put` of more than `max_size` rows keeps the newest `max_size`; BBRL's raises or writes onto itself.
- A `put` that does not fit (another T, shape or dtype, a new or a missing variable) is refused before anything
  changes, with the variable's name; BBRL's stores a part of it, or rows that do not belong together.
- `to` moves what is put and drawn later, too, and returns the buffer. `variables` is empty, not None, before the first
  `put`. NumPy workspaces are taken as well. There is no `print_obs`.
"""

from __future__ import annotations

from typing import Any

import torch

from bam_train.errors import UnknownVariable, ValueMismatch, WorkspaceError
from bam_train.loop.workspace import Workspace


class ReplayBuffer:
    """The newest `max_size` rows that were put in; a row is T times of every variable.

    The first `put` fixes the names, T, shapes and dtypes.

    Attributes:
        variables: Name to tensor, max_size x T x ...; rows from `size()` on are zeros that nobody wrote.
        position: The row that the next `put` writes first.
        is_full: Whether `max_size` rows have been put in.
        max_size: Rows that are kept at most.
        device: Where the rows are kept and drawn.

    Args:
        max_size: Rows that are kept at most, at least 1.
        device: Where to keep them.

    Raises:
        WorkspaceError: `max_size` is less than 1.
    """

    def __init__(self, max_size: int, device: torch.device | str = torch.device("cpu")) -> None:  # noqa: B008 - a value
        self.max_size = int(max_size)
        if self.max_size < 1:
            raise WorkspaceError(f"max_size: expected at least 1 row, found {max_size}.")
        self.device = torch.device(device)
        self.variables: dict[str, torch.Tensor] = {}
        self.position = 0
        self.is_full = False

    def put(self, workspace: Workspace) -> None:
        """Add the N columns of a workspace (T x N x ...) as N rows; the oldest rows make room.

        Values are copied, detached, to the buffer's device. Transitions (`get_transitions`) have T = 2; whole rollouts
        of one length T can be put as well. Of more than `max_size` rows the last ones stay.

        Raises:
            UnknownVariable: A variable that the buffer has is missing.
            ValueMismatch: Another T, shape or dtype than the first `put`.
            WorkspaceError: A variable that the buffer does not have, columns that differ in number, or no variable.
        """
        rows = {name: self._rows(name, workspace.get_full(name)) for name in workspace.keys()}  # noqa: SIM118
        count = _count(rows)
        if self.variables:
            self._require_alike(rows)
        else:
            self.variables = {name: self._empty(value) for name, value in rows.items()}
        start = self.position + max(0, count - self.max_size)
        kept = min(count, self.max_size)
        for name, value in rows.items():
            self._write(self.variables[name], value if kept == count else value[-kept:], start % self.max_size)
        self.is_full = self.is_full or self.position + count >= self.max_size
        self.position = (self.position + count) % self.max_size

    def size(self) -> int:
        """Rows that can be drawn."""
        return self.max_size if self.is_full else self.position

    def get_shuffled(self, batch_size: int) -> Workspace:
        """A workspace (T x batch_size x ...) of rows drawn uniformly, with replacement; one draw for all variables.

        Draws from torch's global generator: the same ``torch.manual_seed`` gives the same rows as BBRL's.

        Raises:
            WorkspaceError: Nothing has been put in.
        """
        size = self.size()
        if not size:
            raise WorkspaceError("The replay buffer is empty: put transitions into it before drawing from it.")
        chosen = torch.randint(low=0, high=size, size=(batch_size,), device=self.device)
        workspace = Workspace()
        for name, value in self.variables.items():
            workspace.set_full(name, value.index_select(0, chosen).transpose(0, 1))
        return workspace

    def to(self, device: torch.device | str) -> ReplayBuffer:
        """Move the rows, and those of later puts, to a device; returns the buffer."""
        self.device = torch.device(device)
        self.variables = {name: value.to(self.device) for name, value in self.variables.items()}
        return self

    def _rows(self, name: str, value: Any) -> torch.Tensor:
        """T x N x ... as N x T x ..., without graph, on the buffer's device."""
        value = torch.as_tensor(value)
        if value.ndim < 2:
            raise ValueMismatch(
                f"{name!r} in the replay buffer: expected T x N x ..., found shape {tuple(value.shape)}."
            )
        if value.requires_grad or value.device != self.device:
            value = value.detach().to(self.device)
        return value.transpose(0, 1)

    def _empty(self, rows: torch.Tensor) -> torch.Tensor:
        """Room for `max_size` rows like these."""
        return torch.zeros((self.max_size, *rows.shape[1:]), dtype=rows.dtype, device=self.device)

    def _write(self, kept: torch.Tensor, rows: torch.Tensor, start: int) -> None:
        """Write at most `max_size` rows from `start` on, going round at the end."""
        before_end = self.max_size - start
        if len(rows) <= before_end:
            kept[start : start + len(rows)] = rows
        else:
            kept[start:] = rows[:before_end]
            kept[: len(rows) - before_end] = rows[before_end:]

    def _require_alike(self, rows: dict[str, torch.Tensor]) -> None:
        """Refuse rows that do not fit those in the buffer."""
        for name in self.variables:
            if name not in rows:
                raise UnknownVariable(name, rows)
        for name, value in rows.items():
            if name not in self.variables:
                has = ", ".join(map(repr, sorted(self.variables)))
                raise WorkspaceError(f"{name!r} is not in the replay buffer, which has {has} since the first put.")
            _require_like(name, self.variables[name], value)


def _require_like(name: str, kept: torch.Tensor, rows: torch.Tensor) -> None:
    """Refuse another T, shape or dtype than the buffer's."""
    if rows.shape[1:] == kept.shape[1:] and rows.dtype is kept.dtype:
        return
    pairs = (
        ("time size", kept.shape[1], rows.shape[1]),
        ("shape", tuple(kept.shape[2:]), tuple(rows.shape[2:])),
        ("dtype", kept.dtype, rows.dtype),
    )
    for what, expected, found in pairs:
        if expected != found:
            raise ValueMismatch(f"{name!r} in the replay buffer: expected {what} {expected}, found {found}.")


def _count(rows: dict[str, torch.Tensor]) -> int:
    """N, the same for every variable."""
    counts = {name: len(value) for name, value in rows.items()}
    if not counts:
        raise WorkspaceError("The workspace is empty: there is nothing to put into the replay buffer.")
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{name!r} {count}" for name, count in counts.items())
        raise WorkspaceError(f"Expected one batch size for all variables, found {found}.")
    return next(iter(counts.values()))
