"""Golden actions: observations, and what RLlib's own code does on them, to check the frozen policy against.

RLlib itself is imported only by `golden`: what draws observations is needed where it is not installed too.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from bam_train.checkpoint import safetensors_file
from bam_train.trainers.rllib.freezing.freeze import FrozenModule
from bam_train.trainers.rllib.freezing.parts import Array, Filter, PolicyParts, leaf_spaces

_BUDGET = 200_000  # bytes of observations; images are random and do not pack
_FAR = 1e6  # a bound beyond this says nothing about the values that occur


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


def pack(observations: dict[str, Array], actions: Array) -> bytes:
    """Write the member; keys are those of a Dict, or just ``""``."""
    named = {f"observation.{key}" if key else "observation": value for key, value in observations.items()}
    return safetensors_file.dump({**named, "action": actions})


def clear_observations(parts: PolicyParts, n: int = 256, seed: int = 0) -> dict[str, Array]:
    """Draw observations; of discrete actions those whose choice is clear: ties are decided by rounding alone."""
    space = parts.observation_space
    n = min(n, max(4, _BUDGET // _size(space)))
    observations = draw(parts, 2 * n, np.random.default_rng(seed))
    module = FrozenModule(parts)
    with torch.no_grad():
        margin = module.head.margin(module.scores(*map(torch.as_tensor, observations.values()))).numpy()
    keep = np.sort(np.argsort(-margin, kind="stable")[:n])
    return {key: value[keep] for key, value in observations.items()}


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
    return {key: _draw(leaf, n, rng, moments.get(key)) for key, leaf in leaf_spaces(parts.observation_space).items()}


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


def _size(space: spaces.Space[Any]) -> int:
    """Return the bytes of one observation."""
    return sum(math.prod(leaf.shape or ()) * np.dtype(leaf.dtype).itemsize for leaf in leaf_spaces(space).values()) or 1


def _draw(space: Any, n: int, rng: np.random.Generator, moments: Any) -> Array:
    shape = (n, *space.shape)
    if isinstance(space, spaces.MultiBinary):
        return rng.integers(2, size=shape, dtype=np.int8)
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
        return np.asarray(space.start + rng.integers(counts, size=shape), space.dtype)
    if np.issubdtype(space.dtype, np.integer):
        return np.asarray(rng.integers(space.low, space.high, size=shape, dtype=space.dtype, endpoint=True))
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    values = rng.normal(size=shape)
    if moments is not None:
        values = moments[0] + 2.0 * moments[1] * values
    else:
        near = (low > -_FAR) & (high < _FAR)
        start, stop = np.where(near, low, 0.0), np.where(near, high, 1.0)
        values = np.where(near, start + (stop - start) * rng.random(shape), values)
    return np.clip(values, low, high).astype(space.dtype)
