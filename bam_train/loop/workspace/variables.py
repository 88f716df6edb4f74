"""One variable of a workspace: a list with one array for each time, or one array of all times.

A variable that `set` writes is a list; a variable that `set_full` writes is one array until the next `set`. The joined
array of a list is cached until the next write through the workspace, so a second full read costs only a copy. It does
not show a stored value that was changed in place since the first full read.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from bam_train.errors import LoopError


class Variable:
    """One variable of NumPy arrays, T x B x ..., from the time `first` on; B x ... (its `shape`) at one time."""

    ARRAY: type = np.ndarray
    """The class of its values."""
    KIND = "a numpy.ndarray"
    """The same, for error messages."""
    COPIES = True
    """Whether values are copied when they are written; else the objects themselves are kept."""
    library: Any = np
    """The module with `stack` and `concatenate` for these values."""

    def __init__(self, name: str, first: int = 0) -> None:
        self.name, self.first = name, first
        self.shape: Any = None
        self.dtype: Any = None
        self._values: list[Any] | None = []
        self._whole: Any = None  # all times, when `_values` is None
        self._joined: Any = None  # the list as one array, until the next write

    # -- sizes -----------------------------------------------------------------------------------------------------

    @property
    def size(self) -> Any:
        """The shape of one time (of a list) or of all times (of one array), as in BBRL."""
        return self._whole.shape if self._values is None else self.shape or ()

    @property
    def device(self) -> Any:
        """The device of the values."""
        return "cpu"

    def time_size(self) -> int:
        """One after the last time written."""
        return self.first + len(self._whole if self._values is None else self._values)

    def batch_size(self) -> int:
        """B; raises LoopError without a batch axis, as `set_full` accepts shape (T,) too."""
        if not self.shape:
            raise LoopError(f"{self.name!r} has no batch axis; write it as T x B x ....")
        return int(self.shape[0])

    # -- one time --------------------------------------------------------------------------------------------------

    def set(self, t: int, value: Any) -> None:
        """Write `value` (B x ...) at time t; missing earlier times become zeros."""
        if not self._fits(value):
            self._check(value, f"t={t}")
        if self.COPIES:
            value = np.array(value)
        values = self._values
        if values is not None and t - self.first == len(values):  # the usual case, without a call
            self._joined = None
            values.append(value)
        else:
            self._store(t, value)

    def get(self, t: int) -> Any:
        """The value at time t, B x ...; -1 is the last."""
        values = self._whole if self._values is None else self._values  # array or list
        index = t - self.first if t >= 0 else len(values) + t
        if 0 <= index < len(values):
            return values[index]
        raise self._not_written(t)

    # -- all times -------------------------------------------------------------------------------------------------

    def set_full(self, value: Any) -> None:
        """Write T x B x .... In a list it overwrites the first T times and leaves later ones, as in BBRL."""
        self._check_full(value)
        if self._values:
            for k in range(len(value)):
                self.set(self.first + k, value[k, ...])
            return
        self._values, self._whole, self._joined = None, np.array(value) if self.COPIES else value, None
        self._be_like(value.shape[1:], value)

    def full(self) -> Any:
        """A copy of all times kept, T x B x ...."""
        return self.copied(self.view())

    def view(self) -> Any:
        """All times kept, T x B x ..., to be read before the next write and not to be changed."""
        if self._values is None:
            return self._whole
        if self._joined is None:
            self._joined = self._join(self._values)
        return self._joined

    def truncated(self, begin: int, end: int) -> Any:
        """Times [begin, end), clipped to those written; a view of one array, or a copy of a list."""
        times = slice(max(0, begin - self.first), max(0, end - self.first))
        if self._values is None:
            return self._whole[times]
        values = self._values[times]
        return self._join(values) if values else self._join([self._zeros()])[:0]

    def drop(self, first: int) -> None:
        """Forget the times before `first`."""
        del self._listed()[: first - self.first]
        self.first, self._joined = first, None

    def copy_time(self, begin: int, to: int, count: int) -> None:
        """Copy times [begin, begin + count) to [to, to + count): the objects of a list, or the memory of an array."""
        if self._values is not None:
            for k in range(count):
                self.set(to + k, self.get(begin + k))
        elif count:
            for t in (begin, begin + count - 1, to, to + count - 1):
                self.get(t)  # raises LoopError
            self._whole[to : to + count] = self.copied(self._whole[begin : begin + count])

    def detach(self) -> None:
        """Cut every value off its graph."""

    # -- what `TensorVariable` overrides ---------------------------------------------------------------------------

    def _fits(self, value: Any) -> bool:
        """Whether the value has the shape, dtype and device of the variable; fast."""
        return type(value) is np.ndarray and value.shape == self.shape and value.dtype == self.dtype

    def _join(self, values: Sequence[Any]) -> Any:
        """T values B x ..., at least one, as one new array T x B x ...."""
        if not self.shape:
            return np.stack(values)
        return np.concatenate(values).reshape(len(values), *self.shape)  # several times faster than `stack`

    def _zeros(self) -> Any:
        """The value at a time that was not written."""
        return np.zeros(self.shape, self.dtype)

    @staticmethod
    def index(index: Any, like: Any) -> Any:
        """`index` (integers or booleans) as an array that indexes `like`."""
        array = np.asarray(index)
        empty = array.dtype.kind == "f" and not array.size  # from an empty list
        return np.empty(0, dtype=np.int64) if empty else array

    @staticmethod
    def copied(array: Any) -> Any:
        """A copy that shares no memory, and keeps the graph."""
        return np.array(array)

    @staticmethod
    def on_device(array: Any, device: Any) -> Any:
        """The array on `device`; the same object if it is there already."""
        if str(device).partition(":")[0] != "cpu":
            raise LoopError(f"A NumPy array cannot be moved to {device}; only tensors can.")
        return array

    # -- inside ----------------------------------------------------------------------------------------------------

    def _store(self, t: int, value: Any) -> None:
        """Put a value that fits at time t."""
        self._joined = None
        values = self._listed() if self._values is None else self._values
        count = len(values)
        index = t - self.first if t >= 0 else count + t
        if index == count:
            values.append(value)
        elif index > count:
            values.extend(self._zeros() for _ in range(index - count))
            values.append(value)
        elif index >= 0:
            values[index] = value
        else:
            raise self._not_written(t)

    def _listed(self) -> list[Any]:
        """The list; one array becomes a list of views of it."""
        if self._values is None:
            self._values, self._whole = [self._whole[k, ...] for k in range(len(self._whole))], None
        return self._values

    def _be_like(self, shape: Any, value: Any) -> None:
        """Take the shape, dtype and device of the first value."""
        self.shape, self.dtype = shape, value.dtype

    def _check(self, value: Any, where: str) -> None:
        """Take the shape and dtype of the first value; raise LoopError if another value differs."""
        if not isinstance(value, self.ARRAY):
            raise kind_mismatch(self.name, where, self.KIND, value)
        if self.shape is None:
            if value.ndim == 0:  # type: ignore[attr-defined]
                raise no_batch(self.name, where)
            self._be_like(value.shape, value)  # type: ignore[attr-defined]
        for what in ("shape", "dtype", "device"):
            expected, found = getattr(self, what), getattr(value, what, "cpu")  # arrays of NumPy 1 have no device
            if expected != found:
                raise mismatch(self.name, where, what, expected, found)

    def _check_full(self, value: Any) -> None:
        """Raise LoopError unless the value is an array with a time axis."""
        if not isinstance(value, self.ARRAY):
            raise kind_mismatch(self.name, "all times", self.KIND, value)
        if value.ndim == 0:  # type: ignore[attr-defined]
            raise LoopError(
                f"{self.name!r} at all times: expected time and batch first (T x B x ...), found a single number."
            )

    def _not_written(self, t: int) -> LoopError:
        return LoopError(f"{self.name!r} is not written at t={t}; {self.kept_times()}.")

    def kept_times(self) -> str:
        """The times kept, for an error message."""
        if self.time_size() <= self.first:
            return "it has none"
        several = self.time_size() - self.first > 1
        text = f"it has times {self.first} to {self.time_size() - 1}" if several else f"it has time {self.first} only"
        return f"{text}; earlier ones have left the window" if self.first else text


def kind_name(value: Any) -> str:
    """Module and class, such as ``numpy.ndarray``; builtins without module."""
    kind = type(value)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"


def mismatch(name: str, where: str, what: str, expected: Any, found: Any) -> LoopError:
    """The error for a value that differs from earlier ones."""
    shown = [str(tuple(part)) if isinstance(part, tuple) else str(part) for part in (expected, found)]
    return LoopError(f"{name!r} at {where}: expected {what} {shown[0]}, found {shown[1]}.")


def no_batch(name: str, where: str) -> LoopError:
    """The error for a value without axes."""
    return LoopError(
        f"{name!r} at {where}: expected a batch axis first (B x ...), found a single number; give it shape (1,)."
    )


def kind_mismatch(name: str, where: str, expected: str, found: Any) -> LoopError:
    """The error for a value that is not an array of the expected kind."""
    kind = kind_name(found)
    return LoopError(f"{name!r} at {where}: expected {expected}, found {'an' if kind[0] in 'aeiou' else 'a'} {kind}.")


def to_array(value: Any) -> np.ndarray:
    """A tensor or array as an array, which shares its memory where possible."""
    if isinstance(value, np.ndarray):
        return value
    try:
        array: np.ndarray = value.numpy()
    except (RuntimeError, TypeError):  # with a gradient, on another device, or of a dtype that NumPy lacks
        value = value.detach().cpu()
        array = (value.float() if value.is_floating_point() and value.itemsize < 4 else value).numpy()
    return array


def unknown_variable(name: str, known: Iterable[str], role: str = "") -> LoopError:
    """The error for a variable that no agent wrote, asked for as a `role` such as ``"stop_variable"``."""
    from bam_envs.core.wording import closest  # not above: a policy alone needs no environments

    names = sorted(known)
    close = closest(name, names, cutoff=0.6)
    question = "." if close is None else f", did you mean {close!r}?"
    has = f" It has {', '.join(map(repr, names))}." if names else " It is empty."
    return LoopError(f"{role} {name!r} is not in the workspace{question}{has}".lstrip())
