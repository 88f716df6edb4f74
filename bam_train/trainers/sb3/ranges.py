"""Numbers that no algorithm can learn with; what the library itself would take without a word."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bam_train.errors import SettingsError
from bam_train.values import linear_start

_SHARES = ("gamma", "gae_lambda", "tau", "exploration_fraction", "exploration_initial_eps", "exploration_final_eps")
_POSITIVE = ("learning_rate", "clip_range", "max_grad_norm", "rms_prop_eps", "target_kl")
_COUNTS = ("n_steps", "batch_size", "n_epochs", "buffer_size", "train_freq", "target_update_interval", "policy_delay")
_NOT_NEGATIVE = ("learning_starts", "ent_coef", "vf_coef")


def check_ranges(values: Mapping[str, Any]) -> None:
    """Refuse a hyperparameter out of its range; text such as ``auto`` is none, a schedule is its first value.

    Raises:
        SettingsError: Names it, its range and the value.
    """
    for name, value in values.items():
        number = _number(value)
        if number is None:
            continue
        if not math.isfinite(number):
            raise SettingsError(f"{name}: expected a finite number, found {value!r}")
        expected = _complaint(name, number)
        if expected is not None:
            raise SettingsError(f"{name}: expected {expected}, found {value!r}")


def _complaint(name: str, number: float) -> str | None:
    """What was expected instead of `number`; None if it is in range."""
    if name in _SHARES and not 0 <= number <= 1:
        return "a number from 0 to 1"
    if name in _POSITIVE and not number > 0:
        return "a number above 0"
    if name in _COUNTS and not number >= 1:
        return "at least 1"
    if name in _NOT_NEGATIVE and not number >= 0:
        return "at least 0"
    return None


def _number(value: Any) -> float | None:
    """The number that `value` starts with; None if it is none."""
    if isinstance(value, str):
        return linear_start(value)
    if isinstance(value, list) and value:
        return _number(value[0])
    return None if isinstance(value, bool) or not isinstance(value, (int, float)) else float(value)
