"""A tiny environment whose every number can be worked out by hand."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest


class Corridor(gym.Env):
    """Cells 0 to 4; starts in 1, 2 or 3; action 0 goes left, 1 right. Cell 4 is the goal, cell 0 a hole; each step costs 0.25."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    observation_space = gym.spaces.Box(0.0, 4.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, says_success=True, slow=False, render_mode=None):
        self.says_success, self.slow, self.render_mode = says_success, slow, render_mode
        self.cell = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = int(self.np_random.integers(1, 4))
        return self._observation(), {}

    def step(self, action):
        self.cell += 0 if self.slow else 2 * int(action) - 1
        info = {"is_success": self.cell == 4} if self.says_success else {}
        return self._observation(), -0.25 + float(self.cell == 4), self.cell in (0, 4), False, info

    def _observation(self):
        return np.array([self.cell], np.float32)

    def render(self):
        picture = np.zeros((8, 40, 3), np.uint8)
        picture[:, 8 * self.cell : 8 * self.cell + 8] = (255, 200, 0)
        return picture


@pytest.fixture
def corridor():
    """Registers ``test/Corridor-v0``, 10 steps at most, for one test; its id."""
    gym.register("test/Corridor-v0", entry_point=Corridor, max_episode_steps=10)
    yield "test/Corridor-v0"
    del gym.registry["test/Corridor-v0"]


def starting_cell(seed: int) -> int:
    """Where the corridor's episode with this seed starts."""
    return int(gym.utils.seeding.np_random(seed)[0].integers(1, 4))


@pytest.fixture(name="starting_cell")
def starting_cell_fixture():
    return starting_cell
