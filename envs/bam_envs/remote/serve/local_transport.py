"""Transports within one process: `LocalTransport`, with the checks of the others, and `FakeTransport` for tests."""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import Space, spaces

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, RemoteError
from bam_envs.remote.serve.env_server import Env, EnvServer
from bam_envs.remote.transport import EnvSpecMessage, Info, Seed


class LocalTransport:
    """An environment in this process, without a network. Results are those of the other transports bit for bit.

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
        self._enter("connect")
        return self.server.spec()

    def reset(self, seed: Seed = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; (observation, info)."""
        self._enter("reset", seed, options)
        with _as_over_a_network():
            return self.server.reset(self.client, seed, options)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info)."""
        self._enter("step", action)
        with _as_over_a_network():
            return self.server.step(self.client, action)

    def close(self) -> None:
        """Release the environment; one that no server shares is closed."""
        self._enter("close")
        self._closed = True
        self.server.leave(self.client)
        if self._owned:
            self.server.close()

    def _enter(self, call: str, *arguments: Any) -> None:
        if self._closed and call != "close":
            raise LinkLost("This transport is closed; make a new one.")


@contextmanager
def _as_over_a_network() -> Iterator[None]:
    """Raise the errors of the server as the client of another transport gets them."""
    try:
        yield
    except (RemoteError, InvalidValue):
        raise
    except BamEnvsError as error:
        raise RemoteError(str(error)) from error


class FakeEnv(gym.Env[Any, Any]):
    """Its observations are samples of their space; the reward is the number of the step, at most `episode_steps`."""

    def __init__(
        self,
        observation_space: Space[Any] | None = None,
        action_space: Space[Any] | None = None,
        episode_steps: int = 10,
    ) -> None:
        self.observation_space = observation_space or spaces.Box(-10.0, 10.0, (3,))
        self.action_space = action_space or spaces.Box(-1.0, 1.0, (2,))
        self.episode_steps, self.elapsed = episode_steps, 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Begin an episode; the info holds the options."""
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.elapsed = 0
        return self.observation_space.sample(), {"options": options or {}}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """One step; the info holds the number of the step, also as an array."""
        self.elapsed += 1
        info = {"elapsed": self.elapsed, "steps": np.array([self.elapsed], np.int32)}
        return self.observation_space.sample(), float(self.elapsed), self.elapsed >= self.episode_steps, False, info


class FakeTransport(LocalTransport):
    """Records its calls, and raises the faults that a test queues.

    ::

        transport = FakeTransport()
        env = RemoteEnv(transport)
        env.reset(seed=1)
        transport.faults.append(LinkLost("the cable is out"))
        env.step(env.action_space.sample())  # raises it
        assert transport.calls == [("connect",), ("reset", 1, None), ("step", …)]

    Args:
        env: What it carries; a `FakeEnv` by default.
    """

    def __init__(self, env: Env | None = None) -> None:
        super().__init__(FakeEnv() if env is None else env)
        self.calls: list[tuple[Any, ...]] = []
        """Every call: its name and its arguments."""
        self.faults: deque[BaseException] = deque()
        """Raised by the next calls of `reset` and `step`, one each, which do nothing then."""

    def _enter(self, call: str, *arguments: Any) -> None:
        self.calls.append((call, *arguments))
        if self.faults and call in ("reset", "step"):
            raise self.faults.popleft()
        super()._enter(call, *arguments)
