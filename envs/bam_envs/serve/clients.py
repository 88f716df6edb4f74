"""Who the senders of commands are, over all their connections."""

from __future__ import annotations

import hashlib
import threading
from collections import Counter

from bam_envs.bridge.bus import Caller
from bam_envs.errors import RemoteError

_NAMELESS = "a sender without a name"
_MOST_SESSIONS = 64
"""Of one connection: each is remembered until that ends."""


def shown(caller: Caller, session: str | None) -> str:
    """What the others are told of who sends for `session` through `caller`: never the session, which is a key to it."""
    if caller.address or caller.name or session is None:
        return caller.address or caller.name or _NAMELESS
    return f"{_NAMELESS} (#{hashlib.sha256(session.encode()).hexdigest()[:6]})"


class Clients:
    """A client is a session over all its connections; where messages name no session, a connection."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callers: dict[str, set[str]] = {}
        self._sessions: Counter[str] = Counter()  # of each caller

    def name(self, caller: Caller, session: str | None) -> str:
        """What to call the client that sent a message of `session`, if it says one, through `caller`.

        Raises:
            RemoteError: It said too many sessions.
        """
        name = shown(caller, None) if session is None else f"session {session}"
        if caller.name:  # else nobody says when it leaves
            with self._lock:
                self._remember(name, caller.name)
        return name

    def _remember(self, client: str, caller: str) -> None:
        if caller in self._callers.get(client, ()):
            return
        if self._sessions[caller] >= _MOST_SESSIONS:
            raise RemoteError(f"One connection may send for at most {_MOST_SESSIONS} sessions; open another one.")
        self._sessions[caller] += 1
        self._callers.setdefault(client, set()).add(caller)

    def left(self, caller: Caller) -> list[str]:
        """The clients whose last connection `caller` was."""
        with self._lock:
            del self._sessions[caller.name]
            mine = [client for client, callers in self._callers.items() if caller.name in callers]
            for client in mine:
                self._callers[client].discard(caller.name)
            gone = [client for client in mine if not self._callers[client]]
            for client in gone:
                del self._callers[client]
        return gone
