"""Small environments whose every number can be told beforehand."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from bam_train.loop import Workspace


class Counting(gym.Env):
    """Observes (episode, step); the reward is 10 x episode + step; ends after `length` steps.

    It says how it was reset and stepped, and refuses to be stepped when no episode is running.
    """

    def __init__(self, length=3, limit=None, actions=None):
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = spaces.Discrete(100) if actions is None else actions
        self.length, self.limit = length, limit
        self.episode, self.count, self.running = 0, 0, False
        self.seeds, self.actions, self.closed = [], [], False

    def observe(self):
        return np.array([self.episode, self.count], dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.episode, self.count, self.running = self.episode + 1, 0, True
        return self.observe(), {"is_success": False}

    def step(self, action):
        if not self.running:
            raise RuntimeError("stepped after the end")
        self.actions.append(action)
        self.count += 1
        terminated, truncated = self.count == self.length, self.count == self.limit
        self.running = not (terminated or truncated)
        info = {"is_success": terminated}
        if self.count % 2:
            info["odd"] = self.count
        if terminated:
            info["length"] = float(self.count)
        return self.observe(), 10 * self.episode + self.count, terminated, truncated, info

    def close(self):
        self.closed = True


class Fixed(Counting):
    """Gives one observation for ever."""

    def __init__(self, observation, space, **kwargs):
        super().__init__(**kwargs)
        self.observation, self.observation_space = observation, space

    def observe(self):
        return self.observation


def run(agent, steps, workspace=None, first=0, act=None, **kwargs):
    """Run an agent of one environment or several with actions 1, 2, 3, ..., or what `act` says."""
    workspace = Workspace() if workspace is None else workspace
    for t in range(first, first + steps):
        agent(workspace, t=t, **kwargs)
        action = act(t) if act else torch.full((agent.num_envs,), t + 1)
        workspace.set("action", t, action if agent.arrays == "torch" else np.asarray(action))
    return workspace


def column(workspace, name, row=0):
    """All times of one row as plain values."""
    return workspace[name][:, row].tolist()


@pytest.fixture
def toys():
    """The environments and helpers of this file."""
    return SimpleNamespace(Counting=Counting, Fixed=Fixed, run=run, column=column)
