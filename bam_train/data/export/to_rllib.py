"""RLlib: Parquet files with a row a step, which its offline algorithms read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from bam_train.data.data_set import DataSet
from bam_train.data.recorded_episode import Array, Episode
from bam_train.errors import SettingsError

ROWS_A_FILE = 50_000


def write(data: DataSet, indices: Sequence[int], path: Path) -> str:
    """Write the folder of Parquet files; actions are the environment's own, rewards float32 as RLlib's."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for kind, space in (("observations", data.info.observation_space), ("actions", data.info.action_space)):
        if isinstance(space, (gym.spaces.Dict, gym.spaces.Tuple)):
            what = f"the {kind} are a {type(space).__name__} of several"
            raise SettingsError(f"--to rllib: RLlib reads one array a step, and {what}; use --to minari or --to hdf5")
    tables: list[Any] = []
    count = 0

    def flush() -> None:
        nonlocal count
        name = path / f"episodes-{count:04d}.parquet"
        pq.write_table(pa.concat_tables(tables), name)
        count += 1
        tables.clear()

    for number, episode in enumerate(data.episodes(indices)):
        tables.append(pa.table(_columns(number, episode)))
        if sum(map(len, tables)) >= ROWS_A_FILE:
            flush()
    if tables:
        flush()
    return f"config.offline_data(input_=[{str(path)!r}])"


def _columns(number: int, episode: Episode) -> dict[str, Any]:
    import pyarrow as pa

    steps = len(episode)
    last = np.arange(steps) == steps - 1
    return {
        "eps_id": pa.array([f"{number:06d}"] * steps),
        "t": pa.array(np.arange(steps)),
        "obs": _column(episode.observations[:-1]),
        "actions": _column(episode.actions),
        "rewards": pa.array(episode.rewards.astype(np.float32)),
        "new_obs": _column(episode.observations[1:]),
        "terminateds": pa.array(last & episode.terminated),
        "truncateds": pa.array(last & episode.truncated),
    }


def _column(values: Array) -> Any:
    """Lists of a fixed size; tensors for arrays of several axes, of which Ray Data makes arrays again."""
    import pyarrow as pa

    flat = np.ascontiguousarray(values)
    if values.ndim == 1:
        return pa.array(flat)
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(pa.array(flat.reshape(-1)), values.shape[1])
    return pa.FixedShapeTensorArray.from_numpy_ndarray(flat)
