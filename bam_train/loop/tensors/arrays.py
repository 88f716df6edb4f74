"""Storage of one tensor variable of a workspace, as BBRL's: a list of one tensor a time, or one tensor of all times.

A variable that `set` writes is a list: every value stays the very object that was given, with its graph, so that what
was written at t and read at t + 1 can still be differentiated through. One that `set_full` writes is that tensor.

Unlike BBRL's, the joined form of a list is kept until the next write through the workspace, so that a second full read
costs a copy only. A stored value that is changed in place after a full read does not show in the next one.

Numbers that few agents read before the rollout is over, such as rewards and flags, can be deferred: they are kept as
NumPy arrays or lists, and become tensors when they are read, all at once by a full read. Making a tensor costs several
times what keeping it does.

Longer than most files here: a list, one tensor and deferred numbers are three forms of one variable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from bam_train.errors import WorkspaceError
from bam_train.loop.arrays import (
    UNLIMITED,
    batch_of,
    kind_mismatch,
    mismatch,
    no_batch,
    no_window,
    not_written,
    require_full,
)


class _Joined(NamedTuple):
    """A concatenation of a list, which nobody else holds."""

    tensor: torch.Tensor
    grad_enabled: bool
    """Whether gradients were on when it was made."""

    def is_current(self) -> bool:
        """Whether a new concatenation would have the same graph."""
        return torch.is_grad_enabled() == self.grad_enabled or (self.grad_enabled and not self.tensor.requires_grad)


_DEFERRED = (tuple, list, np.ndarray)
"""What deferred numbers are kept as."""


class TensorVariable:
    """One variable, T x B x ...; B x ... at one time.

    Args:
        name: For error messages.
        first: The first time kept; only a windowed workspace starts later than 0.
        limit: Times that are kept at most.
        make_room: Called with a time that does not fit; afterwards `first` is later.
    """

    KIND = "a torch.Tensor"

    def __init__(
        self,
        name: str,
        first: int = 0,
        limit: int = UNLIMITED,
        make_room: Callable[[int], None] = no_window,
    ) -> None:
        self.name, self.first, self._limit, self._make_room = name, first, limit, make_room
        self._values: list[Any] | None = []  # tensors, and deferred numbers
        self._deferred: Any = None  # the NumPy dtype of deferred numbers; None when there are none
        self._whole: torch.Tensor | None = None  # the variable itself when `_values` is None
        self._read: _Joined | None = None
        self._shape: torch.Size | None = None  # of one time; None before the first write
        self._dtype: torch.dtype | None = None
        self._device: torch.device | None = None
        self._is_cpu = False

    # -- what it is ------------------------------------------------------------------------------------------------

    @property
    def size(self) -> torch.Size:
        """Shape of one time of a list, of the whole of one tensor."""
        if self._whole is not None:
            return self._whole.shape
        return torch.Size(()) if self._shape is None else self._shape

    @property
    def dtype(self) -> torch.dtype | None:
        """The dtype of its values; None before the first."""
        return self._dtype

    @property
    def device(self) -> torch.device | None:
        """The device of its values; None before the first."""
        return self._device

    @property
    def stop(self) -> int:
        """One after the last time written."""
        return self.time_size()

    def time_size(self) -> int:
        """One after the last time written."""
        return self.first + (len(self._values) if self._values is not None else len(self._tensor))

    def batch_size(self) -> int:
        """B."""
        return batch_of(self.name, self._shape)

    @property
    def _tensor(self) -> torch.Tensor:
        if self._whole is None:
            raise WorkspaceError(f"{self.name!r} is empty.")
        return self._whole

    # -- one time --------------------------------------------------------------------------------------------------

    def set(self, t: int, value: torch.Tensor) -> None:
        """Keep `value` (B x ...) at time t, the object itself; missing earlier times become zeros.

        Raises:
            ValueMismatch: Another shape, dtype, device or kind than before.
            TimeNotWritten: A negative or lost time.
        """
        try:
            fits = (
                value.shape == self._shape
                and value.dtype is self._dtype
                and (value.is_cpu if self._is_cpu else value.device == self._device)  # `is_cpu` is quicker
            )
        except AttributeError:
            fits = False
        if not fits:
            self._check(value, f"t={t}")
        self._read = None
        values = self._values
        if values is None:
            values = self._to_list()
        count = len(values)
        index = t - self.first if t >= 0 else count + t
        if index == count < self._limit:
            values.append(value)
        elif index >= count:
            self._append(t, index, value)
        elif index >= 0:
            values[index] = value
        else:
            raise not_written(self.name, t, self.first, self.stop)

    def get(self, t: int) -> torch.Tensor:
        """Time t, B x ...; -1 is the last. The object that was set, or a view of the whole.

        Raises:
            TimeNotWritten: Nobody wrote it.
        """
        values: Any = self._tensor if self._values is None else self._values  # indexed alike
        index = t - self.first if t >= 0 else len(values) + t
        if 0 <= index < len(values):
            value: torch.Tensor = values[index]
            if self._deferred is not None and type(value) in _DEFERRED:
                value = values[index] = torch.from_numpy(np.array(value, self._deferred))
            return value
        raise not_written(self.name, t, self.first, self.stop)

    def defer(self, t: int, numbers: Any, dtype: Any) -> bool:
        """Keep numbers (B,) that become a tensor when somebody reads them.

        Args:
            t: The time.
            numbers: A sequence that nobody changes any more, of the variable's shape: that is not looked at.
            dtype: The NumPy dtype that becomes the variable's.

        Returns:
            Whether they were kept: only as the next time of a list on the CPU.
        """
        values = self._values
        if values is None or t - self.first != len(values) or len(values) >= self._limit or not self._is_cpu:
            return False
        values.append(numbers)
        self._deferred, self._read = dtype, None
        return True

    # -- all times -------------------------------------------------------------------------------------------------

    def set_full(self, value: torch.Tensor) -> None:
        """Keep T x B x ..., the object itself. Over a list it overwrites the first T and leaves the rest."""
        if self._values:
            require_full(self.name, value, torch.Tensor, self.KIND)
            for k, row in enumerate(value):
                self.set(self.first + k, row)
            return
        require_full(self.name, value, torch.Tensor, self.KIND)
        self._values, self._whole, self._read = None, value, None
        self._be_like(value.shape[1:], value)

    def full(self) -> torch.Tensor:
        """All times kept, T x B x ...; of a list a new tensor, quick until the next write."""
        return self._tensor if self._values is None else self.view().clone()

    def view(self) -> torch.Tensor:
        """All times kept, T x B x ..., to be read at once and not to be changed."""
        if self._values is None:
            return self._tensor
        if self._read is None or not self._read.is_current():
            tensor = _joined(self._values) if self._deferred is None else self._joined_deferred(self._values)
            if tensor.is_inference():  # cannot be used outside, where the next reader may be
                return tensor
            self._read = _Joined(tensor, torch.is_grad_enabled())
        return self._read.tensor

    def truncated(self, begin: int, end: int) -> torch.Tensor:
        """Times [begin, end), cut off at the end; a view of one tensor, a copy of a list."""
        self._settle()
        begin, end = max(0, begin - self.first), max(0, end - self.first)
        if self._values is None:
            return self._tensor[begin:end]
        rows = self._values[begin:end]
        return _joined(rows) if rows else torch.zeros((0, *self.size), dtype=self._dtype, device=self._device)

    def drop(self, first: int) -> None:
        """Forget the times before `first`."""
        values = self._to_list() if self._values is None else self._values
        del values[: first - self.first]
        self.first, self._read = first, None

    def copy_time(self, begin: int, to: int, count: int) -> None:
        """Copy times [begin, begin + count) onto [to, to + count): objects of a list, memory of one tensor."""
        if count == 0:
            return
        if self._values is None:
            whole = self._tensor
            self.get(begin), self.get(begin + count - 1), self.get(to), self.get(to + count - 1)
            whole[to : to + count] = whole[begin : begin + count].clone()
            return
        for k in range(count):
            self.set(to + k, self.get(begin + k))

    def detach(self) -> None:
        """Cut every value off its graph."""
        self._read = None
        if self._values is None:
            self._whole = self._tensor.detach()
        else:
            self._values = [value if type(value) in _DEFERRED else value.detach() for value in self._values]

    # -- deferred numbers ------------------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Make tensors of all deferred numbers, one for each time."""
        if self._deferred is not None and self._values is not None:
            for t in range(self.first, self.stop):
                self.get(t)
            self._deferred = None

    def _joined_deferred(self, values: list[Any]) -> torch.Tensor:
        """All times at once, T x B, some of which are deferred."""
        try:
            rows = [value if type(value) in _DEFERRED else value.numpy() for value in values]
        except RuntimeError:  # one has a gradient
            self._settle()
            return _joined(values)
        return torch.from_numpy(np.array(rows, self._deferred))

    # -- growing ---------------------------------------------------------------------------------------------------

    def _append(self, t: int, index: int, value: torch.Tensor) -> None:
        """Keep a value later than the next time, or one that needs room first."""
        values = self._values
        if values is None:
            raise WorkspaceError(f"{self.name!r} has no list.")
        if index >= self._limit:
            self._make_room(t)
            index = t - self.first
        values.extend(torch.zeros_like(value, requires_grad=False) for _ in range(index - len(values)))
        values.append(value)

    def _to_list(self) -> list[torch.Tensor]:
        """Turn one tensor into a list of views of it."""
        values = [self._tensor[k] for k in range(len(self._tensor))]  # not unbind, whose views refuse in-place changes
        self._values, self._whole = values, None
        return values

    def _be_like(self, shape: torch.Size, value: torch.Tensor) -> None:
        self._shape, self._dtype, self._device, self._is_cpu = shape, value.dtype, value.device, value.is_cpu

    def _check(self, value: Any, where: str) -> None:
        """Take the first value's shape, dtype and device, or say what differs from them."""
        if not isinstance(value, torch.Tensor):
            raise kind_mismatch(self.name, where, self.KIND, value)
        if self._shape is None:
            if value.ndim == 0:
                raise no_batch(self.name, where)
            self._be_like(value.shape, value)
        pairs = (
            ("shape", self._shape, value.shape),
            ("dtype", self._dtype, value.dtype),
            ("device", self._device, value.device),
        )
        for what, ours, theirs in pairs:
            if ours != theirs:
                raise mismatch(self.name, where, what, ours, theirs)

    # -- operations on full tensors --------------------------------------------------------------------------------

    @staticmethod
    def stack(arrays: Sequence[torch.Tensor]) -> torch.Tensor:
        """Tensors of one shape along a new first axis."""
        return torch.stack(list(arrays))

    @staticmethod
    def concatenate(arrays: Sequence[torch.Tensor], axis: int) -> torch.Tensor:
        """Tensors one after the other along `axis`."""
        return torch.cat(list(arrays), dim=axis)

    @staticmethod
    def index(index: Any, like: torch.Tensor) -> torch.Tensor:
        """`index` (integers or booleans) as a tensor that indexes `like`."""
        tensor = torch.as_tensor(index, device=like.device)
        if tensor.is_floating_point() and not tensor.numel():  # what an empty list becomes
            return tensor.long()
        return tensor

    @staticmethod
    def copied(array: torch.Tensor) -> torch.Tensor:
        """A copy that shares no memory and keeps the graph."""
        return array.clone()

    @staticmethod
    def on_device(array: torch.Tensor, device: Any) -> torch.Tensor:
        """The tensor on `device`; itself if it is there."""
        return array.to(device)


def _joined(values: Sequence[torch.Tensor]) -> torch.Tensor:
    """T tensors B x ... as one T x B x ...; `cat` and a view, several times as quick as `stack` for many small ones."""
    shape = values[0].shape
    return torch.cat(list(values)).view(len(values), *shape).contiguous()  # `cat` keeps channels_last
