"""FakeTransport: a transport for tests, which notes what it was asked and fails when it is told to."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from bam_envs.remote.serve.describe import Env
from bam_envs.remote.transports.local import LocalTransport
from bam_envs.remote.transports.transport import EnvSpecMessage, Info


class FakeEnv(gym.Env[Any, Any]):
    """Its observations are samples of their space; the reward is the number of the step.

    Args:
        observation_space: Three numbers by default.
        action_space: Two numbers from -1 to 1 by default.
        episode_steps: Steps after which an episode is terminated.
    """

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
        steps: NDArray[np.int32] = np.array([self.elapsed], np.int32)
        info = {"elapsed": self.elapsed, "steps": steps}
        return self.observation_space.sample(), float(self.elapsed), self.elapsed >= self.episode_steps, False, info


class FakeTransport:
    """Carries nothing anywhere.

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
        self._inner = LocalTransport(FakeEnv() if env is None else env)
        self.calls: list[tuple[Any, ...]] = []
        """Every call: its name and its arguments."""
        self.faults: deque[BaseException] = deque()
        """Raised by the next calls of `reset` and `step`, one each, which do nothing then."""

    def connect(self) -> EnvSpecMessage:
        """What is there."""
        self.calls.append(("connect",))
        return self._inner.connect()

    def reset(self, seed: int | list[int | None] | None = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; (observation, info)."""
        self._note("reset", seed, options)
        return self._inner.reset(seed, options)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info)."""
        self._note("step", action)
        return self._inner.step(action)

    def close(self) -> None:
        """Let go of the environment."""
        self.calls.append(("close",))
        self._inner.close()

    def _note(self, *call: Any) -> None:
        self.calls.append(call)
        if self.faults:
            raise self.faults.popleft()
