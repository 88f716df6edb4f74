"""Play a policy in environments side by side: `rollout` gives whole episodes, and `play` every step of them.

Environments restart in the same step (`AutoresetMode.SAME_STEP`), or are reset before the next one (`DISABLED`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple, Protocol

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from bam_envs.core.spaces import joined, leaves_by_path, part_at
from bam_train.env_faults import require_finite_action

Array = NDArray[Any]
Parts = Callable[[Any, Array], tuple[Array, ...]]
"""Called with observations and actions (n, ...) before each step; returns what is kept of the step, (n, ...) each."""


class BatchPolicy(Protocol):
    """A policy that can be played: a `FrozenPolicy`, or an adapter of a trainer's model."""

    def reset(self, env_ids: Any = None) -> None:
        """Forget the recurrent state of `env_ids` (indices), or of all environments."""

    def act_batch(self, observations: Any) -> Any:
        """Actions for a batch of observations. Shapes: (n, ...) -> (n, ...)."""


@dataclass(frozen=True)
class PlayedEpisode:
    """An episode that has ended."""

    seed: int | None
    """Seed of its reset; None if the environment was not seeded for it."""
    total: float
    """Undiscounted sum of its rewards."""
    length: int
    """Number of steps."""
    success: bool | None
    """`is_success` in the info of its last step; None if the environment does not report it."""
    env_id: int = 0
    """Index of its environment."""
    parts: tuple[Array, ...] = ()
    """What was kept of its steps; see `Parts`. Shape: (T, ...) each."""


class PlayedStep(NamedTuple):
    """What a step of n environments led to."""

    observations: Any
    """The next ones to act on, of ended episodes the first of the next ones (last ones if `DISABLED`). (n, ...)"""
    rewards: NDArray[np.float64]
    """Shape: (n,)."""
    terminated: NDArray[np.bool_]
    """Shape: (n,)."""
    truncated: NDArray[np.bool_]
    """Shape: (n,)."""
    infos: dict[str, Any]
    """Of the vector environment."""
    ended: list[PlayedEpisode]
    """The episodes that ended, in the order of their environments."""

    @property
    def following(self) -> Any:
        """The observations that the step led to, of ended episodes the last ones. Shape: (n, ...)."""
        return last_observations(self.observations, self.infos, self.terminated | self.truncated)


def rollout(
    envs: VectorEnv[Any, Any, Any],
    policy: BatchPolicy,
    *,
    seed: int | None = None,
    keep: Callable[[int], bool] = lambda number: True,
    parts: Parts | None = None,
    limit: int | None = None,
) -> Iterator[PlayedEpisode]:
    """Play until no episode runs that is kept, and yield those as they end, whole.

    Args:
        envs: The environments.
        policy: Its recurrent state is reset where an episode begins.
        seed: Environment i is seeded with ``seed + i`` at first, and not again.
        keep: Whether an episode is yielded, by its number in the order of beginning; asked when it begins.
        parts: What is kept of each step; by default nothing.
        limit: Most steps of every environment; what runs then is not yielded.

    Raises:
        PolicyError: An action is not finite.
    """
    begun, rest = envs.num_envs, getattr(envs.unwrapped, "rest", None)
    kept = [keep(number) for number in range(begun)]
    begins_to_rest = not all(kept)
    try:
        for step in islice(play(envs, policy, seed=seed, parts=parts), limit):
            for episode in step.ended:
                if kept[episode.env_id]:
                    yield episode
                kept[episode.env_id] = keep(begun)
                begun += 1
            if not any(kept):
                return
            if rest is not None and (step.ended or begins_to_rest):
                rest(~np.array(kept))
                begins_to_rest = False
    finally:
        if rest is not None:
            rest(np.zeros(envs.num_envs, dtype=bool))


def play(
    envs: VectorEnv[Any, Any, Any],
    policy: BatchPolicy,
    *,
    seed: int | None = None,
    observations: Any = None,
    parts: Parts | None = None,
) -> Iterator[PlayedStep]:
    """Step all environments without end, and yield each step; see `rollout`.

    Args:
        envs: The environments.
        policy: Its recurrent state is reset where an episode begins.
        seed: As of `rollout`.
        observations: Those of episodes that have begun already, from which to go on; by default all are reset.
        parts: As of `rollout`.
    """
    n, restarts = envs.num_envs, envs.metadata.get("autoreset_mode") is not AutoresetMode.DISABLED
    totals, lengths, rows = np.zeros(n), np.zeros(n, np.int64), list[tuple[Array, ...]]()
    if observations is None:
        observations, _ = envs.reset(seed=seed)
    else:
        seed = None
    seeds = [None if seed is None else seed + i for i in range(n)]
    policy.reset()
    while True:
        actions = np.asarray(policy.act_batch(observations))
        require_finite_action(actions, lengths, "an episode" if seed is None else f"the episodes from seed {seed} on")
        if parts is not None:
            rows.append(tuple(map(np.array, parts(observations, actions))))
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        totals += rewards
        lengths += 1
        over = terminated | truncated
        ended = []
        for i in np.flatnonzero(over).tolist():
            own = tuple(np.array([part[i] for part in column]) for column in zip(*rows[-lengths[i] :], strict=True))
            ended.append(PlayedEpisode(seeds[i], float(totals[i]), int(lengths[i]), success_of(infos, i), i, own))
            totals[i], lengths[i], seeds[i] = 0, 0, None
        del rows[: len(rows) - lengths.max()]
        yield PlayedStep(observations, rewards, terminated, truncated, infos, ended)
        if ended:
            if not restarts:
                observations, _ = envs.reset(options={"reset_mask": over})
            policy.reset(np.flatnonzero(over))


def success_of(infos: Mapping[str, Any], env_id: int) -> bool | None:
    """``is_success`` in the last info of an environment whose episode ended; None if it is not reported."""
    final = infos.get("final_info", infos)
    if "is_success" not in final or not final.get("_is_success", {env_id: True})[env_id]:
        return None
    return bool(final["is_success"][env_id])


def last_observations(observations: Any, infos: Mapping[str, Any], ended: NDArray[np.bool_]) -> Any:
    """Observations (n, ...) after a step, with the last ones of the episodes that `ended` (n,) in their places."""
    rows = np.flatnonzero(ended).tolist()
    return _replaced(observations, infos["final_obs"], rows) if rows and "final_obs" in infos else observations


def _replaced(observations: Any, final: Any, rows: list[int]) -> Any:
    """`observations` with the `rows` of `final`: nested as they are, or an array with one observation for each."""
    is_nested, merged = isinstance(final, (Mapping, tuple)), {}
    for path, array in leaves_by_path(observations):
        merged[path] = np.array(array)
        for i in rows:
            merged[path][i] = part_at(final, path)[i] if is_nested else part_at(final[i], path)
    return joined(observations, merged)
