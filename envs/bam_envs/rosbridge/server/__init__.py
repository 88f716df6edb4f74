"""The rosbridge server: a core without I/O, and the sockets around it."""

from bam_envs.rosbridge.server.options import ServerOptions
from bam_envs.rosbridge.server.server import BridgeServer

__all__ = ["BridgeServer", "ServerOptions"]
