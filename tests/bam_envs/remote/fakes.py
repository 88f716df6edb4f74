"""An environment and a transport of which tests know everything."""

from collections import deque

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from bam_envs.remote.serve.env_server import LocalTransport


class FakeEnv(gym.Env):
    """Its observations are samples of their space; the reward is the number of the step, at most `episode_steps`."""

    def __init__(self, observation_space=None, action_space=None, episode_steps=10):
        self.observation_space = observation_space or spaces.Box(-10.0, 10.0, (3,))
        self.action_space = action_space or spaces.Box(-1.0, 1.0, (2,))
        self.episode_steps, self.elapsed = episode_steps, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.elapsed = 0
        return self.observation_space.sample(), {"options": options or {}}

    def step(self, action):
        self.elapsed += 1
        info = {"elapsed": self.elapsed, "steps": np.array([self.elapsed], np.int32)}
        return self.observation_space.sample(), float(self.elapsed), self.elapsed >= self.episode_steps, False, info


class FakeTransport(LocalTransport):
    """Keeps its calls; the next calls of `reset` and `step` raise the faults and do nothing."""

    def __init__(self, env=None):
        super().__init__(FakeEnv() if env is None else env)
        self.calls, self.faults = [], deque()

    def connect(self):
        self.calls.append(("connect",))
        return super().connect()

    def reset(self, seed=None, options=None):
        self._keep("reset", seed, options)
        return super().reset(seed, options)

    def step(self, action):
        self._keep("step", action)
        return super().step(action)

    def close(self):
        self.calls.append(("close",))
        super().close()

    def _keep(self, *call):
        self.calls.append(call)
        if self.faults:
            raise self.faults.popleft()
