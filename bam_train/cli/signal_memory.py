"""Signals that are not lost, whatever becomes of the exceptions that their handlers raise."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

from bam_train.cli.program import Terminated

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class SignalMemory:
    """Within this, a signal is remembered: what its handler raises is lost where Python ignores it, as in `__del__`."""

    def __init__(self) -> None:
        self.came: list[int] = []
        """The signals that came, in order."""
        self._before: dict[int, Any] = {}

    def __enter__(self) -> SignalMemory:
        if threading.current_thread() is threading.main_thread():
            handlers = {number: signal.getsignal(number) for number in _SIGNALS}
            self._before = {number: handler for number, handler in handlers.items() if callable(handler)}
            for number in self._before:
                signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.came.append(number)
        self._before[number](number, frame)

    def raise_again(self) -> None:
        """What a signal raised that came before now, if one did."""
        if self.came:
            raise KeyboardInterrupt if self.came[0] == signal.SIGINT else Terminated(self.came[0])
