"""Recorded episodes for bc, marwil, cql and iql: a data set, or plain Parquet files with one row per step.

A data set is read while learning (`streamed_episodes`). Plain files have the columns ``eps_id`` (text), ``obs``,
``actions`` (in the environment's action space), ``rewards``, ``new_obs``, ``terminateds``, ``truncateds``; others are
ignored. The rows of an episode are consecutive.

RLlib sends every row of every update through Ray Data as a separate episode, at a few thousand rows a second. Here a
learner reads the files into its memory once and draws rows from it, a hundred times as fast. One update learns from
``train_batch_size_per_learner`` rows, each of which counts as a step of the run.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import fsspec
import numpy as np
import pyarrow.compute
import pyarrow.fs
import pyarrow.parquet
import torch
from gymnasium import Space, spaces
from numpy.typing import NDArray
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.offline.offline_data import OfflineData
from ray.rllib.utils.spaces.space_utils import normalize_action

from bam_train.data import DataSet
from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.rllib import register_foreign
from bam_train.trainers.rllib.streamed_episodes import blocks, columns_of, draws, is_data_set, require_fit
from bam_train.trainers.zero_based_spaces import less_start

Array = NDArray[Any]

COLUMNS = ("eps_id", "obs", "actions", "rewards", "new_obs", "terminateds", "truncateds")
"""Columns that every file must have."""

_MOST_UPDATES = 100  # of an iteration


def add_data(config: Any, settings: TrainSettings, observation_space: Space[Any], action_space: Space[Any]) -> Any:
    """Configure learning from recorded episodes; returns the configuration.

    Raises:
        SettingsError: There are no episodes, or they do not fit the environment.
    """
    _require_columns(settings.data or "", observation_space, action_space)
    batch = int(settings.hyperparameters["train_batch_size_per_learner"])
    updates = max(2, min(_MOST_UPDATES, min(settings.steps, settings.eval_every or settings.steps) // batch))
    config.environment(
        observation_space=observation_space, action_space=action_space, env_config=dict(settings.env_kwargs)
    )
    if config.is_online:  # CQL, a subclass of SAC, makes an environment without stepping it
        config.environment(register_foreign(settings.env), disable_env_checking=True)
        config.env_runners(num_env_runners=0)
    config.offline_data(
        input_=[settings.data],
        offline_data_class=RecordedData,
        dataset_num_iters_per_learner=updates,
    )
    return config


class RecordedData(OfflineData):  # type: ignore[misc]
    """RLlib's `OfflineData` for files that fit into memory, for `AlgorithmConfig.offline_data`."""

    def __init__(self, config: Any) -> None:  # not RLlib's, which opens the files with Ray Data
        self._config = config
        self.iter_batches_kwargs: dict[str, Any] = {}
        self.spaces = self.module_spec = self.learner_handles = self.locality_hints = None  # RLlib sets them

    def sample(self, num_samples: int, return_iterator: bool = True, num_shards: int = 1) -> list[Draws]:
        """One endless iterator for each learner, with its own random numbers."""
        seed = self._config.seed or 0
        count = max(1, num_shards)
        return [Draws(self._config.input_[0], self._config, seed, shard, count) for shard in range(count)]


class Draws:
    """Batches of random rows for the learner `shard` of `shards`; pickled without the rows."""

    def __init__(self, data: str, config: Any, seed: int, shard: int = 0, shards: int = 1) -> None:
        self._data, self._seed, self._shard, self._shards = data, seed + shard, shard, shards
        self._spaces = config.observation_space, config.action_space
        self._gamma = float(config.gamma)

    def iter_torch_batches(self, *, batch_size: int, device: Any = None, **_: Any) -> Iterator[dict[str, Any]]:
        """Yield batches of tensors (batch_size, ...) by module and column, as ``default_policy/obs``."""
        if is_data_set(self._data):
            for batch in self._streamed(batch_size):
                yield {f"{DEFAULT_MODULE_ID}/{name}": torch.from_numpy(one).to(device) for name, one in batch.items()}
        table = load(self._data, *self._spaces, self._gamma)
        columns = {name: torch.from_numpy(values).to(device or "cpu") for name, values in table.items()}
        rng = np.random.default_rng(self._seed)
        while True:
            rows = torch.from_numpy(rng.integers(len(table["rewards"]), size=batch_size)).to(device or "cpu")
            yield {f"{DEFAULT_MODULE_ID}/{name}": values[rows] for name, values in columns.items()}

    def _streamed(self, batch_size: int) -> Iterator[dict[str, Array]]:
        """Batches of a data set, of which a few blocks of episodes are in memory."""
        data, rng = DataSet.open(self._data), np.random.default_rng(self._seed)
        parts = blocks(data, self._shard, self._shards, rng)
        tables = (for_learners(self._data, *columns_of(data, part), *self._spaces, self._gamma) for part in parts)
        return draws(tables, batch_size, rng, every=len(next(blocks(data, 0, 1, rng))) == len(data))


def load(data: str, observation_space: Space[Any], action_space: Space[Any], gamma: float) -> dict[str, Array]:
    """Read all rows in the form that RLlib's learners take.

    Returns:
        Columns (rows, ...): obs, new_obs, actions, rewards, terminateds, truncateds, value_targets (the sum of the
        rewards from a row to the last recorded one of its episode, discounted by `gamma`), weights, n_step.

    Raises:
        SettingsError: There are no rows, or a value is missing, not finite or not in its space.
    """
    path, filesystem = _open(data)
    table = pyarrow.parquet.ParquetDataset(path, filesystem=filesystem).read(list(COLUMNS))
    shapes = {"obs": observation_space.shape, "new_obs": observation_space.shape, "actions": action_space.shape}
    columns = {
        name: _column(f"data: {data}: {name}", table[name], shapes.get(name) or ())
        for name in COLUMNS
        if name != "eps_id"
    }
    episode = np.asarray(table["eps_id"].to_pylist())
    last = np.append(episode[1:] != episode[:-1], True) | columns["terminateds"] | columns["truncateds"]
    return for_learners(data, columns, last, observation_space, action_space, gamma)


def for_learners(
    data: str,
    columns: dict[str, Array],
    last: Array,
    observation_space: Space[Any],
    action_space: Space[Any],
    gamma: float,
) -> dict[str, Array]:
    """The result of `load` from the columns of files; `last` (rows,) says which rows end an episode."""
    rewards = columns["rewards"].astype(np.float32)
    total, targets = 0.0, np.empty_like(rewards)
    for t in range(len(rewards) - 1, -1, -1):  # R_t = r_t + gamma R_{t+1}, 0 after an episode's last row
        total = float(rewards[t]) + (0.0 if last[t] else gamma * total)
        targets[t] = total
    return {
        "obs": columns["obs"].astype(observation_space.dtype),
        "new_obs": columns["new_obs"].astype(observation_space.dtype),
        "actions": _for_module(f"data: {data}: actions", columns["actions"], action_space),
        "rewards": rewards,
        "terminateds": columns["terminateds"].astype(bool),
        "truncateds": columns["truncateds"].astype(bool),
        "value_targets": targets,
        "weights": np.ones_like(rewards),
        "n_step": np.ones_like(rewards),
    }


def _column(name: str, column: Any, shape: tuple[int, ...]) -> Array:
    """A column of numbers, or of (nested) lists of them, as one array (rows, *shape); SettingsError for others."""
    found: list[int] | None = []
    values = column.combine_chunks()
    while found is not None and (pyarrow.types.is_list(values.type) or pyarrow.types.is_fixed_size_list(values.type)):
        lengths = pyarrow.compute.unique(pyarrow.compute.list_value_length(values)).to_pylist()
        whole = len(lengths) <= 1 and None not in lengths
        found = [*found, max(lengths, default=0)] if whole else None
        values = values.flatten()
    if not len(column):
        raise SettingsError(f"{name}: expected a row or more, found none")
    if found is None or tuple(found) != shape:
        text = "rows of different lengths" if found is None else f"shape {tuple(found)}"
        raise SettingsError(f"{name}: expected rows of shape {shape}, found {text}")
    array: Array = values.to_numpy(zero_copy_only=False).reshape(-1, *shape)
    if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
        raise SettingsError(f"{name}: expected finite numbers, found others or rows without one. Record it again")
    return array


def _for_module(name: str, actions: Array, space: Space[Any]) -> Array:
    """Convert the environment's actions (n, ...) to those of an RLlib module: from -1 to 1, or counted from 0."""
    if not isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return np.asarray(normalize_action(actions.astype(space.dtype), space), space.dtype)
    choices = space.n if isinstance(space, spaces.Discrete) else space.nvec
    least, most = np.asarray(space.start), np.asarray(space.start + choices - 1)
    wrong = actions[((actions < least) | (actions > most)).reshape(len(actions), -1).any(axis=1)]
    if len(wrong):
        raise SettingsError(f"{name}: expected {least} to {most}, found {wrong[0]}")
    return np.asarray(less_start(space, actions), np.int64)


def _open(data: str) -> tuple[str, Any]:
    """Path and filesystem of a folder of Parquet files, local or at any fsspec address."""
    try:
        known, path = fsspec.core.url_to_fs(os.path.expanduser(data))
        files = [path] if known.isfile(path) else sorted(known.glob(f"{path.rstrip('/')}/**/*.parquet"))
    except (ImportError, ValueError, OSError) as error:
        raise SettingsError(f"data: {data} cannot be opened: {' '.join(str(error).split())}") from error
    if not files:
        what = "has no .parquet file in it" if known.exists(path) else "does not exist"
        raise SettingsError(f"data: {data} {what}. Write some with scripts/record_parquet.py")
    if known.protocol in ("file", ("file", "local")):
        return str(path), None
    return str(path), pyarrow.fs.PyFileSystem(pyarrow.fs.FSSpecHandler(known))


def _require_columns(data: str, observation_space: Space[Any], action_space: Space[Any]) -> None:
    """Refuse files that lack a column, or have observations or actions of another shape."""
    if is_data_set(data):
        require_fit(data, observation_space, action_space)
        return
    path, filesystem = _open(data)
    try:
        dataset = pyarrow.parquet.ParquetDataset(path, filesystem=filesystem)
        names = dataset.schema.names
        missing = [name for name in COLUMNS if name not in names]
        if missing:
            raise SettingsError(f"data: {data} lacks the column {', '.join(missing)}; it has {', '.join(names)}")
        first = dataset.fragments[0].head(1, columns=["obs", "actions"]).to_pylist()
    except (OSError, pyarrow.ArrowInvalid) as error:
        raise SettingsError(f"data: {data} cannot be read as Parquet: {' '.join(str(error).split())}") from error
    for name, space in (("obs", observation_space), ("actions", action_space)):
        found = np.shape(first[0][name]) if first else space.shape
        if found != space.shape:
            raise SettingsError(f"data: {data}: expected {name} of shape {space.shape}, found {found}")
