"""Compare a frozen policy with the trainer's own actions, which the checkpoint holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from bam_train.errors import PolicyError
from bam_train.policy.array_specs import ArraySpec

TOLERANCE = 1e-5
"""Largest difference from the trainer's own action; a Box wider than 2 is measured in half its range."""
MOST_ROWS = 1024
"""Recorded observations at most; a few hundred are written."""
_SINGLE = 8  # rows that are acted on one by one too


class Policy(Protocol):
    """What acts."""

    recurrent: bool

    def reset(self) -> None:
        """Start an episode."""

    def act(self, observation: Any) -> Any:
        """Act on one observation."""

    def act_batch(self, observations: Any) -> np.ndarray:
        """Act on n observations."""


def worst_difference(
    policy: Policy, observation: list[ArraySpec], action: ArraySpec, arrays: Mapping[str, np.ndarray]
) -> tuple[float, int]:
    """Act on the recorded observations.

    Args:
        policy: To be checked; forgets what it saw.
        observation: Its observation's arrays.
        action: Its action.
        arrays: ``action`` and the observations by name, (n, ...) each; of a recurrent policy the steps of one episode.

    Returns:
        The largest difference and its row.

    Raises:
        PolicyError: The arrays do not fit the policy.
    """
    expected = _expected(observation, action, arrays)
    parts = {part.name.removeprefix("observation").removeprefix("."): arrays[part.name] for part in observation}
    count = len(expected) if policy.recurrent else min(_SINGLE, len(expected))
    policy.reset()
    found = np.array([policy.act(_rows(parts, k)) for k in range(count)])
    policy.reset()
    if not policy.recurrent:
        found = np.concatenate([found, policy.act_batch(_rows(parts, slice(None)))[count:]])
    difference = np.abs(found.astype(np.float64) - expected) / _unit(action, expected)
    worst = difference.reshape(len(expected), -1).max(axis=1)
    row = int(np.argmax(np.where(np.isnan(worst), np.inf, worst)))
    return float(worst[row]), row


def _expected(observation: list[ArraySpec], action: ArraySpec, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the recorded actions if every array is there with as many rows."""
    names = {"action", *(part.name for part in observation)}
    if set(arrays) != names:
        raise PolicyError(f"expected the arrays {sorted(names)}, found {sorted(arrays)}")
    rows = {name: array.shape[:1] for name, array in arrays.items()}
    if len(set(rows.values())) != 1 or rows["action"] in ((), (0,)):
        raise PolicyError(f"expected as many rows in each array, found {rows}")
    expected = arrays["action"]
    if len(expected) > MOST_ROWS:
        raise PolicyError(f"expected at most {MOST_ROWS} rows, found {len(expected)}")
    if expected.shape[1:] != action.shape:
        raise PolicyError(f"action: expected shape {action.shape}, found {expected.shape[1:]}")
    return expected.astype(np.float64)


def _rows(parts: Mapping[str, np.ndarray], chosen: Any) -> Any:
    if "" in parts:
        return parts[""][chosen]
    return {key: array[chosen] for key, array in parts.items()}


def _unit(action: ArraySpec, expected: np.ndarray) -> np.ndarray:
    """What a difference is measured in: 1, or half the range of a Box if that is more, as float32 rounds."""
    if action.kind != "Box" or action.low is None or action.high is None:
        return np.ones(())
    half = (action.high - action.low) / 2
    return np.asarray(np.maximum(np.where(np.isfinite(half), half, np.abs(expected)), 1.0))
