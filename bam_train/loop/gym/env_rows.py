"""n single environments stepped one after the other, as rows: the hot path of `ParallelGymAgent`.

Everything here is lists and small arrays; nothing knows of workspaces or tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import add
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import Autoreset
from numpy.typing import NDArray

from bam_train.loop.gym.peeling import NEVER, Env, Peeled, Result, Step, peel


class Rows(NamedTuple):
    """What n environments gave at one time; n of each.

    Attributes:
        observations: As the environments gave them.
        rewards: Of the step; 0 at a reset.
        terminated: Gymnasium's flag.
        truncated: Gymnasium's flag.
        infos: As the environments gave them.
        cumulated: Undiscounted sum of the episode's rewards so far.
        timestep: Steps since the reset, int64. A new array at every time.
    """

    observations: Sequence[Any]
    rewards: Sequence[Any]
    terminated: Sequence[bool]
    truncated: Sequence[bool]
    infos: Sequence[dict[str, Any]]
    cumulated: list[float]
    timestep: NDArray[np.int64]


def has_autoreset(env: Env) -> bool:
    """Whether a Gymnasium `Autoreset` is anywhere in the chain of wrappers."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Autoreset):
            return True
        env = env.env
    return False


class EnvRows:
    """The environments of one run, with the sums and counts of their episodes.

    Args:
        envs: With an `Autoreset` in the chain of each where `autoreset` is True.
        autoreset: Whether an ended episode is followed by a new one; else its last frame is repeated with reward 0.
        include_last_state: Whether the row at which an episode ends has its last observation. If not it has the
            first of the next episode, and no row is spent on the reset.
    """

    def __init__(self, envs: Sequence[Env], autoreset: bool, include_last_state: bool) -> None:
        self._envs, self._autoreset, self._include_last = envs, autoreset, include_last_state
        self._peeled: list[Peeled] = [peel(env, autoreset) for env in envs]
        self._steps: list[Step] = [one.step for one in self._peeled]
        self._cumulated: list[float] = [0.0] * len(envs)
        self._timestep = np.zeros(len(envs), dtype=np.int64)
        self._advance: Any = 1
        self._now = 0
        self._deadlines = [one.limit for one in self._peeled]  # when each row is truncated, by `_now`
        self._soonest = min(self._deadlines)
        self._resetting: list[int] = []  # rows whose next step is a reset

    def reset(self, seeds: Sequence[int | None]) -> Rows:
        """Begin an episode in every environment."""
        pairs = [env.reset(seed=seed) for env, seed in zip(self._envs, seeds, strict=True)]
        zeros, no = [0.0] * len(pairs), [False] * len(pairs)
        observations, infos = zip(*pairs, strict=True)
        return Rows(observations, zeros, no, no, infos, zeros, self._timestep.copy())

    def step(self, actions: Sequence[Any]) -> Rows:
        """Step every environment that has not ended for good."""
        results = [step(action) for step, action in zip(self._steps, actions, strict=True)]
        self._now += 1
        if self._resetting:
            self._have_reset()
        if self._now >= self._soonest:
            self._truncate(results)
        observations, rewards, terminated, truncated, infos = zip(*results, strict=True)
        self._cumulated = cumulated = list(map(add, self._cumulated, rewards))
        self._timestep = timestep = self._timestep + self._advance
        rows = Rows(observations, rewards, terminated, truncated, infos, cumulated, timestep)
        if any(terminated) or any(truncated):
            return self._ended(rows)
        return rows

    def _have_reset(self) -> None:
        """After the step that reset some rows."""
        for k in self._resetting:
            self._steps[k], self._deadlines[k] = self._peeled[k].step, self._now + self._peeled[k].limit
            self._soonest = min(self._soonest, self._deadlines[k])
        self._resetting = []

    def _truncate(self, results: list[Result]) -> None:
        """Truncate the rows whose time limit has come, as `TimeLimit` does."""
        for k, deadline in enumerate(self._deadlines):
            if self._now >= deadline:
                observation, reward, terminated, _, info = results[k]
                results[k] = (observation, reward, terminated, True, info)
                self._deadlines[k] = NEVER  # until the next reset
        self._soonest = min(self._deadlines)

    def _ended(self, rows: Rows) -> Rows:
        """After a step at which episodes ended."""
        flags = zip(rows.terminated, rows.truncated, strict=True)
        ended = [k for k, (terminated, truncated) in enumerate(flags) if terminated or truncated]
        if not self._autoreset:
            self._stop(ended, rows)
            return rows
        self._cumulated, self._timestep = rows.cumulated.copy(), rows.timestep.copy()
        for k in ended:
            self._cumulated[k] = 0.0
            self._timestep[k] = -1  # so that the reset is step 0
            self._steps[k] = self._peeled[k].start_reset()
            self._deadlines[k] = NEVER
        self._resetting = ended
        if self._include_last:
            return rows
        observations = list(rows.observations)
        for k in ended:
            observations[k] = self._steps[k](None)[0]
        self._have_reset()
        return rows._replace(observations=observations)

    def _stop(self, ended: Sequence[int], rows: Rows) -> None:
        """From now on, repeat the last frame of these environments."""
        self._advance = np.ones(len(self._envs), dtype=np.int64)
        for k in ended:
            last = (rows.observations[k], 0.0, rows.terminated[k], rows.truncated[k], rows.infos[k])
            self._steps[k] = _Repeat(last)
            self._advance[k], self._deadlines[k] = 0, NEVER


class _Repeat:
    """Stands in for the step of an environment that has ended for good."""

    def __init__(self, result: Result) -> None:
        self._result = result

    def __call__(self, action: Any) -> Result:
        return self._result
