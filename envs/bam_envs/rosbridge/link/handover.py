"""Handing a frame from any thread to the thread of the network: it is sent, or taken back, never neither or both."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from bam_envs.core.errors import BamEnvsError, LinkLost


class Parcel:
    """One frame on its way to the network thread.

    The sender waits until the frame is written, because only then it knows; when that takes too long (something holds
    up the network thread) it takes the frame back, so that it is not sent late.

    Args:
        frame: Text in UTF-8.
        identity: Id of the request that the frame is; empty for a message that nothing answers.
        answer: What the answer to that request resolves.
        refused: Hears on the network thread why it was not sent; for a sender that does not wait.
    """

    def __init__(
        self,
        frame: bytes,
        identity: str = "",
        answer: Future[Any] | None = None,
        refused: Callable[[BamEnvsError], None] | None = None,
    ) -> None:
        self.frame, self.identity, self.answer, self._refused = frame, identity, answer, refused
        self._error: BamEnvsError | None = None
        # Locks as one-shot flags: a Condition or an Event costs several times as much in the control loop.
        self._taken, self._settled = threading.Lock(), threading.Lock()
        self._settled.acquire()

    def take(self) -> bool:
        """Whether the caller is the first to take it: the network thread to send it, the sender to drop it."""
        return self._taken.acquire(blocking=False)

    def settle(self, error: BamEnvsError | None = None) -> None:
        """Tell the sender that it was written, or why it was not."""
        self._error = error
        self._settled.release()
        if error is not None and self._refused is not None:
            self._refused(error)

    def wait(self, timeout: float) -> None:
        """Wait until it is written.

        Raises:
            LinkLost: It was not, and will not be.
        """
        if not self._settled.acquire(timeout=timeout):
            if self.take():
                raise LinkLost(
                    f"The network thread took nothing for {timeout:g} s; nothing was sent. "
                    "A listener must return at once: do work in another thread."
                )
            self._settled.acquire()
        if self._error is not None:
            raise self._error
