"""Environments that run in another process: transports to them, Gymnasium environments over these, and servers."""

from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bam_envs.remote.remote_env import RemoteEnv, make_remote_env, make_remote_vector_env, open_transport
    from bam_envs.remote.remote_vector_env import RemoteVectorEnv
    from bam_envs.remote.ros2_transport import RclpyTransport
    from bam_envs.remote.rosbridge_transport import RosbridgeTransport
    from bam_envs.remote.serve.env_server import EnvServer, LocalTransport
    from bam_envs.remote.serve.serve_options import ServeOptions
    from bam_envs.remote.serve.served_environment import ServedEnvironment
    from bam_envs.remote.serve.tcp_server import TcpServer
    from bam_envs.remote.tcp_transport import TcpTransport
    from bam_envs.remote.wire.transport import EnvSpecMessage, Transport

__all__ = ["EnvServer", "EnvSpecMessage", "LocalTransport", "RclpyTransport", "RemoteEnv"]
__all__ += ["RemoteVectorEnv", "RosbridgeTransport", "ServeOptions", "ServedEnvironment", "TcpServer", "TcpTransport"]
__all__ += ["Transport", "make_remote_env", "make_remote_vector_env", "open_transport"]

_MODULES = {
    "remote_env": ("RemoteEnv", "make_remote_env", "make_remote_vector_env", "open_transport"),
    "remote_vector_env": ("RemoteVectorEnv",),
    "ros2_transport": ("RclpyTransport",),
    "rosbridge_transport": ("RosbridgeTransport",),
    "serve.env_server": ("EnvServer", "LocalTransport"),
    "serve.serve_options": ("ServeOptions",),
    "serve.served_environment": ("ServedEnvironment",),
    "serve.tcp_server": ("TcpServer",),
    "tcp_transport": ("TcpTransport",),
    "wire.transport": ("EnvSpecMessage", "Transport"),
}


def __getattr__(name: str) -> Any:
    """Import a public name on use (PEP 562)."""
    module = next((module for module, names in _MODULES.items() if name in names), None)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return resolve_name(f"{__name__}.{module}:{name}")


def __dir__() -> list[str]:
    return sorted(__all__)
