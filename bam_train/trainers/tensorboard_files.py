"""TensorBoard's event files; a full disk loses some of them, but does not end a run."""

import contextlib
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class TensorBoardFiles:
    """Writes numbers into a folder until writing fails."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(folder))
        self._hook = threading.excepthook
        threading.excepthook = self._thread_failed

    def write(self, numbers: Mapping[str, Any], step: int) -> None:
        """Write numbers at a step."""
        try:
            if self._writer is not None:
                for name, value in numbers.items():
                    self._writer.add_scalar(name, value, step)
                self._writer.flush()
        except OSError:
            self.close()

    def close(self) -> None:
        """Close the files."""
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.suppress(OSError):
                writer.close()
            threading.excepthook = self._hook

    def _thread_failed(self, failed: threading.ExceptHookArgs) -> None:
        """Hide the errors of TensorBoard's thread, which `write` gets too, from standard error."""
        if not (isinstance(failed.exc_value, OSError) and type(failed.thread).__module__.startswith("tensorboard.")):
            self._hook(failed)
