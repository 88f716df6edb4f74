"""A workspace in the shared memory of several processes.

Its variables and its length are fixed. Values are copied when they are written, without their graph; a read returns a
view of the memory, which changes when another process writes. Unlike in BBRL, `set_full` writes into the shared memory,
a split workspace has all members of a workspace, and NumPy variables can be shared too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from bam_train.errors import LoopError
from bam_train.loop.workspace.tensor_variable import TensorVariable
from bam_train.loop.workspace.variables import Variable
from bam_train.loop.workspace.workspace import Workspace


class _SharedVariable(Variable):
    """One variable of NumPy arrays in the shared tensor `memory`, T x B x ...."""

    COPIES = False  # `_store` and `set_full` do

    def __init__(self, name: str, memory: torch.Tensor) -> None:
        super().__init__(name)
        self.memory = memory
        super().set_full(memory.numpy() if self.ARRAY is np.ndarray else memory)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.name, self.memory)

    def set(self, t: int, value: Any) -> None:
        """Copy `value` (B x ...) to time t, from any device."""
        super().set(t, value.detach().to(self.device) if isinstance(value, torch.Tensor) else value)

    def _store(self, t: int, value: Any) -> None:
        if t < -len(self.memory):
            raise self._not_written(t)
        self._require_length(t)
        self._whole[t] = value

    def set_full(self, value: Any) -> None:
        """Copy T x B x ... to the first T times; later ones do not change."""
        self._check_full(value)
        self._require_length(len(value) - 1)
        if len(value):
            self._check(value[0], "all times")
        self._whole[: len(value)] = value.detach() if isinstance(value, torch.Tensor) else value

    def detach(self) -> None:
        """Do nothing: shared memory has no graph."""

    def _require_length(self, t: int) -> None:
        if t >= len(self.memory):
            raise LoopError(
                f"{self.name!r} at t={t}: a shared workspace has a fixed length, and this one has {len(self.memory)} "
                f"times; make it as long as the run: NRemoteAgent.create(..., time_size=...), {t + 1} at least."
            )


class _SharedTensorVariable(_SharedVariable, TensorVariable):
    """The same for tensors."""


class SharedWorkspace(Workspace):
    """Named variables in shared memory; `bam_train.loop.NRemoteAgent.create` and `shared_workspace` make them."""

    is_shared = True

    def __init__(self, variables: Mapping[str, Any]) -> None:
        super().__init__()
        self.variables = dict(variables)

    def __reduce__(self) -> tuple[Any, ...]:
        return SharedWorkspace, (self.variables,)

    def columns(self, begin: int, end: int) -> SharedWorkspace:
        """The batch columns [begin, end), in the same memory."""
        variables: Mapping[str, Any] = self.variables
        return SharedWorkspace({name: type(v)(name, v.memory[:, begin:end]) for name, v in variables.items()})

    def remove_variable(self, name: str) -> None:
        """Raise LoopError: other processes use the variable."""
        raise LoopError(f"{name!r} cannot be removed from a shared workspace.")

    def clear(self, name: str | None = None) -> None:
        """Raise LoopError: other processes use the workspace."""
        raise LoopError("A shared workspace cannot be cleared: its variables and its length are fixed.")

    def _new(self, name: str, value: Any, where: str) -> Any:
        raise LoopError(
            f"{name!r} cannot be added to a shared workspace, which has {', '.join(map(repr, self.variables))}."
        )


def shared_workspace(workspace: Workspace, n_repeat: int = 1, time_size: int | None = None) -> SharedWorkspace:
    """Copy a workspace into shared memory, without its graph.

    Args:
        workspace: The workspace to copy, with at least one variable, of dtypes that torch has.
        n_repeat: The number of copies side by side over the batch.
        time_size: The number of times of the copy, which then holds zeros; None for the times and values of
            `workspace`.
    """
    for what, number in (("n_repeat", n_repeat), ("time_size", 1 if time_size is None else time_size)):
        if number < 1:
            raise LoopError(f"{what}: expected at least 1, found {number}.")
    if not workspace.variables:
        raise LoopError("The workspace is empty: there is nothing to share; run the agent on it first.")
    variables = {}
    for name, one in workspace.variables.items():
        value = one.full()
        try:
            tensor = torch.cat([torch.as_tensor(value).detach()] * n_repeat, dim=1)
        except TypeError as error:
            raise LoopError(f"{name!r} cannot be shared: {error}") from error
        if time_size is not None:
            tensor = tensor.new_zeros((time_size, *tensor.shape[1:]))
        kind = _SharedVariable if isinstance(value, np.ndarray) else _SharedTensorVariable
        variables[name] = kind(name, tensor.clone().share_memory_())
    return SharedWorkspace(variables)
