"""Minari 0.5: one HDF5 file under a root folder, pictures without loss."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.core.errors import MissingExtra
from bam_train.data.data_set import DataSet
from bam_train.data.recorded_episode import DataSetInfo, Episode


def write(data: DataSet, indices: Sequence[int], path: Path) -> str:
    """Write the folder that ``MINARI_DATASETS_PATH`` names.

    ``infos`` of an episode are the further columns, one row a step (T, not T + 1 as a collector's). Its metadata has
    ``digest``, ``success`` and ``facts`` (JSON).
    """
    try:
        import h5py  # noqa: F401 - Minari's error comes late
        import minari
    except ImportError as error:
        raise MissingExtra(error.name or "minari", "data", "export --to minari") from error
    name = f"{data.info.env.rpartition(':')[2].rpartition('-v')[0] or 'bam'}/recorded-v0"
    with _root(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no author, no address of code, older gymnasium
        made = minari.create_dataset_from_buffers(
            name,
            (_buffer(number, one) for number, one in enumerate(data.episodes(indices))),
            observation_space=data.info.observation_space,
            action_space=data.info.action_space,
            algorithm_name=", ".join(sorted({str(data.facts(i).get("policy", "")) for i in indices} - {""})) or None,
            jpeg_encoding=False,
        )
        made.storage.update_episode_metadata([_metadata(data, index) for index in indices], range(len(indices)))
        made.storage.update_metadata({"env_spec": spec} if (spec := _spec(data.info)) else {})
    return f"MINARI_DATASETS_PATH={path} python -c 'import minari; minari.load_dataset(\"{name}\")'"


def _buffer(number: int, episode: Episode) -> Any:
    from minari.data_collector import EpisodeBuffer

    last = np.arange(len(episode)) == len(episode) - 1
    infos = {name: values.tolist() if values.dtype.kind in "UO" else values for name, values in episode.columns.items()}
    seed = episode.facts.get("seed")
    return EpisodeBuffer(
        id=number,
        seed=seed if isinstance(seed, int) else None,
        observations=episode.observations,
        actions=episode.actions,
        rewards=episode.rewards,
        terminations=last & episode.terminated,
        truncations=last & episode.truncated,
        infos=infos or None,
    )


def _metadata(data: DataSet, index: int) -> dict[str, Any]:
    facts = data.facts(index)
    known = {} if facts["success"] is None else {"success": facts["success"]}
    return {"digest": data.digests[index], "facts": json.dumps(facts), **known}


def _spec(info: DataSetInfo) -> str:
    """The environment for ``recover_environment``; "" where it is not registered here."""
    try:
        spec = gym.spec(info.env)
        spec.kwargs |= info.env_kwargs
        return spec.to_json()
    except (gym.error.Error, ModuleNotFoundError, TypeError, ValueError):
        return ""


@contextmanager
def _root(path: Path) -> Iterator[None]:
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(path.resolve())  # Minari cannot size a file below a relative one
    try:
        yield
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before
