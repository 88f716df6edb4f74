"""A vector environment in NumPy that can save its state, for either kind of action; its numbers can be worked out."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from bam_envs.core.location import Remote
from bam_train.trainers.sb3 import sb3_trainer as trainer_module
from bam_train.trainers.sb3 import sb3_vec_env as vec_env


class Walk(VectorEnv):
    """Rows at a position; actions move it; beyond 1 or -1 it ends (success above), after 12 steps it is truncated.

    Observed: position and a number drawn at every step. Reward: the position.
    """

    def __init__(self, num_envs, discrete=False):
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_fps": 20}
        self.single_observation_space = gym.spaces.Box(-2.0, 2.0, (2,), np.float32)
        self.single_action_space = gym.spaces.Discrete(2) if discrete else gym.spaces.Box(-1, 1, (1,), np.float32)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.discrete = discrete
        self.position, self.elapsed = np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64)
        self.rngs = [np.random.default_rng() for _ in range(num_envs)]
        self.buffer = np.zeros((num_envs, 2), np.float32)

    def reset(self, *, seed=None, options=None):
        for row in range(self.num_envs if seed is not None else 0):
            self.rngs[row] = np.random.default_rng(seed[row] if isinstance(seed, list) else seed + row)
        self._begin(range(self.num_envs))
        return self._observe(), {}

    def _begin(self, rows):
        for row in rows:
            self.position[row], self.elapsed[row] = self.rngs[row].uniform(-0.5, 0.5), 0

    def _observe(self):
        self.buffer[:, 0] = self.position
        self.buffer[:, 1] = [rng.normal() for rng in self.rngs]
        return self.buffer.clip(-2, 2, out=self.buffer)  # always the same array: who keeps it must copy it

    def step(self, actions):
        moved = np.where(actions == 1, 0.3, -0.3) if self.discrete else 0.3 * np.asarray(actions)[:, 0]
        self.position = self.position + moved
        self.elapsed += 1
        terminated, truncated = np.abs(self.position) > 1, self.elapsed >= 12
        reward, ended, infos = self.position.copy(), terminated | truncated, {}
        observation = self._observe()
        if ended.any():
            infos["final_obs"], infos["_final_obs"] = observation.copy(), ended
            infos["final_info"] = {"is_success": self.position > 1, "_is_success": ended}
            self._begin(np.flatnonzero(ended))
            observation = self._observe()
        return observation, reward, terminated, truncated, infos

    def state_dict(self):
        return {
            "position": self.position.copy(),
            "elapsed": self.elapsed.copy(),
            "rngs": [rng.bit_generator.state for rng in self.rngs],
        }

    def load_state_dict(self, state):
        self.position, self.elapsed = np.array(state["position"]), np.array(state["elapsed"])
        for rng, one in zip(self.rngs, state["rngs"], strict=True):
            rng.bit_generator.state = one


class OneWalk(gym.Env):
    """The same for one row, so that Gymnasium can make it."""

    def __init__(self, discrete=False, render_mode=None):
        self.rows = Walk(1, discrete)
        self.observation_space, self.action_space = self.rows.single_observation_space, self.rows.single_action_space
        self.metadata = {"render_modes": [], "render_fps": 20}
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.rows.reset(seed=seed)[0][0].copy(), {}

    def step(self, action):
        observation, reward, terminated, truncated, infos = self.rows.step(np.asarray([action]))
        final = infos.get("final_obs", observation)[0].copy()
        info = {"is_success": bool(infos["final_info"]["is_success"][0])} if infos else {"is_success": False}
        return final, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


@pytest.fixture
def walk(monkeypatch):
    """Registers ``test/Walk-v0`` for one test and trains on its rows as on our own environments; its id."""

    real = vec_env.make_training_env

    def make(env_id, env_kwargs, num_envs, place, coarse, near):
        if isinstance(place, Remote) or env_id != "test/Walk-v0":
            return real(env_id, env_kwargs, num_envs, place, coarse=coarse, near=near)
        return vec_env.BatchVecEnv(Walk(num_envs, **env_kwargs))

    monkeypatch.setattr(trainer_module, "make_training_env", make)
    gym.register("test/Walk-v0", entry_point=OneWalk)
    yield "test/Walk-v0"
    del gym.registry["test/Walk-v0"]


@pytest.fixture
def rows():
    """The class of the vector environment."""
    return Walk
