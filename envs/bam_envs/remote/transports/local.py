"""LocalTransport: an environment in this process behind the same checks as one far away."""

from __future__ import annotations

from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, RemoteError
from bam_envs.remote.serve.describe import Env
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.transports.transport import EnvSpecMessage, Info


class LocalTransport:
    """Carries nothing anywhere. Results are those of the other transports bit for bit.

    Args:
        env: A Gymnasium environment, a vector environment (see `EnvServer`), or a server, which others may share.
        client: How a shared server names this one.
    """

    def __init__(self, env: Env | EnvServer, client: str = "local") -> None:
        self.server = env if isinstance(env, EnvServer) else EnvServer(env)
        self.client = client
        self._owned = not isinstance(env, EnvServer)
        self._closed = False

    def connect(self) -> EnvSpecMessage:
        """What is there."""
        self._require_open()
        return self.server.spec()

    def reset(self, seed: int | list[int | None] | None = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; (observation, info)."""
        self._require_open()
        try:
            return self.server.reset(self.client, seed, options)
        except (RemoteError, InvalidValue):
            raise
        except BamEnvsError as error:
            raise RemoteError(str(error)) from error

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info)."""
        self._require_open()
        try:
            return self.server.step(self.client, action)
        except (RemoteError, InvalidValue):
            raise
        except BamEnvsError as error:
            raise RemoteError(str(error)) from error

    def close(self) -> None:
        """Let go of the environment; one that no server shares is closed."""
        self._closed = True
        self.server.leave(self.client)
        if self._owned:
            self.server.close()

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost("This transport is closed; make a new one.")
