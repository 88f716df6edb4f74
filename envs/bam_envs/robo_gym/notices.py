"""What an option of robo-gym's means here, said once in a process: by `logging`, so that it is never an exception."""

from __future__ import annotations

import logging
from collections.abc import Iterable

_LOG = logging.getLogger(__name__)
_SAID: set[str] = set()


def say_once(key: str, text: str) -> None:
    """Log `text` as a warning, unless something with this `key` was said before."""
    if key not in _SAID:
        _SAID.add(key)
        _LOG.warning("%s", text)


def first_told(topic: str, names: Iterable[str]) -> list[str]:
    """Those of `names` that are told of for the first time under `topic`."""
    new = [name for name in names if f"{topic}: {name}" not in _SAID]
    _SAID.update(f"{topic}: {name}" for name in new)
    return new


def forget() -> None:
    """Say everything once more."""
    _SAID.clear()
