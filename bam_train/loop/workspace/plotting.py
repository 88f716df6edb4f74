"""Workspaces as figures (matplotlib) and as tables (pandas); both libraries are imported on use."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from bam_envs.core.errors import MissingExtra
from bam_train.errors import LoopError
from bam_train.files.pictures import new_figure
from bam_train.loop.workspace.variables import to_array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame


class Recorded(Protocol):
    """What is drawn of a `Workspace`."""

    first_time: int

    def keys(self) -> Iterable[str]:
        """The names of the variables."""

    def get_full(self, name: str) -> Any:
        """A variable. Shape: (T, B, ...)."""


MAX_LINES = 10
"""Maximum lines in one plot, the number of matplotlib's colours."""
MAX_VALUE_AXES = 2
"""A value with more axes than this is an image."""


def plot(workspace: Recorded, *names: str, batch: int | Sequence[int] | None = None) -> Figure:
    """Draw variables over time: one plot below the other, with one line for each batch column and component.

    Floats are drawn as lines, bool and integers as steps. A plot has at most 10 lines; its title then gives the total.
    A notebook shows the figure, which does not belong to pyplot, as the last value of a cell.

    Args:
        workspace: The workspace to draw.
        *names: The variables, in this order; by default all except images.
        batch: The batch column or columns to draw; None draws all.

    Raises:
        LoopError: There is nothing to draw, a variable holds images, or it lacks one of the batch columns.
        MissingExtra: matplotlib is not installed.
    """
    arrays = _arrays(workspace, names, "plot()")
    figure = new_figure("Workspace.plot()", 8, 0.6 + 1.9 * len(arrays))
    figure._repr_png_ = partial(_png, figure)  # type: ignore[attr-defined]
    rows = figure.subplots(len(arrays), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, array) in zip(rows, arrays.items(), strict=True):
        times = workspace.first_time + np.arange(len(array))
        columns = range(array.shape[1]) if batch is None else [int(column) for column in np.atleast_1d(batch)]
        for column in columns:
            if not 0 <= column < array.shape[1]:
                last = array.shape[1] - 1
                raise LoopError(f"{name!r} has no batch column {column}; it has columns 0 to {last}.")
        _draw(axes, times, name, array, columns)
    rows[-1].set_xlabel("t")
    return figure


def to_dataframe(workspace: Recorded, *names: str) -> DataFrame:
    """Return the variables as a table with one row for each time and batch column, indexed by ``("time", "batch")``.

    A scalar variable is one column with its name, a vector ``name[0]``, ``name[1]``, …, a matrix ``name[0,0]``, ….
    Where a variable is shorter than another, floats are NaN; bool and integers are NA, in pandas' nullable types.
    Names and errors are those of `plot`.
    """
    try:
        import pandas
    except ImportError as error:
        raise MissingExtra("pandas", "notebook", "Workspace.to_dataframe()") from error
    arrays = _arrays(workspace, names, "to_dataframe()")
    first = workspace.first_time
    length, width = (max(array.shape[axis] for array in arrays.values()) for axis in (0, 1))
    rows = pandas.MultiIndex.from_product([range(first, first + length), range(width)], names=["time", "batch"])
    columns = {}
    for name, array in arrays.items():
        written = pandas.MultiIndex.from_product([range(first, first + len(array)), range(array.shape[1])])
        flat = array.reshape(written.size, -1)
        for label, values in zip(_labels(array.shape[2:]), flat.T, strict=True):
            if not written.equals(rows) and values.dtype.kind != "f":
                values = pandas.array(values)  # such as Int64 and boolean, which have NA
            columns[name + label] = pandas.Series(values, index=written).reindex(rows)
    return pandas.DataFrame(columns, index=rows)


def _arrays(workspace: Recorded, names: tuple[str, ...], purpose: str) -> dict[str, np.ndarray]:
    """The named variables, or all, (T, B, ...) each, without images."""
    arrays = {name: to_array(workspace.get_full(name)) for name in names or workspace.keys()}
    arrays = {name: array if array.ndim > 1 else array[:, None] for name, array in arrays.items()}  # without a batch
    images = [name for name, array in arrays.items() if array.ndim > 2 + MAX_VALUE_AXES]
    if names and images:
        shape = arrays[images[0]].shape[2:]
        raise LoopError(
            f"{images[0]!r}: expected numbers, vectors or matrices, found images of shape {shape}; "
            f"leave it out of {purpose}."
        )
    if len(images) == len(arrays):
        raise LoopError(f"{purpose} has nothing to show: the workspace {'has only images' if images else 'is empty'}.")
    return {name: array for name, array in arrays.items() if name not in images}


def _labels(shape: tuple[int, ...]) -> Iterator[str]:
    """``""`` for a scalar; ``[0]``, ``[1]``, … for a vector; ``[0,0]``, … for a matrix, in C order."""
    for index in np.ndindex(shape):
        yield f"[{','.join(map(str, index))}]" if index else ""


def _draw(axes: Axes, times: np.ndarray, name: str, array: np.ndarray, columns: Sequence[int]) -> None:
    labels = list(_labels(array.shape[2:]))
    values = array.reshape(*array.shape[:2], len(labels))
    lines = [(column, component) for column in columns for component in range(len(labels))]
    style = "default" if array.dtype.kind == "f" else "steps-post"
    for column, component in lines[:MAX_LINES]:
        label = f"{column}{labels[component]}" if array.shape[1] > 1 else labels[component]
        marker = "." if len(times) == 1 else ""  # a line through one point cannot be seen
        axes.plot(times, values[:, column, component], drawstyle=style, marker=marker, label=label, linewidth=1)
    if array.dtype == bool:
        axes.set_yticks([0, 1], ["False", "True"])
    elif style != "default":
        axes.locator_params(axis="y", integer=True)
    axes.set_ylabel(name)
    if len(lines) > 1:
        title = "batch" if array.shape[1] > 1 else None
        beside = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "ncols": 1 if len(lines) <= 5 else 2}
        axes.legend(title=title, fontsize="small", title_fontsize="small", **beside)
    if len(lines) > MAX_LINES:
        choose = "; choose with batch=" if len(columns) > 1 else ""
        axes.set_title(f"{name}: the first {MAX_LINES} of {len(lines)} lines{choose}", fontsize="small")


def _png(figure: Figure) -> bytes:
    """The figure as a PNG, for notebooks that have not imported pyplot."""
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()
