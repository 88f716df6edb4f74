"""Infos of a vector environment as one dict a row, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from bam_envs.remote.transport import Info


def split_infos(infos: Mapping[str, Any], num_envs: int) -> list[Info]:
    """What Gymnasium's vector infos say of each row: row i has `key` where ``infos["_" + key][i]``."""
    rows: list[Info] = [{} for _ in range(num_envs)]
    for key, value in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos.get("_" + key)
        parts = _split(value, num_envs)
        for i, row in enumerate(rows):
            if mask is None or mask[i]:
                row[key] = parts[i]
    return rows


def _split(value: Any, num_envs: int) -> Any:
    if isinstance(value, Mapping):
        return split_infos(value, num_envs)
    if isinstance(value, (np.ndarray, list, tuple)) and len(value) == num_envs:
        return value
    return [value] * num_envs


def join_infos(rows: Sequence[Info]) -> dict[str, Any]:
    """Vector infos of one dict a row, with Gymnasium's masks."""
    infos: dict[str, Any] = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        mask = np.array([key in row for row in rows])
        values = [row[key] for row in rows if key in row]
        infos[key], infos["_" + key] = _join(rows, key, values, mask), mask
    return infos


def _join(rows: Sequence[Info], key: str, values: Sequence[Any], mask: NDArray[np.bool_]) -> Any:
    if all(isinstance(one, Mapping) for one in values):
        return join_infos([row.get(key, {}) for row in rows])
    column = _column(values, len(rows))
    for i, value in zip(np.flatnonzero(mask), values, strict=True):
        column[i] = value
    return column


def _column(values: Sequence[Any], num_envs: int) -> NDArray[Any]:
    """An empty array for the `values` of `num_envs` rows: of numbers where all are of one dtype and shape."""
    if all(isinstance(one, (bool, int, float, np.generic, np.ndarray)) for one in values):
        kinds = {(array.dtype, array.shape) for array in map(np.asarray, values)}
        if len(kinds) == 1:
            [(dtype, shape)] = kinds
            return np.zeros((num_envs, *shape), dtype)
    return np.full(num_envs, None, dtype=object)


def join_observations(space: Space[Any], rows: Sequence[Any]) -> Any:
    """One batch of the observations of all rows, in arrays of its own."""
    return concatenate(space, rows, create_empty_array(space, len(rows)))


def join_final(space: Space[Any], last: Sequence[Any], infos: Sequence[Info]) -> Any:
    """The column ``final_obs``: the last observation of each row's episode, or of the step where it goes on."""
    rows = [info.get("final_obs", observation) for info, observation in zip(infos, last, strict=True)]
    if isinstance(space, spaces.Box):
        return join_observations(space, rows)
    column = np.full(len(rows), None, dtype=object)
    for i, info in enumerate(infos):
        column[i] = info.get("final_obs")
    return column
