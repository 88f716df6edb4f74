"""How a rosbridge server treats its clients."""

from __future__ import annotations

from dataclasses import dataclass, field

from bam_envs.rosbridge.server.outbox import OutboxLimits
from bam_envs.rosbridge.server.session import Limits


@dataclass(frozen=True)
class ServerOptions:
    """Options of a `BridgeServer`."""

    max_clients: int = 256
    """Most clients at the same time; the next one is told 503."""
    limits: Limits = field(default_factory=Limits)
    """What one client may use."""
    outbox: OutboxLimits = field(default_factory=OutboxLimits)
    """How much may wait for a client that reads slowly."""
    open_timeout: float = 5.0
    """A socket must have become a WebSocket by then [s]."""
    ping_interval: float = 1.0
    """How often a client is asked whether it is still there [s]: who drives and does not answer loses command soon."""
    ping_timeout: float = 20.0
    """How long its answer may take [s]."""
    close_timeout: float = 1.0
    """How long a client may take to say goodbye [s]."""
