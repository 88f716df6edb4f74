"""Temporary files that become checkpoints: locked while somebody writes them, so that those of the dead can be told.

A process that is killed cannot remove its file, but the system releases its lock. A process number in the name would
not do: computers and containers that share a folder number their processes alike.
"""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: files that were left stay
    fcntl = None  # type: ignore[assignment]


@contextlib.contextmanager
def temporary_file(target: Path) -> Iterator[Path]:
    """A private file beside `target`, to be written and then moved; what is still there at the end is removed.

    Raises:
        OSError: It cannot be made there.
    """
    descriptor, path = _locked(target)
    try:
        yield path
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        if fcntl is not None:
            os.close(descriptor)


def _locked(target: Path) -> tuple[int, Path]:
    while True:
        descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".tmp")
        if fcntl is None:
            os.close(descriptor)
            return -1, Path(name)
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:
            return descriptor, Path(name)
        os.close(descriptor)  # `remove_orphans` came between


def remove_orphans(target: Path) -> None:
    """Remove temporary files of `target`, and of name-2, name-3, … beside it, whose writers are dead; never fails."""
    ours = re.compile(rf"\.{re.escape(target.stem)}(-\d+)?{re.escape(target.suffix)}\.\w{{8}}\.tmp")
    with contextlib.suppress(OSError):
        for path in target.parent.iterdir():
            if ours.fullmatch(path.name):
                _remove_if_unlocked(path)


def _remove_if_unlocked(path: Path) -> None:
    if fcntl is None:
        return
    with contextlib.suppress(OSError), path.open("rb+") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # BlockingIOError: somebody writes it
        path.unlink()
