"""The rosbridge server: a protocol without I/O, and the sockets around it."""

from bam_envs.rosbridge.server.bridge_server import BridgeServer
from bam_envs.rosbridge.server.client_session import ServerOptions
from bam_envs.rosbridge.server.site import Page, Site, read_pages

__all__ = ["BridgeServer", "Page", "ServerOptions", "Site", "read_pages"]
