"""Who the senders of commands are, over all their connections."""

from __future__ import annotations

import threading

from bam_envs.bridge.bus import Caller


class Clients:
    """A client is a session over all its connections; where messages name no session, a connection."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callers: dict[str, set[str]] = {}

    def name(self, caller: Caller, session: str | None) -> str:
        """What to call the client that sent a message of `session`, if it says one, through `caller`."""
        nameless = caller.address or caller.name or "a sender without a name"
        name = nameless if session is None else f"session {session}"
        if caller.name:  # else nobody says when it leaves
            with self._lock:
                self._callers.setdefault(name, set()).add(caller.name)
        return name

    def left(self, caller: Caller) -> list[str]:
        """The clients whose last connection `caller` was."""
        with self._lock:
            mine = [client for client, callers in self._callers.items() if caller.name in callers]
            for client in mine:
                self._callers[client].discard(caller.name)
            gone = [client for client in mine if not self._callers[client]]
            for client in gone:
                del self._callers[client]
        return gone
