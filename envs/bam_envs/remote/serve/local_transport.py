"""LocalTransport: a transport within one process, with the checks of the others."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, RemoteError
from bam_envs.remote.serve.env_server import Env, EnvServer
from bam_envs.remote.wire.transport import EnvSpecMessage, Info, Seed


class LocalTransport:
    """An environment in this process, without a network. Results equal those of the other transports bit for bit.

    Args:
        env: An environment (see `EnvServer`), or a server, which others may share.
        client: The name of this client for a shared server.
    """

    def __init__(self, env: Env | EnvServer, client: str = "local") -> None:
        self.server = env if isinstance(env, EnvServer) else EnvServer(env)
        self.client = client
        self._owned = not isinstance(env, EnvServer)
        self._closed = False

    def connect(self) -> EnvSpecMessage:
        """Return the description of the environment."""
        self._require_open()
        return self.server.spec()

    def reset(self, seed: Seed = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; (observation, info)."""
        self._require_open()
        with _as_over_a_network():
            begun: tuple[Any, Any] = self.server.spec().exact(self.server.reset(self.client, seed, options))
        return begun

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info)."""
        self._require_open()
        with _as_over_a_network():
            stepped: tuple[Any, Any, Any, Any, Any]
            stepped = self.server.spec().exact(self.server.step(self.client, action))
        return stepped

    def close(self) -> None:
        """Release the environment, and close it unless it came with a server."""
        self._closed = True
        self.server.leave(self.client)
        if self._owned:
            self.server.close()

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost("This transport is closed; make a new one.")


@contextmanager
def _as_over_a_network() -> Iterator[None]:
    """Raise the server's errors as other transports do."""
    try:
        yield
    except (RemoteError, InvalidValue):
        raise
    except BamEnvsError as error:
        raise RemoteError(str(error)) from error
