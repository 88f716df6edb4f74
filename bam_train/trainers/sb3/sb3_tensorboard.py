"""TensorBoard files that training does not depend on: a full disk ends them, not the run."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter, TensorBoardOutputFormat


class ForgivingTensorBoard(KVWriter):  # type: ignore[misc]
    """Writes event files into a folder until it cannot.

    Args:
        folder: Where they go.
    """

    def __init__(self, folder: Path) -> None:
        self._files: TensorBoardOutputFormat | None = TensorBoardOutputFormat(str(folder))
        self._hook = threading.excepthook
        threading.excepthook = self._thread_failed

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Write values at a step."""
        try:
            if self._files is not None:
                self._files.write(key_values, key_excluded, step)
        except OSError:
            self.close()

    def close(self) -> None:
        """Let go of the files."""
        files, self._files = self._files, None
        if files is None:
            return
        with contextlib.suppress(OSError):
            files.close()
        threading.excepthook = self._hook

    def _thread_failed(self, failed: threading.ExceptHookArgs) -> None:
        """TensorBoard's own thread says on standard error what `write` is told too: leave that out."""
        if not (isinstance(failed.exc_value, OSError) and type(failed.thread).__module__.startswith("tensorboard.")):
            self._hook(failed)
