"""The options of a live agent."""

from dataclasses import dataclass
from pathlib import Path

from bam_envs.core.location import LiveRobot, is_loopback
from bam_envs.rosbridge.dialing import AGENT_PORT


@dataclass(frozen=True)
class AgentOptions:
    """What a live agent drives, what it listens to, and where it keeps its versions."""

    robot: LiveRobot
    """Where the robot is; the `stage` below counts, not the one in it."""
    folder: Path
    """Folder of the versions, the audit file and the recordings."""
    bind: str = "127.0.0.1"
    port: int = AGENT_PORT
    cert: Path | None = None
    key: Path | None = None
    token_file: Path | None = None
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
    no_record: bool = False
    record: str | None = None
    """Data set to which the episodes of each recording are added at its end."""

    @property
    def warning(self) -> str | None:
        """A warning about an address that other computers reach, in one line; None if there is no reason for one."""
        if is_loopback(self.bind) or self.cert:
            return None
        return f"tokens and commands go over {self.bind} unencrypted: give --cert and --key, or trust that network"
