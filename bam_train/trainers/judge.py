"""Evaluation during training: as short as will do, and not to be passed by luck."""

from __future__ import annotations

import math
from typing import Any

from gymnasium.vector import VectorEnv

from bam_train.evaluation import BatchPolicy, EvaluationReport, evaluate
from bam_train.settings import TrainSettings

JUDGE_SEED = 2_000_000
"""Where these seeds start: apart from training's small ones and from bam-eval's, whose episodes must be fresh."""


def judge(
    policy: BatchPolicy,
    settings: TrainSettings,
    last: bool = False,
    rows: VectorEnv[Any, Any, Any] | None = None,
) -> tuple[EvaluationReport, bool]:
    """Evaluate a policy; towards ``until_success`` in up to three parts.

    First a quarter of the episodes, which spares early, hopeless policies a long evaluation; then all, if that may
    reach it; then, if it did, as many fresh ones, which must reach it too.

    Args:
        policy: What acts.
        settings: Of the run; episode k is seeded JUDGE_SEED + seed + k.
        last: Whether this is the run's last evaluation, which is never cut short.
        rows: Environments to evaluate on, left open; by default some are made.

    Returns:
        The report (the worse of two), and whether ``until_success`` was reached.
    """
    episodes, wanted = settings.eval_episodes, settings.until_success
    if wanted is None:
        return _episodes(policy, settings, 0, episodes, rows), False
    if not last:
        look = _episodes(policy, settings, 0, math.ceil(episodes / 4), rows)
        if _failures(look) > (1 - wanted) * episodes + 1e-9:
            return look, False
    report = _episodes(policy, settings, 0, episodes, rows)
    if report.success_rate is None or report.success_rate < wanted:
        return report, False
    again = _episodes(policy, settings, episodes, episodes, rows)
    worse = min(report, again, key=lambda one: one.success_rate or 0.0)
    return worse, again.success_rate is not None and again.success_rate >= wanted


def _episodes(
    policy: BatchPolicy, settings: TrainSettings, skip: int, count: int, rows: VectorEnv[Any, Any, Any] | None
) -> EvaluationReport:
    seed = JUDGE_SEED + settings.seed + skip
    return evaluate(policy, settings.env, settings.env_kwargs, episodes=count, seed=seed, env=rows)


def _failures(report: EvaluationReport) -> int:
    return 0 if report.successes is None else report.episodes - report.successes
