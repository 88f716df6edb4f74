"""Which client is in command: one at a time; the others see its name."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bam_envs.core.errors import NotInCommand
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Caller

Change = Callable[[str | None, str | None], None]
"""Called with the names, as others see them, of the client that was in command and of the one that is, or None."""
LEASE_SECONDS = 2.0
"""Usual time without a sign of life after which another client may take command [s]."""


class CommandLease:
    """Command of one robot or environment. The first to ask has it, until it leaves or another one may take it.

    A client without a sign of life for longer than `seconds` [s] keeps command until another one asks. A sign of life
    is a request, `renew`, or what the connection shows by itself. Safe to call from any thread.
    """

    def __init__(self, seconds: float = LEASE_SECONDS, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds = seconds
        self._clock, self._lock = clock, threading.RLock()
        self._holder: str | None = None
        self._shown: str | None = None  # what the holder is called where others read it
        self._heard, self._caller = 0.0, UNKNOWN_CALLER  # the connection on which it was taken
        self._running = 0
        self._listeners: list[Change] = []

    @property
    def holder(self) -> str | None:
        """The client in command, or None."""
        return self._holder

    def on_change(self, listener: Change) -> None:
        """Call `listener` whenever command changes, in the thread that changes it, which holds no lock of this."""
        self._listeners.append(listener)

    def take(
        self, client: str, caller: Caller = UNKNOWN_CALLER, *, force: bool = False, shown: str | None = None
    ) -> bool:
        """Put `client` in command; whether it was not before.

        Args:
            client: Its name.
            caller: The connection on which it asks.
            force: Take it from the client that has it.
            shown: What other clients see instead of its name, where that is a secret.

        Raises:
            NotInCommand: Another client has it, and gave a sign of life within `seconds`.
        """
        with self._lock:
            if self._holder not in (None, client) and not force:
                silent = min(self._clock() - self._heard, self._caller.silence())
                if self._running or silent <= self.seconds:
                    raise NotInCommand(self._refusal(shown or client))
            self._heard, self._caller = self._clock(), caller
            if self._holder == client:
                return False
            before, self._shown = self._shown, shown or client
            self._holder, self._running = client, 0
        for listener in self._listeners:
            listener(before, shown or client)
        return True

    def renew(self, client: str) -> None:
        """Record a sign of life of `client`, if it is in command."""
        with self._lock:
            if self._holder == client:
                self._heard = self._clock()

    def require(self, client: str) -> None:
        """Record a sign of life of `client`; raises NotInCommand if it is not in command."""
        with self._lock:
            if self._holder != client:
                raise NotInCommand(self._refusal(client))
            self._heard = self._clock()

    @contextmanager
    def busy(self, client: str) -> Iterator[None]:
        """While a request of `client` runs, however long it takes, it does not count as silent."""
        with self._lock:
            self.require(client)
            self._running += 1
        try:
            yield
        finally:
            with self._lock:
                if self._holder == client:
                    self._running, self._heard = max(0, self._running - 1), self._clock()

    def release(self, client: str | None = None, connection: str = "") -> bool:
        """Take command from `client`, or from who took it on the `connection` of that name; whether it had it."""
        with self._lock:
            its_own = bool(connection) and connection == self._caller.name
            if self._holder is None or not (its_own or client == self._holder):
                return False
            before, self._shown = self._shown, None
            self._holder, self._running = None, 0
        for listener in self._listeners:
            listener(before, None)
        return True

    def _refusal(self, client: str) -> str:
        if self._holder is None:
            return f"Nobody is in command, {client} neither; reset() takes command."
        return (
            f"{self._shown} is in command, not {client}; it passes on when {self._shown} leaves or is silent for "
            f"{self.seconds:g} s."
        )
