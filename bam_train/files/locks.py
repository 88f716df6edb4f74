"""Locks of files and folders between processes, which end with their process; on Windows there are none."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from bam_train.errors import OutputError

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]

LOCKS = fcntl is not None
"""Whether the system has locks."""


def lock(file: int | IO[bytes] | IO[str], *, wait: bool = True) -> None:
    """Lock an open file or folder; without locks it does nothing.

    Raises:
        BlockingIOError: Another process has it, unless `wait`.
        OSError: The file system has no locks.
    """
    if fcntl is not None:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


@contextlib.contextmanager
def locked(folder: Path, wait: bool = False) -> Iterator[int | None]:
    """Within the ``with`` block no other call has the lock of the folder; yields its descriptor.

    Children that get the descriptor hold the lock as long as one of them lives.

    Raises:
        OutputError: Another process has it, unless `wait`.
    """
    if not LOCKS:
        yield None
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            lock(descriptor, wait=wait)
        except BlockingIOError as error:
            text = "another program trains its seeds, or its runs are being saved. Wait for its end"
            raise OutputError(f"{folder}: {text}", kind="FolderInUse") from error
        yield descriptor
    finally:
        os.close(descriptor)
