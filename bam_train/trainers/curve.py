"""The learning curve of a run as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bam_train.errors import OutputError


def draw_curve(records: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """Draw return (and success, if the environment knows it) over steps into a PNG.

    Args:
        records: Those of ``progress.jsonl``; "training" ones make thin lines, "evaluation" ones dots.
        title: Heading.
        path: The picture.

    Raises:
        OutputError: It cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = ["return_mean"]
    if any(record.get("success_rate") is not None for record in records):
        names.append("success_rate")
    figure = Figure(figsize=(8, 2.6 * len(names) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(plots, names, strict=True):
        _draw(axes, records, name)
    plots[0].set_title(title)
    if plots[0].get_legend_handles_labels()[0]:
        plots[0].legend(loc="lower right")
    plots[-1].set_xlabel("steps")
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _draw(axes: Any, records: Sequence[dict[str, Any]], name: str) -> None:
    for kind, style in (("training", {"linewidth": 1, "alpha": 0.7}), ("evaluation", {"marker": "o", "markersize": 4})):
        rows = [(row["steps"], row[name]) for row in records if row["kind"] == kind and row.get(name) is not None]
        if rows:
            axes.plot(*zip(*rows, strict=True), label=kind, **style)
    axes.set_ylabel({"return_mean": "mean return", "success_rate": "success rate"}[name])
    if name == "success_rate":
        axes.set_ylim(-0.03, 1.03)
    axes.grid(alpha=0.3)
