"""The audit file of a live agent: who did what, when, from where and why; one line of JSON for each event.

The fields of a line are those of `AuditEvent`. ``time`` is the wall clock, and ``monotonic`` a clock that nobody sets:
where the wall clock was set since the line before, ``clock_moved`` has by how much [s]. Another thread writes, so that
the loop waits for no disk.
"""

import contextlib
import logging
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import msgspec

from bam_train.agent.agent_states import State

MOST_BYTES = 4 * 2**20
"""Size at which a new file begins."""
FILES = 4
"""Number of files that are kept: ``audit.jsonl``, ``audit.1.jsonl`` (older) and so on."""
_TEXT = 500  # characters of a text that are kept
_LINE = 4 * 6 * _TEXT + 1000  # most bytes of a line: a character of JSON may take 6
_WAITING = 1000  # events that wait while the disk is full; the newest ones
_RETRY = 5.0  # time between two attempts to write to a full disk [s]
_LOG = logging.getLogger(__name__)


class AuditEvent(msgspec.Struct, frozen=True, omit_defaults=True, rename={"before": "from", "after": "to"}):
    """One line of the file."""

    time: str
    """UTC, ISO 8601."""
    monotonic: float
    """Time since the computer was started [s]."""
    what: str
    """Kind of event, such as ``state`` or ``swap``."""
    text: str
    """What happened, and why."""
    who: str
    """Name of a person or program, as they call themselves; ``the agent`` for what it did by itself."""
    where: str = ""
    """Address it came from; "" for what the agent did by itself."""
    digest: str = ""
    """The active version."""
    before: str = ""
    """State of the agent before, where the event changed it."""
    after: str = ""
    """State of the agent afterwards."""
    clock_moved: float = 0.0
    """By how much the wall clock was set since the event before [s]; 0 for less than a second."""


class Audit:
    """Appends events to the file at `path`; `write` may be called by any thread, and neither waits nor raises.

    Args:
        path: The file; a missing folder is made.
        wall: The wall clock [s since 1970].
        monotonic: The clock that nobody sets [s].

    Attributes:
        fault: Why the last events are not in the file; "" if they are.
    """

    def __init__(
        self, path: Path, wall: Callable[[], float] = time.time, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self.path, self.fault = path, ""
        self._wall, self._monotonic, self._offset = wall, monotonic, wall() - monotonic()
        self._lock = threading.Lock()
        self._events: queue.SimpleQueue[AuditEvent | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="bam-audit", daemon=True)
        self._thread.start()

    def write(
        self,
        what: str,
        text: str,
        *,
        who: str,
        where: str = "",
        digest: str = "",
        before: State | None = None,
        after: State | None = None,
    ) -> None:
        """Append an event, as of `AuditEvent`; long texts are cut."""
        what, text, who, where = (one[:_TEXT] for one in (what, text, who, where))
        states = {name: state.value for name, state in (("before", before), ("after", after)) if state is not None}
        with self._lock:  # events are in the order of their times
            wall, monotonic = self._wall(), self._monotonic()
            moved, self._offset = wall - monotonic - self._offset, wall - monotonic
            at = datetime.fromtimestamp(wall, timezone.utc).isoformat(timespec="milliseconds")
            moved = round(moved, 3) if abs(moved) >= 1 else 0.0
            event = AuditEvent(at, round(monotonic, 3), what, text, who, where, digest, **states, clock_moved=moved)
            self._events.put(event)

    def close(self, timeout: float = 5.0) -> None:
        """Write what waits, and end the thread; waits at most `timeout` [s]. Idempotent."""
        self._events.put(None)
        self._thread.join(timeout)

    # ---- the file

    def _run(self) -> None:
        waiting: deque[bytes] = deque(maxlen=_WAITING)
        ends = False
        while not ends:
            with contextlib.suppress(queue.Empty):
                new = [self._events.get(timeout=_RETRY if waiting else None)]
                while len(new) < _WAITING and not self._events.empty():
                    new.append(self._events.get())
                ends = None in new
                waiting.extend(msgspec.json.encode(event) + b"\n" for event in new if event is not None)
            if waiting and self._save(b"".join(waiting)):
                waiting.clear()

    def _save(self, lines: bytes) -> bool:
        """Append lines, all or none, and wait for the disk; whether that worked."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._rotate(len(lines))
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
            try:
                size = os.fstat(descriptor).st_size
                is_cut = size > 0 and os.pread(descriptor, 1, size - 1) != b"\n"
                try:
                    _write(descriptor, b"\n" * is_cut + lines)
                    os.fsync(descriptor)
                except OSError:
                    os.ftruncate(descriptor, size)
                    raise
            finally:
                os.close(descriptor)
        except OSError as error:
            if not self.fault:
                self.fault = f"{self.path}: cannot be written: {error.strerror or error}. Make room"
                _LOG.warning("%s", self.fault)
            return False
        self.fault = ""
        return True

    def _rotate(self, number: int) -> None:
        """Begin a new file if this one has no room for so many bytes; the oldest is removed."""
        if self.path.exists() and self.path.stat().st_size + number > MOST_BYTES:
            for place in range(FILES - 1, 0, -1):
                with contextlib.suppress(FileNotFoundError):
                    os.replace(_older(self.path, place - 1), _older(self.path, place))


def tail(path: Path, n: int = 50) -> list[dict[str, Any]]:
    """The last `n` lines of an audit file, the oldest first; a line that was cut is left out."""
    events: list[dict[str, Any]] = []
    for place in range(FILES):
        lines: list[bytes] = []
        with contextlib.suppress(OSError), _older(path, place).open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - _LINE * n))
            lines = file.read().splitlines()
        found = []
        for line in lines:
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError):  # cut, by a kill or by the seek
                found.append(msgspec.to_builtins(msgspec.json.decode(line, type=AuditEvent)))
        events = found + events
        if len(events) >= n:
            break
    return events[max(0, len(events) - n) :]


def _older(path: Path, place: int) -> Path:
    """The file of `place` rotations ago: ``audit.jsonl``, ``audit.1.jsonl`` and so on."""
    return path.with_name(f"{path.stem}.{place}{path.suffix}") if place else path


def _write(descriptor: int, data: bytes) -> None:
    while data:
        data = data[os.write(descriptor, data) :]
