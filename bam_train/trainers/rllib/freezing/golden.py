"""Golden actions: observations, and what RLlib's own code does on them, to check the frozen policy against.

RLlib itself is imported only by `golden`: what draws observations is needed where it is not installed too.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_train.trainers.freezing.golden import affordable, clearest, draw_array, pack
from bam_train.trainers.rllib.freezing.freeze import FrozenModule
from bam_train.trainers.rllib.freezing.parts import Array, Filter, PolicyParts, leaf_spaces


def golden(parts: PolicyParts, module: Any, env_to_module: Any, config: Any, n: int = 256, seed: int = 0) -> bytes:
    """Draw observations and record RLlib's deterministic actions: its connectors, module and distribution.

    Args:
        parts: Of the same policy.
        module: The RLModule; left as it was.
        env_to_module: The env runner's pipeline, or None; what it has learnt of observations is left as it was.
        config: The AlgorithmConfig; says what is done with actions.
        n: Rows; fewer if they are large.
        seed: Of the observations.

    Returns:
        A safetensors file with ``observation`` (or ``observation.<key>``), (n, ...), and ``action``, (n, ...).
    """
    from bam_train.trainers.rllib.freezing.reference import rllib_actions

    observations = clear_observations(parts, n, seed)
    actions = rllib_actions(parts, module, env_to_module, config, observations)
    return pack(observations, actions)


def clear_observations(parts: PolicyParts, n: int = 256, seed: int = 0) -> dict[str, Array]:
    """Draw observations; of discrete actions those whose choice is clear: ties are decided by rounding alone."""
    n = affordable(leaf_spaces(parts.observation_space).values(), n)
    return clearest(FrozenModule(parts), draw(parts, 2 * n, np.random.default_rng(seed)), n)


def shifted(parts: PolicyParts, actions: Array) -> Array:
    """Actions of the environment's type, counted from its ``start``: RLlib counts from 0."""
    space = parts.action_space
    start = space.start if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) else 0
    return np.asarray(actions + start, np.int64 if isinstance(space, spaces.Discrete) else space.dtype)


def rows(observations: dict[str, Array]) -> list[Any]:
    """The observations one by one, as an environment gives them."""
    count = len(next(iter(observations.values())))
    if "" in observations:
        return [observations[""][k] for k in range(count)]
    return [{key: array[k] for key, array in observations.items()} for k in range(count)]


def draw(parts: PolicyParts, n: int, rng: np.random.Generator) -> dict[str, Array]:
    """Draw n observations; the keys are those of a Dict, or just ``""``.

    Normalised numbers are drawn about their running mean, so that few of them end at the filter's limits.
    """
    moments = _moments(parts)
    return {
        key: draw_array(leaf, n, rng, moments.get(key)) for key, leaf in leaf_spaces(parts.observation_space).items()
    }


def _moments(parts: PolicyParts) -> dict[str, tuple[Array, Array]]:
    """Mean and deviation of every array whose numbers are normalised."""
    known: Filter | None = parts.filter
    if known is None:
        return {}
    mean, spread, at, found = known.offset.ravel(), known.divisor.ravel(), 0, {}
    for key, leaf in leaf_spaces(parts.observation_space).items():
        width = _width(leaf)
        if isinstance(leaf, spaces.Box):
            found[key] = (mean[at : at + width].reshape(leaf.shape), spread[at : at + width].reshape(leaf.shape))
        at += width
    return found


def _width(leaf: Any) -> int:
    """Numbers of a flattened array."""
    if isinstance(leaf, spaces.Discrete):
        return int(leaf.n)
    if isinstance(leaf, spaces.MultiDiscrete):
        return int(leaf.nvec.sum())
    return math.prod(leaf.shape)
