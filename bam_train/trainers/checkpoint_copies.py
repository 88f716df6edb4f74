"""Copies of a run's checkpoint at an fsspec address, such as a bucket: what is left of a computer that goes away."""

from __future__ import annotations

import importlib
import posixpath
from pathlib import Path
from typing import Any

from bam_train.errors import OutputError


class Copies:
    """Where checkpoints are copied to.

    Args:
        url: An fsspec address, such as ``s3://bucket/runs/`` or ``file:///mnt/share/pick.zip``. One that ends in
            ``.zip`` is the copy's own; any other is a folder.

    Raises:
        OutputError: It is no address, there is no such kind of address, or a package that it needs is missing.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        if "://" not in url:
            raise OutputError(f"{url}: --copy-to expects an address, such as s3://bucket/runs/, or a file's: file:///…")
        try:
            fsspec: Any = importlib.import_module("fsspec.core")
        except ModuleNotFoundError as error:
            raise OutputError("--copy-to needs fsspec, which is not installed. Run: pip install fsspec") from error
        try:
            self._files, self._path = fsspec.url_to_fs(url)
        except (ImportError, ValueError) as error:  # a package that is missing, a protocol that is not known
            raise OutputError(f"{url}: cannot be copied to: {_line(error)}") from error

    def copy(self, checkpoint: Path) -> None:
        """Copy a checkpoint there, over an earlier copy.

        Raises:
            OutputError: It could not be copied.
        """
        target = self._path if self._path.endswith(".zip") else posixpath.join(self._path, checkpoint.name)
        try:
            self._put(str(checkpoint), target)
        except Exception as error:  # every kind of storage has errors of its own
            raise OutputError(
                f"{self.url}: {checkpoint} could not be copied there: {type(error).__name__}: {_line(error)}"
            ) from error

    def _put(self, source: str, target: str) -> None:
        """Buckets show a file when all of it is there; a folder shows it from its first byte on."""
        if "file" not in self._files.protocol:
            self._files.put_file(source, target)
            return
        self._files.makedirs(posixpath.dirname(target), exist_ok=True)
        self._files.put_file(source, f"{target}.tmp")
        self._files.mv(f"{target}.tmp", target)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
