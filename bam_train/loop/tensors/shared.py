"""A workspace whose memory several processes see.

Its variables and its length are fixed. Values are copied in, without their graph; what is read is a view of the memory,
which changes when another process writes.

Differences from BBRL: a split workspace has all members of a workspace; `set_full` writes into the shared memory, where
BBRL's puts a private tensor in its place; times that overlap can be copied; writing beyond the end, another shape or
another dtype is an error that names the variable; NumPy variables can be shared, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bam_train.errors import WorkspaceError
from bam_train.loop.arrays import NumpyVariable, mismatch, not_written, require_full
from bam_train.loop.tensors.arrays import TensorVariable
from bam_train.loop.workspace import Workspace


class SharedTensorVariable(TensorVariable):
    """One tensor variable, T x B x ..., in shared memory.

    Args:
        name: For error messages.
        tensor: The memory.
    """

    def __init__(self, name: str, tensor: torch.Tensor) -> None:
        super().__init__(name)
        super().set_full(tensor)

    def __reduce__(self) -> tuple[Any, ...]:
        return SharedTensorVariable, (self.name, self._tensor)

    @property
    def memory(self) -> torch.Tensor:
        """The shared tensor."""
        return self._tensor

    def set(self, t: int, value: torch.Tensor) -> None:
        """Copy `value` (B x ...) to time t, from any device.

        Raises:
            ValueMismatch: Another shape, dtype or kind.
            WorkspaceError: t is beyond the end.
            TimeNotWritten: t is negative beyond the first.
        """
        self._check(value.to(self.device) if isinstance(value, torch.Tensor) else value, f"t={t}")
        self._tensor[_index(self.name, t, len(self._tensor))] = value.detach()

    def set_full(self, value: torch.Tensor) -> None:
        """Copy T x B x ... onto the first T times; later ones stay.

        Raises:
            ValueMismatch: Another shape, dtype or kind.
            WorkspaceError: It is longer than the variable.
        """
        require_full(self.name, value, torch.Tensor, self.KIND)
        _require_alike(self.name, self._tensor, value)
        self._tensor[: len(value)] = value.detach()

    def detach(self) -> None:
        """Nothing: shared memory keeps no graph."""


class SharedNumpyVariable(NumpyVariable):
    """One NumPy variable, T x B x ..., in the shared memory of a tensor.

    Args:
        name: For error messages.
        tensor: The memory.
    """

    def __init__(self, name: str, tensor: torch.Tensor) -> None:
        super().__init__(name)
        self.memory = tensor
        self._buffer = tensor.numpy()
        self._count, self._shape, self._sliced = len(tensor), tuple(tensor.shape[1:]), False

    def __reduce__(self) -> tuple[Any, ...]:
        return SharedNumpyVariable, (self.name, self.memory)

    def set_full(self, value: NDArray[Any]) -> None:
        """Copy T x B x ... onto the first T times; later ones stay.

        Raises:
            ValueMismatch: Another shape, dtype or kind.
            WorkspaceError: It is longer than the variable.
        """
        require_full(self.name, value, np.ndarray, self.KIND)
        _require_alike(self.name, self._buffer, value)
        self._buffer[: len(value)] = value

    def _append(self, t: int, index: int) -> int:
        return _index(self.name, t, self._count)


class SharedWorkspace(Workspace):
    """Named variables in shared memory; `bam_train.loop.NRemoteAgent.create` and `shared_workspace` make them.

    Args:
        variables: The variables by name.
    """

    is_shared = True

    def __init__(self, variables: Mapping[str, Any]) -> None:
        super().__init__()
        self.variables = dict(variables)

    def __reduce__(self) -> tuple[Any, ...]:
        return SharedWorkspace, (self.variables,)

    def remove_variable(self, name: str) -> None:
        """Refused: other processes use it.

        Raises:
            WorkspaceError: Always.
        """
        raise WorkspaceError(f"{name!r} cannot be removed from a shared workspace.")

    def clear(self, name: str | None = None) -> None:
        """Refused: other processes use it.

        Raises:
            WorkspaceError: Always.
        """
        raise WorkspaceError("A shared workspace cannot be cleared: its variables and its length are fixed.")

    def _new(self, name: str, value: Any, where: str) -> Any:
        raise WorkspaceError(
            f"{name!r} cannot be added to a shared workspace, which has {', '.join(map(repr, self.variables))}."
        )


class _SplitSharedWorkspace(SharedWorkspace):
    """Some batch columns of a shared workspace, in the same memory.

    Args:
        workspace: The whole.
        batch_dims: First column, and one after the last.
    """

    def __init__(self, workspace: SharedWorkspace, batch_dims: tuple[int, int]) -> None:
        begin, end = batch_dims
        super().__init__(
            {name: type(one)(name, one.memory[:, begin:end]) for name, one in workspace.variables.items()}  # type: ignore[union-attr]
        )
        self.batch_dims = batch_dims


def shared_workspace(workspace: Workspace, n_repeat: int = 1, time_size: int | None = None) -> SharedWorkspace:
    """A copy of a workspace in shared memory, without graph.

    Args:
        workspace: What to copy.
        n_repeat: How often to repeat it over the batch.
        time_size: Times of the copy, which then holds zeros; None for the times and values of `workspace`.

    Raises:
        WorkspaceError: `workspace` is empty, has arrays that torch does not know, or a number is less than 1.
    """
    for name, number in (("n_repeat", n_repeat), ("time_size", 1 if time_size is None else time_size)):
        if number < 1:
            raise WorkspaceError(f"{name}: expected at least 1, found {number}.")
    if not workspace.variables:
        raise WorkspaceError("The workspace is empty: there is nothing to share; run the agent on it first.")
    return SharedWorkspace(
        {name: _shared(name, one.full(), n_repeat, time_size) for name, one in workspace.variables.items()}
    )


def _shared(name: str, value: Any, n_repeat: int, time_size: int | None) -> SharedTensorVariable | SharedNumpyVariable:
    """One variable of the copy."""
    try:
        tensor = torch.as_tensor(value).detach()
    except TypeError as error:
        raise WorkspaceError(f"{name!r} cannot be shared: {error}") from error
    times, columns = tensor.shape[:2]
    memory = tensor.new_zeros((time_size or times, n_repeat * columns, *tensor.shape[2:])).share_memory_()
    if time_size is None:
        memory.copy_(torch.cat([tensor] * n_repeat, dim=1))
    return SharedNumpyVariable(name, memory) if isinstance(value, np.ndarray) else SharedTensorVariable(name, memory)


def _index(name: str, t: int, times: int) -> int:
    """Time t as an index from 0."""
    if t >= times:
        raise WorkspaceError(
            f"{name!r} at t={t}: a shared workspace has a fixed length, and this one has {times} times; "
            f"make it as long as the run: NRemoteAgent.create(..., time_size=...), {t + 1} at least."
        )
    if t < -times:
        raise not_written(name, t, 0, times)
    return t % times


def _require_alike(name: str, memory: Any, value: Any) -> None:
    """Refuse all times of another shape, dtype or more times."""
    for what, ours, theirs in (
        ("shape of one time", tuple(memory.shape[1:]), tuple(value.shape[1:])),
        ("dtype", memory.dtype, value.dtype),
    ):
        if ours != theirs:
            raise mismatch(name, "all times", what, ours, theirs)
    if len(value) > len(memory):
        _index(name, len(value) - 1, len(memory))
