"""Numbers that no algorithm can learn with; what the library itself would take without a word."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bam_train.trainers.ranges import Ranges
from bam_train.values import linear_start

_RANGES = Ranges(
    shares=("gamma", "gae_lambda", "tau", "exploration_fraction", "exploration_initial_eps", "exploration_final_eps"),
    positive=("learning_rate", "clip_range", "max_grad_norm", "rms_prop_eps", "target_kl"),
    counts=("n_steps", "batch_size", "n_epochs", "buffer_size", "train_freq", "target_update_interval", "policy_delay"),
    not_negative=("learning_starts", "ent_coef", "vf_coef"),
)


def check_ranges(values: Mapping[str, Any]) -> None:
    """Refuse a hyperparameter out of its range; text such as ``auto`` is none, a schedule is its first value.

    Raises:
        SettingsError: Names it, its range and the value.
    """
    for name, value in values.items():
        number = _number(value)
        if number is not None:
            _RANGES.require(name, number, value)


def _number(value: Any) -> float | None:
    """The number that `value` starts with; None if it is none."""
    if isinstance(value, str):
        return linear_start(value)
    if isinstance(value, list) and value:
        return _number(value[0])
    return None if isinstance(value, bool) or not isinstance(value, (int, float)) else float(value)
