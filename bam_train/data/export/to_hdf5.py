"""HDF5 as robomimic has it: ``data/demo_K/obs/NAME``, and ``next_obs/NAME``, ``actions``, ``rewards``, ``dones``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bam_envs.core.errors import MissingExtra
from bam_train.data.data_set import DataSet


def write(data: DataSet, indices: Sequence[int], path: Path) -> str:
    """Write the file; ``terminated``, ``truncated`` and further columns (``columns/NAME``) stand beside ``dones``."""
    try:
        import h5py
    except ImportError as error:
        raise MissingExtra("h5py", "data", "export --to hdf5") from error
    with h5py.File(path, "w") as file:
        root = file.create_group("data")
        for number, episode in enumerate(data.episodes(indices)):
            demo = root.create_group(f"demo_{number}")
            last = np.arange(len(episode)) == len(episode) - 1
            for leaf in data.info.observation_leaves:
                values, name = leaf.of(episode.observations), leaf.column.removeprefix("observation.")
                demo[f"obs/{name}"], demo[f"next_obs/{name}"] = values[:-1], values[1:]
            for leaf in data.info.action_leaves:
                demo[leaf.column.replace("action", "actions", 1)] = leaf.of(episode.actions)
            demo["rewards"], demo["dones"] = episode.rewards, last.astype(np.int64)
            demo["terminated"], demo["truncated"] = last & episode.terminated, last & episode.truncated
            for name, values in episode.columns.items():
                demo[f"columns/{name}"] = values.astype(h5py.string_dtype()) if values.dtype.kind == "U" else values
            facts = {"digest": episode.digest, "facts": json.dumps(data.facts(indices[number]))}
            demo.attrs.update({"num_samples": len(episode), **facts})
        env = {"env_name": data.info.env, "env_kwargs": data.info.env_kwargs, "type": 2}  # robomimic's: a gym
        root.attrs.update({"total": sum(data.facts(i)["length"] for i in indices), "env_args": json.dumps(env)})
        root.attrs["bam"] = json.dumps(data.info.to_json())
    return f"h5py.File({str(path)!r})['data/demo_0/obs']"
