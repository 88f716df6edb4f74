"""Environments that run in another process: transports to them, Gymnasium environments over these, and servers."""

from typing import TYPE_CHECKING

from bam_envs.core.lazy_imports import lazy_imports

if TYPE_CHECKING:
    from bam_envs.remote.remote_env import RemoteEnv, make_remote_env, make_remote_vector_env, open_transport
    from bam_envs.remote.remote_vector_env import RemoteVectorEnv
    from bam_envs.remote.ros2_transport import RclpyTransport
    from bam_envs.remote.rosbridge_transport import RosbridgeTransport
    from bam_envs.remote.serve.env_server import EnvServer
    from bam_envs.remote.serve.local_transport import FakeTransport, LocalTransport
    from bam_envs.remote.serve.serve_options import ServeOptions
    from bam_envs.remote.serve.served_environment import ServedEnvironment
    from bam_envs.remote.serve.tcp_server import TcpServer
    from bam_envs.remote.tcp_transport import TcpTransport
    from bam_envs.remote.transport import EnvSpecMessage, Transport

_MODULES = {
    "EnvServer": "bam_envs.remote.serve.env_server",
    "EnvSpecMessage": "bam_envs.remote.transport",
    "FakeTransport": "bam_envs.remote.serve.local_transport",
    "LocalTransport": "bam_envs.remote.serve.local_transport",
    "RclpyTransport": "bam_envs.remote.ros2_transport",
    "RemoteEnv": "bam_envs.remote.remote_env",
    "RemoteVectorEnv": "bam_envs.remote.remote_vector_env",
    "RosbridgeTransport": "bam_envs.remote.rosbridge_transport",
    "ServeOptions": "bam_envs.remote.serve.serve_options",
    "ServedEnvironment": "bam_envs.remote.serve.served_environment",
    "TcpServer": "bam_envs.remote.serve.tcp_server",
    "TcpTransport": "bam_envs.remote.tcp_transport",
    "Transport": "bam_envs.remote.transport",
    "make_remote_env": "bam_envs.remote.remote_env",
    "make_remote_vector_env": "bam_envs.remote.remote_env",
    "open_transport": "bam_envs.remote.remote_env",
}

__all__ = [
    "EnvServer",
    "EnvSpecMessage",
    "FakeTransport",
    "LocalTransport",
    "RclpyTransport",
    "RemoteEnv",
    "RemoteVectorEnv",
    "RosbridgeTransport",
    "ServeOptions",
    "ServedEnvironment",
    "TcpServer",
    "TcpTransport",
    "Transport",
    "make_remote_env",
    "make_remote_vector_env",
    "open_transport",
]

__getattr__, __dir__ = lazy_imports(__name__, _MODULES)
