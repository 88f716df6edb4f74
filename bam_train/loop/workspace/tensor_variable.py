"""One variable of a workspace whose values are torch tensors."""

from collections.abc import Sequence
from typing import Any

import torch

from bam_train.loop.workspace.variables import Variable


class TensorVariable(Variable):
    """Keeps tensor objects as they are, with their graph."""

    ARRAY = torch.Tensor
    KIND = "a torch.Tensor"
    COPIES = False
    library = torch

    _device: torch.device | None = None
    _is_cpu = False
    _joined_with_grad = False

    @property
    def device(self) -> torch.device | None:
        """Where the values are; None before the first write."""
        return self._device

    def full(self) -> torch.Tensor:
        """All times kept, T x B x ...: the tensor itself, or a copy of a list."""
        return self._whole if self._values is None else self.view().clone()

    def view(self) -> torch.Tensor:
        """All times kept, T x B x ..., to be read before the next write and not to be changed."""
        if self._values is None:
            whole: torch.Tensor = self._whole
            return whole
        grad = torch.is_grad_enabled()
        # A tensor joined with gradients off lacks the graph; one joined with gradients on may have one in excess.
        if self._joined is not None and self._joined_with_grad != grad and (grad or self._joined.requires_grad):
            self._joined = None
        if self._joined is None:
            self._joined, self._joined_with_grad = self._join(self._values), grad
        tensor: torch.Tensor = self._joined
        if tensor.is_inference():  # cannot be used outside of inference mode, where the next reader may be
            self._joined = None
        return tensor

    def detach(self) -> None:
        """Cut every value off its graph."""
        self._joined = None
        if self._values is None:
            self._whole = self._whole.detach()
        else:
            self._values = [value.detach() for value in self._values]

    def _fits(self, value: Any) -> bool:
        try:
            return (
                value.shape == self.shape
                and value.dtype is self.dtype
                and (value.is_cpu if self._is_cpu else value.device == self._device)  # `is_cpu` is quicker
            )
        except AttributeError:
            return False

    def _be_like(self, shape: Any, value: Any) -> None:
        super()._be_like(shape, value)
        self._device, self._is_cpu = value.device, value.is_cpu

    def _join(self, values: Sequence[Any]) -> torch.Tensor:
        if not self.shape:
            return torch.stack(list(values))
        # `cat` and a view are several times as quick as `stack` for many small tensors; `cat` keeps channels_last.
        return torch.cat(list(values)).view(len(values), *self.shape).contiguous()

    def _zeros(self) -> torch.Tensor:
        return torch.zeros(self.shape, dtype=self.dtype, device=self._device)

    @staticmethod
    def index(index: Any, like: torch.Tensor) -> torch.Tensor:
        """`index` (integers or booleans) as a tensor on the device of `like`."""
        tensor = torch.as_tensor(index, device=like.device)
        empty = tensor.is_floating_point() and not tensor.numel()  # what an empty list becomes
        return tensor.long() if empty else tensor

    @staticmethod
    def copied(array: torch.Tensor) -> torch.Tensor:
        """A copy that shares no memory, and keeps the graph."""
        return array.clone()

    @staticmethod
    def on_device(array: torch.Tensor, device: Any) -> torch.Tensor:
        """The tensor on `device`; itself if it is there."""
        return array.to(device)
