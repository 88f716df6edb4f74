"""Golden observations: what a frozen policy is checked on against the library that trained it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from bam_train.checkpoint import safetensors_file

_BUDGET = 200_000  # bytes of observations; images are random and do not pack
_FAR = 1e6  # a bound beyond this says nothing about the values that occur

Array = NDArray[Any]


def affordable(observation: Iterable[Any], n: int) -> int:
    """How many rows of these arrays to record: `n`, fewer if they are large.

    Args:
        observation: Spaces of the arrays.
        n: Wanted.
    """
    size = sum(math.prod(leaf.shape or ()) * np.dtype(leaf.dtype).itemsize for leaf in observation)
    return min(n, max(4, _BUDGET // (size or 1)))


def draw_array(space: Any, n: int, rng: np.random.Generator, moments: tuple[Array, Array] | None) -> Array:
    """Draw n values of a space that is no Dict, (n, ...).

    Args:
        space: Theirs.
        n: How many.
        rng: Where from.
        moments: Mean and deviation of numbers that the policy normalises, so that few of them end at its limits.
    """
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
    return np.asarray(np.clip(values, low, high).astype(space.dtype))


def clearest(module: Any, observations: Mapping[str, Array], n: int) -> dict[str, Array]:
    """The n rows whose choice is clearest: where two choices tie, rounding decides, and that proves nothing.

    Args:
        module: The frozen policy as a torch module, with ``scores`` and ``head.margin``.
        observations: By key, rows of each.
        n: At most.
    """
    with torch.no_grad():
        margin = module.head.margin(module.scores(*map(torch.as_tensor, observations.values()))).numpy()
    keep = np.sort(np.argsort(-margin, kind="stable")[:n])
    return {key: value[keep] for key, value in observations.items()}


def pack(observations: Mapping[str, Array], actions: Array) -> bytes:
    """Write the checkpoint's member.

    Args:
        observations: By key of a Dict, or just ``""``; (n, ...) each.
        actions: For them, (n, ...).
    """
    named = {f"observation.{key}" if key else "observation": value for key, value in observations.items()}
    return safetensors_file.dump({**named, "action": actions})
