"""The files of the web console, as pages of a `Site`: plain HTML, CSS and modules, and uPlot for the charts."""

from collections.abc import Mapping
from pathlib import Path

from bam_envs.rosbridge.server import Page, read_pages

FOLDER = Path(__file__).parents[1] / "console"
LIBRARY = FOLDER / "uplot"
"""Where the installation puts uPlot (``hatch_build.py``); the console works without it, but for its charts."""


def console_pages() -> Mapping[str, Page]:
    """The pages by their path; ``/`` is the console."""
    return {**read_pages(FOLDER), **(read_pages(LIBRARY) if LIBRARY.is_dir() else {})}
