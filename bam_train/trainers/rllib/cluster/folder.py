"""The folder of a Ray of a run's own: gone when the run ends, or else when the next one begins.

A process that is killed takes nothing away. A file in the folder is locked for as long as its process lives, so the
next run knows which folders are nobody's, whichever number their process had.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: folders that were left stay
    fcntl = None  # type: ignore[assignment]

_PREFIX, _LOCK, _NEW = "bam-ray-", "in-use", "new"


@contextlib.contextmanager
def own_folder(root: str | None = None) -> Iterator[Path]:
    """A new folder, within; those that runs left which were killed are taken away first.

    Args:
        root: Folder to make it in, with a short name, as Ray's sockets in it need; None for the usual one.
    """
    root = root or ("/tmp" if os.path.isdir("/tmp") else tempfile.gettempdir())
    _take_away_left(Path(root))
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=root))
    lock = os.open(folder / _NEW, os.O_CREAT | os.O_RDWR, 0o600)
    try:
        if _locked(lock):
            os.rename(folder / _NEW, folder / _LOCK)  # under this name others try it, and it is locked by now
        yield folder
    finally:
        os.close(lock)
        shutil.rmtree(folder, ignore_errors=True)


def _take_away_left(root: Path) -> None:
    for path in root.glob(f"{_PREFIX}*/{_LOCK}"):
        with contextlib.suppress(OSError):  # somebody else's
            lock = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if _locked(lock):
                    shutil.rmtree(path.parent, ignore_errors=True)
            finally:
                os.close(lock)


def _locked(lock: int) -> bool:
    """Whether the file could be locked: nobody has it."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
