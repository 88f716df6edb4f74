import gymnasium as gym
import numpy as np
import pytest

from bam_train.agent.transitions import TransitionLog
from bam_train.settings import SB3Settings

ENV = "LiveLine-v0"


class Line(gym.Env):
    """Two numbers; the action should be their difference. Four steps an episode."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-2, 2, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._see(), {}

    def _see(self):
        self.seen = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.seen

    def step(self, action):
        error = abs(float(action[0] - (self.seen[0] - self.seen[1])))
        self.steps += 1
        done = self.steps == 4
        return self._see(), -error, done, False, {"is_success": done and error < 0.5}


@pytest.fixture(autouse=True)
def line():
    gym.register(ENV, Line)
    yield
    del gym.registry[ENV]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def settings():
    def make(**changes):
        small = {"critic_width": 16, "actor_width": 16, "history": 2, "batch_size": 16, "warmup": 4, "actor_after": 0}
        small |= {"average": 0.05, "blur": 0.02, "advantage_weight": 1.0}
        small |= changes.pop("hyperparameters", {})
        values = {"env": ENV, "algo": "rlpd", "trainer": "live", "steps": 200, "hyperparameters": small}
        return SB3Settings(**{**values, **changes})

    return make


def play(episodes, *, first=0, person=False, seed=0):
    """Transitions of a policy that is always right, with a little noise."""
    log, env, rng = TransitionLog(), Line(), np.random.default_rng(seed)
    for episode in range(first, first + episodes):
        seen, _ = env.reset(seed=seed + episode)
        for step in range(4):
            action = np.array([seen[0] - seen[1] + 0.05 * rng.standard_normal()], np.float32)
            after, reward, terminated, truncated, info = env.step(action)
            flags = terminated, truncated, info["is_success"], person
            log.add(seen, action, reward, after, *flags, episode, step, "" if person else "ab")
            seen = after
    return log.take()
