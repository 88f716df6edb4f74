"""The release gate: may a candidate replace the champion? Decided in simulation, on recorded episodes, or on both.

In simulation both policies play the same seeds, wave after wave, until the verdict stands or the episodes are used up.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

from bam_train.checkpoint import Checkpoint
from bam_train.data import DataSet
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
from bam_train.estimation.paired_test import Pairs, Verdict, verdict_of
from bam_train.estimation.steps import read_steps
from bam_train.evaluation import default_num_envs, waves, wilson_interval
from bam_train.finite_envs import FiniteVectorEnv
from bam_train.policy import FrozenPolicy
from bam_train.rollout import PlayedEpisode


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
