"""Spaces that count from another number than 0, as learning libraries take them: these ignore ``start``."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TransformAction, TransformObservation

_Counted = (spaces.Discrete, spaces.MultiDiscrete)


def from_zero(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """The environment with every Discrete and MultiDiscrete counted from 0; itself if they all are already."""
    seen, acted = env.observation_space, env.action_space
    if (zero := space_from_zero(acted)) != acted:
        env = TransformAction(env, functools.partial(plus_start, acted), zero)
    if (zero := space_from_zero(seen)) != seen:
        env = TransformObservation(env, functools.partial(less_start, seen), zero)
    return env


def plus_start(space: spaces.Space[Any], value: Any) -> Any:
    """A value counted from 0 as the space has it, in the space's dtype; other kinds as they are."""
    if not isinstance(space, _Counted):
        return value
    return np.asarray(np.asarray(value) + space.start).astype(space.dtype)[()]


def less_start(space: spaces.Space[Any], value: Any) -> Any:
    """A value of the space, or a batch of them, counted from 0; other kinds as they are."""
    if isinstance(space, spaces.Dict):
        return {key: less_start(space.spaces[key], one) for key, one in value.items()}
    return value - space.start if isinstance(space, _Counted) else value


def space_from_zero(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """The space with every Discrete and MultiDiscrete counted from 0; leaves of a Dict too."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: space_from_zero(leaf) for key, leaf in space.spaces.items()})
    if not isinstance(space, _Counted):
        return space
    dtype: Any = np.dtype(space.dtype).type
    if isinstance(space, spaces.Discrete):
        return spaces.Discrete(int(space.n), dtype=dtype)
    return spaces.MultiDiscrete(space.nvec, dtype=dtype)
