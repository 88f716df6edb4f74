"""The files of the web console, as pages of a `Site`: plain HTML, CSS and modules, without build and internet."""

from collections.abc import Mapping
from pathlib import Path

from bam_envs.rosbridge.server import Page, read_pages


def console_pages() -> Mapping[str, Page]:
    """The pages by their path; ``/`` is the console."""
    return read_pages(Path(__file__).parents[1] / "console")
