"""Addresses of rosbridge servers: ``ws://host:port/namespace``, or ``wss://`` for TLS."""

from __future__ import annotations

import re
from dataclasses import dataclass
from urllib.parse import SplitResult, urlsplit

from bam_envs.core.errors import InvalidValue

DEFAULT_PORT = 9090
_NAMESPACE = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)*")
_EXAMPLE = "Expected ws://host:port or wss://host:port, with a namespace behind it if there is one."


@dataclass(frozen=True)
class Address:
    """Where a server is, and the namespace of what is meant there."""

    host: str
    """Name or IP address."""
    port: int
    """TCP port."""
    secure: bool
    """Whether TLS is spoken."""
    namespace: str
    """What goes before each topic, e.g. ``/bam_001``; empty without one. It is not sent to the server."""

    @property
    def url(self) -> str:
        """As given, without the namespace."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'wss' if self.secure else 'ws'}://{host}:{self.port}"


def parse_address(url: str) -> Address:
    """Read an address; the port is rosbridge's 9090 where it is left out.

    Raises:
        InvalidValue: It is not such an address.
    """
    parts = _split(url)
    if parts.scheme not in ("ws", "wss"):
        raise InvalidValue(f"Address {url!r} has the scheme {parts.scheme!r}. {_EXAMPLE}")
    if not parts.hostname:
        raise InvalidValue(f"Address {url!r} names no host. {_EXAMPLE}")
    if parts.query or parts.fragment or parts.username is not None:
        raise InvalidValue(f"Address {url!r} has more than host, port and namespace. {_EXAMPLE}")
    return Address(parts.hostname, _port(url, parts), parts.scheme == "wss", _namespace(url, parts.path))


def require_tls(url: str, ca_file: object) -> None:
    """A file of authorities is given only where there is TLS to use it.

    Raises:
        InvalidValue: `url` has none.
    """
    if ca_file is not None and not url.startswith("wss://"):
        raise InvalidValue(f"{url}: ca_file says whom wss:// trusts, and this address is without TLS; leave it out.")


def _split(url: str) -> SplitResult:
    try:
        parts = urlsplit(url)
        (parts.hostname or "").encode("idna")
        if "\0" in url:
            raise ValueError("a NUL character")
    except ValueError as error:  # brackets, or a name that cannot be looked up
        raise InvalidValue(f"Address {url!r} has a host that is none: {error}. {_EXAMPLE}") from error
    return parts


def _port(url: str, parts: SplitResult) -> int:
    try:
        port = parts.port
    except ValueError as error:
        raise InvalidValue(f"Address {url!r} has a port that is none: {error}. {_EXAMPLE}") from error
    if port == 0:
        raise InvalidValue(f"Address {url!r} has port 0, which no server has. {_EXAMPLE}")
    return DEFAULT_PORT if port is None else port


def _namespace(url: str, path: str) -> str:
    namespace = path.rstrip("/")
    if not _NAMESPACE.fullmatch(namespace):
        raise InvalidValue(
            f"Address {url!r} has the namespace {namespace!r}. "
            "Expected names of letters, digits and underscores, each after a slash, e.g. /bam_001."
        )
    return namespace
