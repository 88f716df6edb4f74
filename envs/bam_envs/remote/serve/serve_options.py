"""The options of a served environment: its addresses and how its time passes; imports no server."""

import re
from dataclasses import dataclass

from bam_envs.core.errors import InvalidValue
from bam_envs.core.location import Credentials, is_loopback
from bam_envs.core.validation import Port, Positive, RobotName, check_fields
from bam_envs.core.wording import as_flag
from bam_envs.remote.serve.command_lease import LEASE_SECONDS
from bam_envs.remote.wire.gymapi_versions import version_named

_NAMESPACE = re.compile(r"(/[A-Za-z]\w*)*")
DEFAULT_PORT = 9090
_EXCLUDE = (("realtime", "fast"), ("via", "rclpy"), ("via", "cert"), ("rclpy", "cert"), ("no_token", "token_file"))


@dataclass(frozen=True, kw_only=True)
class ServeOptions(Credentials):
    """The addresses of a served environment, and how its time passes.

    The token file has a secret that clients must show; with `via`, that of the server there, which `ca_file` is for.
    """

    port: Port | None = None
    """Port of the rosbridge server, 0 for a free one; 9090 by default, but none for a policy with --tcp alone."""
    bind: str = "127.0.0.1"
    """Address to listen on; 127.0.0.1 is this computer only, 0.0.0.0 all its networks."""
    namespace: str = ""
    """Prefix of every topic and service, such as bam_001."""
    name: RobotName = ""
    """Name that the robot tells its clients, to tell it from others: trials count for the robot of that name."""
    tcp: Port | None = None
    """Serve the environment on this TCP port too, which is faster; 0 takes a free one."""
    via: str | None = None
    """Offer everything through the rosbridge server at this address (ws://10.0.0.5:9090) instead of a new one."""
    rclpy: bool = False
    """Run as a ROS 2 node instead of a rosbridge server; needs rclpy."""
    realtime: bool = False
    """Time passes in real time: the default of an environment with a robot."""
    fast: bool = False
    """Time passes only with steps and commands, as fast as they come: the default of other environments."""
    lease: Positive = LEASE_SECONDS
    """Time without a sign of life after which a client may lose command to another one [s]."""
    cert: str | None = None
    """Certificate in PEM, for wss:// instead of ws://."""
    key: str | None = None
    """Its key, if it is in another file."""
    operator_token_file: str | None = None
    """File with another secret: clients that show it may take command from others."""
    no_token: bool = False
    """Listen on a network without a token: anybody who reaches this computer may command the environment."""
    image_format: str = "png"
    """Images as png, which keeps every bit, or jpeg."""
    gymapi_version: str | None = None
    """Version of bam_msgs/GymAPI, where clients do not show theirs: 2025-05-24, 2025-06-17 or 2025-06-22 (default)."""

    def require_sane(self) -> None:
        """Raise InvalidValue, with the flags, for values that are not possible and flags that exclude each other."""
        check_fields(self, as_flag)
        for one, other in _EXCLUDE:
            if getattr(self, one) and getattr(self, other):
                raise InvalidValue(f"{as_flag(one)} and {as_flag(other)} exclude each other; give one of the two.")
        if self.cert and self.tcp is not None:
            raise InvalidValue(
                "--tcp carries everything in the clear, and --cert does not change that; leave one of the two out."
            )
        for flag, value, needed in (("key", self.key, "cert"), ("ca-file", self.ca_file, "via")):
            if value and not getattr(self, needed):
                raise InvalidValue(f"--{flag} means something only with --{needed}.")
        if self.rclpy and self.token_file and self.tcp is None:
            raise InvalidValue("--token-file protects nothing with --rclpy: ROS 2 has no token. Leave it out.")
        if self.operator_token_file and not self.listens:
            raise InvalidValue("--operator-token-file means something only where clients connect to this program.")
        # Networks without a token need an explicit flag.
        if self._is_open and not self.token_file and not self.no_token:
            raise InvalidValue(
                f"Anybody who reaches {self._place} could command what is served here: give --token-file, or "
                "--bind 127.0.0.1; or --no-token, if everybody there is to."
            )
        if self.gymapi_version is not None:
            version_named(self.gymapi_version)
        if not _NAMESPACE.fullmatch(self.prefix):
            raise InvalidValue(f"--namespace must be letters, digits and _, such as bam_001, not {self.namespace!r}.")

    @property
    def listens(self) -> bool:
        """Whether clients connect to this program."""
        return self.tcp is not None or not (self.via or self.rclpy)

    @property
    def has_topics(self) -> bool:
        """Whether topics and services are asked for, and not the TCP port alone."""
        return self.tcp is None or self.port is not None or self.via is not None or self.rclpy

    @property
    def _is_open(self) -> bool:
        """Whether other computers reach it."""
        return self.listens and not is_loopback(self.bind)

    @property
    def _place(self) -> str:
        return self.bind or "every address of this computer"

    @property
    def warning(self) -> str | None:
        """A warning about an address that other computers reach, in one line; None if there is no reason for one."""
        if not self._is_open or self.cert:
            return None
        if self.no_token:
            return f"Anybody who reaches {self._place} may command what is served here, because of --no-token."
        clear = f"The token is sent unencrypted to {self._place}, and so is everything else"
        return f"{clear}: give --cert, or trust that network."

    @property
    def prefix(self) -> str:
        """The prefix of every name: ``/bam_001``, or an empty text."""
        stripped = self.namespace.strip("/")
        return f"/{stripped}" if stripped else ""
