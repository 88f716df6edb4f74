"""The address of a server and the credentials of a client, in one frozen value."""

import re
import ssl
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple
from urllib.parse import urlsplit

from bam_envs.core.errors import InvalidValue
from bam_envs.core.location import NO_CREDENTIALS, Credentials, LiveRobot, require_real
from bam_envs.core.validation import RobotName, check
from bam_envs.rosbridge.tokens import read_token

_DEFAULT_PORT = 9090
_NAMESPACE = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)*")
_EXAMPLE = "Expected ws://host:port or wss://host:port, followed by a namespace if there is one."


class Address(NamedTuple):
    """The parts of the URL of a rosbridge server."""

    host: str
    port: int
    secure: bool  # whether the connection uses TLS
    namespace: str  # prefix of each topic and service, e.g. `/bam_001`; empty without one. It is not sent to the server

    @property
    def url(self) -> str:
        """The URL without the namespace."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'wss' if self.secure else 'ws'}://{host}:{self.port}"


@dataclass(frozen=True)
class Endpoint:
    """The address of a rosbridge server (``ws://``, ``wss://``) or of a whole environment (``tcp://``, …).

    `InvalidValue` for an address, a token, a name or a timeout that is not valid, and for a `ca_file` without TLS.
    """

    url: str
    """``ws://host:port/namespace`` or ``wss://…`` (TLS); transports also take ``tcp://host:port`` and ``ros2://…``."""
    credentials: Credentials = NO_CREDENTIALS
    """The files of certificates and of the token."""
    token: str | None = field(default=None, repr=False)
    """Shared secret of the server, sent as a bearer token; by default the one in the token file."""
    connect_timeout: float = 3.0
    """Longest time to connect [s]."""
    timeout: float | None = None
    """Longest time to wait for an answer [s]; None: the default of the caller."""
    robot_name: str = ""
    """Name of the robot there, as its operator knows it; empty if the robot tells it, or none is known."""
    stand_in: str = LiveRobot.stand_in
    """See `LiveRobot`."""

    def __post_init__(self) -> None:
        require_real(self.url)
        if self.token is None and self.credentials.token_file is not None:
            object.__setattr__(self, "token", read_token(self.credentials.token_file))
        if self.url.startswith(("ws://", "wss://")):
            self.address  # noqa: B018 - parsed here to report a wrong one at once
            if self.token is not None and not re.fullmatch(r"[!-~]+", self.token):
                raise InvalidValue(
                    "The token is empty, or contains blanks, line ends or characters beyond ASCII, which HTTP headers "
                    "cannot carry. Read a token file without its line end."
                )
        if self.credentials.ca_file is not None and not self.url.startswith("wss://"):
            raise InvalidValue(
                f"{self.url}: ca_file is for wss:// only, and this address is without TLS; leave it out."
            )
        check(self.robot_name, RobotName, "robot_name")
        for name, value in (("connect_timeout", self.connect_timeout), ("timeout", self.timeout)):
            if value is not None and not value > 0:
                raise InvalidValue(f"{name}: expected a time above 0 s, found {value!r}.")

    @classmethod
    def of(cls, robot: LiveRobot) -> "Endpoint":
        """The server of a live robot with an address."""
        return cls(robot.url, robot.credentials, robot_name=robot.robot_name, stand_in=robot.stand_in)

    @cached_property
    def address(self) -> Address:
        """The parts of `url`, with port 9090 by default; `InvalidValue` for a wrong one."""
        url = self.url
        try:
            parts = urlsplit(url)
            (parts.hostname or "").encode("idna")
            if "\0" in url:
                raise ValueError("a NUL character")
        except ValueError as error:  # brackets, or a name that cannot be looked up
            raise InvalidValue(f"Address {url!r} has an invalid host: {error}. {_EXAMPLE}") from error
        if parts.scheme not in ("ws", "wss"):
            raise InvalidValue(f"Address {url!r} has the scheme {parts.scheme!r}. {_EXAMPLE}")
        if not parts.hostname:
            raise InvalidValue(f"Address {url!r} names no host. {_EXAMPLE}")
        if parts.query or parts.fragment or parts.username is not None:
            raise InvalidValue(f"Address {url!r} has more than host, port and namespace. {_EXAMPLE}")
        namespace = parts.path.rstrip("/")
        if not _NAMESPACE.fullmatch(namespace):
            raise InvalidValue(
                f"Address {url!r} has the namespace {namespace!r}. "
                "Expected names of letters, digits and underscores, each after a slash, e.g. /bam_001."
            )
        try:
            port = _DEFAULT_PORT if parts.port is None else parts.port
            if port == 0:
                raise ValueError("no server has port 0")
        except ValueError as error:
            raise InvalidValue(f"Address {url!r} has an invalid port: {error}. {_EXAMPLE}") from error
        return Address(parts.hostname, port, parts.scheme == "wss", namespace)

    def tls_context(self) -> ssl.SSLContext | None:
        """TLS settings that check certificate and host name; None without TLS. `InvalidValue` for a bad CA file."""
        if not self.address.secure:
            return None
        try:
            return ssl.create_default_context(cafile=self.credentials.ca_file)
        except OSError as error:
            reason = error.strerror or error
            raise InvalidValue(
                f"CA file {self.credentials.ca_file!r} cannot be used: {reason}. Give a file of certificates in PEM."
            ) from error
