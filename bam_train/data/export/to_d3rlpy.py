"""d3rlpy 2.8: the file of a `ReplayBuffer`. d3rlpy's own reader of Minari files shifts observations; this does not."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.core.errors import MissingExtra
from bam_train.data.data_set import DataSet
from bam_train.data.recorded_episode import Array, DataSetInfo, Episode
from bam_train.errors import SettingsError


def write(data: DataSet, indices: Sequence[int], path: Path) -> str:
    """Write what ``ReplayBuffer.load`` reads."""
    require_fit(data.info)
    io = import_d3rlpy().dataset.io
    with path.open("w+b") as file:
        io.dump(Episodes(data, indices), file)
    return f"d3rlpy.dataset.ReplayBuffer.load(open({str(path)!r}, 'rb'), d3rlpy.dataset.InfiniteBuffer())"


def require_fit(info: DataSetInfo) -> None:
    """Refuse actions that d3rlpy does not know."""
    if not isinstance(info.action_space, (gym.spaces.Box, gym.spaces.Discrete)):
        found = type(info.action_space).__name__
        raise SettingsError(
            f"--to d3rlpy: its actions are Box or Discrete, found {found}; use --to minari or --to hdf5"
        )


class Episodes(Sequence[Any]):
    """The episodes as d3rlpy's, one file in memory at a time."""

    def __init__(self, data: DataSet, indices: Sequence[int]) -> None:
        self._data, self._indices = data, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, place: Any) -> Any:
        return as_d3rlpy(self._data.info, self._data[self._indices[place]])

    def __iter__(self) -> Iterator[Any]:
        return (as_d3rlpy(self._data.info, one) for one in self._data.episodes(self._indices))


def as_d3rlpy(info: DataSetInfo, episode: Episode) -> Any:
    """An episode of d3rlpy with T transitions, whose observations and next observations are those of `episode`.

    Floats are float32; pictures are (channels, height, width); a Dict is a list in the order of the space. d3rlpy has
    the next observation of a step only as the observation of the following one. So an episode that did not terminate
    gets one more row, with the final observation, an action and a reward of zeros, of which d3rlpy makes no transition.
    The last next observation of a terminated episode has no place; d3rlpy puts zeros there, and no algorithm uses it.
    """
    d3rlpy = import_d3rlpy()
    more = 0 if episode.terminated else 1
    steps = len(episode)
    observed = [_observed(leaf.of(episode.observations))[: steps + more] for leaf in info.observation_leaves]
    actions = _columns(episode.actions, steps)
    rewards = episode.rewards.astype(np.float32).reshape(steps, 1)
    if more:
        actions, rewards = (np.concatenate([one, np.zeros_like(one[:1])]) for one in (actions, rewards))
    return d3rlpy.dataset.Episode(
        observed if isinstance(info.observation_space, (gym.spaces.Dict, gym.spaces.Tuple)) else observed[0],
        actions,
        rewards,
        terminated=bool(episode.terminated),
    )


def _observed(values: Array) -> Array:
    return (
        np.moveaxis(values, -1, 1) if values.ndim == 4 and values.dtype == np.uint8 else _columns(values, len(values))
    )


def _columns(values: Array, steps: int) -> Array:
    """Shape (steps, ...) with at least one axis more; floats as float32."""
    wide = values.reshape(steps, *(values.shape[1:] or (1,)))
    return wide.astype(np.float32) if wide.dtype.kind == "f" else wide


def import_d3rlpy() -> Any:
    """The package d3rlpy, whose own log and the warnings of the old gym stay silent."""
    import contextlib
    import io

    quiet = logging.getLogger("OpenGL")  # which d3rlpy's dependencies may log at import
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            quiet.setLevel(logging.WARNING)
            import d3rlpy
    except ImportError as error:
        raise MissingExtra("d3rlpy", "offline", "export --to d3rlpy") from error
    return d3rlpy
