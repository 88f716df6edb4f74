"""One variable of a workspace whose values are torch tensors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from bam_train.loop.variables import Variable


class TensorVariable(Variable):
    """Keeps tensor objects as they are; or NumPy arrays that become tensors when somebody reads them."""

    ARRAY = torch.Tensor
    KIND = "a torch.Tensor"
    COPIES = False
    library = torch

    _device: torch.device | None = None
    _is_cpu = False
    _array_dtype: np.dtype[Any] | None = None  # of the deferred arrays in the list; None when there are none
    _joined_with_grad = False

    @property
    def device(self) -> torch.device | None:
        """Where the values are; None before the first write."""
        return self._device

    def set_deferred(self, t: int, array: np.ndarray) -> None:
        """Write the tensor of a NumPy array (B x ...) that nobody changes any more, made when somebody reads it.

        Making a tensor costs several times as much as keeping the array, and rewards and flags are mostly read at once,
        when the rollout is over.
        """
        if array.shape != self.shape or not self._is_cpu or (self._array_dtype or _numpy(self.dtype)) != array.dtype:
            self.set(t, torch.from_numpy(array))
            return
        self._array_dtype = array.dtype
        self._store(t, array)

    def get(self, t: int) -> torch.Tensor:
        """The value at time t, B x ...; -1 is the last."""
        values: Any = self._whole if self._values is None else self._values
        index = t - self.first if t >= 0 else len(values) + t
        if not 0 <= index < len(values):
            raise self._not_written(t)
        value: torch.Tensor = values[index]
        if type(value) is np.ndarray:
            value = torch.from_numpy(value)
            if not torch.is_inference_mode_enabled():  # others could not use it outside
                values[index] = value
        return value

    def full(self) -> torch.Tensor:
        """All times kept, T x B x ...: one tensor itself, of a list a copy."""
        return self._whole if self._values is None else self.view().clone()

    def view(self) -> torch.Tensor:
        """All times kept, T x B x ..., to be read at once and not to be changed."""
        if self._values is None:
            whole: torch.Tensor = self._whole
            return whole
        grad = torch.is_grad_enabled()
        # Joined while gradients were off it lacks the graph; joined while they were on it may have one too many.
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
            self._values = [value if type(value) is np.ndarray else value.detach() for value in self._values]

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
        self._device, self._is_cpu, self._array_dtype = value.device, value.is_cpu, None

    def _join(self, values: Sequence[Any]) -> torch.Tensor:
        if self._array_dtype is not None:
            try:
                arrays = [value if type(value) is np.ndarray else value.numpy() for value in values]
                return torch.from_numpy(np.concatenate(arrays).reshape(len(values), *self.shape))
            except RuntimeError:  # a value has a gradient
                values = [torch.from_numpy(value) if type(value) is np.ndarray else value for value in values]
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


def _numpy(dtype: Any) -> np.dtype[Any] | None:
    """The NumPy dtype of a torch dtype; None for those that NumPy lacks."""
    return np.dtype(str(dtype).removeprefix("torch.")) if dtype in _SHARED else None


_SHARED = (torch.bool, torch.int64, torch.float32, torch.float64)
"""The dtypes of what environments give."""
