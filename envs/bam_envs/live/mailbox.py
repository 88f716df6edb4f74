"""One slot for the newest message of each signal: all that the thread of the network does is to put it there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Letter:
    """A message that came."""

    message: Any
    """As it came; nobody has looked at it."""
    arrived: float
    """When it came [s], our monotonic clock."""
    number: int
    """Counts what came for its slot, from 1."""


class Alarm:
    """Wakes the one thread that waits. A lock used as a flag: an Event costs several times as much."""

    def __init__(self) -> None:
        self._silent = threading.Lock()
        self._silent.acquire()

    def ring(self) -> None:
        """End the wait, or the next one. As often as one likes, from any thread."""
        with suppress(RuntimeError):  # it rings already
            self._silent.release()

    def stop(self) -> None:
        """Let the next wait be one."""
        self._silent.acquire(blocking=False)

    def wait(self, timeout: float) -> None:
        """Wait until it rings, at most `timeout` [s]; afterwards it is silent."""
        self._silent.acquire(timeout=timeout)


class Mailbox:
    """Slots by name, and a way to wait for them.

    Args:
        clock: Monotonic clock [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._changed = clock, threading.Condition()
        self._slots: dict[str, Letter] = {}

    def put(self, names: Iterable[str], message: Any) -> None:
        """A message for the slots `names` came; it takes the place of what is there."""
        with self._changed:
            arrived = self._clock()
            for name in names:
                before = self._slots.get(name)
                self._slots[name] = Letter(message, arrived, 1 if before is None else before.number + 1)
            self._changed.notify_all()

    def newest(self) -> dict[str, Letter]:
        """What is in the slots; a slot that nothing came for is not there."""
        with self._changed:
            return dict(self._slots)

    def clear(self) -> None:
        """Empty the slots; whoever waits looks again."""
        with self._changed:
            self._slots.clear()
            self._changed.notify_all()

    def wait_for(self, ready: Callable[[dict[str, Letter]], bool], timeout: float) -> bool:
        """Wait until `ready` says so of the slots, at most `timeout` [s]; whether it did."""
        with self._changed:
            return self._changed.wait_for(lambda: ready(self._slots), timeout)
