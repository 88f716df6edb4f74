"""An asyncio loop in a thread of its own, and how other threads have work done there."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any, TypeVar

from bam_envs.core.errors import LinkLost

T = TypeVar("T")
_PATIENCE = 10.0


class LoopThread:
    """Runs one coroutine to its end.

    Args:
        name: Of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None

    @property
    def was_started(self) -> bool:
        """Whether `start` was called."""
        return self._thread is not None

    @property
    def is_current(self) -> bool:
        """Whether this is the thread."""
        return threading.current_thread() is self._thread

    def start(self, main: Callable[[Future[None]], Coroutine[Any, Any, None]]) -> None:
        """Run ``main(ready)``; returns when it has settled `ready`, or raises what it put there.

        Args:
            main: Sets the result of what it is given, or its exception.
        """
        ready: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, args=(main, ready), name=self._name, daemon=True)
        self._thread.start()
        ready.result()

    def join(self) -> None:
        """Wait for its end, from any other thread."""
        if self._thread is not None and not self.is_current:
            self._thread.join()

    def post(self, work: Callable[[], object]) -> bool:
        """Have `work` done there soon; False if the loop is not running."""
        loop = self._loop
        if loop is None:
            return False
        try:
            # Waking up the loop costs a system call, and there it is awake.
            (loop.call_soon if self.is_current else loop.call_soon_threadsafe)(work)
        except RuntimeError:  # the loop was closed a moment ago
            return False
        return True

    def do(self, work: Callable[[], T]) -> T:
        """Do `work` there and wait for its result; at once where there is no loop, or this is its thread.

        Raises:
            LinkLost: The loop ended meanwhile.
        """
        done: Future[T] = Future()
        if self.is_current or not self.post(lambda: _settle(done, work)):
            return work()
        try:
            return done.result(timeout=_PATIENCE)
        except FutureTimeoutError:
            raise LinkLost(f"{self._name}: ended meanwhile.") from None

    def _run(self, main: Callable[[Future[None]], Coroutine[Any, Any, None]], ready: Future[None]) -> None:
        asyncio.run(self._entered(main, ready))

    async def _entered(self, main: Callable[[Future[None]], Coroutine[Any, Any, None]], ready: Future[None]) -> None:
        self._loop = asyncio.get_running_loop()
        try:
            await main(ready)
        # Whoever waits for `ready` must hear of it, whatever it is.
        except Exception as error:
            if ready.done():
                raise
            ready.set_exception(error)
        finally:
            self._loop = None


def _settle(done: Future[T], work: Callable[[], T]) -> None:
    try:
        done.set_result(work())
    except Exception as error:  # it belongs to who waits, whatever it is
        done.set_exception(error)
