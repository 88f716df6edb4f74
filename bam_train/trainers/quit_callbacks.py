"""What is still to be done when a program quits at once: no `finally` runs then, only what is registered here."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

_CALLS: list[Callable[[], None]] = []


@contextlib.contextmanager
def at_quit(call: Callable[[], None]) -> Iterator[None]:
    """Within, `call` is to be called before the process quits at once.

    Args:
        call: Short, and fit for a signal handler, as it may come in the middle of anything.
    """
    _CALLS.append(call)
    try:
        yield
    finally:
        _CALLS.remove(call)


def before_quitting() -> None:
    """Call what is registered, the latest first, whatever becomes of it."""
    for call in reversed(_CALLS):
        with contextlib.suppress(Exception):  # nobody is left to be told, and quitting must not fail
            call()
