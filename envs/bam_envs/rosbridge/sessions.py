"""Sessions: a client proves that it is the driver with a key that is never published.

A client that wants to drive calls the service `SESSION_SERVICE` (std_srvs/Trigger). The answer, which only this client
gets, has a public name and a secret key. Every command is signed with the key, over its tag (number, deadline), its
topic and its numbers. Where the server knows connections, a session belongs to the one that opened it.
"""

import hmac
import json
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from bam_envs.core.errors import BamEnvsError, ProtocolError, RemoteError
from bam_envs.ros.freshness import StampFreshness, Tag, Tagger, new_session, signature
from bam_envs.rosbridge.bus import Caller, Message

SESSION_SERVICE = "/bam/session"  # where a session is opened (std_srvs/Trigger)
LEASE_TOPIC = "/bam/lease"
"""Where the driver renews its lease, or leaves (std_msgs/String: `RENEW` or `LEAVE`, a blank, a signed tag)."""
RENEW, LEAVE = "renew", "leave"
_NOT_OPEN, _ELSEWHERE = "is not open here", "is of another connection"
FORBIDDEN = "This needs a token of the role drive; the token shown may watch, and halt the robot."
"""Answer to a client that may only watch."""
_MOST = 64  # sessions of one caller; the oldest is closed for a new one


class _Session(NamedTuple):
    caller: str
    key: bytes
    fresh: StampFreshness


class Sessions:
    """The robot's side: every open session; one that `is_driving` is never closed for a new one. Thread-safe."""

    def __init__(self, is_driving: Callable[[str], bool] = lambda name: False) -> None:
        self._is_driving, self._lock = is_driving, threading.Lock()
        self._sessions: OrderedDict[str, _Session] = OrderedDict()

    def open(self, request: Message, caller: Caller) -> Message:
        """Answer `SESSION_SERVICE`: a new session of `caller`."""
        name = new_session()
        with self._lock:
            names = [one for one, session in self._sessions.items() if session.caller == caller.name]
            if len(names) >= _MOST:
                del self._sessions[next(one for one in names if not self._is_driving(one))]
            self._sessions[name] = session = _Session(caller.name, secrets.token_bytes(32), StampFreshness())
        return {"success": True, "message": json.dumps({"session": name, "key": session.key.hex()})}

    def prove(
        self, tag: Tag, channel: str, content: bytes, caller: Caller, *, anywhere: bool = False
    ) -> StampFreshness:
        """Check that `content` was signed for `channel` by the session of `tag`; returns its `StampFreshness`.

        It must come over the connection that opened the session or, with `anywhere`, over any. `RemoteError` if the
        session is not open, or did not sign it.
        """
        with self._lock:
            session = self._sessions.get(tag.session)
            if session is None:
                raise RemoteError(
                    f"session {tag.session} {_NOT_OPEN}: reset(), which opens one at {SESSION_SERVICE}; "
                    "both sides must be of one version of bam-train"
                )
            self._sessions.move_to_end(tag.session)
        expected = signature(session.key, tag, channel, content).encode()
        if not hmac.compare_digest(tag.mac.encode(errors="surrogatepass"), expected):
            raise RemoteError(f"session {tag.session}: the signature of a message on {channel} is wrong")
        if not anywhere and session.caller != caller.name:
            raise RemoteError(f"session {tag.session} {_ELSEWHERE}")
        return session.fresh

    def newest(self, caller: Caller) -> str:
        """The session that the connection of `caller` opened last; empty if none is open."""
        with self._lock:
            names = [name for name, session in self._sessions.items() if session.caller == caller.name]
        return names[-1] if names else ""

    def left(self, caller: Caller) -> list[str]:
        """Close the sessions of `caller`, whose connection ended; returns their names."""
        with self._lock:
            gone = [name for name, session in self._sessions.items() if session.caller == caller.name]
            for name in gone:
                del self._sessions[name]
        return gone

    def end(self, name: str) -> None:
        """Close one session."""
        with self._lock:
            self._sessions.pop(name, None)


def is_over(error: BamEnvsError) -> bool:
    """Whether `error` is a refusal after which a new session is needed."""
    return _NOT_OPEN in str(error) or _ELSEWHERE in str(error)


def is_forbidden(error: RemoteError) -> bool:
    """Whether `error` is a refusal for want of a token that lets its owner drive."""
    return FORBIDDEN in str(error)


def read_session(response: Mapping[str, Any], where: str) -> Tagger:
    """The tagger, with its key, of the session that `response` of `SESSION_SERVICE` opened, or `ProtocolError`."""
    try:
        content = json.loads(response["message"])
        name, key = content["session"], bytes.fromhex(content["key"])
        if not isinstance(name, str) or not name.isalnum() or len(key) < 16:
            raise ValueError
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"{where}: expected a session and its key, found something else.") from error
    return Tagger(session=name, key=key)
