"""What carries a whole environment: local, rosbridge (bam_msgs/GymAPI), TCP, native ROS 2."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bam_envs.transports.fake import FakeTransport
    from bam_envs.transports.local import LocalTransport
    from bam_envs.transports.opening import open_transport
    from bam_envs.transports.rclpy import RclpyTransport
    from bam_envs.transports.rosbridge import RosbridgeTransport
    from bam_envs.transports.tcp import TcpTransport
    from bam_envs.transports.transport import EnvSpecMessage, Transport

_MODULES = {
    "EnvSpecMessage": "bam_envs.transports.transport",
    "FakeTransport": "bam_envs.transports.fake",
    "LocalTransport": "bam_envs.transports.local",
    "RclpyTransport": "bam_envs.transports.rclpy",
    "RosbridgeTransport": "bam_envs.transports.rosbridge",
    "TcpTransport": "bam_envs.transports.tcp",
    "Transport": "bam_envs.transports.transport",
    "open_transport": "bam_envs.transports.opening",
}
"""Name to the module that has it; imported when it is used, so that nobody pays for the others."""

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


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
