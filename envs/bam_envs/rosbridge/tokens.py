"""Who comes into a server: the shared secrets that clients show, the limit on guesses, the places of clients, the log.

Some places are kept for higher roles, and who says nothing gives way.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import os
import stat
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, Protocol, TypeVar, get_args

from bam_envs.core.errors import InvalidValue

Role = Literal["watch", "drive", "administer"]
ROLES: tuple[Role, ...] = get_args(Role)
"""From the least to the most: each role may do what those before it may."""
_log = logging.getLogger(__name__)
_WINDOW = 1.0
_OF_ONE, _OF_ALL = 4, 32  # wrong tokens from one address, and from all that were wrong lately, in `_WINDOW` [s]
_LATELY = 60.0
_MOST_ADDRESSES = 4096
_KEPT = 4
"""A quarter of the places is kept for each higher role."""
_REPEAT_PERIOD = 1.0  # least time between two equal lines of the log [s]
_MOST_LINES = 1024  # different lines that are remembered


def read_token(path: str | Path) -> str:
    """The secret in a file that no other user may read, without white space around it."""
    try:
        if os.name == "posix" and os.stat(path).st_mode & (stat.S_IRWXG | stat.S_IRWXO):
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


def read_tokens(path: str | Path) -> dict[str, Role]:
    """The secrets in the file of a server, each with its role; no other user may read the file.

    The file holds one secret, which administers, or lines of a role and a secret: ``drive 2Yb7...``. Empty lines and
    those that begin with # are skipped. `InvalidValue` for another file; the text shows no secret.
    """
    numbered = enumerate(read_token(path).splitlines(), 1)
    lines = {number: line.split() for number, line in numbered if line.strip() and not line.strip().startswith("#")}
    if len(lines) == 1 and len(words := next(iter(lines.values()))) == 1:
        return {words[0]: "administer"}
    secrets: dict[str, Role] = {}
    for number, words in lines.items():
        role = next((one for one in ROLES if one == words[0]), None)
        if len(words) != 2 or role is None:
            raise InvalidValue(
                f"The token file {path}, line {number}: expected watch, drive or administer, a blank and a token; or "
                "one token alone in the file, which administers."
            )
        if secrets.setdefault(words[1], role) != role:
            raise InvalidValue(
                f"The token file {path}, line {number}: its token has another role above; make a new one."
            )
    if not secrets:
        raise InvalidValue(f"The token file {path} is empty; put a secret into it.")
    return secrets


class Tokens:
    """The secrets of one server, each with the role that it gives; `otherwise` is the role of who shows none.

    With `otherwise` None a client must show one. `InvalidValue` for an empty secret.
    """

    def __init__(self, secrets: Mapping[str, Role] | None = None, otherwise: Role | None = None) -> None:
        self.version = 0
        """Grows whenever the secrets change."""
        self.otherwise = otherwise
        self._secrets = dict(secrets or {})
        if "" in self._secrets:
            raise InvalidValue("Token: expected a text, found an empty one.")

    @classmethod
    def of_clients(cls, client: str | None = None, operator: str | None = None) -> Tokens:
        """Those of a server with one secret for clients, who drive, and one for operators, who administer; or None."""
        if operator is not None and operator == client:
            raise InvalidValue("The operator's token must be another one than that of the clients.")
        given: tuple[tuple[str | None, Role], ...] = ((client, "drive"), (operator, "administer"))
        return cls({secret: role for secret, role in given if secret is not None}, "drive" if client is None else None)

    @property
    def needed(self) -> bool:
        """Whether a client must show a secret."""
        return self.otherwise is None

    @property
    def exist(self) -> bool:
        """Whether there is anything to show."""
        return bool(self._secrets)

    @property
    def roles(self) -> set[Role]:
        """The roles that secrets give."""
        return set(self._secrets.values())

    def role(self, shown: Iterable[str]) -> Role | None:
        """The highest role that one of these secrets gives; None if all are wrong."""
        given: list[Role] = []
        # In constant time: the duration of a refusal must not reveal how much of the token was right.
        for text in shown:
            data = text.encode("utf-8", "surrogatepass")  # a stranger may send anything, even invalid text
            given += [role for secret, role in self._secrets.items() if hmac.compare_digest(data, secret.encode())]
        return max(given, key=ROLES.index, default=None)

    def refresh(self) -> None:
        """Read the secrets again if their file has changed; without a file there is nothing to do."""


class TokenFile(Tokens):
    """The secrets of `read_tokens`, read again when the file changes; a file with a mistake changes nothing."""

    def __init__(self, path: str | Path) -> None:
        self._path, self._stamp = Path(path), _stamp(path)
        super().__init__(read_tokens(path))

    def refresh(self) -> None:
        """Read the file again if it has changed; a mistake in it is logged, once, and the secrets stay as they are."""
        stamp, self._stamp = self._stamp, _stamp(self._path)
        if stamp == self._stamp:
            return
        try:
            self._secrets = read_tokens(self._path)
        except InvalidValue as error:
            _log.warning("The tokens stay as they were: %s", error)
            return
        self.version += 1
        _log.warning("The token file %s has changed; its tokens are the valid ones now.", self._path)


def _stamp(path: str | Path) -> tuple[int, ...]:
    try:
        status = os.stat(path)
    except OSError:
        return ()
    return status.st_mtime_ns, status.st_size, status.st_ino, status.st_mode


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
            now, recent = self._clock(), self._wrong.get(network_of(address))
            if recent is None or now - recent[-1] > _LATELY:
                return True
            # Full queues (4 of one address, 32 of all) whose oldest entry is not a second old.
            return not any(len(times) == times.maxlen and now - times[0] < _WINDOW for times in (recent, self._all))

    def wrong(self, address: str) -> None:
        """Record a wrong token from `address`."""
        with self._lock:
            network = network_of(address)
            recent = self._wrong.pop(network, None) or deque(maxlen=_OF_ONE)
            self._wrong[network] = recent
            for times in (recent, self._all):
                times.append(self._clock())
            if len(self._wrong) > _MOST_ADDRESSES:
                del self._wrong[next(iter(self._wrong))]


def network_of(address: str) -> str:
    """The addresses that one attacker surely has: one of IPv4, a network of 64 bits of IPv6."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv6Address):
        mapped = parsed.ipv4_mapped
        return str(mapped) if mapped is not None else str(ipaddress.ip_network((parsed, 64), strict=False))
    return str(parsed)


class Client(Protocol):
    """A client, as far as its place is concerned."""

    host: str
    """Its network address."""
    role: Role | None
    """What it may do; None counts as the least role."""
    born: float
    """When it connected [s, monotonic]."""
    spoke: float
    """When it last sent a message after its admission [s, monotonic]; 0 if it has sent none."""


AnyClient = TypeVar("AnyClient", bound=Client)


def places(most: int, role: Role, known: Iterable[Role]) -> int:
    """How many of `most` places are open to a role, if the server has tokens of the roles `known`."""
    return most - most // _KEPT * sum(ROLES.index(one) > ROLES.index(role) for one in set(known))


def who_leaves(newcomer: Client, present: Sequence[AnyClient]) -> AnyClient | None:
    """The client that gives its place to a newcomer where all are taken; None if everybody may stay.

    Nobody leaves for a lower role. Who never sent a message leaves first, the oldest of the address with the most of
    them. Then an address with at least two more clients than that of the newcomer gives up the one that has been silent
    for longest: whoever drives is the last one of these.
    """
    rank = _rank(newcomer)
    rivals = [one for one in present if _rank(one) <= rank]
    among = [one for one in rivals if not one.spoke] or rivals
    counts = Counter(network_of(one.host) for one in among)
    if not counts:
        return None
    where, most = counts.most_common(1)[0]
    leaves = min((one for one in among if network_of(one.host) == where), key=lambda one: one.spoke or one.born)
    return None if leaves.spoke and most < counts[network_of(newcomer.host)] + 2 else leaves


def _rank(client: Client) -> int:
    return 0 if client.role is None else ROLES.index(client.role)


class Refusals:
    """Logs who was refused, and why. Equal lines come at most once a second, with the number of those left out.

    Not thread-safe.
    """

    def __init__(self, logger: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._logger, self._clock = logger, clock
        self._seen: dict[tuple[str, str], tuple[float, int]] = {}  # the oldest first

    def note(self, who: str, why: str) -> None:
        """Log one refusal. `why` is one line that shows no secret, and of what a stranger sent only a short part."""
        now, key = self._clock(), (who, why)
        at, more = self._seen.get(key, (now - _REPEAT_PERIOD, 0))
        if now - at < _REPEAT_PERIOD:
            self._seen[key] = at, more + 1
            return
        self._logger.warning("%s was refused: %s%s", who, why, f" (and {more} times before)" if more else "")
        self._seen.pop(key, None)
        self._seen[key] = now, 0
        if len(self._seen) > _MOST_LINES:
            del self._seen[next(iter(self._seen))]
