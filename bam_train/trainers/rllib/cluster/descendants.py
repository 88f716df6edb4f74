"""The processes that Ray starts for a run, and their end."""

from __future__ import annotations

import contextlib
import importlib
from typing import Any

import ray  # noqa: F401 - has psutil in a folder of its own

psutil: Any = importlib.import_module("psutil")

GRACE = 3.0
"""How long a process may take to end by itself once Ray has shut down [s]."""


class Descendants:
    """What this process starts from here on, and what that starts: none of it outlives `end`.

    psutil knows a process by its number and the time at which it was started.
    """

    def __init__(self) -> None:
        self._before = set(self._children())
        self._watched: set[Any] = set()

    def watch(self) -> None:
        """Note who is there now: once their parent is gone, they can no longer be told."""
        for child in set(self._children()) - self._before:
            self._watched.add(child)
            with contextlib.suppress(psutil.Error):
                self._watched.update(child.children(recursive=True))

    def end(self) -> None:
        """Wait until all of them are gone; the ones that do not go are killed."""
        _, alive = psutil.wait_procs(list(self._watched), timeout=GRACE)
        for process in alive:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(alive, timeout=GRACE)

    def kill(self) -> None:
        """End all of them here and now, and wait for none."""
        self.watch()
        for process in self._watched:
            with contextlib.suppress(psutil.Error):
                process.kill()

    def _children(self) -> list[Any]:
        children: list[Any] = psutil.Process().children()
        return children
