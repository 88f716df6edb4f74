"""The other end of robots and transports: an environment and its simulated robot, served to many clients."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bam_envs.serve.env_server import EnvServer
    from bam_envs.serve.options import ServeOptions
    from bam_envs.serve.program import ServedEnvironment
    from bam_envs.serve.tcp_server import TcpServer

_MODULES = {
    "EnvServer": "bam_envs.serve.env_server",
    "ServeOptions": "bam_envs.serve.options",
    "ServedEnvironment": "bam_envs.serve.program",
    "TcpServer": "bam_envs.serve.tcp_server",
}
"""Name to the module that has it; imported when it is used, so that nobody pays for the others."""

__all__ = [
    "EnvServer",
    "ServeOptions",
    "ServedEnvironment",
    "TcpServer",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
