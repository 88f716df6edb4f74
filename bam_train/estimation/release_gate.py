"""The release gate: may a candidate replace the champion? Decided in simulation, on recorded episodes, or on both.

In simulation both policies play the same seeds, wave after wave, until the verdict stands or the episodes are used up.
A pair is one seed, or one start, with the outcome of both. It scores +1 where only the candidate succeeds, -1 where
only the champion does, and 0 otherwise; its mean is the difference of the success rates. The interval of the difference
may be looked at as often as one likes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from bam_train.checkpoint import Checkpoint
from bam_train.data import DataSet
from bam_train.env_faults import FiniteVectorEnv
from bam_train.environments import (
    environment_of,
    first_difference,
    held_out,
    interface_in,
    interface_pairs,
    make_vector_env,
    require_env_kwargs,
    require_fit,
)
from bam_train.errors import CheckpointMismatch, SettingsError
from bam_train.estimation.data_evaluation import (
    Seen,
    require_contrast,
    require_enough,
    require_same_interface,
    unseen_indices,
    within_bounds,
)
from bam_train.estimation.estimates import Estimate
from bam_train.estimation.fitted_q import fit_q
from bam_train.estimation.steps import read_steps
from bam_train.evaluation import default_num_envs, waves, wilson_interval
from bam_train.policy import FrozenPolicy
from bam_train.rollout import PlayedEpisode

Verdict = Literal["better", "not worse", "worse", "undecided"]
ERROR = 0.05
"""Share of comparisons whose interval may miss the true difference at any of the looks; half of it on each side."""
_BETS = np.geomspace(0.004, 0.99, 24)
"""Shares of the stake that are bet, with equal weights; small ones for long comparisons, large ones for few losses."""


@dataclass(frozen=True)
class Pairs:
    """Counts of the outcomes of pairs."""

    wins: int = 0
    """Only the candidate succeeded."""
    ties: int = 0
    losses: int = 0
    """Only the champion succeeded."""

    def __len__(self) -> int:
        return self.wins + self.ties + self.losses

    def __add__(self, other: Pairs) -> Pairs:
        return Pairs(self.wins + other.wins, self.ties + other.ties, self.losses + other.losses)

    @property
    def difference(self) -> float:
        """Mean score; 0 without pairs."""
        return (self.wins - self.losses) / max(1, len(self))

    def interval(self, error: float = ERROR) -> tuple[float, float]:
        """Interval of the true difference that covers it at all looks together with probability 1 - `error`.

        The difference is at most m as long as nobody could have grown rich by betting against that: a stake that wins
        ``b (x - m) / (1 + m)`` of itself with each score x is a supermartingale if the mean of x is m or less, so that
        it exceeds 2 / `error` with probability `error` / 2 at most (Ville). Waudby-Smith and Ramdas, Estimating means
        of bounded random variables by betting (2024), section 4; here the stake is spread over fixed bets b.
        """
        low = _least(self.wins, self.ties, self.losses, error / 2)
        return low, -_least(self.losses, self.ties, self.wins, error / 2)

    def verdict(self, margin: float) -> Verdict:
        """What the interval says; see `verdict_of`."""
        return verdict_of(self.interval(), margin)

    def is_decided(self, margin: float) -> bool:
        """Whether more pairs would hardly change the verdict: better, worse, or equal but for the margin."""
        is_equal = self._is_more_than(-margin) and self._is_less_than(margin)
        return is_equal or self._is_more_than(0.0) or self._is_less_than(0.0)

    def _is_more_than(self, mean: float) -> bool:
        """Whether all of the interval is above `mean`."""
        return _is_refuted(self.wins, self.ties, self.losses, mean, ERROR / 2)

    def _is_less_than(self, mean: float) -> bool:
        return _is_refuted(self.losses, self.ties, self.wins, -mean, ERROR / 2)


def _is_refuted(wins: int, ties: int, losses: int, mean: float, error: float) -> bool:
    """Whether the bets against a true mean of `mean` or less have won 1 / `error` times the stake."""
    bet = _BETS / (1 + mean)
    wealth = wins * np.log1p(bet * (1 - mean)) + ties * np.log1p(-bet * mean) + losses * np.log1p(-_BETS)
    return bool(np.logaddexp.reduce(wealth) >= math.log(len(_BETS) / error))


def _least(wins: int, ties: int, losses: int, error: float) -> float:
    """The least mean that is not refuted at level `error`."""
    low, high = -1.0, 1.0
    for _ in range(30):  # wealth falls as the mean that is bet against grows
        mean = (low + high) / 2
        if _is_refuted(wins, ties, losses, mean, error):
            low = mean
        else:
            high = mean
    return low


def verdict_of(interval: tuple[float, float], margin: float) -> Verdict:
    """The verdict on a candidate by the interval of its difference from the champion.

    Better: all of the interval is above 0. Worse: all of it is below 0. Not worse: all of it is above -`margin`.
    """
    low, high = interval
    if low > 0:
        return "better"
    if high < 0:
        return "worse"
    return "not worse" if low > -margin else "undecided"


@dataclass(frozen=True)
class Comparison:
    """A candidate and a champion over pairs of episodes."""

    env: str
    metric: str
    """``success``, or ``return`` where the environment reports no success: then the higher return of a pair wins."""
    verdict: Verdict
    margin: float
    episodes: int
    """Pairs of episodes."""
    seed: int
    candidate: float
    """Success rate, or mean return."""
    champion: float
    wins: int
    losses: int
    difference: float
    """Of the success rates, or of the shares of pairs with the higher return."""
    interval: tuple[float, float]
    """95 % interval of the difference, valid although it was looked at after every wave."""

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {**asdict(self), "interval": list(self.interval)}


def compare(
    candidate: Checkpoint,
    champion: Checkpoint,
    env: str | None = None,
    env_kwargs: dict[str, Any] | None = None,
    *,
    margin: float,
    episodes: int,
    seed: int,
    num_envs: int | None = None,
    on_progress: Callable[[int, Pairs], None] = lambda done, pairs: None,
) -> Comparison:
    """Play the environment of the champion with both policies.

    Args:
        candidate: The policy that may replace the champion.
        champion: The policy in use; the environment and its arguments are those that it was trained with.
        env: Refuse checkpoints of another environment.
        env_kwargs: Arguments of the environment; they win over the champion's.
        margin: A candidate that is worse by less than this counts as not worse, in shares of episodes.
        episodes: Most pairs of episodes.
        seed: Seed of the first pair; pair k has ``seed + k``.
        num_envs: Environments side by side.
        on_progress: Called after every wave with the number of pairs and their outcomes.

    Raises:
        SettingsError: The environment does not take these arguments.
        CheckpointMismatch: A checkpoint does not fit the environment.
    """
    require_comparable(candidate, champion)
    env_id, kwargs = environment_of(champion, env)
    require_env_kwargs(env_id, env_kwargs or {})
    policies = [FrozenPolicy.from_checkpoint(one) for one in (candidate, champion)]
    played: list[list[PlayedEpisode]] = [[], []]
    pairs = Pairs()
    width = num_envs or default_num_envs(env_id, episodes)
    with closing(make_vector_env(env_id, held_out(env_id, kwargs, env_kwargs or {}), width)) as envs:
        for one in (candidate, champion):
            require_fit(one, envs)
        finite = FiniteVectorEnv(envs, env_id)
        sides = [waves(finite, policy, episodes=episodes, seed=seed) for policy in policies]
        for wave in zip(*sides, strict=True):
            for all_of_it, new in zip(played, wave, strict=True):
                all_of_it += new
            pairs += count_pairs(*wave)
            on_progress(len(pairs), pairs)
            if pairs.is_decided(margin):
                break
    return _comparison(env_id, played, pairs, margin, seed)


def require_comparable(candidate: Checkpoint, champion: Checkpoint) -> None:
    """Refuse a candidate of another environment, other spaces, units or rate than those of the champion."""
    theirs, remedy = champion.manifest, f"Compare it with a champion of {candidate.manifest.env}"
    candidate.requires_env(theirs.env, f"{champion.path} is the champion of that one. {remedy}")
    if found := first_difference(*interface_pairs(candidate, interface_in(theirs))):
        what, one, other = found
        text = f"{what} is {one}, and {other} in the champion {champion.path}"
        raise CheckpointMismatch(candidate.path, f"{text}; a gate compares policies that see and do the same")


def count_pairs(candidate: list[PlayedEpisode], champion: list[PlayedEpisode]) -> Pairs:
    """Who wins each pair of episodes: by success, or by return where success is not reported."""
    by_success = all(one.success is not None for one in (*candidate, *champion))
    scores = [[float(one.success or 0) if by_success else one.total for one in side] for side in (candidate, champion)]
    wins = sum(one > other for one, other in zip(*scores, strict=True))
    losses = sum(one < other for one, other in zip(*scores, strict=True))
    return Pairs(wins, len(candidate) - wins - losses, losses)


def _comparison(env: str, played: list[list[PlayedEpisode]], pairs: Pairs, margin: float, seed: int) -> Comparison:
    known = [[one.success is not None for one in side] for side in played]
    by_success = all(map(all, known))
    if not by_success and any(map(any, known)):
        raise SettingsError(f"{env}: some episodes report is_success and others do not; report it in all of them")
    means = [sum(float(one.success or 0) if by_success else one.total for one in side) / len(side) for side in played]
    return Comparison(
        env=env,
        metric="success" if by_success else "return",
        verdict=pairs.verdict(margin),
        margin=margin,
        episodes=len(pairs),
        seed=seed,
        candidate=means[0],
        champion=means[1],
        wins=pairs.wins,
        losses=pairs.losses,
        difference=pairs.difference,
        interval=pairs.interval(),
    )


@dataclass(frozen=True)
class DataComparison:
    """A candidate and a champion on recorded episodes."""

    place: str
    metric: str
    """``success``, or ``return`` if an episode has no success."""
    verdict: Verdict
    episodes: int
    candidate: Estimate
    champion: Estimate
    difference: Estimate

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        estimates = {name: getattr(self, name).to_json() for name in ("candidate", "champion", "difference")}
        return {**vars(self), **estimates}


def compare_on_data(
    candidate: Checkpoint, champion: Checkpoint, data: DataSet, *, margin: float, seen: Seen = "refuse"
) -> DataComparison:
    """Estimate the value of both policies by fitted Q evaluation, from the same draws of the same episodes.

    Args:
        candidate: The policy that may replace the champion.
        champion: The policy in use.
        data: Episodes of any policy.
        margin: A success rate that is lower by less than this is not worse; of a return, in shares of its spread.
        seen: What becomes of episodes that one of the two learnt from.

    Raises:
        CheckpointMismatch: Another environment, other spaces or units, or one of the two learnt from these episodes.
        BadDataSet: Too few episodes, or observations with pictures.
    """
    both = (candidate, champion)
    for one in both:
        require_same_interface(one, data)
    indices = sorted(set.intersection(*(set(unseen_indices(one, data, seen)) for one in both)))
    require_enough(data, len(indices))
    by_success = all(data.facts(index)["success"] is not None for index in indices)
    steps = [read_steps(data, FrozenPolicy.from_checkpoint(one), indices, by_success) for one in both]
    require_contrast(data, steps[0])
    fitted = [fit_q(one) for one in steps]
    difference = fitted[0].estimate(other=fitted[1])
    if by_success:  # no surer than as many pairs without a difference
        half, value = wilson_interval(0, len(indices))[1], difference.value
        low, high = difference.interval
        difference = Estimate(value, (min(low, value - half), max(high, value + half)), difference.effective)
    unit = 1.0 if by_success else max(1e-9, float(steps[0].returns.std()))
    return DataComparison(
        place=data.place,
        metric="success" if by_success else "return",
        verdict=verdict_of(difference.interval, margin * unit),
        episodes=len(indices),
        candidate=within_bounds(fitted[0].estimate(), by_success),
        champion=within_bounds(fitted[1].estimate(), by_success),
        difference=difference,
    )
