"""What RLlib's learners keep beside their state, and a resumed run would begin anew: numbers that adapt themselves.

PPO's and APPO's KL coefficient, SAC's, TQC's and CQL's temperature, MARWIL's running mean of squared advantages, where
a schedule of the entropy's weight is, and when the target networks of DQN, its relatives and APPO were updated last.
``Learner.get_state`` of Ray 2.60 has none.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import torch
from ray.rllib.utils.schedules.scheduler import Scheduler

Extras = dict[str, dict[str, float]]

_NAMES = (
    "curr_kl_coeffs_per_module",
    "curr_log_alpha",
    "moving_avg_sqd_adv_norms_per_module",
    "last_update_ts_by_mid",
    "_last_update_ts_by_mid",
    "entropy_coeff_schedulers_per_module",
)


def extras_of(algorithm: Any) -> Extras:
    """Attribute of the learner to module to number; {} if it has none. All learners have the same."""
    results = list(algorithm.learner_group.foreach_learner(_take))
    return dict(results[0].get()) if results else {}


def set_extras(algorithm: Any, extras: Mapping[str, Mapping[str, float]]) -> None:
    """Give them to every learner."""
    for result in algorithm.learner_group.foreach_learner(functools.partial(_give, extras=extras)):
        result.get()  # raises what went wrong there


def _take(learner: Any) -> Extras:
    tables = {name: getattr(learner, name) for name in _NAMES if hasattr(learner, name)}
    return {name: {key: _number(table[key]) for key in learner.module.keys()} for name, table in tables.items()}  # noqa: SIM118 - no mapping


def _number(value: Any) -> float:
    """A tensor of one number, or a number, or what a schedule is at, as a number that JSON keeps exactly."""
    if isinstance(value, Scheduler):
        value = value.get_current_value()
    number: float = value.item() if isinstance(value, torch.Tensor) else value
    return number


def _give(learner: Any, extras: Mapping[str, Mapping[str, float]]) -> None:
    for name, numbers in extras.items():
        table = getattr(learner, name)
        for key, number in numbers.items():
            if isinstance(table[key], Scheduler):
                _set_schedule(table[key], number)
            elif isinstance(table[key], torch.Tensor):
                table[key].data.fill_(number)  # in place: an optimiser may hold it
            else:
                table[key] = number


def _set_schedule(schedule: Scheduler, number: float) -> None:
    """Where it is until the first update's end says so; a fixed number stays."""
    if schedule.use_schedule:
        schedule.get_current_value().data.fill_(number)
