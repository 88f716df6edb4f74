"""Where an environment is served, and how its time passes; imports nothing that serves."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass

from bam_envs.errors import InvalidValue

_NAMESPACE = re.compile(r"(/[A-Za-z]\w*)*")


@dataclass(frozen=True)
class ServeOptions:
    """Where an environment is served, and how its time passes."""

    port: int = 9090
    """Port of the rosbridge server; 0 takes a free one."""
    bind: str = "127.0.0.1"
    """Address to listen on; 127.0.0.1 is this computer alone, 0.0.0.0 every network it is in."""
    namespace: str = ""
    """Name before every topic and service, such as bam_001."""
    tcp: int | None = None
    """Serve the environment on this TCP port too, which is faster; 0 takes a free one."""
    via: str | None = None
    """Offer everything through the rosbridge server at this address (ws://10.0.0.5:9090) instead of one here."""
    rclpy: bool = False
    """Be a ROS 2 node instead of a rosbridge server; needs rclpy."""
    realtime: bool = False
    """Time passes as on the clock: the default of an environment with a robot."""
    fast: bool = False
    """Time passes only with steps and commands, as fast as they come: the default of other environments."""
    lease: float = 5.0
    """A client that is silent for so long may lose command to another one [s]."""
    cert: str | None = None
    """Certificate in PEM, for wss:// instead of ws://."""
    key: str | None = None
    """Its key, if it is in another file."""
    token_file: str | None = None
    """File with a secret that clients must show; with --via, the one to show there."""
    ca_file: str | None = None
    """With --via wss://: certificates to trust instead of the system's."""
    image_format: str = "png"
    """Images as png, which keeps every bit, or jpeg."""

    def require_sane(self) -> None:
        """Refuse what excludes each other.

        Raises:
            InvalidValue: Names the flags.
        """
        pairs = (("realtime", "fast"), ("via", "rclpy"), ("via", "cert"), ("rclpy", "cert"))
        for one, other in pairs:
            if getattr(self, one) and getattr(self, other):
                raise InvalidValue(f"--{one} and --{other} exclude each other; give one of the two.")
        if self.cert and self.tcp is not None:
            raise InvalidValue(
                "--tcp carries everything in the clear, and --cert does not change that; leave one of the two out."
            )
        for flag, value, needed in (("key", self.key, "cert"), ("ca-file", self.ca_file, "via")):
            if value and not getattr(self, needed):
                raise InvalidValue(f"--{flag} means something only with --{needed}.")
        if self.rclpy and self.token_file and self.tcp is None:
            raise InvalidValue("--token-file protects nothing with --rclpy: ROS 2 has no token. Leave it out.")
        if not self.lease > 0:
            raise InvalidValue(f"--lease must be above 0 s, not {self.lease:g}.")
        for flag, port in (("port", self.port), ("tcp", self.tcp)):
            if port is not None and not 0 <= port <= 65535:
                raise InvalidValue(f"--{flag} must be 0 to 65535, not {port}.")
        if not _NAMESPACE.fullmatch(self.prefix):
            raise InvalidValue(f"--namespace must be letters, digits and _, such as bam_001, not {self.namespace!r}.")

    @property
    def warning(self) -> str | None:
        """What people should know of where it listens, in one line; None if there is nothing."""
        listens = self.tcp is not None or not (self.via or self.rclpy)
        if not listens or self.token_file is not None or _is_loopback(self.bind):
            return None
        where = self.bind or "every address of this computer"
        return f"Anybody who reaches {where} may command what is served here: give --token-file, or --bind 127.0.0.1."

    @property
    def prefix(self) -> str:
        """What stands before every name: ``/bam_001``, or nothing."""
        stripped = self.namespace.strip("/")
        return f"/{stripped}" if stripped else ""


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name: only this one is sure to stay on this computer
        return host == "localhost"
