"""Spaces of every kind, and episodes of random numbers in them."""

import itertools

import gymnasium as gym
import numpy as np

from bam_envs.core.spaces import mapped
from bam_train.data import DataSetInfo, DataSetWriter, Episode
from bam_train.data.layout import Files

SPACES = {
    "box": gym.spaces.Box(-np.inf, np.inf, (3,), np.float32),
    "one number": gym.spaces.Box(-1, 1, (1,), np.float64),
    "no axis": gym.spaces.Box(-1, 1, (), np.float32),
    "matrix": gym.spaces.Box(-9, 9, (2, 3), np.int16),
    "picture": gym.spaces.Box(0, 255, (4, 5, 3), np.uint8),
    "grey": gym.spaces.Box(0, 255, (4, 5, 1), np.uint8),
    "discrete": gym.spaces.Discrete(4, start=2),
    "multi": gym.spaces.MultiDiscrete([3, 4]),
    "binary": gym.spaces.MultiBinary(3),
    "nested": gym.spaces.Dict(
        {
            "camera": gym.spaces.Box(0, 255, (4, 5, 3), np.uint8),
            "arm": gym.spaces.Dict({"joints": gym.spaces.Box(-1, 1, (6,), np.float32), "mode": gym.spaces.Discrete(3)}),
            "pair": gym.spaces.Tuple([gym.spaces.Box(-1, 1, (2,), np.float16), gym.spaces.MultiBinary(2)]),
        }
    ),
}


def info_of(observation="box", action="box", **changes):
    values = {"env": "bam/pick-v0", "env_kwargs": {}, "period": 0.05, "robot": "ur5e"}
    return DataSetInfo(
        **{**values, "observation_space": SPACES[observation], "action_space": SPACES[action], **changes}
    )


def samples(space, count):
    """`count` values of a space, as arrays with the steps first."""
    return mapped(lambda part: np.stack([np.asarray(part.sample(), part.dtype) for _ in range(count)]), space)


def episode(info, steps, seed=0, **changes):
    info.observation_space.seed(seed)
    info.action_space.seed(seed)
    values = {"rewards": np.random.default_rng(seed).normal(size=steps), "terminated": seed % 2 == 0}
    values |= {"truncated": seed % 2 == 1, "success": [True, False, None][seed % 3], "facts": {"seed": seed}}
    values |= {"observations": samples(info.observation_space, steps + 1), "actions": samples(info.action_space, steps)}
    return Episode(**{**values, **changes})


def write(place, info, episodes, **options):
    with DataSetWriter(place, info, **options) as writer:
        return [writer.add(one) for one in episodes]


def fails_at(number, error):
    """`Files.write` that raises this error at its call of this number, counted from 1."""
    write_file, calls = Files.write, itertools.count(1)

    def write_some(self, name, content):
        if next(calls) == number:
            raise error
        write_file(self, name, content)

    return write_some
