"""Data sets for bc, marwil, cql and iql of RLlib: read while learning, in blocks of episodes, within bounded memory.

Each learner reads its own episodes, so several learners share a data set, at a place that all of them reach.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import Space
from numpy.typing import NDArray

from bam_envs.core.spaces import space_to_json
from bam_train.data import DataSet
from bam_train.errors import PlaceError, SettingsError
from bam_train.files.place import Place

Array = NDArray[Any]
_BLOCK_STEPS = 20_000
"""About so many steps are read together; batches are drawn from `_BLOCKS` blocks."""
_BLOCKS = 8


def is_data_set(data: str) -> bool:
    """Whether there is a data set at a place, and no plain Parquet files."""
    try:
        return bool((Place(data) / "meta" / "bam.json").exists())
    except PlaceError:  # an address of fsspec alone
        return False


def require_fit(data: str, observation_space: Space[Any], action_space: Space[Any]) -> None:
    """Raise SettingsError unless a data set has episodes of these spaces."""
    found = DataSet.open(data)
    if not len(found):
        raise SettingsError(f"data: {data} has no episodes yet. Record some first")
    pairs = ((found.info.observation_space, observation_space), (found.info.action_space, action_space))
    for (theirs, ours), name in zip(pairs, ("observation", "action"), strict=True):
        if space_to_json(theirs) != space_to_json(ours):
            raise SettingsError(f"data: {data} has the {name} space {theirs}, and the environment {ours}")


def columns_of(data: DataSet, indices: list[int]) -> tuple[dict[str, Array], Array]:
    """Columns of plain Parquet files from episodes, and whether each row is its episode's last. Shape: (rows, ...)."""
    steps = data.transitions(indices)
    last = np.append(steps.episode[1:] != steps.episode[:-1], True)
    columns = {
        "obs": steps.observations,
        "actions": steps.actions,
        "rewards": steps.rewards,
        "new_obs": steps.next_observations,
        "terminateds": steps.terminals,
        "truncateds": last & ~steps.terminals,
    }
    for name, values in columns.items():
        if not np.isfinite(np.asarray(values, np.float64)).all():
            raise SettingsError(f"data: {data.place}: {name} has a number that is not finite; see bam-data check")
    return columns, last


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
