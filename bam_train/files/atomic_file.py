"""Files that are complete or absent, such as checkpoints and videos: written to a temporary file, then renamed; locks.

The temporary file is locked while a process writes it: a process that is killed cannot remove its file, but the system
releases its lock. A process id in the name would not be unique: computers and containers that share a folder use the
same ids. Locks end with their process; on Windows there are none.
"""

import contextlib
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from bam_train.errors import OutputError

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]

LOCKS = fcntl is not None
"""Whether the system has locks."""
REPLACED: list[Callable[[Path], None]] = []
"""Called with each file that `replacing` has replaced."""


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


def require_writable(path: Path) -> Path:
    """Check, before any work is done, that `replacing` can write to `path`; returns it with ``~`` expanded.

    Raises:
        OutputError: It is a folder, or nothing may be written where it would be.
    """
    path = path.expanduser()
    folder = next((one for one in path.absolute().parents if one.exists()), path)
    why = "it is a folder" if path.is_dir() else f"{folder} is a file" if not folder.is_dir() else ""
    if why or not os.access(folder, os.W_OK):
        raise OutputError(f"{path}: cannot be written: {why or 'no permission'}; choose another file")
    return path


@contextlib.contextmanager
def replacing(target: Path, suffix: str = ".tmp") -> Iterator[Path]:
    """Yield a temporary file beside `target`; it replaces `target` in one step at the end, or is removed on error.

    Missing folders are made.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor, path = _locked(target, suffix)
    try:
        yield path
        if LOCKS:
            os.fsync(descriptor)
        mask = os.umask(0o022)
        os.umask(mask)
        path.chmod(0o666 & ~mask)
        os.replace(path, target)
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        if LOCKS:
            os.close(descriptor)
    with contextlib.suppress(OSError):  # make the rename itself durable, where the system can
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    for tell in REPLACED:
        tell(target)


def _locked(target: Path, suffix: str) -> tuple[int, Path]:
    while True:
        descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=suffix)
        if not LOCKS:  # Windows, which renames no open file
            os.close(descriptor)
            return -1, Path(name)
        with contextlib.suppress(OSError):  # a file system without locks
            lock(descriptor)
        if os.fstat(descriptor).st_nlink:
            return descriptor, Path(name)
        os.close(descriptor)  # removed by `remove_orphans` before it was locked


def remove_orphans(target: Path) -> None:
    """Remove temporary files of `target`, and of name-2, name-3, … beside it, whose writers are dead; never fails."""
    pattern = re.compile(rf"\.{re.escape(target.stem)}(-\d+)?{re.escape(target.suffix)}\.\w{{8}}\.tmp")
    with contextlib.suppress(OSError):
        for path in target.parent.iterdir() if LOCKS else ():
            if pattern.fullmatch(path.name):
                with contextlib.suppress(OSError), path.open("rb+") as file:
                    lock(file, wait=False)  # BlockingIOError: a process still writes it
                    path.unlink()
