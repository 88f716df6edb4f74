"""A policy on another computer: an environment that `bam-serve` serves, and that a `PolicyLink` takes for a graph.

A chunk is the observation of that environment after a step, whose action are the policy's inputs. So every transport
carries it, with its tokens and TLS, and requests in one order with one answer each.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.ros.codec import A_POLICY
from bam_train.policy.frozen_policy import FrozenPolicy

Array = NDArray[Any]


class ServedPolicy(gym.Env[Array, dict[str, Array]]):
    """A policy with chunks as an environment: a step takes the graph's inputs, and shows the chunk for them.

    Raises:
        PolicyError: It has no chunks.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium has it
    served_as = A_POLICY
    """What a server says that it serves."""

    def __init__(self, policy: FrozenPolicy) -> None:
        policy.plan()
        self._policy, shape = policy, policy.answer_shape
        self.action_space = spaces.Dict({part.name: _any(part.shape, part.dtype) for part in policy.taken})
        self.observation_space = _any(shape, np.dtype(np.float32))
        self._nothing = np.zeros(shape, np.float32)

    def reset(self, **_: Any) -> tuple[Array, dict[str, Any]]:
        """Nothing: a policy with chunks has no memory."""
        return self._nothing, {}

    def step(self, action: dict[str, Array]) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """The chunk for one observation."""
        chunk = self._policy.answer({name: value[None] for name, value in action.items()})[0]
        self._policy.plan().add(0, chunk)  # its shape, and that it is finite
        return chunk, 0.0, False, False, {}


def _any(shape: tuple[int, ...], dtype: np.dtype[Any]) -> spaces.Box:
    """Arrays of any numbers."""
    whole = None if dtype.kind == "f" else np.iinfo(dtype)
    low, high = (-np.inf, np.inf) if whole is None else (whole.min, whole.max)
    return spaces.Box(low, high, shape, dtype.type)
