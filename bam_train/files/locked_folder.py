"""Folders that one process uses at a time."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from bam_train.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows: nothing keeps two calls from the same folder
    fcntl = None  # type: ignore[assignment]

LOCKS = fcntl is not None
"""Whether a folder can be locked."""


@contextlib.contextmanager
def locked(folder: Path, wait: bool = False) -> Iterator[int | None]:
    """Within the ``with`` block no other call has the lock of the folder; yields its descriptor.

    Children that get the descriptor hold the lock as long as one of them lives.

    Raises:
        OutputError: Another process has it, unless `wait`.
    """
    if fcntl is None:
        yield None
        return
    lock = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            text = "another program trains its seeds, or its runs are being saved. Wait for its end"
            raise OutputError(f"{folder}: {text}", kind="FolderInUse") from error
        yield lock
    finally:
        os.close(lock)
