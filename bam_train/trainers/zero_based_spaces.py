"""Conversion of spaces with a ``start`` other than 0, which learning libraries ignore, to spaces that count from 0."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TransformAction, TransformObservation

_Counted = (spaces.Discrete, spaces.MultiDiscrete)


def from_zero(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """Wrap the environment so that every Discrete and MultiDiscrete counts from 0; unchanged if they do already."""
    seen, acted = env.observation_space, env.action_space
    if (zero := space_from_zero(acted)) != acted:
        env = TransformAction(env, functools.partial(plus_start, acted), zero)
    if (zero := space_from_zero(seen)) != seen:
        env = TransformObservation(env, functools.partial(less_start, seen), zero)
    return env


def plus_start(space: spaces.Space[Any], value: Any) -> Any:
    """Convert a value that counts from 0 to one of the space, in its dtype; values of other kinds are unchanged."""
    if not isinstance(space, _Counted):
        return value
    return np.asarray(np.asarray(value) + space.start).astype(space.dtype)[()]


def less_start(space: spaces.Space[Any], value: Any) -> Any:
    """Convert a value of the space, or a batch of them, to count from 0; values of other kinds are unchanged."""
    if isinstance(space, spaces.Dict):
        return {key: less_start(space.spaces[key], part) for key, part in value.items()}
    return value - space.start if isinstance(space, _Counted) else value


def space_from_zero(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """The space with every Discrete and MultiDiscrete counting from 0, also in a Dict."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: space_from_zero(leaf) for key, leaf in space.spaces.items()})
    if not isinstance(space, _Counted):
        return space
    dtype: Any = np.dtype(space.dtype).type
    if isinstance(space, spaces.Discrete):
        return spaces.Discrete(int(space.n), dtype=dtype)
    return spaces.MultiDiscrete(space.nvec, dtype=dtype)
