"""Figures of matplotlib, which is imported on use: made, and written whole."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bam_envs.core.errors import MissingExtra
from bam_train.errors import OutputError, SettingsError
from bam_train.files.atomic_file import replacing, require_writable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".jpg", ".svg", ".pdf")


def require_picture_path(path: Path) -> Path:
    """Check, before any work is done, that `save_figure` can write to the path; returns it with ``~`` expanded.

    Raises:
        SettingsError: Its suffix is none of `SUFFIXES`.
        OutputError: It is a folder, or nothing may be written where it would be.
    """
    if path.suffix.lower() not in (*SUFFIXES, ""):
        raise SettingsError(f"{path}: expected a picture that ends in {', '.join(SUFFIXES)}, found {path.suffix!r}")
    return require_writable(path)


def new_figure(purpose: str, width: float, height: float) -> Figure:
    """A figure of this size [inches], which does not belong to pyplot; raises MissingExtra without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("matplotlib", "notebook", purpose) from error
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path) -> None:
    """Write the figure, as the suffix of `path` says, PNG without one; raises OutputError if it cannot be written."""
    try:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=100, format=path.suffix[1:].lower() or "png")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
