"""What was answered lately, so that a request that comes twice is executed once."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable
from concurrent.futures import Future
from typing import Generic, TypeVar

Answer = TypeVar("Answer")


class RecentAnswers(Generic[Answer]):
    """The newest answers by the key of their request. Any thread.

    Args:
        size: How many are kept; the oldest goes first.
    """

    def __init__(self, size: int = 32) -> None:
        self.size = size
        """See above."""
        self._lock = threading.Lock()
        self._futures: OrderedDict[Hashable, Future[Answer]] = OrderedDict()

    def claim(self, key: Hashable) -> tuple[Future[Answer], bool]:
        """Where the answer to `key` will be, and whether it is for the caller to make it."""
        with self._lock:
            if key in self._futures:
                return self._futures[key], False
            future = self._futures[key] = Future()
            if len(self._futures) > self.size:
                self._futures.popitem(last=False)
            return future, True
