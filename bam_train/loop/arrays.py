"""Storage of one NumPy variable of a workspace: one buffer that grows, time first.

Values are copied in. What is read of one time is a view of the buffer: it changes only where the same time is written
again; copy it before you change it. What is read of several times is a copy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from bam_train.errors import TimeNotWritten, ValueMismatch, WorkspaceError

UNLIMITED = 2**62
"""More times than any workspace holds."""

_FIRST_ROWS = 16
"""Times that a new buffer has room for."""


def no_window(t: int) -> None:
    """Makes no room for time t: nothing is ever forgotten."""


def kept(first: int, stop: int) -> str:
    """Which times a variable has, for an error's text."""
    if stop <= first:
        return "it has none"
    only = f"it has times {first} to {stop - 1}" if stop - first > 1 else f"it has time {first} only"
    return f"{only}; earlier ones have left the window" if first else only


def not_written(name: str, t: int, first: int, stop: int) -> TimeNotWritten:
    """The error for a time that a variable does not have."""
    return TimeNotWritten(f"{name!r} is not written at t={t}; {kept(first, stop)}.")


def require_window(name: str, begin: int, end: int, first: int) -> None:
    """Refuse a range of times that is empty, negative, or has left the window.

    Raises:
        WorkspaceError: Not ``0 <= begin < end``.
        TimeNotWritten: It begins before the first time that is kept.
    """
    if not 0 <= begin < end:
        raise WorkspaceError(f"{name!r}: expected times with 0 <= from < to, found from {begin} to {end}.")
    if begin < first:
        raise TimeNotWritten(f"{name!r} has lost t={begin}: times before {first} have left the window.")


class NumpyVariable:
    """One variable, T x B x ...; B x ... at one time.

    Args:
        name: For error messages.
        first: The first time kept; only a windowed workspace starts later than 0.
        limit: Times that are kept at most.
        make_room: Called with a time that does not fit; afterwards `first` is later.
    """

    KIND = "a numpy.ndarray"

    def __init__(
        self,
        name: str,
        first: int = 0,
        limit: int = UNLIMITED,
        make_room: Callable[[int], None] = no_window,
    ) -> None:
        self.name, self.first, self._limit, self._make_room = name, first, limit, make_room
        self._buffer: NDArray[Any] = np.empty((0, 0))
        self._count = 0
        self._shape: tuple[int, ...] | None = None  # of one time; None before the first write
        self._sliced = True  # whether the last write was of one time

    # -- what it is ------------------------------------------------------------------------------------------------

    @property
    def size(self) -> tuple[int, ...]:
        """Shape of one time after a `set`, of the whole after a `set_full`, as BBRL's."""
        return (self._shape or ()) if self._sliced else (self._count, *(self._shape or ()))

    @property
    def dtype(self) -> DTypeLike:
        """The dtype of its values."""
        return self._buffer.dtype

    @property
    def device(self) -> str:
        """Where it is: NumPy knows one place."""
        return "cpu"

    @property
    def stop(self) -> int:
        """One after the last time written."""
        return self.first + self._count

    def time_size(self) -> int:
        """One after the last time written."""
        return self.first + self._count

    def batch_size(self) -> int:
        """B."""
        return batch_of(self.name, self._shape)

    # -- one time --------------------------------------------------------------------------------------------------

    def set(self, t: int, value: NDArray[Any]) -> None:
        """Copy `value` (B x ...) to time t; missing earlier times become zeros.

        Raises:
            ValueMismatch: Another shape, dtype or kind than before.
            TimeNotWritten: A negative or lost time.
        """
        try:
            fits = value.shape == self._shape and value.dtype == self._buffer.dtype
        except AttributeError:
            fits = False
        if not fits or type(value) is not np.ndarray:
            self._check(value, f"t={t}")
        index = t - self.first if t >= 0 else self._count + t
        if index >= self._count:
            index = self._append(t, index)
        elif index < 0:
            raise not_written(self.name, t, self.first, self.stop)
        self._sliced = True
        self._buffer[index] = value

    def get(self, t: int) -> NDArray[Any]:
        """A view of time t, B x ...; -1 is the last.

        Raises:
            TimeNotWritten: Nobody wrote it.
        """
        index = t - self.first if t >= 0 else self._count + t
        if 0 <= index < self._count:
            row: NDArray[Any] = self._buffer[index]
            return row
        raise not_written(self.name, t, self.first, self.stop)

    # -- all times -------------------------------------------------------------------------------------------------

    def set_full(self, value: NDArray[Any]) -> None:
        """Copy T x B x ... in. Over single times it overwrites the first T and leaves the rest, as BBRL does."""
        require_full(self.name, value, np.ndarray, self.KIND)
        if self._sliced and self._shape is not None:
            for k, row in enumerate(value):
                self.set(self.first + k, np.asarray(row))
            return
        self._buffer = np.array(value)
        self._count, self._shape, self._sliced = len(value), value.shape[1:], False

    def full(self) -> NDArray[Any]:
        """A copy of all times kept, T x B x ..."""
        return np.array(self.view())

    def view(self) -> NDArray[Any]:
        """All times kept, T x B x ..., to be read at once and not to be changed."""
        return self._buffer[: self._count]

    def truncated(self, begin: int, end: int) -> NDArray[Any]:
        """A copy of times [begin, end), cut off at the end."""
        piece = self.view()[max(0, begin - self.first) : max(0, end - self.first)]
        return np.array(piece)

    def drop(self, first: int) -> None:
        """Forget the times before `first`."""
        left = max(0, self.stop - first)
        buffer = np.empty_like(self._buffer)  # a new one, so that what somebody has read does not change
        buffer[:left] = self._buffer[self._count - left : self._count]
        self._buffer, self.first, self._count = buffer, first, left

    def copy_time(self, begin: int, to: int, count: int) -> None:
        """Copy times [begin, begin + count) onto [to, to + count)."""
        for k in range(count):
            self.set(to + k, self.get(begin + k))

    def detach(self) -> None:
        """Nothing: NumPy keeps no graph."""

    # -- growing ---------------------------------------------------------------------------------------------------

    def _append(self, t: int, index: int) -> int:
        """Make room for a time that is not there yet; its index in the buffer."""
        if index >= self._limit:
            self._make_room(t)
            index = t - self.first
        if index >= len(self._buffer):
            rows = min(max(2 * len(self._buffer), index + 1, _FIRST_ROWS), max(self._limit, index + 1))
            grown = np.zeros((rows, *self._buffer.shape[1:]), self._buffer.dtype)
            grown[: self._count] = self._buffer[: self._count]
            self._buffer = grown
        self._buffer[self._count : index] = 0
        self._count = index + 1
        return index

    def _check(self, value: Any, where: str) -> None:
        """Take the first value's shape and dtype, or say what differs from them."""
        if not isinstance(value, np.ndarray):
            raise kind_mismatch(self.name, where, self.KIND, value)
        if self._shape is None:
            if value.ndim == 0:
                raise no_batch(self.name, where)
            self._shape, self._buffer = value.shape, np.empty((0, *value.shape), value.dtype)
        for what, ours, theirs in (("shape", self._shape, value.shape), ("dtype", self._buffer.dtype, value.dtype)):
            if ours != theirs:
                raise mismatch(self.name, where, what, ours, theirs)

    # -- operations on full arrays ---------------------------------------------------------------------------------

    @staticmethod
    def stack(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Arrays of one shape along a new first axis."""
        stacked: NDArray[Any] = np.stack(arrays)
        return stacked

    @staticmethod
    def concatenate(arrays: Sequence[NDArray[Any]], axis: int) -> NDArray[Any]:
        """Arrays one after the other along `axis`."""
        joined: NDArray[Any] = np.concatenate(arrays, axis=axis)
        return joined

    @staticmethod
    def index(index: Any, like: Any) -> NDArray[Any]:
        """`index` (integers or booleans) as an array that indexes `like`."""
        array = np.asarray(index)
        if array.dtype.kind == "f" and not array.size:  # what an empty list becomes
            return np.empty(0, dtype=np.int64)
        return array

    @staticmethod
    def copied(array: NDArray[Any]) -> NDArray[Any]:
        """A copy that shares no memory."""
        return np.array(array)

    @staticmethod
    def on_device(array: NDArray[Any], device: Any) -> NDArray[Any]:
        """The array itself: NumPy's are on the CPU."""
        if str(device).partition(":")[0] != "cpu":
            raise WorkspaceError(f"A NumPy array cannot be moved to {device}; only tensors can.")
        return array


def kind_name(value: Any) -> str:
    """Module and class, such as ``numpy.ndarray``; builtins without module."""
    kind = type(value)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"


def mismatch(name: str, where: str, what: str, expected: Any, found: Any) -> ValueMismatch:
    """The error for a value that differs from the ones before."""
    shown = [str(tuple(one)) if isinstance(one, tuple) else str(one) for one in (expected, found)]
    return ValueMismatch(f"{name!r} at {where}: expected {what} {shown[0]}, found {shown[1]}.")


def no_batch(name: str, where: str) -> ValueMismatch:
    """The error for a value without axes."""
    return ValueMismatch(
        f"{name!r} at {where}: expected a batch axis first (B x ...), found a single number; give it shape (1,)."
    )


def kind_mismatch(name: str, where: str, expected: str, found: Any) -> ValueMismatch:
    """The error for a value that is no array of this kind."""
    return ValueMismatch(f"{name!r} at {where}: expected {expected}, found {_article(kind_name(found))}.")


def require_full(name: str, value: Any, kind: type, kind_text: str) -> None:
    """Refuse what is not an array with a time axis."""
    if not isinstance(value, kind):
        raise kind_mismatch(name, "all times", kind_text, value)
    if value.ndim == 0:  # type: ignore[attr-defined]
        raise ValueMismatch(
            f"{name!r} at all times: expected time and batch first (T x B x ...), found a single number."
        )


def batch_of(name: str, shape: tuple[int, ...] | None) -> int:
    """B of the shape of one time.

    Raises:
        WorkspaceError: It has no batch axis: `set_full` takes T alone too.
    """
    if not shape:
        raise WorkspaceError(f"{name!r} has no batch axis; write it as T x B x ....")
    return shape[0]


def _article(noun: str) -> str:
    return f"an {noun}" if noun[0] in "aeiou" else f"a {noun}"
