"""What carries a whole environment: local, rosbridge (bam_msgs/GymAPI), TCP, native ROS 2."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bam_envs.core.on_use import imported_on_use

if TYPE_CHECKING:
    from bam_envs.remote.transports.fake import FakeTransport
    from bam_envs.remote.transports.local import LocalTransport
    from bam_envs.remote.transports.opening import open_transport
    from bam_envs.remote.transports.rclpy import RclpyTransport
    from bam_envs.remote.transports.rosbridge import RosbridgeTransport
    from bam_envs.remote.transports.tcp import TcpTransport
    from bam_envs.remote.transports.transport import EnvSpecMessage, Transport

_MODULES = {
    "EnvSpecMessage": "bam_envs.remote.transports.transport",
    "FakeTransport": "bam_envs.remote.transports.fake",
    "LocalTransport": "bam_envs.remote.transports.local",
    "RclpyTransport": "bam_envs.remote.transports.rclpy",
    "RosbridgeTransport": "bam_envs.remote.transports.rosbridge",
    "TcpTransport": "bam_envs.remote.transports.tcp",
    "Transport": "bam_envs.remote.transports.transport",
    "open_transport": "bam_envs.remote.transports.opening",
}
"""Name to the module that has it."""

__all__ = [
    "EnvSpecMessage",
    "FakeTransport",
    "LocalTransport",
    "RclpyTransport",
    "RosbridgeTransport",
    "TcpTransport",
    "Transport",
    "open_transport",
]

__getattr__, __dir__ = imported_on_use(__name__, _MODULES)
