"""The workspace: named variables over time, which agents read and write.

A variable is T x B x ...: time first, batch second; at one time it is B x .... Values are torch tensors (kept as they
are, with their graph) or NumPy arrays (copied in); torch is not needed for the latter.

It is BBRL's `Workspace`, with these differences:

- What BBRL asserts is an exception here that names the variable, what was expected and what was found.
- A first write that fails leaves nothing behind.
- A full read is kept until the next write, see `bam_train.loop.tensors.arrays`.
- `to`, `cat_batch` and `sample_subworkspace` with more than one window work; `copy_n_last_steps` copies only the
  variables that it was given.
- `select_batch` gives variables of one tensor each, which are quicker to go on with.
- `copy_n_last_steps` copies once, also where the copied times overlap (BBRL copies once for each variable).
- With a window it forgets old times, after giving them to a sink: memory stays flat however long the loop runs. What is
  made of it (`contiguous`, `select_batch`, `to`, a copy) holds the times kept, and begins at time 0 again.

Longer than most files here: BBRL's users find every member in one class.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, KeysView, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_train.errors import TimeNotWritten, UnknownVariable, WorkspaceError
from bam_train.loop.arrays import UNLIMITED, NumpyVariable, kept, kind_mismatch, no_batch, no_window, require_window

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from bam_train.loop.tensors.arrays import TensorVariable

    Variable = NumpyVariable | TensorVariable

Sink = Callable[[int, dict[str, Any]], None]
"""Called with the first time of a piece and its variables, T x B x ... each."""

_LEAST_PIECE = 64
"""Times that leave a window together, at least: moving them one by one would be slow."""


class Workspace:
    """Named variables over time.

    Args:
        workspace: Begin as a copy of this one, sharing no memory.
        window: Keep at least the last so many times and forget older ones; None keeps all.
        sink: Gets what leaves the window, in order: ``sink(first_time, {name: array (n, B, ...)})``. A variable that
            nobody wrote at these times is shorter or absent. It is called by the write that needs room: a loop with a
            deadline waits for it.

    Attributes:
        variables: The variables by name, in the order of their first write.
        first_time: The first time kept; 0 without a window.
        is_shared: Whether several processes see its memory.
    """

    is_shared = False

    def __init__(
        self, workspace: Workspace | None = None, *, window: int | None = None, sink: Sink | None = None
    ) -> None:
        if window is not None and window < 2:
            raise WorkspaceError(f"window: expected at least 2 times (the last and the one before), found {window}.")
        if sink is not None and not callable(sink):
            raise WorkspaceError(f"sink: expected sink(first_time, values), found {type(sink).__name__}.")
        self.variables: dict[str, Variable] = {}
        self.first_time = 0
        self.window, self._sink = window, sink
        self._outbox: deque[tuple[int, dict[str, Any]]] = deque()  # what the sink has still to get
        self._limit = UNLIMITED if window is None else window + max(window, _LEAST_PIECE)
        if workspace is not None:
            for name, variable in workspace.variables.items():
                self.set_full(name, variable.copied(variable.full()))

    # -- one variable ----------------------------------------------------------------------------------------------

    def set(self, name: str, t: int, value: Any) -> None:
        """Write `value` (B x ...) at time t; -1 is the last.

        A new variable is made; missing earlier times become zeros. Any order of times will do.

        Raises:
            ValueMismatch: Another shape, dtype, device or kind of array than the variable has.
            TimeNotWritten: t has left the window, or is negative beyond the first.
        """
        try:
            variable = self.variables[name]
        except KeyError:
            self._set_first(name, t, value)
        else:
            try:
                variable.set(t, value)
            except (TypeError, IndexError):
                raise _no_time(name, t) from None

    def get(self, name: str, t: int) -> Any:
        """The value at time t, B x ...; -1 is the last.

        Raises:
            UnknownVariable: Nobody wrote it.
            TimeNotWritten: Nobody wrote it at t, or t has left the window.
        """
        try:
            variable = self.variables[name]
        except KeyError:
            raise UnknownVariable(name, self.variables) from None
        try:
            return variable.get(t)
        except (TypeError, IndexError):
            raise _no_time(name, t) from None

    def set_full(self, name: str, value: Any) -> None:
        """Write all times at once, T x B x ....

        On a variable that was written time by time it overwrites times 0 to T - 1 and leaves later ones.

        Raises:
            ValueMismatch: Not an array, or it differs from the times already written.
            WorkspaceError: Earlier times have left the window.
        """
        if self.first_time:
            raise WorkspaceError(
                f"{name!r}: all times cannot be written, those before {self.first_time} have left the window."
            )
        variable = self.variables.get(name)
        fresh = self._new(name, value, "all times") if variable is None else variable
        fresh.set_full(value)
        self.variables[name] = fresh

    def get_full(self, name: str) -> Any:
        """All times kept, T x B x ....

        Raises:
            UnknownVariable: Nobody wrote it.
        """
        return self._variable(name).full()

    def get_time_truncated(self, name: str, from_time: int, to_time: int) -> Any:
        """Times [from_time, to_time) of one variable, cut off at the end.

        Raises:
            WorkspaceError: Not ``0 <= from_time < to_time``.
        """
        variable = self._variable(name)
        require_window(name, from_time, to_time, self.first_time)
        return variable.truncated(from_time, to_time)

    def remove_variable(self, name: str) -> None:
        """Forget one variable; it may come back with another shape.

        Raises:
            UnknownVariable: Nobody wrote it.
        """
        self._variable(name)
        del self.variables[name]

    def clear(self, name: str | None = None) -> None:
        """Forget one variable, or everything. What is in the window does not go to the sink: see `flush`."""
        if name is not None:
            self.remove_variable(name)
            return
        self.variables.clear()
        self.first_time = 0

    def keys(self) -> KeysView[str]:
        """Names in the order of their first write."""
        return self.variables.keys()

    def __getitem__(self, key: str | Iterable[str]) -> Any:
        """`get_full` of one name; of several, a generator over theirs, in that order."""
        if isinstance(key, str):
            return self.get_full(key)
        return (self.get_full(name) for name in key)

    def __contains__(self, name: object) -> bool:
        return name in self.variables

    def __iter__(self) -> Iterator[str]:
        return iter(self.variables)

    # -- sizes -----------------------------------------------------------------------------------------------------

    def time_size(self) -> int | None:
        """One after the last time written; None when empty.

        Raises:
            WorkspaceError: The variables differ.
        """
        return self._common("time", {name: one.time_size() for name, one in self.variables.items()})

    def batch_size(self) -> int | None:
        """B; None when empty.

        Raises:
            WorkspaceError: The variables differ.
        """
        return self._common("batch", {name: one.batch_size() for name, one in self.variables.items()})

    def __str__(self) -> str:
        lines = (
            f"\t{name}: time_size = {one.time_size()}, batch_size = {one.batch_size()}"
            for name, one in self.variables.items()
        )
        return "\n".join(["Workspace:", *lines])

    # -- time ------------------------------------------------------------------------------------------------------

    def copy_time(self, from_time: int, to_time: int, n_steps: int, var_names: Sequence[str] | None = None) -> None:
        """Copy times [from_time, from_time + n_steps) onto [to_time, to_time + n_steps), of some or all variables."""
        for name in self._chosen(var_names):
            self.variables[name].copy_time(from_time, to_time, n_steps)

    def copy_n_last_steps(self, n: int, var_names: Sequence[str] | None = None) -> None:
        """Copy the last n times onto the first n; the length does not change.

        Raises:
            WorkspaceError: The variables have different lengths, or fewer than n times.
        """
        names = self._chosen(var_names)
        size = self._common("time", {name: self.variables[name].time_size() for name in names})
        if size is None:
            return
        if not 0 <= n <= size:
            raise WorkspaceError(f"copy_n_last_steps: expected at most {size} steps, found {n}.")
        self.copy_time(size - n, 0, n, names)

    def subtime(self, from_t: int, to_t: int) -> Workspace:
        """A new workspace of times [from_t, to_t) of all variables, by Python's slice rules.

        Raises:
            WorkspaceError: The variables have different lengths.
            TimeNotWritten: It begins with a time that has left the window.
        """
        begin, end, _ = slice(from_t, to_t).indices(self.time_size() or 0)
        for name in self.variables if begin < end else ():
            require_window(name, begin, end, self.first_time)
        return self._of({name: one.truncated(begin, max(begin, end)) for name, one in self.variables.items()})

    def get_time_truncated_workspace(self, from_time: int, to_time: int) -> Workspace:
        """A new workspace of times [from_time, to_time); lengths may differ."""
        return self._of({name: self.get_time_truncated(name, from_time, to_time) for name in self.variables})

    # -- batch -----------------------------------------------------------------------------------------------------

    def select_batch(self, batch_indexes: Any) -> Workspace:
        """A new workspace of these batch columns: integers (order and repeats kept) or a mask of booleans.

        Raises:
            WorkspaceError: The variables have different batch sizes.
        """
        self.batch_size()
        views = {name: (one, one.view()) for name, one in self.variables.items()}
        return self._of({name: array[:, one.index(batch_indexes, array)] for name, (one, array) in views.items()})

    def select_batch_n(self, n: int) -> Workspace:
        """A new workspace of n batch columns, drawn uniformly with replacement.

        Raises:
            WorkspaceError: There are none.
        """
        size = self.batch_size()
        if not size:
            raise WorkspaceError(f"select_batch_n: {n} columns are wanted, and there are none.")
        if self._has_tensors():
            import torch

            return self.select_batch(torch.randint(low=0, high=size, size=(n,)))
        return self.select_batch(np.random.randint(size, size=n))

    def select_subtime(self, t: Any, window_size: int) -> Workspace:
        """A new workspace where column b has times t[b] to t[b] + window_size - 1.

        Args:
            t: One time for each column. Shape: (B,), int.
            window_size: Times of the result.

        Raises:
            TimeNotWritten: A window goes beyond the times of a variable.
        """
        result = {}
        for name, one in self.variables.items():
            array = one.view()
            start = one.index(t, array) - self.first_time
            if len(start) and not 0 <= int(start.min()) <= int(start.max()) <= len(array) - window_size:
                raise TimeNotWritten(
                    f"{name!r}: windows of {window_size} from t={int(start.min()) + self.first_time} to "
                    f"{int(start.max()) + self.first_time} are wanted; {kept(one.first, one.stop)}."
                )
            columns = one.index(range(one.batch_size()), array)
            result[name] = one.stack([array[start + k, columns] for k in range(window_size)])
        return self._of(result)

    def sample_subworkspace(self, n_times: int, n_batch_elements: int, n_timesteps: int) -> Workspace:
        """A new workspace of `n_times` random windows, one after the other over the batch.

        Args:
            n_times: Windows.
            n_batch_elements: Columns of each, drawn without replacement; all if there are not more.
            n_timesteps: Times of each.

        Raises:
            WorkspaceError: A window is longer than what there is.
        """
        times, columns = self.time_size() or 0, self.batch_size() or 0
        if n_timesteps > times or n_times < 1:
            raise WorkspaceError(
                f"sample_subworkspace: expected one or more windows of at most {times} times, "
                f"found {n_times} of {n_timesteps}."
            )
        pieces = [self._window(times, columns, n_batch_elements, n_timesteps) for _ in range(n_times)]
        return pieces[0] if n_times == 1 else Workspace.cat_batch(pieces)

    @staticmethod
    def cat_batch(workspaces: Sequence[Workspace]) -> Workspace:
        """A new workspace: these, side by side over the batch.

        Raises:
            WorkspaceError: There are none, or they have different lengths.
            UnknownVariable: One lacks a variable that the first has.
        """
        if not workspaces:
            raise WorkspaceError("cat_batch: expected one workspace or more, found none.")
        first = workspaces[0]
        for other in workspaces[1:]:
            if other.time_size() != first.time_size():
                raise WorkspaceError(
                    f"cat_batch: expected workspaces of {first.time_size()} times, found one of {other.time_size()}."
                )
        arrays = {
            name: one.concatenate([workspace.get_full(name) for workspace in workspaces], 1)
            for name, one in first.variables.items()
        }
        return first._of(arrays)

    def get_transitions(self, no_final_state: bool = False, filter_key: str = "env/done") -> Workspace:
        """A new workspace of pairs of neighbouring times, 2 x N x ..., time-major, then over the batch.

        Pairs whose first step has `filter_key` true join the last state of an episode to the first of the next; they
        are left out.

        Args:
            no_final_state: Leave none out; `filter_key` is not needed.
            filter_key: The variable that says where episodes end.

        Raises:
            UnknownVariable: There is no `filter_key`.
            WorkspaceError: A variable is not as long as `filter_key`.
        """
        if no_final_state:
            return self._of({name: self._pairs(name, None) for name in self.variables})
        if filter_key not in self.variables:
            raise UnknownVariable(filter_key, self.variables, "filter_key")
        inside = ~_as_bool(self.get_full(filter_key)[:-1])
        for name, one in self.variables.items():
            if one.time_size() != self.variables[filter_key].time_size():
                raise WorkspaceError(
                    f"{name!r} has {one.time_size()} times and {filter_key!r} has "
                    f"{self.variables[filter_key].time_size()}; get_transitions needs all to be alike."
                )
        return self._of({name: self._pairs(name, inside) for name in self.variables})

    # -- the whole -------------------------------------------------------------------------------------------------

    def zero_grad(self) -> None:
        """Cut every value off its graph; the values stay."""
        for one in self.variables.values():
            one.detach()

    def contiguous(self) -> Workspace:
        """A new workspace whose variables are one array each."""
        return self._of({name: one.full() for name, one in self.variables.items()})

    def to(self, device: Any) -> Workspace:
        """A new workspace on `device`; tensors that are there already are shared."""
        return self._of({name: one.on_device(one.full(), device) for name, one in self.variables.items()})

    def flush(self) -> None:
        """Give all that is left to the sink, forget it, and begin again at time 0."""
        stop = max((one.stop for one in self.variables.values()), default=0)
        if stop > self.first_time:
            self._take_out(stop)
        self.clear()
        self._deliver()

    def _convert_to_shared_workspace(self, n_repeat: int = 1, time_size: int | None = None) -> Workspace:
        """A copy in memory that processes share, repeated over the batch; for remote agents."""
        from bam_train.loop.tensors.shared import shared_workspace

        workspace: Workspace = shared_workspace(self, n_repeat, time_size)
        return workspace

    # -- pictures --------------------------------------------------------------------------------------------------

    def plot(self, *names: str, batch: int | Sequence[int] | None = None) -> Figure:
        """A matplotlib figure of these variables over time (all without a name), one axes each.

        Args:
            names: Variables.
            batch: The column or columns to draw; all by default.

        Raises:
            MissingExtra: matplotlib is not installed.
            UnknownVariable: Nobody wrote it.
        """
        from bam_train.loop.plotting import plot

        return plot(self, *names, batch=batch)

    def to_dataframe(self, *names: str) -> pd.DataFrame:
        """A pandas table of these variables (all without a name): one row for each time and batch column.

        Raises:
            MissingExtra: pandas is not installed.
            UnknownVariable: Nobody wrote it.
        """
        from bam_train.loop.plotting import to_dataframe

        return to_dataframe(self, *names)

    # -- inside ----------------------------------------------------------------------------------------------------

    def _set_first(self, name: str, t: int, value: Any) -> None:
        """Make a variable with its first value; without leaving anything behind if that fails."""
        self.variables[name] = self._new(name, value, f"t={t}")
        try:
            self.variables[name].set(t, value)
        except BaseException:
            del self.variables[name]
            raise

    def _variable(self, name: str) -> Variable:
        try:
            return self.variables[name]
        except KeyError:
            raise UnknownVariable(name, self.variables) from None

    def _new(self, name: str, value: Any, where: str) -> Variable:
        """An empty variable for values of this kind."""
        storage: type[NumpyVariable] | type[TensorVariable]
        if isinstance(value, np.ndarray):
            storage = NumpyVariable
        elif sys.modules.get("torch") is not None and isinstance(value, sys.modules["torch"].Tensor):
            from bam_train.loop.tensors.arrays import TensorVariable

            storage = TensorVariable
        elif isinstance(value, np.generic):
            raise no_batch(name, where)
        else:
            raise kind_mismatch(name, where, "a torch.Tensor or a numpy.ndarray", value)
        # Only with a window: in a cycle with its variables a workspace is freed late, by the garbage collector.
        make_room = no_window if self.window is None else self._make_room
        return storage(name, self.first_time, self._limit, make_room)

    def _of(self, arrays: Mapping[str, Any]) -> Workspace:
        """A new workspace of full arrays."""
        workspace = Workspace()
        for name, array in arrays.items():
            workspace.set_full(name, array)
        return workspace

    def _chosen(self, names: Sequence[str] | None) -> list[str]:
        if names is None:
            return list(self.variables)
        for name in names:
            self._variable(name)
        return list(names)

    def _has_tensors(self) -> bool:
        return not all(isinstance(one, NumpyVariable) for one in self.variables.values())

    def _window(self, times: int, columns: int, n_columns: int, n_times: int) -> Workspace:
        """One random window, drawn as BBRL draws it."""
        window = self
        if n_times < times:
            start = int(np.random.randint(times - n_times))
            window = self.subtime(start, start + n_times)
        if n_columns >= columns:
            return window
        if self._has_tensors():
            import torch

            return window.select_batch(torch.randperm(columns)[:n_columns])
        return window.select_batch(np.random.permutation(columns)[:n_columns])

    def _pairs(self, name: str, inside: Any) -> Any:
        """Neighbouring times of one variable, 2 x N x ...; those where `inside` (T - 1, B) is true, or all."""
        one = self.variables[name]
        array = one.view()
        if inside is None:
            shape = (-1, *array.shape[2:]) if array.shape[0] > 1 else (0, *array.shape[2:])
            return one.stack([array[:-1].reshape(shape), array[1:].reshape(shape)])
        chosen = one.index(inside, array)
        return one.stack([array[:-1][chosen], array[1:][chosen]])

    @staticmethod
    def _common(what: str, sizes: Mapping[str, int]) -> int | None:
        """The one size that all have.

        Raises:
            WorkspaceError: Two differ; names them.
        """
        first: tuple[str, int] | None = None
        for name, size in sizes.items():
            if first is None:
                first = (name, size)
            elif size != first[1]:
                raise WorkspaceError(
                    f"The variables have different {what} sizes: {first[0]!r} has {first[1]}, {name!r} has {size}."
                )
        return None if first is None else first[1]

    def _make_room(self, t: int) -> None:
        """Forget so much that time t fits; what is forgotten goes to the sink."""
        first = t - (self.window or 0) + 1
        self._take_out(first)
        for one in self.variables.values():
            one.drop(first)
        self._deliver()

    def _deliver(self) -> None:
        """Give the sink what is waiting for it; each piece once, also if the sink fails."""
        while self._outbox and self._sink is not None:
            self._sink(*self._outbox.popleft())

    def _take_out(self, stop: int) -> None:
        """Keep the times before `stop` for the sink, and count them as forgotten."""
        first, self.first_time = self.first_time, stop
        if self._sink is None:
            return
        piece = {
            name: one.copied(one.truncated(first, min(stop, one.stop)))  # of a tensor it would be a view
            for name, one in self.variables.items()
            if one.stop > first
        }
        self._outbox.append((first, piece))


def _no_time(name: str, t: Any) -> WorkspaceError:
    return WorkspaceError(f"{name!r}: expected a whole number as time, found {t!r}.")


def _as_bool(array: Any) -> Any:
    return array.astype(bool) if isinstance(array, np.ndarray) else array.bool()
