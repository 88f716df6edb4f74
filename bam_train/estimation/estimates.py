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

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_train.estimation.steps import Steps
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


def action_ratios(steps: Steps, space: gym.Space[object], seed: int = 0) -> Array | None:
    """Probability of each recorded action under the policy, divided by that under whoever acted. Shape: (n,).

    A frozen policy is deterministic. Discrete: its own action has probability 1. Continuous: it counts as a policy with
    Gaussian noise, of the standard deviation that the recorded actions have around what whoever acted meant. Without
    recorded propensities, whoever acted is a network that learns the recorded actions: categorical, or Gaussian. None
    for other spaces, and for recorded actions without noise.
    """
    if isinstance(space, gym.spaces.Discrete):
        same = np.argmax(steps.actions, axis=1) == np.argmax(steps.wanted, axis=1)
        known = steps.propensity
        if known is None:
            scores = _fitted(steps, seed)
            chances = np.exp(scores - np.logaddexp.reduce(scores, axis=1, keepdims=True))
            known = np.take_along_axis(chances, np.argmax(steps.actions, axis=1)[:, None], axis=1)[:, 0]
        return np.asarray(same / np.maximum(known, 1e-6))
    if not isinstance(space, gym.spaces.Box):
        return None
    meant = _fitted(steps, seed)
    spread = np.sqrt(np.mean((steps.actions - meant) ** 2, axis=0, dtype=np.float64))
    if float(spread.min()) < 1e-4:
        return None
    log_wanted = _log_density(steps.actions - steps.wanted, spread)
    if steps.propensity is not None:
        return np.asarray(np.exp(log_wanted) / np.maximum(steps.propensity, 1e-300))
    return np.asarray(np.exp(np.clip(log_wanted - _log_density(steps.actions - meant, spread), -700, 700)))


def _log_density(error: Array, spread: Array) -> Array:
    """Of a Gaussian with independent numbers. Shapes: (n, k), (k,) -> (n,)."""
    return np.asarray(-0.5 * ((error / spread) ** 2 + np.log(2 * np.pi * spread**2)).sum(axis=1))


def _fitted(steps: Steps, seed: int, updates: int = 600, batch: int = 512) -> Array:
    """What whoever acted meant, given the observation: mean of the action, or scores of the choices. Shape: (n, k)."""
    import torch

    torch.set_num_threads(1)
    draws = torch.Generator().manual_seed(seed)
    mean, spread = steps.observations.mean(axis=0), steps.observations.std(axis=0) + 1e-3
    inputs = torch.as_tensor((steps.observations - mean) / spread)
    actions = torch.as_tensor(steps.actions)
    is_choice = bool(((actions == 0) | (actions == 1)).all() and (actions.sum(dim=1) == 1).all())
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        layers = [torch.nn.Linear(inputs.shape[1], 64), torch.nn.Tanh(), torch.nn.Linear(64, actions.shape[1])]
        network = torch.nn.Sequential(*layers)
    optimizer = torch.optim.Adam(network.parameters(), 5e-3)
    for _ in range(updates):
        index = torch.randint(len(inputs), (batch,), generator=draws)
        found = network(inputs[index])
        if is_choice:
            loss = torch.nn.functional.cross_entropy(found, actions[index])
        else:
            loss = torch.nn.functional.mse_loss(found, actions[index])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        return np.asarray(network(inputs).double().numpy())
