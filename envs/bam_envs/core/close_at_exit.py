"""Closing what is still open when Python ends."""

import atexit
import logging
import weakref
from typing import Any, Protocol

from bam_envs.core.errors import BamEnvsError

_log = logging.getLogger(__name__)
_open: weakref.WeakSet[Any] = weakref.WeakSet()


class Closable(Protocol):
    """What can be closed, as often as one likes."""

    def close(self) -> object:
        """Let go of everything."""


def close_at_exit(thing: Closable) -> None:
    """Close `thing` when Python ends, if it is still there.

    The threads of the network run then; a ``__del__`` comes later, waits for them in vain and misses modules.
    """
    if not _open:
        atexit.unregister(_close_all)
        atexit.register(_close_all)  # last come, first served: before what the network needs is taken down
    _open.add(thing)


def _close_all() -> None:
    for thing in list(_open):
        try:
            thing.close()
        except BamEnvsError as error:  # noqa: PERF203 - the others are closed all the same
            _log.warning("%s", error)
