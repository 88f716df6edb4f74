"""Observations and infos of a batch of environments, from one value for each environment, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from gymnasium.vector.utils import concatenate, create_empty_array

from bam_envs.remote.transport import Info


def split_infos(infos: Mapping[str, Any], num_envs: int) -> list[Info]:
    """The info of each environment out of Gymnasium's vector infos: i has `key` where ``infos["_" + key][i]``."""
    each: list[Info] = [{} for _ in range(num_envs)]
    for key, value in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos.get("_" + key)
        if isinstance(value, Mapping):
            value = split_infos(value, num_envs)
        elif not isinstance(value, (np.ndarray, list, tuple)) or len(value) != num_envs:
            value = [value] * num_envs
        for i, info in enumerate(each):
            if mask is None or mask[i]:
                info[key] = value[i]
    return each


def join_infos(each: Sequence[Info]) -> dict[str, Any]:
    """Vector infos with Gymnasium's masks, of one info for each environment."""
    infos: dict[str, Any] = {}
    for key in dict.fromkeys(key for info in each for key in info):
        mask = np.array([key in info for info in each])
        values = [info[key] for info in each if key in info]
        if all(isinstance(one, Mapping) for one in values):
            infos[key] = join_infos([info.get(key, {}) for info in each])
        else:
            infos[key] = _column(values, len(each))
            for i, value in zip(np.flatnonzero(mask), values, strict=True):
                infos[key][i] = value
        infos["_" + key] = mask
    return infos


def _column(values: Sequence[Any], num_envs: int) -> np.ndarray[Any, Any]:
    """An empty array for the `values` of `num_envs` environments: of numbers where all have one dtype and shape."""
    if all(isinstance(one, (bool, int, float, np.generic, np.ndarray)) for one in values):
        kinds = {(array.dtype, array.shape) for array in map(np.asarray, values)}
        if len(kinds) == 1:
            [(dtype, shape)] = kinds
            return np.zeros((num_envs, *shape), dtype)
    return np.full(num_envs, None, dtype=object)


def join_observations(space: Space[Any], each: Sequence[Any]) -> Any:
    """One batch of the observations (or actions) of all environments, in arrays of its own."""
    return concatenate(space, each, create_empty_array(space, len(each)))


def join_final(space: Space[Any], last: Sequence[Any], infos: Sequence[Info]) -> Any:
    """``final_obs`` of a batch: the last observation of each episode that ended, or of the step where it goes on."""
    if isinstance(space, spaces.Box):
        final = [info.get("final_obs", observation) for info, observation in zip(infos, last, strict=True)]
        return join_observations(space, final)
    column = np.full(len(infos), None, dtype=object)
    for i, info in enumerate(infos):
        column[i] = info.get("final_obs")
    return column
