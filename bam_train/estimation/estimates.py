"""Value of a policy from steps that others took: direct, by importance sampling, and doubly robust.

Arrays hold the steps of all episodes one after another: `rewards` and `ratios` have shape (n,), and `episode` (n,) the
number of each step's episode, 0 to the number of episodes - 1. A bandit is the case of one step an episode. The ratio
of a step is the probability (or density) of its action under the policy, divided by that under the policy that acted.
Dudik et al., Doubly robust policy evaluation (2014); Jiang and Li, Doubly robust off-policy value evaluation (2016).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_train.evaluation import Z95

Array = NDArray[Any]
FEWEST = 10.0
"""Effective episodes below which an interval means nothing: a few episodes have nearly all of the weight."""


@dataclass(frozen=True)
class Estimate:
    """The mean value of an episode."""

    value: float
    interval: tuple[float, float]
    """95 %."""
    effective: float
    """Effective number of episodes, Kish's (sum of weights)² / (sum of squares); all of them without weights."""

    @property
    def is_sound(self) -> bool:
        """Whether enough episodes have weight."""
        return self.effective >= FEWEST

    def as_rate(self) -> Estimate:
        """The same between 0 and 1, where the value of an episode is its success."""
        value, low, high = (min(1.0, max(0.0, one)) for one in (self.value, *self.interval))
        return Estimate(value, (low, high), self.effective)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"value": self.value, "interval": list(self.interval), "effective": self.effective}


def estimate_mean(values: Array, effective: float | None = None) -> Estimate:
    """The mean of one value an episode, shape (e,), with the interval of the central limit theorem."""
    mean, half = float(values.mean()), Z95 * float(values.std()) / math.sqrt(len(values))
    return Estimate(mean, (mean - half, mean + half), float(len(values)) if effective is None else effective)


def weights_up_to(ratios: Array, episode: Array) -> Array:
    """The product of the ratios of each step and those before it in its episode. Shape: (n,)."""
    logs = np.log(np.maximum(ratios, 1e-300))
    sums = np.cumsum(logs)
    first = np.flatnonzero(np.diff(episode, prepend=-1))
    before = np.concatenate([[0.0], sums])[first]
    product: Array = np.exp(np.minimum(sums - np.repeat(before, np.diff([*first, len(episode)])), 700.0))
    return product


def importance_sampling(rewards: Array, ratios: Array, episode: Array) -> Estimate:
    """IPS: the mean over episodes of their rewards, each weighted by the ratios up to it. Unbiased, and often noisy."""
    weights = weights_up_to(ratios, episode)
    return estimate_mean(_sums(weights * rewards, episode), effective_episodes(_last(weights, episode)))


def self_normalised(rewards: Array, ratios: Array, episode: Array) -> Estimate:
    """SNIPS: the mean return of the episodes, weighted by all of their ratios. A little biased, and less noisy."""
    weights, returns = _last(weights_up_to(ratios, episode), episode), _sums(rewards, episode)
    total = max(float(weights.sum()), 1e-300)
    mean = float(weights @ returns) / total
    half = Z95 * float(np.sqrt(np.sum((weights / total * (returns - mean)) ** 2)))
    return Estimate(mean, (mean - half, mean + half), effective_episodes(weights))


def doubly_robust(
    rewards: Array, ratios: Array, episode: Array, of_actions: Array, of_states: Array, of_next: Array
) -> Estimate:
    """DR: the model's value of the starts, and the weighted errors of the model along the episodes.

    Args:
        rewards: Shape: (n,).
        ratios: Shape: (n,).
        episode: Shape: (n,).
        of_actions: The model's value of the recorded action in each state. Shape: (n,).
        of_states: The model's value of the policy in each state. Shape: (n,).
        of_next: The same in the state after the step, 0 where the episode ends. Shape: (n,).
    """
    weights = weights_up_to(ratios, episode)
    starts = of_states[np.flatnonzero(np.diff(episode, prepend=-1))]
    errors = _sums(weights * (rewards + of_next - of_actions), episode)
    return estimate_mean(starts + errors, effective_episodes(_last(weights, episode)))


def effective_episodes(weights: Array) -> float:
    """Kish's effective sample size of the weights of the episodes."""
    scaled = weights / max(float(weights.max()), 1e-300)
    return float(scaled.sum() ** 2 / max(float((scaled**2).sum()), 1e-300))


def _sums(values: Array, episode: Array) -> Array:
    return np.bincount(episode, values)


def _last(values: Array, episode: Array) -> Array:
    return values[np.flatnonzero(np.diff(episode, append=-1))]
