"""How likely the recorded actions were: as recorded, or under a model of whoever acted that is learnt from the data."""

from __future__ import annotations

import gymnasium as gym
import numpy as np

from bam_train.estimation.estimates import Array
from bam_train.estimation.steps import Steps


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
