"""Threads that answer service calls, so that the thread of the network never waits for a robot."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable


class Workers:
    """A pool of threads that does not keep a program from ending.

    A `ThreadPoolExecutor` joins its threads when the interpreter exits: one handler that hangs, and the program stays.

    Args:
        most: Most threads; each is started when the others are busy.
        name: What their names begin with.
    """

    def __init__(self, most: int, name: str) -> None:
        self.most, self.name = most, name
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._idle = threading.Semaphore(0)

    def submit(self, work: Callable[[], None]) -> None:
        """Have `work` done, which must not raise. From one thread only."""
        self._work.put(work)
        if not self._idle.acquire(blocking=False) and len(self._threads) < self.most:
            name = f"{self.name}-{len(self._threads)}"
            self._threads.append(threading.Thread(target=self._run, name=name, daemon=True))
            self._threads[-1].start()

    def close(self, patience: float = 1.0) -> None:
        """End the threads; those that are busy for longer than `patience` [s] end by themselves later."""
        deadline = time.monotonic() + patience
        for _ in self._threads:
            self._work.put(None)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def _run(self) -> None:
        while (work := self._work.get()) is not None:
            work()
            self._idle.release()
