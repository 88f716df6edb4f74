"""The link of a client to a rosbridge server, and a stream of large messages."""

from bam_envs.rosbridge.link.link import RosbridgeLink

__all__ = ["RosbridgeLink"]
