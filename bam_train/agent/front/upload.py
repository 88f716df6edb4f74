"""One upload on its way into a file of the agent: whole and as announced, or gone."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
from pathlib import Path

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_train.errors import OutputError

_PREFIX, _SUFFIX = "upload-", ".part"
_RESERVE = 128 * 2**20
"""Space that stays free on the disk for recordings and logs [bytes]."""


class Upload:
    """Takes `size` bytes with a digest into a new file in `folder`. Its content is never opened here.

    Raises:
        InvalidValue: The upload is larger than `most` bytes, or than the disk has room for.
        OutputError: The file cannot be written.
    """

    def __init__(self, folder: Path, size: int, sha256: str, most: int) -> None:
        if size > most:
            raise InvalidValue(f"The upload has {_mb(size)}, and {_mb(most)} is the most that this agent takes.")
        self.size, self.received = size, 0
        self._announced, self._digest = sha256, hashlib.sha256()
        with _on_disk(folder):
            folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(folder).free
            if free < size + _RESERVE:
                raise InvalidValue(
                    f"The disk of the robot's computer has {_mb(free)} free, and the upload of {_mb(size)} needs "
                    f"{_mb(size + _RESERVE)}. Make room in {folder}."
                )
            number, name = tempfile.mkstemp(_SUFFIX, _PREFIX, folder)  # readable by this user alone
        self.path, self._file = Path(name), os.fdopen(number, "wb")

    def write(self, data: bytes) -> bool:
        """Add a piece; True if the upload is complete, and is what was announced. Otherwise the file is removed."""
        try:
            if self.received + len(data) > self.size:
                raise ProtocolError(f"The upload is longer than the {self.size} bytes that were announced.")
            with _on_disk(self.path.parent):
                self._file.write(data)
                self.received += len(data)
                self._digest.update(data)
                if self.received < self.size:
                    return False
                self._file.close()
            if (found := self._digest.hexdigest()) != self._announced:
                raise ProtocolError(
                    f"The upload has the SHA-256 {found[:12]}, and {self._announced[:12]} was announced. Push again."
                )
        except BaseException:
            self.remove()
            raise
        return True

    def remove(self) -> None:
        """Close and remove the file, if it is still there. Idempotent."""
        with contextlib.suppress(OSError):
            self._file.close()
        with contextlib.suppress(OSError):
            self.path.unlink()


def remove_leftovers(folder: Path) -> None:
    """Remove the uploads of a process that was killed."""
    for path in folder.glob(f"{_PREFIX}*{_SUFFIX}"):
        with contextlib.suppress(OSError):
            path.unlink()


class _on_disk(contextlib.AbstractContextManager[None]):  # noqa: N801 - reads as a phrase
    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            raise OutputError(f"The upload cannot be written to {self._folder}: {error.strerror or error}.") from error


def _mb(size: int) -> str:
    return f"{size / 1e6:.1f} MB"
