"""RLlib's own deterministic actions: its connectors, module and distribution, computed by its code.

Of a live algorithm as it is; of `PolicyParts` that were read from a directory by making RLlib's module and connectors
again and giving them the weights, so that nothing is unpickled.
"""

from __future__ import annotations

import copy
import importlib
import logging
import re
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.connectors.env_to_module import FlattenObservations, MeanStdFilter
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.filter import RunningStat

from bam_train.errors import PolicyError
from bam_train.trainers.from_zero import less_start
from bam_train.trainers.rllib.freezing.golden import rows, shifted
from bam_train.trainers.rllib.freezing.parts import Array, Filter, PolicyParts

_OWN = re.compile(r"(ray\.rllib\.algorithms\.\w+\.torch\.default_\w+_torch_rl_module)\.(Default\w+TorchRLModule)")


def rllib_actions(
    parts: PolicyParts, module: Any, env_to_module: Any, config: Any, observations: dict[str, Array]
) -> Array:
    """Return RLlib's own deterministic actions for raw observations, in the environment's action space, (n, ...)."""
    each = [less_start(parts.observation_space, one) for one in rows(observations)]  # RLlib counts from 0
    episodes = [
        SingleAgentEpisode(
            observations=[one], observation_space=parts.observation_space, action_space=parts.action_space
        )
        for one in each
    ]
    pair = (parts.observation_space, parts.action_space)
    every = {INPUT_ENV_SPACES: pair, INPUT_ENV_SINGLE_SPACES: pair}
    before = copy.deepcopy(env_to_module) or config.build_env_to_module_connector(env=None, spaces=every)
    for connector in before.connectors:
        if hasattr(connector, "_update_stats"):
            connector._update_stats = False
    after = config.build_module_to_env_connector(env=None, spaces=every)
    given = {"rl_module": module, "episodes": episodes, "explore": False, "shared_data": {}}
    with torch.no_grad():
        outputs = module.forward_inference(before(batch={}, **given))
        batch = after(batch=outputs, **given)
    actions = batch[Columns.ACTIONS_FOR_ENV] if Columns.ACTIONS_FOR_ENV in batch else batch[Columns.ACTIONS]
    return shifted(parts, np.stack([np.asarray(action) for action in actions]))


def remade(parts: PolicyParts) -> tuple[Any, Any, Any]:
    """Make RLlib's module, env-to-module pipeline and configuration of parts again.

    Raises:
        PolicyError: The module is not of a class of RLlib's own, or the weights do not fit it.
    """
    pair = (parts.observation_space, parts.action_space)
    every = {INPUT_ENV_SPACES: pair, INPUT_ENV_SINGLE_SPACES: pair}
    config = AlgorithmConfig().environment(
        observation_space=pair[0],
        action_space=pair[1],
        normalize_actions=parts.normalize_actions,
        clip_actions=parts.clip_actions,
    )
    config.env_runners(env_to_module_connector=lambda env=None, spaces=None, device=None: _connectors(parts))
    before = config.build_env_to_module_connector(env=None, spaces=every)
    for piece in before.connectors:
        if isinstance(piece, MeanStdFilter) and parts.filter is not None:
            _set_filter(piece, parts.filter)
    return _module(parts, before.observation_space), before, config


def _connectors(parts: PolicyParts) -> list[Any]:
    limit = None if parts.filter is None else parts.filter.limit
    pieces = [FlattenObservations()] if parts.flatten else []
    if parts.filter is not None:
        pieces.insert(0 if parts.filter_first else len(pieces), MeanStdFilter(clip_by_value=limit))
    return pieces


def _set_filter(piece: Any, given: Filter) -> None:
    """Give RLlib's filter the statistics."""
    piece.get_state()  # makes it
    own = piece._filters[None]
    own.demean, own.destd, own.clip = given.center, given.scale, given.limit
    own.running_stats = RunningStat(np.shape(given.mean))
    own.running_stats.num_pushes = given.count
    own.running_stats.mean_array = np.array(given.mean, np.float64)
    own.running_stats.sum_sq_diff_array = np.array(given.squares, np.float64)


def _module(parts: PolicyParts, observation_space: spaces.Space[Any]) -> Any:
    """RLlib's module with the weights."""
    if parts.module is not None:
        return parts.module
    match = _OWN.fullmatch(parts.module_class)
    if match is None:
        raise PolicyError(f"module class {parts.module_class!r} is not one of RLlib's own")
    kind = getattr(importlib.import_module(match[1]), match[2])
    model_config = {**vars(DefaultModelConfig()), **parts.model_config}
    quiet = logging.root.manager.disable
    logging.disable(logging.WARNING)  # RLlib warns of an argument that is not given
    try:
        module = kind(
            observation_space=observation_space,
            action_space=parts.action_space,
            inference_only=True,
            model_config=model_config,
        )
        module.set_state(parts.weights)
    except (AssertionError, AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise PolicyError(f"the weights do not fit {match[2]}: {reason:.200}") from error
    finally:
        logging.disable(quiet)
    return module
