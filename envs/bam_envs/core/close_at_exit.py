"""Close open robots and environments when Python ends."""

import atexit
import logging
import weakref
from typing import Any, Protocol

from bam_envs.core.errors import BamEnvsError

_log = logging.getLogger(__name__)
_open: weakref.WeakSet[Any] = weakref.WeakSet()


class Closable(Protocol):
    """Anything with an idempotent `close`."""

    def close(self) -> object:
        """Release every resource."""


def close_at_exit(thing: Closable) -> None:
    """Close `thing` when Python ends, if it still exists.

    Network threads still run at that time; a ``__del__`` would run later, after they and some modules have ended.
    """
    if not _open:
        atexit.unregister(_close_all)
        atexit.register(_close_all)  # run in reverse order of registration: before the network ends
    _open.add(thing)


def _close_all() -> None:
    for thing in list(_open):
        try:
            thing.close()
        except BamEnvsError as error:  # noqa: PERF203 - close the remaining ones
            _log.warning("%s", error)
