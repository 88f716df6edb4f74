"""The log of refused clients: one line each, and never a flood."""

import logging
import time
from collections.abc import Callable

_REPEAT_PERIOD = 1.0  # least time between two equal lines [s]
_MOST = 1024  # different lines that are remembered


class Refusals:
    """Logs who was refused, and why. Equal lines come at most once a second, with the number of those left out.

    Not thread-safe.
    """

    def __init__(self, logger: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._logger, self._clock = logger, clock
        self._seen: dict[tuple[str, str], tuple[float, int]] = {}  # the oldest first

    def note(self, who: str, why: str) -> None:
        """Log one refusal. `why` is one line that shows no secret, and of what a stranger sent only a short part."""
        now, key = self._clock(), (who, why)
        at, more = self._seen.get(key, (now - _REPEAT_PERIOD, 0))
        if now - at < _REPEAT_PERIOD:
            self._seen[key] = at, more + 1
            return
        self._logger.warning("%s was refused: %s%s", who, why, f" (and {more} times before)" if more else "")
        self._seen.pop(key, None)
        self._seen[key] = now, 0
        if len(self._seen) > _MOST:
            del self._seen[next(iter(self._seen))]
