"""The lease on command: one client is in command at a time; the others see its name."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bam_envs.core.errors import NotInCommand
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Caller

Change = Callable[[str | None, str | None], None]
"""Called with the shown names of the clients that were and are in command; each may be None."""
LEASE_SECONDS = 2.0
"""Default time without a sign of life after which another client may take command [s]."""


class CommandLease:
    """Command of one robot or environment. The first client to ask has it until it leaves or another one may take it.

    A client without a sign of life for longer than `seconds` [s] keeps command until another one asks. A sign of life
    is a request, `renew`, or activity of the connection. Thread-safe.
    """

    def __init__(self, seconds: float = LEASE_SECONDS, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds = seconds
        self._clock, self._lock = clock, threading.RLock()
        self._holder: str | None = None
        self._shown: str | None = None  # the holder's name for other clients
        self._heard, self._caller = 0.0, UNKNOWN_CALLER  # the connection on which it was taken
        self._running = 0
        self._listeners: list[Change] = []

    @property
    def holder(self) -> str | None:
        """The client in command, or None."""
        return self._holder

    @property
    def connection(self) -> str:
        """Name of the connection on which it was taken."""
        return self._caller.name

    @property
    def silence(self) -> float:
        """Time since the last sign of life of that connection [s]; infinite if it is not known."""
        return self._caller.silence()

    def on_change(self, listener: Change) -> None:
        """Call `listener` whenever command changes, in the thread that changes it, without this object's lock."""
        self._listeners.append(listener)

    def take(
        self, client: str, caller: Caller = UNKNOWN_CALLER, *, force: bool = False, shown: str | None = None
    ) -> bool:
        """Put `client` in command; True if it was not before.

        Args:
            client: Its name.
            caller: Its connection.
            force: Take command from the client that has it.
            shown: The name that other clients see, if `client` is a secret.

        Raises:
            NotInCommand: Another client has command, and gave a sign of life within `seconds`.
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
        """A context in which `client` does not count as silent, for a request of any duration."""
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
        """Take command from `client`, or from the client of `connection`; True if it had command."""
        with self._lock:
            connected = bool(connection) and connection == self._caller.name
            if self._holder is None or not (connected or client == self._holder):
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
