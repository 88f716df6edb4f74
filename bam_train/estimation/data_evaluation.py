"""Evaluate a policy on recorded episodes, without a robot and without simulation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import Checkpoint
from bam_train.data import DataSet
from bam_train.environments import first_difference, interface_pairs, names_and_units
from bam_train.errors import BadDataSet, CheckpointMismatch
from bam_train.estimation.estimates import (
    Array,
    Estimate,
    action_ratios,
    doubly_robust,
    importance_sampling,
    self_normalised,
)
from bam_train.estimation.fitted_q import FittedQ, fit_q
from bam_train.estimation.steps import Steps, read_steps
from bam_train.evaluation import wilson_interval
from bam_train.files.log_lines import counted
from bam_train.policy import FrozenPolicy

Seen = Literal["refuse", "skip", "use"]
FEWEST_EPISODES = 20
"""Episodes below which nothing is estimated."""
_MOST_GROUPS = 20
_SAME = 0.1
"""Numbers of an action agree up to this share of half their range."""


@dataclass(frozen=True)
class ActionAgreement:
    """How far the policy would have acted as whoever was recorded meant to, without the noise that was added."""

    share: float
    """Share of the steps in which all numbers of the action agree: choices exactly, others within a tenth of half
    their range."""
    difference: float | None
    """Root mean square difference, in halves of the range; None for choices."""
    noise: float | None = None
    """The same of what was done and what was meant; None for choices."""


@dataclass(frozen=True)
class Group:
    """The episodes with one value of a fact."""

    fact: str
    value: str
    episodes: int
    recorded: float
    """Success rate, or mean return, of whoever was recorded."""
    estimate: Estimate
    """Of the policy, from their starts."""
    agreement: float


@dataclass(frozen=True)
class DataReport:
    """What recorded episodes say about a policy."""

    env: str
    metric: str
    """``success``, or ``return`` if an episode has no success."""
    episodes: int
    steps: int
    skipped: int
    """Episodes that the policy learnt from, which were left out."""
    seen: int
    """Episodes that it learnt from, which were used because that was asked for."""
    recorded: float
    recorded_interval: tuple[float, float] | None
    """Wilson's 95 % interval of the success rate; None for returns."""
    agreement: ActionAgreement
    fitted_q: Estimate
    importance: dict[str, Estimate]
    """``ips``, ``snips`` and ``dr``; empty where actions have no probabilities."""
    probabilities: str
    """Where those of the recorded actions come from: ``recorded``, ``estimated`` or ``none``."""
    groups: tuple[Group, ...]
    """The weakest of each fact first."""

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; null for importance weights that too few episodes have."""
        importance = {
            name: one.to_json() if one.is_sound else {"value": None, "interval": None, "effective": one.effective}
            for name, one in self.importance.items()
        }
        groups = [{**vars(one), "estimate": one.estimate.to_json()} for one in self.groups]
        interval = self.recorded_interval and list(self.recorded_interval)
        own = {"agreement": vars(self.agreement), "fitted_q": self.fitted_q.to_json(), "recorded_interval": interval}
        return {**vars(self), **own, "importance": importance, "groups": groups}


def evaluate_on_data(
    checkpoint: Checkpoint,
    data: DataSet,
    *,
    seen: Seen = "refuse",
    by: Sequence[str] = (),
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, updates: None,
) -> DataReport:
    """Agreement, value estimates and groups of a checkpoint's policy on a data set.

    Args:
        checkpoint: Of the data set's environment.
        data: Episodes of any policy.
        seen: What becomes of episodes that it learnt from: refused, left out, or used.
        by: Facts that divide the episodes into groups; by default all with 2 to 20 values.
        seed: Of the networks.
        on_progress: Called with the number of updates done and of all.

    Raises:
        CheckpointMismatch: Another environment, other spaces or units, or it learnt from these episodes.
        BadDataSet: Too few episodes, an unknown fact, or observations with pictures.
    """
    require_same_interface(checkpoint, data)
    indices = unseen_indices(checkpoint, data, seen)
    facts = [data.facts(index) for index in indices]
    divisions = _divisions(data, facts, by)
    by_success = all(one["success"] is not None for one in facts)
    steps = read_steps(data, FrozenPolicy.from_checkpoint(checkpoint), indices, by_success)
    require_contrast(data, steps)
    fitted = fit_q(steps, seed=seed, on_progress=on_progress)
    ratios = action_ratios(steps, data.info.action_space, seed)
    agrees, *differences = _agreement(steps, data.info.action_space)
    used = {data.digests[index] for index in indices} & set(checkpoint.manifest.data.get("episodes", ()))
    returns = steps.returns
    return DataReport(
        env=data.info.env,
        metric="success" if by_success else "return",
        episodes=len(indices),
        steps=len(steps.rewards),
        skipped=len(data) - len(indices),
        seen=len(used),
        recorded=float(returns.mean()),
        recorded_interval=wilson_interval(int(returns.sum()), len(returns)) if by_success else None,
        agreement=ActionAgreement(float(agrees.mean()), *differences),
        fitted_q=within_bounds(fitted.estimate(), by_success),
        importance={} if ratios is None else _importance(steps, ratios, fitted, by_success),
        probabilities="none" if ratios is None else "estimated" if steps.propensity is None else "recorded",
        groups=tuple(_groups(divisions, steps, fitted, agrees, by_success)),
    )


def require_same_interface(checkpoint: Checkpoint, data: DataSet) -> None:
    """Refuse a data set of another environment, or of other spaces, units or rate, than those of the checkpoint."""
    checkpoint.requires_env(data.info.env, f"That is the environment of {data.place}; give data of its own one")
    info = data.info
    spaces = {name: space_to_json(getattr(info, name)) for name in ("observation_space", "action_space")}
    interface = {**spaces, "signals": names_and_units(info.contract), "period": info.period}
    if found := first_difference(*interface_pairs(checkpoint, interface)):
        what, one, other = found
        text = f"{what} is {one} in the checkpoint and {other} in {data.place}"
        raise CheckpointMismatch(checkpoint.path, f"{text}; evaluate it on data of its own environment")


def unseen_indices(checkpoint: Checkpoint, data: DataSet, seen: Seen) -> list[int]:
    """Indices of the episodes to evaluate on: those that the checkpoint learnt from are refused, left out or used."""
    learnt = set(checkpoint.manifest.data.get("episodes", ()))
    known = [digest in learnt for digest in data.digests]
    if any(known) and seen == "refuse":
        text = f"learnt from {sum(known)} of the {counted(len(known), 'episode')} of {data.place}"
        raise CheckpointMismatch(
            checkpoint.path, f"{text}. Give other data, --seen skip to leave them out, or --seen use"
        )
    found = [index for index, is_known in enumerate(known) if not (is_known and seen == "skip")]
    require_enough(data, len(found))
    return found


def require_enough(data: DataSet, episodes: int) -> None:
    """Refuse to estimate anything from a handful of episodes."""
    if episodes < FEWEST_EPISODES:
        text = f"{counted(episodes, 'episode')} to evaluate on, expected at least {FEWEST_EPISODES}"
        raise BadDataSet(f"{data.place}: has {text}. Record more: bam-data collect {data.place} --policy CHECKPOINT")


def require_contrast(data: DataSet, steps: Steps) -> None:
    """Refuse episodes that all ended alike: nothing in them tells how a policy would do worse, or better."""
    if np.ptp(steps.returns) == 0:
        text = "every episode has the same success or return, so nothing tells a good policy from a bad one"
        remedy = f"Add others: bam-data collect {data.place} --policy CHECKPOINT --random 0.6"
        raise BadDataSet(f"{data.place}: {text}. {remedy}")


def _divisions(data: DataSet, facts: list[dict[str, Any]], by: Sequence[str]) -> dict[str, list[str]]:
    """The value of each fact that divides the episodes, by its name."""
    measured = {"length", "return", "success", "terminated", "truncated", "seed", "end"}
    names = sorted({name for one in facts for name in one} - measured)
    if unknown := [name for name in by if name not in names]:
        raise BadDataSet(
            f"{data.place}: no episode has the fact {unknown[0]!r}; there are {', '.join(names) or 'none'}"
        )
    found = {}
    for name in by or names:
        values = [str(one.get(name, "-"))[: 10 if name == "date" else 40] for one in facts]
        if by or 2 <= len(Counter(values)) <= _MOST_GROUPS:
            found[name] = values
    return found


def _agreement(steps: Steps, space: gym.Space[Any]) -> tuple[Array, float | None, float | None]:
    """Whether each step agrees (n,), and the root mean square difference to what was meant, and of that to the deed."""
    if not isinstance(space, gym.spaces.Box):
        return np.all(steps.meant == steps.wanted, axis=1), None, None
    half = np.ravel(space.high.astype(np.float64) - space.low) / 2
    unit = np.where(np.isfinite(half) & (half > 0), half, 1.0)
    error, noise = (steps.meant - steps.wanted) / unit, (steps.actions - steps.meant) / unit
    return np.all(np.abs(error) <= _SAME, axis=1), *(float(np.sqrt(np.mean(one**2))) for one in (error, noise))


def _importance(steps: Steps, ratios: Array, fitted: FittedQ, by_success: bool) -> dict[str, Estimate]:
    taken = steps.rewards, ratios, steps.episode
    found = {
        "ips": importance_sampling(*taken),
        "snips": self_normalised(*taken),
        "dr": doubly_robust(*taken, fitted.of_actions, fitted.of_states, fitted.of_next),
    }
    return {name: one.as_rate() if by_success else one for name, one in found.items()}


def _groups(
    divisions: dict[str, list[str]], steps: Steps, fitted: FittedQ, agrees: Array, by_success: bool
) -> list[Group]:
    found = []
    returns = steps.returns
    share = np.bincount(steps.episode, agrees) / np.bincount(steps.episode)
    for fact, values in divisions.items():
        groups = []
        for value in sorted(set(values)):
            of = np.flatnonzero(np.array(values) == value)
            estimate = within_bounds(fitted.estimate(of), by_success)
            groups.append(Group(fact, value, len(of), float(returns[of].mean()), estimate, float(share[of].mean())))
        found += sorted(groups, key=lambda group: group.estimate.value)
    return found


def within_bounds(estimate: Estimate, by_success: bool) -> Estimate:
    """A success rate is between 0 and 1, and no surer than that of as many episodes of the policy itself (Wilson)."""
    if not by_success:
        return estimate
    episodes = round(estimate.effective)
    least, most = wilson_interval(round(estimate.value * episodes), episodes)
    low, high = min(least, max(0.0, estimate.interval[0])), max(most, min(1.0, estimate.interval[1]))
    return Estimate(estimate.value, (low, high), estimate.effective)
