"""The workspace: named variables over time, which agents read and write.

One class and longer than other modules: BBRL's programs call all of its methods on one object.
A variable is T x B x ...: time first, batch second; at one time it is B x .... Values are torch tensors, which are kept
as they are, with their graph, or NumPy arrays, which are copied.

It is BBRL's `Workspace`, with these differences:

- BBRL's assertions are exceptions that name the variable, the expected and the found value; a first write that fails
  does not make the variable.
- A full read is cached until the next write, see `bam_train.loop.workspace.variables`.
- `to`, `cat_batch` and `sample_subworkspace` with more than one window work; `copy_n_last_steps` copies only the
  variables that it was given, and once.
- A workspace with a window passes old times to a sink and forgets them: its memory is bounded in a loop of any length.
  Workspaces made from it (`contiguous`, `select_batch`, `to`, a copy) hold the times kept, and start at time 0.

The file is longer than most, so that BBRL's users find every member in one class.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, KeysView, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_train.errors import LoopError
from bam_train.loop.workspace.variables import Variable, kind_mismatch, no_batch, unknown_variable

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Sink = Callable[[int, dict[str, Any]], None]
"""Called with the first time of a piece and the piece's variables, T x B x ... each."""

_LEAST_PIECE = 64
"""The minimum number of times that leave a window together: moving them one by one would be slow."""


class Workspace:
    """Named variables over time. Methods raise `LoopError` for the name of a variable that was not written.

    Args:
        workspace: A workspace to copy, without sharing memory.
        window: The number of times to keep at least, before older ones are forgotten; None keeps all.
        sink: Called with the times that leave the window, in order: ``sink(first_time, {name: array (n, B, ...)})``. A
            variable not written at these times is shorter or absent. The call blocks the write that needs room.

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
            raise LoopError(f"window: expected at least 2 times (the last and the one before), found {window}.")
        if sink is not None and not callable(sink):
            raise LoopError(f"sink: expected sink(first_time, values), found {type(sink).__name__}.")
        self.variables: dict[str, Variable] = {}
        self.first_time = 0
        self.window, self._sink = window, sink
        if workspace is not None:
            for name, variable in workspace.variables.items():
                self.set_full(name, variable.copied(variable.full()))

    # -- one variable ----------------------------------------------------------------------------------------------

    def set(self, name: str, t: int, value: Any) -> None:
        """Write `value` (B x ...) at time t; -1 is the last.

        The first write makes the variable. Missing earlier times become zeros. Times may be written in any order.

        Raises:
            LoopError: Another shape, dtype, device or kind of array than the variable has.
            LoopError: t has left the window, or is negative beyond the first.
        """
        variable = self.variables.get(name)
        is_first = variable is None
        if variable is None:
            variable = self.variables[name] = self._new(name, value, f"t={t}")
        try:
            if self.window is not None and t - self.first_time >= self.window + max(self.window, _LEAST_PIECE):
                self._forget(t - self.window + 1)
            variable.set(t, value)
        except BaseException as error:
            if is_first:
                self.variables.pop(name, None)
            if isinstance(error, (TypeError, IndexError)):
                raise _no_time(name, t) from None
            raise

    def get(self, name: str, t: int) -> Any:
        """The value at time t, B x ...; -1 is the last.

        Raises:
            LoopError: It was not written at t, or t has left the window.
        """
        try:
            variable = self.variables[name]
        except KeyError:
            raise unknown_variable(name, self.variables) from None
        try:
            return variable.get(t)
        except (TypeError, IndexError):
            raise _no_time(name, t) from None

    def set_full(self, name: str, value: Any) -> None:
        """Write all times at once, T x B x ....

        In a variable that was written time by time, it overwrites times 0 to T - 1 and leaves later ones.

        Raises:
            LoopError: Not an array, or it differs from the times already written.
            LoopError: Earlier times have left the window.
        """
        if self.first_time:
            raise LoopError(
                f"{name!r}: all times cannot be written, those before {self.first_time} have left the window."
            )
        variable = self.variables.get(name) or self._new(name, value, "all times")
        variable.set_full(value)
        self.variables[name] = variable

    def get_full(self, name: str) -> Any:
        """All times kept, T x B x ...."""
        return self._variable(name).full()

    def get_time_truncated(self, name: str, from_time: int, to_time: int) -> Any:
        """Times [from_time, to_time) of one variable, ``0 <= from_time < to_time``, clipped to those written."""
        variable = self._variable(name)
        self._require_times(name, from_time, to_time)
        return variable.truncated(from_time, to_time)

    def remove_variable(self, name: str) -> None:
        """Forget one variable; it may be written again with another shape."""
        self._variable(name)
        del self.variables[name]

    def clear(self, name: str | None = None) -> None:
        """Forget one variable, or all. The times in the window do not go to the sink: see `flush`."""
        if name is not None:
            self.remove_variable(name)
            return
        self.variables.clear()
        self.first_time = 0

    def keys(self) -> KeysView[str]:
        """Names in the order of their first write."""
        return self.variables.keys()

    def __getitem__(self, key: str | Iterable[str]) -> Any:
        """`get_full` of one name; for several names, a generator over their values, in that order."""
        if isinstance(key, str):
            return self.get_full(key)
        return (self.get_full(name) for name in key)

    def __contains__(self, name: object) -> bool:
        return name in self.variables

    def __iter__(self) -> Iterator[str]:
        return iter(self.variables)

    # -- sizes -----------------------------------------------------------------------------------------------------

    def time_size(self) -> int | None:
        """One after the last time written; None if empty. Raises `LoopError` if the variables differ."""
        return _common("time", {name: one.time_size() for name, one in self.variables.items()})

    def batch_size(self) -> int | None:
        """B; None if empty. Raises `LoopError` if the variables differ."""
        return _common("batch", {name: one.batch_size() for name, one in self.variables.items()})

    def __str__(self) -> str:
        lines = (
            f"\t{name}: time_size = {one.time_size()}, batch_size = {one.batch_size()}"
            for name, one in self.variables.items()
        )
        return "\n".join(["Workspace:", *lines])

    # -- time ------------------------------------------------------------------------------------------------------

    def copy_time(self, from_time: int, to_time: int, n_steps: int, var_names: Sequence[str] | None = None) -> None:
        """Copy times [from_time, from_time + n_steps) to [to_time, to_time + n_steps), of some or all variables."""
        for one in self._chosen(var_names).values():
            one.copy_time(from_time, to_time, n_steps)

    def copy_n_last_steps(self, n: int, var_names: Sequence[str] | None = None) -> None:
        """Copy the last n times to the first n; the length, which must be the same for all, does not change."""
        size = _common("time", {name: one.time_size() for name, one in self._chosen(var_names).items()})
        if size is None:
            return
        if not 0 <= n <= size:
            raise LoopError(f"copy_n_last_steps: expected at most {size} steps, found {n}.")
        self.copy_time(size - n, 0, n, var_names)

    def subtime(self, from_t: int, to_t: int) -> Workspace:
        """A new workspace of times [from_t, to_t), by Python's slice rules; all variables must have one length."""
        begin, end, _ = slice(from_t, to_t).indices(self.time_size() or 0)
        for name in self.variables if begin < end else ():
            self._require_times(name, begin, end)
        return _of({name: one.truncated(begin, max(begin, end)) for name, one in self.variables.items()})

    def get_time_truncated_workspace(self, from_time: int, to_time: int) -> Workspace:
        """A new workspace of times [from_time, to_time); lengths may differ."""
        return _of({name: self.get_time_truncated(name, from_time, to_time) for name in self.variables})

    # -- batch -----------------------------------------------------------------------------------------------------

    def select_batch(self, batch_indexes: Any) -> Workspace:
        """A new workspace of these batch columns: integers, in any order and repeated, or a boolean mask (B,)."""
        self.batch_size()
        views = {name: (one, one.view()) for name, one in self.variables.items()}
        return _of({name: array[:, one.index(batch_indexes, array)] for name, (one, array) in views.items()})

    def select_batch_n(self, n: int) -> Workspace:
        """A new workspace of n batch columns, drawn uniformly with replacement."""
        size = self.batch_size()
        if not size:
            raise LoopError(f"select_batch_n: {n} columns are wanted, and there are none.")
        torch = self._torch()
        return self.select_batch(torch.randint(size, (n,)) if torch else np.random.randint(size, size=n))

    def select_subtime(self, t: Any, window_size: int) -> Workspace:
        """A new workspace whose column b has the times t[b] to t[b] + window_size - 1; `t` is (B,), int."""
        result = {}
        for name, one in self.variables.items():
            array = one.view()
            start = one.index(t, array) - self.first_time
            if len(start) and not 0 <= int(start.min()) <= int(start.max()) <= len(array) - window_size:
                raise LoopError(
                    f"{name!r}: windows of {window_size} from t={int(start.min()) + self.first_time} to "
                    f"{int(start.max()) + self.first_time} are wanted; {one.kept_times()}."
                )
            columns = one.index(range(one.batch_size()), array)
            result[name] = one.library.stack([array[start + k, columns] for k in range(window_size)])
        return _of(result)

    def sample_subworkspace(self, n_times: int, n_batch_elements: int, n_timesteps: int) -> Workspace:
        """A new workspace of `n_times` random windows, side by side over the batch.

        Each has `n_timesteps` times and `n_batch_elements` columns, drawn without replacement, or all columns if there
        are fewer.
        """
        times = self.time_size() or 0
        if n_timesteps > times or n_times < 1:
            raise LoopError(
                f"sample_subworkspace: expected one or more windows of at most {times} times, "
                f"found {n_times} of {n_timesteps}."
            )
        columns, torch, pieces = self.batch_size() or 0, self._torch(), []
        for _ in range(n_times):
            window = self
            if n_timesteps < times:
                start = int(np.random.randint(times - n_timesteps))  # as BBRL, which never draws the last window
                window = self.subtime(start, start + n_timesteps)
            if n_batch_elements < columns:
                drawn = torch.randperm(columns) if torch else np.random.permutation(columns)
                window = window.select_batch(drawn[:n_batch_elements])
            pieces.append(window)
        return pieces[0] if n_times == 1 else Workspace.cat_batch(pieces)

    @staticmethod
    def cat_batch(workspaces: Sequence[Workspace]) -> Workspace:
        """A new workspace of several, side by side over the batch; all must have one length."""
        if not workspaces:
            raise LoopError("cat_batch: expected one workspace or more, found none.")
        times = workspaces[0].time_size()
        for other in workspaces[1:]:
            if other.time_size() != times:
                raise LoopError(f"cat_batch: expected workspaces of {times} times, found one of {other.time_size()}.")
        variables = workspaces[0].variables.items()
        return _of(
            {name: one.library.concatenate([ws.get_full(name) for ws in workspaces], 1) for name, one in variables}
        )

    # -- transitions -----------------------------------------------------------------------------------------------

    def get_transitions(self, no_final_state: bool = False, filter_key: str = "env/done") -> Workspace:
        """A new workspace of pairs of neighbouring times, 2 x N x ..., time-major, then over the batch.

        A pair whose first step has `filter_key` true joins the last state of an episode and the first of the next. Such
        pairs are left out, unless `no_final_state` is true, which needs no `filter_key`.
        """
        inside = None
        if not no_final_state:
            if filter_key not in self.variables:
                raise unknown_variable(filter_key, self.variables, "filter_key")
            done = self.variables[filter_key]
            for name, one in self.variables.items():
                if one.time_size() != done.time_size():
                    raise LoopError(
                        f"{name!r} has {one.time_size()} times and {filter_key!r} has {done.time_size()}; "
                        f"get_transitions needs all to be alike."
                    )
            inside = done.view()[:-1] == 0
        return _of({name: _pairs(one, inside) for name, one in self.variables.items()})

    # -- the whole -------------------------------------------------------------------------------------------------

    def zero_grad(self) -> None:
        """Cut every value off its graph; the values stay."""
        for one in self.variables.values():
            one.detach()

    def contiguous(self) -> Workspace:
        """A new workspace whose variables are one array each."""
        return _of({name: one.full() for name, one in self.variables.items()})

    def to(self, device: Any) -> Workspace:
        """A new workspace on `device`; tensors that are there already are shared."""
        return _of({name: one.on_device(one.full(), device) for name, one in self.variables.items()})

    def flush(self) -> None:
        """Pass all remaining times to the sink, forget them, and start again at time 0."""
        stop = max((one.time_size() for one in self.variables.values()), default=0)
        try:
            if stop > self.first_time:
                self._forget(stop)
        finally:
            self.clear()

    # -- pictures --------------------------------------------------------------------------------------------------

    def plot(self, *names: str, batch: int | Sequence[int] | None = None) -> Figure:
        """A matplotlib figure of these variables over time, see `bam_train.loop.workspace.plotting.plot`."""
        from bam_train.loop.workspace.plotting import plot

        return plot(self, *names, batch=batch)

    def to_dataframe(self, *names: str) -> pd.DataFrame:
        """A pandas table of these variables, see `bam_train.loop.workspace.plotting.to_dataframe`."""
        from bam_train.loop.workspace.plotting import to_dataframe

        return to_dataframe(self, *names)

    # -- inside ----------------------------------------------------------------------------------------------------

    def _variable(self, name: str) -> Variable:
        try:
            return self.variables[name]
        except KeyError:
            raise unknown_variable(name, self.variables) from None

    def _new(self, name: str, value: Any, where: str) -> Variable:
        """An empty variable for values of this kind."""
        if isinstance(value, np.ndarray):
            kind: type[Variable] = Variable
        elif sys.modules.get("torch") is not None and isinstance(value, sys.modules["torch"].Tensor):
            from bam_train.loop.workspace.tensor_variable import TensorVariable

            kind = TensorVariable
        elif isinstance(value, np.generic):
            raise no_batch(name, where)
        else:
            raise kind_mismatch(name, where, "a torch.Tensor or a numpy.ndarray", value)
        return kind(name, self.first_time)

    def _chosen(self, names: Sequence[str] | None) -> dict[str, Variable]:
        return {name: self._variable(name) for name in (self.variables if names is None else names)}

    def _torch(self) -> Any:
        """The module torch, whose random numbers are used, if there are tensors; else None."""
        return None if all(one.ARRAY is np.ndarray for one in self.variables.values()) else sys.modules["torch"]

    def _require_times(self, name: str, begin: int, end: int) -> None:
        """Refuse a range of times that is empty, negative, or has left the window."""
        if not 0 <= begin < end:
            raise LoopError(f"{name!r}: expected times with 0 <= from < to, found from {begin} to {end}.")
        if begin < self.first_time:
            raise LoopError(f"{name!r} has lost t={begin}: times before {self.first_time} have left the window.")

    def _forget(self, stop: int) -> None:
        """Forget the times before `stop`, and pass them to the sink."""
        first, self.first_time = self.first_time, stop
        piece = {
            name: one.copied(one.truncated(first, min(stop, one.time_size())))  # of an array it would be a view
            for name, one in self.variables.items()
            if one.time_size() > first and self._sink is not None
        }
        for one in self.variables.values():
            one.drop(stop)
        if self._sink is not None:
            self._sink(first, piece)  # last, so that a piece is passed once even if this fails


def _of(arrays: Mapping[str, Any]) -> Workspace:
    """A new workspace of arrays T x B x ...."""
    workspace = Workspace()
    for name, array in arrays.items():
        workspace.set_full(name, array)
    return workspace


def _pairs(one: Variable, inside: Any) -> Any:
    """Pairs of neighbouring times of a variable, 2 x N x ...: those where `inside` (T - 1, B) is true, or all."""
    array = one.view()
    if inside is not None:
        chosen = one.index(inside, array)
        return one.library.stack((array[:-1][chosen], array[1:][chosen]))
    shape = (-1 if len(array) > 1 else 0, *array.shape[2:])
    return one.library.stack((array[:-1].reshape(shape), array[1:].reshape(shape)))


def _common(what: str, sizes: Mapping[str, int]) -> int | None:
    """The size that all variables have; None if there are no variables."""
    (first, common), *others = sizes.items() or [("", None)]
    for name, size in others:
        if size != common:
            raise LoopError(f"The variables have different {what} sizes: {first!r} has {common}, {name!r} has {size}.")
    return common


def _no_time(name: str, t: Any) -> LoopError:
    return LoopError(f"{name!r}: expected a whole number as time, found {t!r}.")
