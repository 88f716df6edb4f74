"""Recorded steps beside what a policy would have done: the arrays that the estimators take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.spaces import indexed
from bam_train.data import DataSet, Episode
from bam_train.errors import BadDataSet

Array = NDArray[Any]
Floats = NDArray[np.float32]
MOST_FEATURES = 2000
"""Numbers of an observation up to which values are estimated; pictures have more."""


class Acting(Protocol):
    """A deterministic policy, such as a `FrozenPolicy`."""

    recurrent: bool

    def reset(self) -> None:
        """Forget the recurrent state."""

    def act(self, observation: Any) -> Any:
        """The action for one observation."""

    def act_batch(self, observations: Any) -> Any:
        """Actions for several, (n, ...) -> (n, ...)."""


@dataclass(frozen=True)
class Steps:
    """All steps of e episodes, n in all, one episode after another; observations and actions as plain vectors."""

    observations: Floats
    """Shape: (n, d)."""
    actions: Floats
    """Recorded. Shape: (n, k)."""
    meant: Floats
    """What whoever acted would have done without noise, where that is recorded (``raw_action``); else `actions`.
    Shape: (n, k)."""
    wanted: Floats
    """The policy's, at the same observations. Shape: (n, k)."""
    next_observations: Floats
    """Shape: (n, d)."""
    next_wanted: Floats
    """The policy's there. Shape: (n, k)."""
    rewards: NDArray[np.float64]
    """Of the task; or 1 for the last step of a success and 0 otherwise. Shape: (n,)."""
    ends: NDArray[np.bool_]
    """Whether nothing counts after the step: the task or its time is over. Shape: (n,)."""
    episode: NDArray[np.int64]
    """Number of its episode, from 0 on. Shape: (n,)."""
    time: Floats
    """Number of the step in its episode, as a share of the longest episode. Shape: (n,)."""
    longest: int
    """Steps of the longest episode."""
    propensity: Array | None
    """Probability, or density, of the recorded action under the policy that acted; None if unknown. Shape: (n,)."""

    @property
    def starts(self) -> Array:
        """Index of the first step of each episode. Shape: (e,)."""
        return np.flatnonzero(np.diff(self.episode, prepend=-1))

    @property
    def returns(self) -> Array:
        """Sum of the rewards of each episode. Shape: (e,)."""
        return np.bincount(self.episode, self.rewards)


def read_steps(data: DataSet, policy: Acting, indices: Sequence[int], by_success: bool) -> Steps:
    """The steps of the episodes with these indices, and what `policy` does at their observations.

    Args:
        data: Read one file at a time; what is kept are vectors of float32.
        policy: Recurrent policies see each episode from its start.
        indices: At least one.
        by_success: The reward is the episode's success at its last step.

    Raises:
        BadDataSet: Observations of too many numbers.
    """
    info = data.info
    size = gym.spaces.flatdim(info.observation_space)
    if size > MOST_FEATURES:
        text = f"an observation has {size} numbers; values are estimated for up to {MOST_FEATURES}"
        raise BadDataSet(f"{data.place}: {text}. Leave pictures out of it, or evaluate in simulation")
    parts = [_parts(one, policy, info, by_success) for one in data.episodes(indices)]
    columns = list(zip(*parts, strict=True))
    observations, actions, meant, wanted, rewards, ends, propensities = columns
    lengths = np.array([len(one) for one in rewards])
    longest = int(lengths.max())
    for end, length in zip(ends, lengths, strict=True):
        end[-1] |= length == longest  # the time limit, which the policy does not see
    join = np.concatenate
    return Steps(
        join([one[:-1] for one in observations]),
        join(actions),
        join(meant),
        join([one[:-1] for one in wanted]),
        join([one[1:] for one in observations]),
        join([one[1:] for one in wanted]),
        join(rewards),
        join(ends),
        np.repeat(np.arange(len(lengths)), lengths),
        join([np.arange(length, dtype=np.float32) / longest for length in lengths]),
        longest,
        None if any(one is None for one in propensities) else join(propensities),
    )


def _parts(episode: Episode, policy: Acting, info: Any, by_success: bool) -> tuple[Any, ...]:
    """The columns of `Steps` of an episode: observations and wanted have the shape (T + 1, ...)."""
    steps = len(episode)
    observations = [indexed(episode.observations, t) for t in range(steps + 1)]
    policy.reset()
    if policy.recurrent:
        actions = [policy.act(one) for one in observations]
    else:
        actions = list(policy.act_batch(episode.observations))
    ends = np.zeros(steps, np.bool_)
    ends[-1] = episode.terminated
    rewards = episode.rewards
    if by_success:
        rewards = np.zeros(steps)
        rewards[-1] = float(episode.success or 0)
    recorded = vectors(info.action_space, [indexed(episode.actions, t) for t in range(steps)])
    return (
        vectors(info.observation_space, observations),
        recorded,
        _meant(episode, recorded, info.action_space),
        vectors(info.action_space, actions),
        rewards,
        ends,
        episode.columns.get("propensity"),
    )


def _meant(episode: Episode, recorded: Floats, space: gym.Space[Any]) -> Floats:
    """What whoever acted would have done without noise; what a person did is what the person meant. Shape: (T, k)."""
    raw = episode.columns.get("raw_action")
    if raw is None:
        return recorded
    is_person = np.asarray(episode.columns.get("intervention", np.zeros(len(recorded))) == 1)
    is_known = np.isfinite(raw.astype(np.float64).reshape(len(raw), -1)).all(axis=1) & ~is_person
    meant: Floats = recorded.copy()
    meant[is_known] = vectors(space, list(raw[is_known])) if is_known.any() else meant[is_known]
    return meant


def vectors(space: gym.Space[Any], values: Sequence[Any]) -> Floats:
    """Values of a space as vectors: Box and Dict as plain numbers, Discrete as one number per choice. Shape: (n, d)."""
    if isinstance(space, gym.spaces.Box):
        plain: Floats = np.asarray(values, np.float32).reshape(len(values), -1)
        return plain
    return np.stack([np.asarray(gym.spaces.flatten(space, value), np.float32) for value in values])
