"""Recorded episodes for bc, marwil, cql and iql: Parquet files, one row a step.

Columns: ``eps_id`` (text), ``obs``, ``actions``, ``rewards``, ``new_obs``, ``terminateds``, ``truncateds``; others
are left alone. The rows of an episode follow one another. Actions are the environment's own; they are scaled
to [-1, 1] here, as RLlib's modules take them.

RLlib would send every row of every update through Ray Data as an episode of its own, at a few thousand rows a second.
Here a learner reads the files into its memory once and draws its rows from there, a hundred times as fast. One update
learns from ``train_batch_size_per_learner`` rows, and each of these is a step of the run.
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

from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.rllib.rllib_registration import register_foreign

Array = NDArray[Any]

COLUMNS = ("eps_id", "obs", "actions", "rewards", "new_obs", "terminateds", "truncateds")
"""What every file must have."""

_MOST_UPDATES = 100
"""Updates of an iteration."""


class RecordedData(OfflineData):  # type: ignore[misc]
    """RLlib's `OfflineData` over files that fit into memory: what `AlgorithmConfig.offline_data` takes.

    Args:
        config: Its ``input_`` names the files, its spaces say what is in them.
    """

    def __init__(self, config: Any) -> None:  # not RLlib's, which opens the files with Ray Data
        self._config = config
        self.iter_batches_kwargs: dict[str, Any] = {}
        self.spaces = self.module_spec = self.learner_handles = self.locality_hints = None  # RLlib sets them

    def sample(self, num_samples: int, return_iterator: bool = True, num_shards: int = 1) -> list[Draws]:
        """One endless iterator for each learner; they draw apart from each other."""
        seed = self._config.seed or 0
        return [Draws(self._config.input_[0], self._config, seed + shard) for shard in range(max(1, num_shards))]


class Draws:
    """Rows drawn at random, batch after batch; travels to its learner without the rows.

    Args:
        data: Folder or address of the files.
        config: Says the spaces and the discount.
        seed: Of the draws.
    """

    def __init__(self, data: str, config: Any, seed: int) -> None:
        self._data, self._seed = data, seed
        self._spaces = config.observation_space, config.action_space
        self._gamma = float(config.gamma)

    def iter_torch_batches(self, *, batch_size: int, device: Any = None, **_: Any) -> Iterator[dict[str, Any]]:
        """Batches of tensors by the module's name and the column's."""
        table = load(self._data, *self._spaces, self._gamma)
        columns = {name: torch.from_numpy(values).to(device or "cpu") for name, values in table.items()}
        rng = np.random.default_rng(self._seed)
        while True:
            rows = torch.from_numpy(rng.integers(len(table["rewards"]), size=batch_size)).to(device or "cpu")
            yield {f"{DEFAULT_MODULE_ID}/{name}": values[rows] for name, values in columns.items()}


def load(data: str, observation_space: Space[Any], action_space: Space[Any], gamma: float) -> dict[str, Array]:
    """All rows, as RLlib's learners take them.

    Args:
        data: Folder or address of the files.
        observation_space: The environment's.
        action_space: The environment's.
        gamma: Discount of ``value_targets``, the rewards from a row to the end of what was recorded of its episode.

    Returns:
        Columns (rows, ...): obs, new_obs, actions, rewards, terminateds, truncateds, value_targets, weights, n_step.

    Raises:
        SettingsError: There are no rows, or one has a value that is missing, not finite or not in its space.
    """
    path, filesystem = open_data(data)
    table = pyarrow.parquet.ParquetDataset(path, filesystem=filesystem).read(list(COLUMNS))
    shapes = {"obs": observation_space.shape, "new_obs": observation_space.shape, "actions": action_space.shape}
    columns = {
        name: _sound(f"data: {data}: {name}", _column(table[name]), shapes.get(name) or ())
        for name in COLUMNS
        if name != "eps_id"
    }
    _require_choices(data, columns["actions"], action_space)
    rewards = columns["rewards"].astype(np.float32)
    episode = np.asarray(table["eps_id"].to_pylist())
    last = np.append(episode[1:] != episode[:-1], True) | columns["terminateds"] | columns["truncateds"]
    return {
        "obs": columns["obs"].astype(observation_space.dtype),
        "new_obs": columns["new_obs"].astype(observation_space.dtype),
        "actions": as_module(columns["actions"], action_space),
        "rewards": rewards,
        "terminateds": columns["terminateds"].astype(bool),
        "truncateds": columns["truncateds"].astype(bool),
        "value_targets": returns(rewards, last, gamma),
        "weights": np.ones_like(rewards),
        "n_step": np.ones_like(rewards),
    }


def returns(rewards: Array, last: Array, gamma: float) -> NDArray[np.float32]:
    """Discounted rewards from each row to the end of its episode: R_t = r_t + gamma R_{t+1}, 0 after `last`.

    Args:
        rewards: (rows,).
        last: Whether a row is its episode's last, (rows,) bool.
        gamma: Discount.
    """
    total, targets = 0.0, np.empty(len(rewards), np.float32)
    for t in range(len(rewards) - 1, -1, -1):
        total = float(rewards[t]) + (0.0 if last[t] else gamma * total)
        targets[t] = total
    return targets


def _column(column: Any) -> Array | None:
    """A column as one array; that of (nested) lists has more axes. None if the lists differ in length."""
    shape: list[int] = []
    flat = column.combine_chunks()
    while pyarrow.types.is_list(flat.type) or pyarrow.types.is_fixed_size_list(flat.type):
        lengths = pyarrow.compute.unique(pyarrow.compute.list_value_length(flat)).to_pylist()
        if len(lengths) > 1 or None in lengths:
            return None
        flat = flat.flatten()
        shape.append(max(lengths, default=0))
    values: Array = flat.to_numpy(zero_copy_only=False)
    return values.reshape(-1, *shape) if shape else values


def _sound(what: str, values: Array | None, shape: tuple[int, ...]) -> Array:
    """The column, if all of its rows are whole.

    Args:
        what: As errors name it.
        values: (rows, ...); None if its rows are of different lengths.
        shape: Of a row.
    """
    if values is None or (len(values) and values.shape[1:] != shape):
        found = "rows of different lengths" if values is None else f"shape {values.shape[1:]}"
        raise SettingsError(f"{what}: expected rows of shape {shape}, found {found}")
    if not len(values):
        raise SettingsError(f"{what}: expected a row or more, found none")
    if values.dtype.kind not in "biuf" or not np.isfinite(values).all():
        raise SettingsError(f"{what}: expected finite numbers, found others or rows without one. Record it again")
    return values


def _require_choices(data: str, actions: Array, space: Space[Any]) -> None:
    """Refuse choices that there are not."""
    if isinstance(space, spaces.Discrete):
        least, most = np.asarray(space.start), np.asarray(space.start + space.n - 1)
    elif isinstance(space, spaces.MultiDiscrete):
        least, most = space.start, space.start + space.nvec - 1
    else:
        return
    wrong = actions[((actions < least) | (actions > most)).reshape(len(actions), -1).any(axis=1)]
    if len(wrong):
        raise SettingsError(f"data: {data}: actions: expected {least} to {most}, found {wrong[0]}")


def as_module(actions: NDArray[Any], space: Space[Any]) -> NDArray[Any]:
    """The environment's actions (n, ...) as a module of RLlib says them: from -1 to 1, counted from 0."""
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return np.asarray(actions - space.start, np.int64)
    scaled: NDArray[Any] = np.asarray(normalize_action(actions.astype(space.dtype), space), space.dtype)
    return scaled


def add_data(config: Any, settings: TrainSettings, observation_space: Space[Any], action_space: Space[Any]) -> Any:
    """Let a configuration learn from the recorded episodes of a run; returns it.

    Raises:
        SettingsError: There are none, or they do not fit the environment.
    """
    path, filesystem = open_data(settings.data or "")
    require_columns(settings.data or "", path, filesystem, observation_space, action_space)
    batch = int(settings.hyperparameters["train_batch_size_per_learner"])
    updates = max(2, min(_MOST_UPDATES, min(settings.steps, settings.eval_every or settings.steps) // batch))
    config.environment(
        observation_space=observation_space, action_space=action_space, env_config=dict(settings.env_kwargs)
    )
    if config.is_online:  # CQL, as a kind of SAC, makes an environment that it then does not step
        config.environment(register_foreign(settings.env), disable_env_checking=True)
        config.env_runners(num_env_runners=0)
    config.offline_data(
        input_=[settings.data],
        offline_data_class=RecordedData,
        dataset_num_iters_per_learner=updates,
    )
    return config


def open_data(data: str) -> tuple[str, Any]:
    """Path and filesystem of a folder of Parquet files, here or anywhere that fsspec knows.

    Raises:
        SettingsError: It is not there, is no such folder, or its filesystem needs a package that is not.
    """
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


def require_columns(
    data: str, path: str, filesystem: Any, observation_space: Space[Any], action_space: Space[Any]
) -> None:
    """Refuse files that lack a column, or whose observations or actions are of another size.

    Raises:
        SettingsError: Names the column, what was expected and what was found.
    """
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
