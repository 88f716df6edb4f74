"""Threads that do not keep a program from ending: one with an asyncio loop, and a pool for slow work."""

import asyncio
import queue
import threading
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoResultYet
from typing import Any, TypeVar

from bam_envs.core.errors import LinkLost

T = TypeVar("T")
_PATIENCE = 10.0
_LISTENER = "A listener must return at once: do work in another thread."
_BUSY = "This computer is busy: end other programs on it."


class LoopThread:
    """Runs one coroutine to its end in a separate asyncio loop; errors name its `owner`."""

    def __init__(self, name: str, owner: str = "this server") -> None:
        self._name, self._owner, self.was_started = name, owner, False
        self.loop: asyncio.AbstractEventLoop | None = None
        """The loop while it runs; one that runs in a thread of other code can be put here."""
        self.listens = False
        """Whether it calls a listener now, or may, which is the likely cause when it is held up."""
        self._thread: threading.Thread | None = None

    @property
    def is_current(self) -> bool:
        """Whether the caller runs in this thread."""
        try:
            return asyncio.get_running_loop() is self.loop
        except RuntimeError:
            return False

    def start(self, main: Callable[[Future[None]], Coroutine[Any, Any, None]]) -> None:
        """Run ``main(ready)`` in the thread; returns when `ready` has its result, or raises its exception."""
        ready: Future[None] = Future()
        thread = threading.Thread(target=lambda: asyncio.run(self._run(main, ready)), name=self._name, daemon=True)
        thread.start()
        self._thread, self.was_started = thread, True
        ready.result()

    def join(self, timeout: float | None = None) -> bool:
        """Wait for the end of the thread, from any other thread; False if it still runs after `timeout` [s]."""
        if self._thread is None or self.is_current:
            return True
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def post(self, work: Callable[[], object]) -> bool:
        """Schedule `work` in the thread; False if the loop does not run."""
        loop = self.loop
        if loop is None:
            return False
        try:
            # Waking the loop costs a system call; in its own thread it is awake.
            (loop.call_soon if self.is_current else loop.call_soon_threadsafe)(work)
        except RuntimeError:  # the loop was closed a moment ago
            return False
        return True

    def do(self, work: Callable[[], T], within: float = _PATIENCE, *, surely: bool = False) -> T:
        """Run `work` in the thread, or in the caller's if the loop does not run, and return its result.

        `LinkLost` if it had not begun after `within` [s]; then it is not run later, or, if `surely`, it still is.
        """
        done: Future[T] = Future()

        def run() -> None:
            if done.set_running_or_notify_cancel():
                try:
                    done.set_result(work())
                except BaseException as error:  # raised in the thread that waits for the result
                    done.set_exception(error)

        if self.is_current or not self.post(run):
            return work()
        try:
            return done.result(within)
        except NoResultYet:
            if surely:
                raise LinkLost(
                    f"{self._owner}: the network thread took nothing for {within:g} s, and does this once it can."
                ) from None
            if done.cancel():
                raise LinkLost(
                    f"{self._owner}: the network thread took nothing for {within:g} s; nothing was sent. "
                    f"{_LISTENER if self.listens else _BUSY}"
                ) from None
            return done.result()  # it is running
        finally:
            if not surely:
                done.cancel()  # also after Ctrl-C: work that has not begun is not wanted any more

    async def _run(self, main: Callable[[Future[None]], Coroutine[Any, Any, None]], ready: Future[None]) -> None:
        self.loop = asyncio.get_running_loop()
        try:
            await main(ready)
        except Exception as error:  # any error goes to the thread that waits for `ready`
            if ready.done():
                raise
            ready.set_exception(error)
        finally:
            self.loop = None


class Workers:
    """A pool of at most `most` daemon threads, each started when the others are busy.

    A `ThreadPoolExecutor` joins its threads when the interpreter exits: one handler that hangs would keep the program.
    """

    def __init__(self, most: int, name: str) -> None:
        self.most, self.name = most, name
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._idle = threading.Semaphore(0)

    def submit(self, work: Callable[[], None]) -> None:
        """Run `work`, which must not raise, in one of the threads. From one thread only."""
        self._work.put(work)
        if not self._idle.acquire(blocking=False) and len(self._threads) < self.most:
            name = f"{self.name}-{len(self._threads)}"
            self._threads.append(threading.Thread(target=self._run, name=name, daemon=True))
            self._threads[-1].start()

    def close(self, patience: float = 1.0) -> None:
        """End the threads; one that is busy for longer than `patience` [s] ends by itself later."""
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
