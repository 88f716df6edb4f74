"""The other end of robots and transports: an environment and its simulated robot, served to many clients."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bam_envs.core.on_use import imported_on_use

if TYPE_CHECKING:
    from bam_envs.remote.serve.env_server import EnvServer
    from bam_envs.remote.serve.options import ServeOptions
    from bam_envs.remote.serve.program import ServedEnvironment
    from bam_envs.remote.serve.tcp_server import TcpServer

_MODULES = {
    "EnvServer": "bam_envs.remote.serve.env_server",
    "ServeOptions": "bam_envs.remote.serve.options",
    "ServedEnvironment": "bam_envs.remote.serve.program",
    "TcpServer": "bam_envs.remote.serve.tcp_server",
}
"""Name to the module that has it."""

__all__ = [
    "EnvServer",
    "ServeOptions",
    "ServedEnvironment",
    "TcpServer",
]

__getattr__, __dir__ = imported_on_use(__name__, _MODULES)
