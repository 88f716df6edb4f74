"""What one runner collects, as arrays (row, time, ...), and RLlib's episodes cut out of them at the end."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer

Array = NDArray[Any]


@dataclass(frozen=True)
class End:
    """How an episode went that ended."""

    length: int
    """Its steps."""
    total: float
    """Undiscounted sum of its rewards."""
    success: bool | None
    """None if the environment does not say."""


class Running:
    """The running episode of every row: its name, how far it is, and what it has earned.

    Attributes:
        ids: Names, n.
        lengths: Steps so far. Shape: (n,).
        returns: Undiscounted sums of rewards. Shape: (n,).
    """

    def __init__(self, rows: int) -> None:
        self.ids = [uuid.uuid4().hex for _ in range(rows)]
        self.lengths = np.zeros(rows, np.int64)
        self.returns = np.zeros(rows)

    def restart(self, row: int) -> None:
        """The row's next episode begins."""
        self.ids[row] = uuid.uuid4().hex
        self.lengths[row], self.returns[row] = 0, 0.0


class Rollout:
    """T steps of n rows.

    Args:
        rows: n.
        steps: T at most.
        first: What the rows observe at its start, as the module sees it. Shape: (n, ...).
    """

    def __init__(self, rows: int, steps: int, first: Array) -> None:
        self.steps = 0
        self.observations = np.empty((rows, steps + 1, *first.shape[1:]), first.dtype)
        self.observations[:, 0] = first
        self.rewards = np.empty((rows, steps), np.float32)
        self.terminated = np.zeros((rows, steps), bool)
        self.truncated = np.zeros((rows, steps), bool)
        self._finals: dict[tuple[int, int], tuple[Array, bool | None]] = {}
        self._capacity = steps
        self._columns: dict[str, Array] = {}

    def add(
        self,
        columns: Mapping[str, Array],
        rewards: Array,
        terminated: Array,
        truncated: Array,
        following: Array,
    ) -> None:
        """One step of every row.

        Args:
            columns: Actions and whatever else the module said, each (n, ...).
            rewards: (n,).
            terminated: (n,) bool.
            truncated: (n,) bool.
            following: What the rows observe now, as the module sees it, (n, ...).
        """
        t = self.steps
        for name, values in columns.items():
            if name not in self._columns:
                self._columns[name] = np.empty((len(values), self._capacity, *values.shape[1:]), values.dtype)
            self._columns[name][:, t] = values
        self.rewards[:, t], self.terminated[:, t], self.truncated[:, t] = rewards, terminated, truncated
        self.observations[:, t + 1] = following
        self.steps = t + 1

    def end(self, rows: Array, observations: Array, success: Array | None) -> None:
        """The step that is added next ends the episodes of some rows.

        Args:
            rows: Which, (k,).
            observations: What they observe last, as the module sees it, (k, ...); `add` is given what follows.
            success: Of all rows, (n,) bool; None if the environment does not say.
        """
        for row, last in zip(rows.tolist(), observations, strict=True):
            self._finals[row, self.steps] = last, None if success is None else bool(success[row])

    def episodes(
        self,
        running: Running,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        extra: Mapping[str, Any],
    ) -> tuple[list[SingleAgentEpisode], list[End]]:
        """The steps as episodes and pieces of episodes, those that ended first; and how these went.

        Args:
            running: The rows' episodes as they were when the rollout began; afterwards as they are at its end.
            observation_space: As the module sees it.
            action_space: The environment's.
            extra: Values that every step has, whoever took it.
        """
        ended, open_, ends = [], [], []
        for row in range(len(self.rewards)):
            start = 0
            done = self.terminated[row, : self.steps] | self.truncated[row, : self.steps]
            for stop in (np.flatnonzero(done) + 1).tolist():
                ended.append(self._piece(row, start, stop, running, observation_space, action_space, extra))
                self._go_on(running, row, start, stop)
                success = self._finals[row, stop - 1][1]
                ends.append(End(int(running.lengths[row]), float(running.returns[row]), success))
                running.restart(row)
                start = stop
            if start < self.steps:
                open_.append(self._piece(row, start, self.steps, running, observation_space, action_space, extra))
                self._go_on(running, row, start, self.steps)
        return ended + open_, ends

    def _go_on(self, running: Running, row: int, start: int, stop: int) -> None:
        running.lengths[row] += stop - start
        running.returns[row] += self.rewards[row, start:stop].sum(dtype=np.float64)

    def _piece(
        self,
        row: int,
        start: int,
        stop: int,
        running: Running,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        extra: Mapping[str, Any],
    ) -> SingleAgentEpisode:
        observations = self.observations[row, start : stop + 1].copy()
        terminated, truncated = bool(self.terminated[row, stop - 1]), bool(self.truncated[row, stop - 1])
        if terminated or truncated:
            observations[-1] = self._finals[row, stop - 1][0]
        columns = {name: _buffer(values[row, start:stop].copy()) for name, values in self._columns.items()}
        fixed = {name: _buffer(np.full(stop - start, value)) for name, value in extra.items()}
        before = int(running.lengths[row])
        return SingleAgentEpisode(
            id_=running.ids[row],
            observations=_buffer(observations, observation_space),
            observation_space=observation_space,
            actions=_buffer(columns.pop("actions").data, action_space),
            action_space=action_space,
            rewards=_buffer(self.rewards[row, start:stop].copy()),
            infos=[{}] * (stop - start + 1),
            terminated=terminated,
            truncated=truncated and not terminated,
            extra_model_outputs={**columns, **fixed},
            t_started=before,
            len_lookback_buffer=0,
        )


def _buffer(values: Array, space: gym.Space[Any] | None = None) -> InfiniteLookbackBuffer:
    return InfiniteLookbackBuffer(values, 0, space)
