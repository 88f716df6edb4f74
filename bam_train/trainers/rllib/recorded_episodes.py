"""Data sets for bc, marwil, cql and iql: read while learning, in blocks of episodes, within bounded memory.

RLlib sends every row of every update through Ray Data as a separate episode, at a few thousand rows a second. Here a
learner reads blocks of episodes into its memory and draws rows from them, a hundred times as fast. One update learns
from ``train_batch_size_per_learner`` rows, each of which counts as a step of the run. Each learner reads its own
episodes, so several learners share a data set, at a place that all of them reach.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from gymnasium import Space, spaces
from numpy.typing import NDArray
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.offline.offline_data import OfflineData
from ray.rllib.utils.spaces.space_utils import normalize_action

from bam_envs.core.spaces import space_to_json
from bam_train.data import DataSet
from bam_train.errors import SettingsError
from bam_train.settings import RLlibSettings
from bam_train.trainers.rllib import register_foreign
from bam_train.trainers.zero_based_spaces import less_start

Array = NDArray[Any]

_MOST_UPDATES = 100  # of an iteration
_BLOCK_STEPS = 20_000
"""About so many steps are read together; batches are drawn from `_BLOCKS` blocks."""
_BLOCKS = 8


def add_data(config: Any, settings: RLlibSettings, observation_space: Space[Any], action_space: Space[Any]) -> Any:
    """Configure learning from recorded episodes; returns the configuration.

    Raises:
        SettingsError: There are no episodes, or they do not fit the environment.
    """
    require_fit(settings.data or "", observation_space, action_space)
    batch = int(settings.hyperparameters["train_batch_size_per_learner"])
    updates = max(2, min(_MOST_UPDATES, min(settings.steps, settings.eval_every or settings.steps) // batch))
    config.environment(
        observation_space=observation_space, action_space=action_space, env_config=dict(settings.env_kwargs)
    )
    if config.is_online:  # CQL, a subclass of SAC, makes an environment without stepping it
        config.environment(register_foreign(settings.env), disable_env_checking=True)
        config.env_runners(num_env_runners=0)
    config.offline_data(input_=[settings.data], offline_data_class=RecordedData, dataset_num_iters_per_learner=updates)
    return config


class RecordedData(OfflineData):  # type: ignore[misc]
    """RLlib's `OfflineData` for a data set, for `AlgorithmConfig.offline_data`."""

    def __init__(self, config: Any) -> None:  # not RLlib's, which opens files with Ray Data
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
        self._gamma = float(config.gamma)

    def iter_torch_batches(self, *, batch_size: int, device: Any = None, **_: Any) -> Iterator[dict[str, Any]]:
        """Yield batches of tensors (batch_size, ...) by module and column, as ``default_policy/obs``."""
        data, rng = DataSet.open(self._data), np.random.default_rng(self._seed)
        parts = blocks(data, self._shard, self._shards, rng)
        tables = (table_of(data, part, self._gamma) for part in parts)
        for batch in draws(tables, batch_size, rng, every=len(next(blocks(data, 0, 1, rng))) == len(data)):
            yield {f"{DEFAULT_MODULE_ID}/{name}": torch.from_numpy(one).to(device) for name, one in batch.items()}


def require_fit(data: str, observation_space: Space[Any], action_space: Space[Any]) -> None:
    """Raise SettingsError unless a data set has episodes of these spaces."""
    found = DataSet.open(data)
    if not len(found):
        raise SettingsError(f"data: {data} has no episodes yet. Record some first")
    pairs = ((found.info.observation_space, observation_space), (found.info.action_space, action_space))
    for (theirs, ours), name in zip(pairs, ("observation", "action"), strict=True):
        if space_to_json(theirs) != space_to_json(ours):
            raise SettingsError(f"data: {data} has the {name} space {theirs}, and the environment {ours}")


def table_of(data: DataSet, indices: list[int], gamma: float) -> dict[str, Array]:
    """Read episodes in the form that RLlib's learners take.

    Returns:
        Columns (rows, ...): obs, new_obs, actions, rewards, terminateds, truncateds, value_targets (the sum of the
        rewards from a row to the last one of its episode, discounted by `gamma`), weights, n_step.

    Raises:
        SettingsError: A number is not finite, or an action not in its space.
    """
    steps = data.transitions(indices)
    last = np.append(steps.episode[1:] != steps.episode[:-1], True)
    rewards = steps.rewards.astype(np.float32)
    found = {"obs": steps.observations, "new_obs": steps.next_observations, "actions": steps.actions}
    for name, values in {**found, "rewards": rewards}.items():
        if not np.isfinite(np.asarray(values, np.float64)).all():
            raise SettingsError(f"data: {data.place}: {name} has a number that is not finite; see bam-data check")
    total, targets = 0.0, np.empty_like(rewards)
    for t in range(len(rewards) - 1, -1, -1):  # R_t = r_t + gamma R_{t+1}, 0 after an episode's last row
        total = float(rewards[t]) + (0.0 if last[t] else gamma * total)
        targets[t] = total
    return {
        "obs": steps.observations,
        "new_obs": steps.next_observations,
        "actions": _for_module(f"data: {data.place}: actions", steps.actions, data.info.action_space),
        "rewards": rewards,
        "terminateds": steps.terminals,
        "truncateds": last & ~steps.terminals,
        "value_targets": targets,
        "weights": np.ones_like(rewards),
        "n_step": np.ones_like(rewards),
    }


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


def blocks(data: DataSet, shard: int, shards: int, rng: np.random.Generator) -> Iterator[list[int]]:
    """Endless lists of neighbouring episodes, every `shards`-th one from `shard` on, in random order."""
    length = max(1, int(np.mean([data.facts(index)["length"] for index in range(min(len(data), 1000))])))
    size = max(1, min(_BLOCK_STEPS // length, len(data) // shards))
    starts = list(range(0, len(data), size))
    own = starts[shard % len(starts) :: shards]
    while True:
        for start in rng.permutation(own).tolist():
            yield list(range(start, min(start + size, len(data))))


def draws(
    tables: Iterator[dict[str, Array]], batch_size: int, rng: np.random.Generator, every: bool
) -> Iterator[dict[str, Array]]:
    """Endless batches from the newest blocks; `every`: of one block, which is then not read again."""
    pool: deque[dict[str, Array]] = deque(maxlen=_BLOCKS)
    for table in tables:
        pool.append(table)
        sizes = np.array([len(one["rewards"]) for one in pool])
        count = len(table["rewards"]) // batch_size + 1
        while every or count > 0:
            count -= 1
            drawn = rng.multinomial(batch_size, sizes / sizes.sum())
            parts = [(one, rng.integers(len(one["rewards"]), size=n)) for one, n in zip(pool, drawn, strict=True) if n]
            yield {name: np.concatenate([one[name][rows] for one, rows in parts]) for name in table}
