"""Seeded evaluation of a policy: success, return and length over a fixed list of episodes; and videos of some.

Episode k starts from ``reset(seed=seed + k)``, independently of the number of environments. Environments run in waves
of one episode each; the steps after the end of an episode, while others are still running, are not counted.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import gt
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from bam_envs.core.validation import NonNegativeInt, PositiveInt, check
from bam_train.env_faults import FiniteVectorEnv
from bam_train.environments import is_batched, make_vector_env
from bam_train.errors import SettingsError
from bam_train.files.pictures import Frame, picture
from bam_train.rollout import BatchPolicy, Parts, PlayedEpisode, rollout

FIRST_SEED = 1_000_000
"""The default seed of the first episode: far from the small seeds that training uses."""
LOOK = 16
"""Episodes that show whether a policy fails too often, of four times as many or more."""

Z95 = 1.959963984540054
"""97.5 % quantile of the normal distribution, for a two-sided 95 % interval."""


@dataclass(frozen=True)
class EvaluationReport:
    """Statistics over all episodes; None where the environment reports no success, or a number is not finite."""

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
    starts: int | None = None
    """Number of different starts that there are, none of which counts twice; None if there are any number."""

    def to_json(self) -> dict[str, Any]:
        """The report as plain JSON values."""
        found = {**asdict(self), "success_interval": self.success_interval and list(self.success_interval)}
        return {name: value for name, value in found.items() if name != "starts" or value is not None}


def wilson_interval(successes: float, episodes: int) -> tuple[float, float]:
    """Wilson's score interval at 95 % for a proportion; valid also for no success and for all.

    Centre (p + z²/2n) / (1 + z²/n), half width z sqrt(p(1-p)/n + z²/4n²) / (1 + z²/n).
    """
    p, z2n = successes / episodes, Z95**2 / episodes
    centre = (p + z2n / 2) / (1 + z2n)
    half = Z95 * math.sqrt(p * (1 - p) / episodes + z2n / (4 * episodes)) / (1 + z2n)
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == episodes else min(1.0, centre + half)
    return low, high


def success_text(successes: int | None, episodes: int) -> str:
    """The success rate, such as ``98.0% (98 of 100; 95 % interval 93.0% to 99.4%)``; None: it is not known."""
    if successes is None:
        return "unknown: the environment does not report is_success"
    low, high = wilson_interval(successes, episodes)
    return f"{successes / episodes:.1%} ({successes} of {episodes}; 95 % interval {low:.1%} to {high:.1%})"


def summarise(env: str, episodes: Sequence[PlayedEpisode], seed: int, starts: int | None = None) -> EvaluationReport:
    """The report over `episodes` (at least one), of which the first has this seed."""

    def finite(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    totals, lengths = np.array([e.total for e in episodes]), np.array([e.length for e in episodes])
    known = [e.success for e in episodes if e.success is not None]
    successes, n = sum(known), len(episodes)
    return EvaluationReport(
        env=env,
        episodes=n,
        seed=seed,
        successes=successes if known else None,
        success_rate=successes / n if known else None,
        success_interval=wilson_interval(successes, n) if known else None,
        return_mean=finite(totals.mean()),
        return_std=finite(totals.std()) if np.isfinite(totals).all() else None,
        return_min=finite(totals.min()),
        return_max=finite(totals.max()),
        length_mean=float(lengths.mean()),
        length_std=float(lengths.std()),
        starts=starts,
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
    most_failures: float = math.inf,
    parts: Callable[[VectorEnv[Any, Any, Any]], Parts | None] = lambda _: None,
    on_wave: Callable[[list[PlayedEpisode], int], object] | None = None,
) -> EvaluationReport:
    """Run `episodes` seeded episodes of the environment `env_id` under `policy` and summarise them.

    Args:
        policy: The policy to evaluate; its recurrent state is reset at the start of every episode.
        env_id: Gymnasium id.
        env_kwargs: Keyword arguments of the environment.
        episodes: At least 1. Of an environment with fewer different starts, each is played once.
        seed: Seed of the first episode; episode k gets ``seed + k``.
        num_envs: Number of environments stepped together; by default that of `default_num_envs`.
        env: A vector environment of `make_vector_env`, used instead of a new one; it is left open.
        most_failures: With more episodes that fail it ends after the wave in progress, but not before `LOOK` episodes,
            or a quarter of all if those are fewer.
        parts: Called with the environments; gives what is kept of each step, see `rollout`. Nothing is kept if there
            are only so many different starts.
        on_wave: Called after every wave with its episodes and the number of all episodes.

    Raises:
        SettingsError: `episodes`, `seed` or `num_envs` out of range.
        PolicyError: An action that is not finite.
        EnvironmentFailed: An observation or a reward that is not finite.
    """
    check(seed, NonNegativeInt, "seed", SettingsError)
    check(episodes, PositiveInt, "episodes", SettingsError)
    check(num_envs, PositiveInt | None, "num_envs", SettingsError)
    if env is not None and env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
        raise SettingsError(f"env: expected autoreset mode SAME_STEP, found {env.metadata.get('autoreset_mode')}")
    num_envs = num_envs or default_num_envs(env_id, episodes)
    made = nullcontext(env) if env is not None else closing(make_vector_env(env_id, env_kwargs, num_envs))
    with made as envs:
        starts, done = number_of_starts(envs), list[PlayedEpisode]()
        least = min(LOOK, episodes / 4)
        first = LOOK if most_failures < LOOK == least else None
        given: dict[str, Any] = {"episodes": episodes, "seed": seed, "first": first, "parts": parts(envs)}
        for wave in waves(FiniteVectorEnv(envs, env_id), policy, **given):
            done += wave
            if on_wave is not None:
                on_wave(wave, min(episodes, starts or episodes))
            if len(done) >= least and sum(e.success is False for e in done) > most_failures:
                break
    return summarise(env_id, done, seed, starts)


def number_of_starts(env: VectorEnv[Any, Any, Any]) -> int | None:
    """How many different episodes can begin; None if there is no such number."""
    count: int | None = getattr(getattr(env.unwrapped, "task", None), "num_starts", None)
    return count


def waves(
    env: VectorEnv[Any, Any, Any],
    policy: BatchPolicy,
    *,
    episodes: int,
    seed: int,
    first: int | None = None,
    parts: Parts | None = None,
) -> Iterator[list[PlayedEpisode]]:
    """Play `episodes` episodes, one in each environment at a time; yields those of each wave that count.

    The first wave has at most `first` episodes. `parts` are as of `evaluate`.

    Episode k starts from ``reset(seed=seed + k)``. Where there are so many starts and no more, such as pictures of a
    test split, an episode counts if its start is new: a second one would say the same.
    """
    inner: Any = env.unwrapped
    starts, played, seen = number_of_starts(env), 0, set[int]()
    left, parts = min(episodes, starts or episodes), parts if starts is None else lambda *_: (inner.task.drawn,)
    while left:
        count = env.num_envs if starts else min(env.num_envs, left if played else first or left, left)
        ended = rollout(env, policy, seed=seed + played, keep=partial(gt, count), parts=parts)
        wave = sorted(ended, key=lambda one: one.env_id)
        if starts is not None:
            new: dict[int, PlayedEpisode] = {}
            for one in wave:
                new.setdefault(int(one.parts[0][0]), one)
            wave = [replace(one, parts=()) for start, one in new.items() if start not in seen]
            seen.update(new)
        wave = wave[:left]
        left, played = left - len(wave), played + count
        yield wave


def record_video(env: gym.Env[Any, Any], policy: Any, add: Callable[[Frame], Any], *, episodes: int, seed: int) -> int:
    """Record a video of a policy, the first frame of every episode included; episode k gets ``seed + k``.

    Args:
        env: Made with ``render_mode="rgb_array"``.
        policy: Has ``reset()`` and ``act(observation)``: a `FrozenPolicy`.
        add: Called with each picture, such as the function that `bam_train.files.pictures.open_video` yields.
        episodes: Number of episodes.
        seed: Seed of the first episode.

    Returns:
        The number of pictures.
    """
    count = 0
    for k in range(episodes):
        observation, _ = env.reset(seed=seed + k)
        policy.reset()
        is_over = False
        while not is_over:
            add(picture(env))
            observation, _, terminated, truncated, _ = env.step(policy.act(observation))
            is_over, count = terminated or truncated, count + 1
        add(picture(env))
        count += 1
    return count


def default_num_envs(env_id: str, episodes: int) -> int:
    """The number of environments for the fewest waves of equal size: 100 batched episodes are two waves of 50."""
    most = 64 if is_batched(env_id) else 16  # batched physics, or Python environments one after the other
    return math.ceil(episodes / math.ceil(episodes / most))
