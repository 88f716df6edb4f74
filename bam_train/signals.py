"""Ctrl-C (SIGINT), SIGTERM and SIGHUP: the only module that installs handlers for them; processes that they spare.

A program alone installs one before, as `bam_train.cli` is imported.

Python runs handlers in the main thread, between two bytecodes. So they are installed in the main thread only; in other
threads the functions of this module do nothing.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any, NoReturn

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that ask a program to end; Windows has no SIGHUP."""

TOGETHER = 0.5
"""Time [s] in which repeated signals, except Ctrl-C, count as one: ``timeout`` sends SIGTERM to the process and then to
its group."""


class Terminated(KeyboardInterrupt):
    """A `signal` other than Ctrl-C; a KeyboardInterrupt because Ray, waiting in C++, passes on no other exception."""

    def __init__(self, number: int) -> None:
        self.signal = signal.Signals(number)
        super().__init__(self.signal)  # the constructor's argument, so that it can be copied


def interrupt(number: int) -> NoReturn:
    """Raise KeyboardInterrupt for Ctrl-C, and `Terminated` for any other signal."""
    raise KeyboardInterrupt if number == signal.SIGINT else Terminated(number)


class _Handler:
    """Passes signals on to `handle`, but a repeated one (see `TOGETHER`) only once."""

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
    """Within the ``with`` block, call `handle` with the number of each signal.

    Args:
        handle: Runs in the main thread; its exceptions are raised in the code that runs there.
        numbers: The signals.
        ignored_too: Whether to handle ignored signals too: ``nohup`` ignores SIGHUP, and a shell the SIGINT of a
            background job.
    """
    left_alone = (None,) if ignored_too else (None, signal.SIG_IGN)  # None: the handler was not installed by Python
    is_main = threading.current_thread() is threading.main_thread()
    before = {n: signal.getsignal(n) for n in numbers if is_main and signal.getsignal(n) not in left_alone}
    for number, around in before.items():
        signal.signal(number, _Handler(handle, around))
    try:
        yield
    finally:
        for number, around in before.items():
            signal.signal(number, around)


@contextlib.contextmanager
def waiting() -> Iterator[None]:
    """Delay signals: none interrupts the ``with`` block, and the first one is raised again at its end."""
    came: list[int] = []
    with handled(came.append):
        yield
    if came:
        signal.raise_signal(came[0])


class SignalMemory(contextlib.ExitStack):
    """Signals interrupt the ``with`` block, and are remembered.

    Python discards exceptions of callbacks such as ``__del__`` and those of an import, so a program calls `raise_again`
    before a robot moves.
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
        """Call `interrupt` for the first signal so far, if there was one."""
        if self.came:
            interrupt(self.came[0])


@contextlib.contextmanager
def reinstalled(number: int) -> Iterator[None]:
    """Within the ``with`` block, foreign code may reset the handler of a signal; it is installed again at the end."""
    try:
        yield
    finally:
        handler = signal.getsignal(number)
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(number, handler)


def ignore(*numbers: int) -> None:
    """In a child process, ignore signals of a terminal, which its whole process group gets; the parent ends it."""
    for number in numbers:
        signal.signal(number, signal.SIG_IGN)


def drop_handlers() -> None:
    """In a forked process: remove the handlers that the fork has copied, then unblock all signals.

    Ctrl-C reaches the whole process group, and the parent handles it; SIGTERM ends this process at once.
    """
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    ignore(signal.SIGINT)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signal.valid_signals())


# Child processes, which a signal at the terminal does not reach


def start_child(call: str, *arguments: str, **options: Any) -> subprocess.Popen[Any]:
    """Call ``module:function`` in a new process that finds the same packages.

    Args:
        call: The function.
        arguments: Its ``sys.argv[1:]``.
        options: Of `subprocess.Popen`.
    """
    module, _, name = call.partition(":")
    # Without the folder it is started in, whose files could hide ours.
    program = f"import sys; sys.path[:] = filter(None, sys.path); import {module} as it; it.{name}()"
    return subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        start_new_session=True,  # Ctrl-C at the terminal is for the parent alone
        **{"stdin": subprocess.DEVNULL, **options},
    )


def await_end(process: subprocess.Popen[Any]) -> None:
    """Wait for the end of a process, which was told to end; kill it if that takes long."""
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def at_end_of_parent(call: Callable[[], object]) -> None:
    """In a child: `call` runs in a thread when the standard input ends, because the parent closes it or has ended."""

    def wait() -> None:
        sys.stdin.read()
        call()

    threading.Thread(target=wait, daemon=True).start()


# A process that quits at once runs no `finally`, only the functions that are registered here.

_CALLS: list[Callable[[], None]] = []


@contextlib.contextmanager
def at_quit(call: Callable[[], None]) -> Iterator[None]:
    """Within the ``with`` block, `call` runs if the process quits at once; it is short and safe in a signal handler."""
    _CALLS.append(call)
    try:
        yield
    finally:
        _CALLS.remove(call)


def before_quitting() -> None:
    """Call the registered functions, the latest first, and ignore their exceptions."""
    for call in reversed(_CALLS):
        with contextlib.suppress(Exception):  # quitting must not fail
            call()
