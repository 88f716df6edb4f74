"""Choices that do not count from 0, and environments around them that do."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from bam_train.environments import make_env
from bam_train.trainers.zero_based_spaces import from_zero


class Parts(gym.Env):
    """Tells back the action that it was given, and what it counts."""

    observation_space = spaces.Dict(
        told=spaces.MultiDiscrete([3, 4], dtype=np.int8, start=[5, -2]),
        mode=spaces.Discrete(5, start=2),
        x=spaces.Box(-1, 1, (2,)),
    )
    action_space = spaces.MultiDiscrete([3, 4], dtype=np.int8, start=[5, -2])

    def look(self, told):
        return {"told": told, "mode": np.int64(6), "x": np.ones(2, np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.look(np.array([5, -2], np.int8)), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.look(action), 0.0, False, False, {}


def test_leaves_of_a_dict_and_several_choices():
    env = from_zero(Parts())
    assert env.action_space == spaces.MultiDiscrete([3, 4], dtype=np.int8)
    assert env.observation_space["mode"] == spaces.Discrete(5)
    first, _ = env.reset(seed=0)
    second, *_ = env.step(np.array([2, 3], np.int64))
    assert [first["told"].tolist(), second["told"].tolist()] == [[0, 0], [2, 3]]
    assert second["mode"] == 4
    assert second["x"].tolist() == [1.0, 1.0]
    assert env.observation_space.contains(second)


def test_what_counts_from_zero_stays_as_it_is(corridor):
    env = make_env(corridor)
    assert from_zero(env) is env
