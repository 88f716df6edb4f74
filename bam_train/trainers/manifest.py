"""What a training run writes into the manifest of its checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium import Space

from bam_envs.core.spaces import space_to_json
from bam_train.settings import TrainSettings
from bam_train.trainers.provenance import git_commit, now, versions


def manifest(
    settings: TrainSettings,
    spaces: tuple[Space[Any], Space[Any]],
    *,
    signals: Mapping[str, Any],
    period: float | None,
    steps: int,
    scores: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the manifest's fields.

    Args:
        settings: Complete ones of the run.
        spaces: The environment's own, of observations and of actions.
        signals: What the environment says of its robot's signals.
        period: Control period, s; None if the environment has none.
        steps: Environment steps so far.
        scores: Of its evaluations.
    """
    return {
        "env": settings.env,
        "env_kwargs": settings.env_kwargs,
        "observation_space": space_to_json(spaces[0]),
        "action_space": space_to_json(spaces[1]),
        "signals": dict(signals),
        "period": period,
        "algorithm": settings.algo,
        "trainer": settings.trainer,
        "settings": settings.to_mapping(),
        "steps": steps,
        "seed": settings.seed,
        "scores": dict(scores),
        **origin(),
    }


def origin() -> dict[str, Any]:
    """What made a checkpoint, and when."""
    return {"versions": versions(), "git_commit": git_commit(), "created": now()}
