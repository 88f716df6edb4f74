"""The options of a live agent."""

from dataclasses import dataclass
from pathlib import Path

from bam_envs.rosbridge.endpoint import is_loopback
from bam_train.env_location import EnvLocation


@dataclass(frozen=True)
class AgentOptions:
    """What a live agent drives, what it listens to, and where it keeps its versions."""

    robot: str
    """Address of the robot behind rosbridge."""
    folder: Path
    """Folder of the versions, the audit file and the recordings."""
    profile: str | None = None
    guards: tuple[tuple[str, float], ...] = ()
    ca_file: str | None = None
    robot_token_file: str | None = None
    bind: str = "127.0.0.1"
    port: int = 9095
    cert: str | None = None
    key: str | None = None
    token_file: str | None = None
    keys: Path | None = None
    allow_unsigned: bool = False
    stage: str | None = None
    """``"trial"``, ``"full"``, or None: on trial if the robot is real."""
    i_know: bool = False
    seed: int = 1_000_000
    resume: bool = False
    """Whether a policy that ran before a take-over runs again when the robot is handed back."""
    lease: float = 30.0
    """Time without use after which a person loses the lease [s]."""
    guard_stops: int = 2
    """Number of stops by guards after which a candidate is rolled back."""
    unusual: str = "warn"
    """What unusual observations lead to: ``"warn"``, ``"hold"`` or ``"stop"``."""
    record: bool = True
    robot_name: str = ""
    """Name of the robot, where it does not tell its serial number or a name."""
    data: str | None = None
    """Data set to which the episodes of each recording are added at its end."""

    @property
    def warning(self) -> str | None:
        """A warning about an address that other computers reach, in one line; None if there is no reason for one."""
        if is_loopback(self.bind) or self.cert:
            return None
        return f"tokens and commands go over {self.bind} unencrypted: give --cert and --key, or trust that network"

    def place(self, *, trial: bool | None) -> EnvLocation:
        """The place of the robot."""
        return EnvLocation(
            self.robot,
            profile=self.profile,
            ca_file=self.ca_file,
            token_file=self.robot_token_file,
            guards=self.guards,
            trial=trial,
            robot_name=self.robot_name,
        )
