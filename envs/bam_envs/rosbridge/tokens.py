"""Shared secrets that clients show to servers, and the limit on guesses."""

import hmac
import ipaddress
import os
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Literal

from bam_envs.core.errors import InvalidValue

Role = Literal["client", "operator"]
_WINDOW = 1.0
_OF_ONE, _OF_ALL = 4, 32  # wrong tokens from one address, and from all that were wrong lately, in `_WINDOW` [s]
_LATELY = 60.0
_MOST_ADDRESSES = 4096


def read_token(path: str | Path, *, private: bool = False) -> str:
    """The secret in a file, without white space around it; with `private`, no other user may read the file."""
    try:
        if private and os.name == "posix" and os.stat(path).st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise InvalidValue(f"The token file {path} is open to other users of this computer. Run: chmod 600 {path}")
        token = Path(path).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise InvalidValue(
            f"The token file {path} cannot be read: {reason}. Write a secret into a file that only you can read."
        ) from error
    if not token:
        raise InvalidValue(f"The token file {path} is empty; put a secret into it.")
    return token


class Tokens:
    """The secrets of one server, each may be None: of clients, and of operators, who may take command from others."""

    def __init__(self, client: str | None = None, operator: str | None = None) -> None:
        if "" in (client, operator):
            raise InvalidValue("Token: expected a text, found an empty one.")
        if operator is not None and operator == client:
            raise InvalidValue("The operator's token must be another one than that of the clients.")
        self._client, self._operator = client, operator
        self.needed = client is not None  # whether a client must show one
        self.exist = self.needed or operator is not None  # whether there is anything to show

    def role(self, shown: Iterable[str]) -> Role | None:
        """The role that one of these tokens gives; None if all are wrong."""
        role: Role | None = None
        # In constant time: the duration of a refusal must not reveal how much of the token was right.
        for text in shown:
            data = text.encode("utf-8", "surrogatepass")  # a stranger may send anything, even invalid text
            if self._client is not None and hmac.compare_digest(data, self._client.encode()):
                role = role or "client"
            if self._operator is not None and hmac.compare_digest(data, self._operator.encode()):
                role = "operator"
        return role


class Guesses:
    """Limits how often wrong tokens are checked: a few per second from one address, and some more from all together.

    An address without a recent wrong token is always checked, so that others cannot lock it out. Thread-safe.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._wrong: dict[str, deque[float]] = {}  # the oldest address first
        self._all: deque[float] = deque(maxlen=_OF_ALL)

    def may_try(self, address: str) -> bool:
        """Whether a token from the IP address `address` may be checked."""
        with self._lock:
            now, recent = self._clock(), self._wrong.get(_network(address))
            if recent is None or now - recent[-1] > _LATELY:
                return True
            # Full queues (4 of one address, 32 of all) whose oldest entry is not a second old.
            return not any(len(times) == times.maxlen and now - times[0] < _WINDOW for times in (recent, self._all))

    def wrong(self, address: str) -> None:
        """Record a wrong token from `address`."""
        with self._lock:
            network = _network(address)
            recent = self._wrong.pop(network, None) or deque(maxlen=_OF_ONE)
            self._wrong[network] = recent
            for times in (recent, self._all):
                times.append(self._clock())
            if len(self._wrong) > _MOST_ADDRESSES:
                del self._wrong[next(iter(self._wrong))]


def _network(address: str) -> str:
    """The addresses that one attacker surely has: one of IPv4, a network of 64 bits of IPv6."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv6Address):
        mapped = parsed.ipv4_mapped
        return str(mapped) if mapped is not None else str(ipaddress.ip_network((parsed, 64), strict=False))
    return str(parsed)
