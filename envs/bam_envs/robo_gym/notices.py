"""What an option of robo-gym's means here, said once in a process: by `logging`, so that it is never an exception."""

from __future__ import annotations

import logging

_LOG = logging.getLogger(__name__)
_SAID: set[str] = set()


def say_once(key: str, text: str) -> None:
    """Log `text` as a warning, unless something with this `key` was said before."""
    if key not in _SAID:
        _SAID.add(key)
        _LOG.warning("%s", text)


def forget() -> None:
    """Say everything once more."""
    _SAID.clear()
