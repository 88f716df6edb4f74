"""Spaces that count from another number than 0, as learning libraries take them: these ignore ``start``."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

_Counted = (spaces.Discrete, spaces.MultiDiscrete)


def from_zero(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """The environment with every Discrete and MultiDiscrete counted from 0; itself if they all are already."""
    wrapped = FromZero(env)
    same = (wrapped.observation_space, wrapped.action_space) == (env.observation_space, env.action_space)
    return env if same else wrapped


class FromZero(gym.Wrapper[Any, Any, Any, Any]):
    """Gives observations less their space's ``start``, and takes actions less its ``start``; leaves of a Dict too."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = space_from_zero(env.observation_space)
        self.action_space = space_from_zero(env.action_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return less_start(self.env.observation_space, observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take an action that is counted from 0."""
        observation, *rest = self.env.step(plus_start(self.env.action_space, action))
        return less_start(self.env.observation_space, observation), *rest


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
