"""Seeded evaluation of a policy: success, return and length over a fixed list of episodes.

Episode k starts from ``reset(seed=seed + k)`` however many rows run side by side. Rows are run in waves: every row
plays one episode, and what a row does after its first end is not counted (it keeps stepping only because others are
not done).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from bam_train.environments import is_batched, make_rows
from bam_train.errors import PolicyError, SettingsError

FIRST_SEED = 1_000_000
"""Where evaluation's seeds start unless told: far from the small seeds that training runs start their episodes from."""

_Z95 = 1.959963984540054
"""97.5 % quantile of the normal distribution, for a two-sided 95 % interval."""

_MOST_ROWS = {True: 64, False: 16}
"""Rows stepped side by side at most: batched physics (True) and one Python environment a row (False)."""

OnProgress = Callable[[int, int], None]
"""Called with the episodes done and the episodes wanted."""


class BatchPolicy(Protocol):
    """What can be evaluated: a `FrozenPolicy`, or a trainer's model behind an adapter."""

    def reset(self, rows: Any = None) -> None:
        """Forget the recurrent state of `rows` (indices), or of all rows."""

    def act_batch(self, observations: Any) -> Any:
        """Actions for a batch of observations. Shapes: (n, ...) -> (n, ...)."""


@dataclass(frozen=True)
class Episode:
    """One counted episode."""

    seed: int
    """The seed its reset got."""
    total: float
    """Undiscounted sum of its rewards."""
    length: int
    """Its steps."""
    success: bool | None
    """`is_success` of its last step's info; None if the environment has no such thing."""


@dataclass(frozen=True)
class EvaluationReport:
    """Figures over all episodes; None where the environment does not say, or a number is not finite."""

    env: str
    """Environment id."""
    episodes: int
    seed: int
    """Seed of the first episode; episode k has seed + k."""
    successes: int | None
    success_rate: float | None
    success_interval: tuple[float, float] | None
    """Wilson's 95 % interval of the success rate."""
    return_mean: float | None
    return_std: float | None
    """Spread over episodes (population standard deviation)."""
    return_min: float | None
    return_max: float | None
    length_mean: float
    length_std: float

    def to_json(self) -> dict[str, Any]:
        """The report as plain JSON values."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        interval = self.success_interval
        return {**values, "success_interval": None if interval is None else list(interval)}


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """Wilson's score interval at 95 % for a proportion; right also at 0 and at all.

    Centre (p + z²/2n) / (1 + z²/n), half width z sqrt(p(1-p)/n + z²/4n²) / (1 + z²/n).
    """
    p, z2n = successes / episodes, _Z95**2 / episodes
    centre = (p + z2n / 2) / (1 + z2n)
    half = _Z95 * math.sqrt(p * (1 - p) / episodes + z2n / (4 * episodes)) / (1 + z2n)
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == episodes else min(1.0, centre + half)
    return low, high


def summarise(env: str, episodes: Sequence[Episode]) -> EvaluationReport:
    """The report over `episodes` (at least one), which are in the order of their seeds."""
    totals, lengths = np.array([e.total for e in episodes]), np.array([e.length for e in episodes])
    known = [e.success for e in episodes if e.success is not None]
    successes, n = sum(known), len(episodes)
    return EvaluationReport(
        env=env,
        episodes=n,
        seed=episodes[0].seed,
        successes=successes if known else None,
        success_rate=successes / n if known else None,
        success_interval=wilson_interval(successes, n) if known else None,
        return_mean=_finite(totals.mean()),
        return_std=_finite(totals.std()) if np.isfinite(totals).all() else None,
        return_min=_finite(totals.min()),
        return_max=_finite(totals.max()),
        length_mean=float(lengths.mean()),
        length_std=float(lengths.std()),
    )


def evaluate(
    policy: BatchPolicy,
    env_id: str,
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    episodes: int = 100,
    seed: int = FIRST_SEED,
    num_envs: int | None = None,
    env: VectorEnv[Any, Any, Any] | None = None,
    on_progress: OnProgress | None = None,
) -> EvaluationReport:
    """Run `episodes` seeded episodes of `env_id` under `policy` and summarise them.

    Args:
        policy: What acts; its recurrent state is forgotten at every start of an episode.
        env_id: Gymnasium id of the environment, e.g. ``"bam/pick-v0"``.
        env_kwargs: Its keyword arguments.
        episodes: How many episodes count; at least 1.
        seed: Seed of the first episode; episode k gets ``seed + k``.
        num_envs: Rows stepped side by side; by default as many as is quick and not more than `episodes`.
        env: A vector environment made by `make_rows` to use instead of making one; it is left open.
        on_progress: Called after every wave of rows.

    Raises:
        SettingsError: `episodes`, `seed` or `num_envs` out of range.
        PolicyError: An action that is not finite.
    """
    require_range(episodes, seed, num_envs)
    with _rows(env_id, env_kwargs, num_envs, episodes, env) as rows:
        done: list[Episode] = []
        while len(done) < episodes:
            done += play_wave(rows, policy, seed + len(done), min(rows.num_envs, episodes - len(done)))
            if on_progress is not None:
                on_progress(len(done), episodes)
    return summarise(env_id, done)


def require_range(episodes: int, seed: int, num_envs: int | None = None, **counts: int) -> None:
    """Refuse numbers that cannot be; `counts` are others that have to be at least 1.

    Raises:
        SettingsError: Names the first that is out of range.
    """
    counts = {"episodes": episodes, "num_envs": 1 if num_envs is None else num_envs, **counts}
    for name, value, least in [("seed", seed, 0), *((name, value, 1) for name, value in counts.items())]:
        if value < least:
            raise SettingsError(f"{name}: expected at least {least}, found {value}")


def play_wave(env: VectorEnv[Any, Any, Any], policy: BatchPolicy, seed: int, count: int) -> list[Episode]:
    """One episode in each of the first `count` rows; row i is seeded ``seed + i``.

    The surplus rows of a last, smaller wave run too (a vector environment steps all rows) and are ignored.
    """
    seeds: Any = [seed + i for i in range(env.num_envs)]  # lists are taken, though Gymnasium's hint says int only
    observations, _ = env.reset(seed=seeds)
    policy.reset()
    totals, lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=np.int64)
    success: list[bool | None] = [None] * env.num_envs
    running = np.arange(env.num_envs) < count
    while running.any():
        actions = policy.act_batch(observations)
        require_finite(actions, f"after {int(lengths.max())} steps of the episodes from seed {seed} on")
        observations, rewards, terminated, truncated, infos = env.step(actions)
        totals[running] += rewards[running]
        lengths += running
        ended = np.flatnonzero(terminated | truncated)
        for row in ended[running[ended]]:
            success[row] = final_success(infos, int(row))
        if len(ended):
            policy.reset(ended)
        running[ended] = False
    return [Episode(seed + i, float(totals[i]), int(lengths[i]), success[i]) for i in range(count)]


def final_success(infos: Mapping[str, Any], row: int) -> bool | None:
    """`is_success` at the end of `row`'s episode; None where the environment does not say.

    With automatic resets in the same step, the end's info is in ``infos["final_info"]``, and
    ``infos["is_success"]`` may be the next episode's.
    """
    final = infos.get("final_info", {})
    if "is_success" not in final or not final.get("_is_success", np.ones(row + 1, dtype=bool))[row]:
        return None
    return bool(final["is_success"][row])


def require_finite(action: NDArray[Any], when: str) -> None:
    """Refuse an action that is not finite, naming the first such number.

    Raises:
        PolicyError: One of the numbers is NaN or infinite.
    """
    numbers = np.asarray(action)
    if numbers.dtype.kind == "f" and not np.isfinite(numbers).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(numbers))[0])
        raise PolicyError(
            f"action{list(index)} is {numbers[index]} {when}; expected finite numbers: the policy is broken"
        )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


@contextmanager
def _rows(
    env_id: str,
    env_kwargs: Mapping[str, Any] | None,
    num_envs: int | None,
    episodes: int,
    env: VectorEnv[Any, Any, Any] | None,
) -> Iterator[VectorEnv[Any, Any, Any]]:
    """The given vector environment, left open; or one of our own, closed at the end."""
    if env is not None:
        if env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise SettingsError(f"env: expected autoreset mode SAME_STEP, found {env.metadata.get('autoreset_mode')}")
        yield env
        return
    own = make_rows(env_id, env_kwargs, num_envs or default_rows(env_id, episodes))
    try:
        yield own
    finally:
        own.close()


def default_rows(env_id: str, episodes: int) -> int:
    """Rows that share `episodes` in the fewest waves, evenly: 100 episodes of ours are two waves of 50."""
    most = _MOST_ROWS[is_batched(env_id)]
    return math.ceil(episodes / math.ceil(episodes / most))
