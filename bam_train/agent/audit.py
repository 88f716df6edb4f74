"""The audit file of a live agent: one JSON line for each change, by whom, from where and why."""

import contextlib
import json
import logging
import os
import queue
import threading
import time
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)


class Audit:
    """Appends lines to `path` from a thread of its own, so that a tick never waits for the disk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="bam-audit", daemon=True)
        self._thread.start()

    def write(self, what: str, text: str, *, who: str, where: str = "", digest: str = "", **more: Any) -> None:
        """Append a line: the kind of change, what happened, who did it, from which address, the active version."""
        now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        row = {"time": now, "monotonic": round(time.monotonic(), 3), "what": what, "text": text, "who": who}
        self._lines.put(json.dumps({**row, "where": where, "digest": digest, **more}).encode() + b"\n")

    def close(self) -> None:
        """Write what waits, and end the thread. Idempotent."""
        self._lines.put(None)
        self._thread.join(5.0)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            self._append(line)

    def _append(self, line: bytes) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            _log.warning("%s: a line is missing: %s", self.path, error.strerror or error)


def tail(path: Path, n: int = 50) -> list[dict[str, Any]]:
    """The last `n` lines of an audit file, the oldest first; a line that was cut is left out."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - 1000 * n))
            lines = file.read().splitlines()
    except OSError:
        return []
    rows = []
    for line in lines[-n:]:
        with contextlib.suppress(ValueError):  # cut by the seek, or by a full disk
            rows.append(json.loads(line))
    return rows
