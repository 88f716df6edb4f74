"""A trained policy that draws its actions as in training, for one environment; a frozen one takes the best ones."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from bam_train.errors import SettingsError
from bam_train.trainers.from_zero import less_start
from bam_train.trainers.rllib.freezing.golden import shifted
from bam_train.trainers.rllib.freezing.parts import PolicyParts


class ExploringPolicy:
    """What RLlib's own module and connectors draw; copies, so that the trainer may go on or be closed.

    Args:
        parts: Of the policy.
        module: The RLModule.
        env_to_module: The env runner's pipeline, or None; what it has learnt of observations does not change.
        config: The AlgorithmConfig; says what is done with actions.

    Raises:
        SettingsError: The policy is recurrent.
    """

    def __init__(self, parts: PolicyParts, module: Any, env_to_module: Any, config: Any) -> None:
        if module.is_stateful():
            raise SettingsError(
                f"{parts.algorithm}: a recurrent policy cannot explore here; let it take its best actions"
            )
        pair = (parts.observation_space, parts.action_space)
        every = {INPUT_ENV_SPACES: pair, INPUT_ENV_SINGLE_SPACES: pair}
        self._parts, self._module = parts, copy.deepcopy(module)
        self._before = copy.deepcopy(env_to_module) or config.build_env_to_module_connector(env=None, spaces=every)
        for connector in self._before.connectors:
            if hasattr(connector, "_update_stats"):
                connector._update_stats = False
        self._after = config.build_module_to_env_connector(env=None, spaces=every)

    def reset(self, rows: Any = None) -> None:
        """Nothing: it has no memory."""

    def act(self, observation: Any) -> Any:
        """An action drawn for one observation, in the environment's action space."""
        parts = self._parts
        episode = SingleAgentEpisode(
            observations=[less_start(parts.observation_space, observation)],  # RLlib counts from 0
            observation_space=parts.observation_space,
            action_space=parts.action_space,
        )
        given = {"rl_module": self._module, "episodes": [episode], "explore": True, "shared_data": {}}
        with torch.no_grad():
            outputs = self._module.forward_exploration(self._before(batch={}, **given))
            batch = self._after(batch=outputs, **given)
        actions = batch[Columns.ACTIONS_FOR_ENV] if Columns.ACTIONS_FOR_ENV in batch else batch[Columns.ACTIONS]
        return shifted(parts, np.asarray(actions[0]))
