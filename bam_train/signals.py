"""Ctrl-C (SIGINT), SIGTERM and SIGHUP: the one place where this process decides what they do.

Python runs a handler in the main thread, between two bytecodes of whatever runs there. So handlers are installed in the
main thread only; in any other one, everything here does nothing.
"""

from __future__ import annotations

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import NoReturn

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""What asks a program to end; Windows has no SIGHUP."""

TOGETHER = 0.5
"""A signal of a program that comes again within this time is the same one [s]: ``timeout`` sends SIGTERM to the process
and then to its group. Ctrl-C is a person's, and counts each time."""


class Terminated(KeyboardInterrupt):
    """Another `signal` than Ctrl-C asked for the end; Ray, waiting in C++, passes on KeyboardInterrupt alone."""

    def __init__(self, number: int) -> None:
        self.signal = signal.Signals(number)
        super().__init__(self.signal)  # what it is made from, so that it can be copied


def interrupt(number: int) -> NoReturn:
    """Raise KeyboardInterrupt for Ctrl-C, and `Terminated` for any other signal."""
    raise KeyboardInterrupt if number == signal.SIGINT else Terminated(number)


class _Handler:
    """Passes signals on to `handle`, except one of a program that comes again at once."""

    def __init__(self, handle: Callable[[int], object], around: object) -> None:
        self._handle = handle
        # Nested handlers share the time of the first signal, which may have ended the inner one.
        self._first: list[float] = around._first if isinstance(around, _Handler) else [-math.inf]

    def __call__(self, number: int, _: FrameType | None) -> None:
        now = time.monotonic()
        if number != signal.SIGINT:
            if now < self._first[0] + TOGETHER:
                return
            self._first[0] = now
        self._handle(number)


@contextlib.contextmanager
def handled(
    handle: Callable[[int], object], numbers: Sequence[int] = SIGNALS, *, ignored_too: bool = False
) -> Iterator[None]:
    """Within this, `handle` is called with the number of each signal.

    Args:
        handle: Runs in the main thread; what it raises comes out of whatever runs there.
        numbers: Which signals.
        ignored_too: Whether to handle also those that are ignored, as ``nohup`` does with SIGHUP and a shell with the
            SIGINT of a background job.
    """
    unheard = (None,) if ignored_too else (None, signal.SIG_IGN)  # None: of a handler that is not Python's
    here = threading.current_thread() is threading.main_thread()
    before = {n: signal.getsignal(n) for n in numbers if here and signal.getsignal(n) not in unheard}
    for number, around in before.items():
        signal.signal(number, _Handler(handle, around))
    try:
        yield
    finally:
        for number, around in before.items():
            signal.signal(number, around)


@contextlib.contextmanager
def waiting() -> Iterator[None]:
    """Within this, signals interrupt nothing; on leaving, the first one does what it would have done."""
    came: list[int] = []
    with handled(came.append):
        yield
    if came:
        signal.raise_signal(came[0])


class SignalMemory(contextlib.ExitStack):
    """Within this, signals interrupt, and are remembered.

    Python discards what is raised in callbacks such as ``__del__`` and those of an import, so a program asks again
    before anything moves.
    """

    def __init__(self) -> None:
        super().__init__()
        self.came: list[int] = []
        """The signals that came, in order."""

    def __enter__(self) -> SignalMemory:
        self.enter_context(handled(self._handle))
        return self

    def _handle(self, number: int) -> None:
        self.came.append(number)
        interrupt(number)

    def raise_again(self) -> None:
        """`interrupt` for a signal that came before now, if one did."""
        if self.came:
            interrupt(self.came[0])


def drop_handlers() -> None:
    """In a forked process: forget the handlers that the fork has copied, then let signals come that it held back.

    Ctrl-C reaches the whole group of processes and is the parent's to handle; SIGTERM ends this process at once.
    """
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signal.valid_signals())


# A program that quits at once runs no `finally`, but only what is registered here.

_CALLS: list[Callable[[], None]] = []


@contextlib.contextmanager
def at_quit(call: Callable[[], None]) -> Iterator[None]:
    """Within, `call` is called before the process quits at once; it is short, and fit for a signal handler."""
    _CALLS.append(call)
    try:
        yield
    finally:
        _CALLS.remove(call)


def before_quitting() -> None:
    """Call what is registered, the latest first, whatever becomes of it."""
    for call in reversed(_CALLS):
        with contextlib.suppress(Exception):  # quitting must not fail
            call()
