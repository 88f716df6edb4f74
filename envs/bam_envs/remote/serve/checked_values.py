"""What goes into a served environment and what comes out of it, checked, in the form of `Transport`."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector.utils import iterate

from bam_envs.core.errors import InvalidValue
from bam_envs.remote.transports.rows import join_observations, split_infos
from bam_envs.remote.transports.transport import EnvSpecMessage, Info
from bam_envs.remote.transports.trees import plain_info
from bam_envs.remote.transports.values import exact

Begun = tuple[Any, Any]
Stepped = tuple[Any, Any, Any, Any, Any]


class CheckedValues:
    """Values of one environment, or of one with rows: lists with one entry a row outside, batches inside.

    Args:
        spec: What is served.
        batch: The batched observation space of an environment with rows, else None.
    """

    def __init__(self, spec: EnvSpecMessage, batch: Any = None) -> None:
        self._spec, self._batch = spec, batch

    def action(self, action: Any) -> Any:
        """An action for the environment. Raises InvalidValue if it does not fit."""
        if not self._spec.vector:
            return exact(self._spec.action_space, action, "action")
        rows = list(action) if isinstance(action, (list, tuple, np.ndarray)) else []
        if len(rows) != self._spec.num_envs:
            raise InvalidValue(f"There must be one action for each of {self._spec.num_envs} rows, not {len(rows)}.")
        space = self._spec.action_space
        return join_observations(space, [exact(space, row, f"action of row {i}") for i, row in enumerate(rows)])

    def begun(self, observation: Any, info: Any) -> Begun:
        """What a reset gave. Raises InvalidValue for what an environment must not say."""
        if not self._spec.vector:
            return self._observation(observation), plain_info(info)
        return self._rows(observation), self._infos(info)

    def stepped(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> Stepped:
        """What a step gave. Raises InvalidValue for what an environment must not say."""
        if not self._spec.vector:
            seen = self._observation(observation)
            return seen, _reward(reward), bool(terminated), bool(truncated), plain_info(info)
        rewards = [_reward(one, f"reward of row {i}") for i, one in enumerate(reward)]
        ends = [[bool(one) for one in flags] for flags in (terminated, truncated)]
        return self._rows(observation), rewards, *ends, self._infos(info)  # type: ignore[return-value]

    def _observation(self, value: Any, name: str = "observation") -> Any:
        return exact(self._spec.observation_space, value, name)

    def _rows(self, observation: Any) -> list[Any]:
        rows = iterate(self._batch, observation)
        return [self._observation(row, f"observation of row {i}") for i, row in enumerate(rows)]

    def _infos(self, infos: Any) -> list[Info]:
        rows = split_infos(infos, self._spec.num_envs)
        return [self._row_info(row, i) for i, row in enumerate(rows)]

    def _row_info(self, info: Info, row: int) -> Info:
        plain: Info = plain_info({key: value for key, value in info.items() if key != "final_obs"})
        if "final_obs" in info:
            plain["final_obs"] = self._observation(info["final_obs"], f"final_obs of row {row}")
        return plain


def _reward(value: Any, name: str = "reward") -> float:
    reward = float(value)
    if reward != reward:
        raise InvalidValue(f"{name} is NaN; only numbers are sent.")
    return reward
