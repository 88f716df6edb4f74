"""Numbers, schedules and layers that no algorithm of RLlib can learn with; some of them it takes, and then hangs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bam_envs.core.validation import Finite, Fraction, NonNegative, Positive, PositiveInt, check
from bam_train.errors import SettingsError
from bam_train.trainers.library_arguments import ranges

_RANGES = ranges(
    {
        Fraction: ("gamma", "lambda_", "tau", "expectile", "epsilon"),
        Positive: (
            *("lr", "actor_lr", "critic_lr", "alpha_lr", "value_lr", "adam_epsilon"),
            *("grad_clip", "clip_param", "vf_clip_param", "kl_target", "initial_alpha", "temperature"),
        ),
        PositiveInt: (
            *("train_batch_size_per_learner", "minibatch_size", "num_epochs", "rollout_fragment_length", "n_step"),
            *("num_atoms", "n_quantiles", "n_critics", "num_actions", "broadcast_interval", "simple_queue_size"),
            *("circular_buffer_num_batches", "circular_buffer_iterations_per_batch"),
        ),
        NonNegative: (
            *("action_init_scale", "entropy_coeff", "vf_loss_coeff", "vf_coeff", "kl_coeff", "beta", "sigma0"),
            *(
                "num_steps_sampled_before_learning_starts",
                "target_network_update_freq",
                "top_quantiles_to_drop_per_net",
            ),
        ),
    }
)
_LAST = {name: NonNegative if kind is Positive else kind for name, kind in _RANGES.items() if kind is not PositiveInt}
"""What a schedule may come to: a rate of 0 ends learning, and does no harm at its end."""


def check_ranges(values: Mapping[str, Any]) -> None:
    """Refuse what no algorithm can learn with among complete hyperparameters.

    Raises:
        SettingsError: Names it, what was expected and what was found.
    """
    for name, value in values.items():
        if isinstance(value, bool):
            continue
        if isinstance(value, (int, float)):
            check(value, _RANGES.get(name, Finite), name, SettingsError)
        elif name == "rollout_fragment_length" and value != "auto":
            raise SettingsError(f"{name}: expected a whole number or 'auto', found {value!r}")
        elif name == "target_entropy" and value not in (None, "auto"):
            raise SettingsError(f"{name}: expected a number or 'auto', found {value!r}")
        elif name == "n_step" and value is not None:
            _require_span(name, value)
        elif isinstance(value, list):
            _require_schedule(name, value)
    _require_layers(values["model_config"])


def _require_span(name: str, value: list[int]) -> None:
    """Least and most of a number that is drawn."""
    if not 1 <= value[0] <= value[1]:
        raise SettingsError(f"{name}: expected [least, most] of at least 1, found {value!r}")


def _require_schedule(name: str, value: list[list[float]]) -> None:
    """Steps that rise from 0, with a value at each."""
    steps = [pair[0] for pair in value if len(pair) == 2]
    if len(steps) < max(2, len(value)) or steps[0] != 0 or sorted(set(steps)) != steps:
        text = "expected a number or a schedule [[0, value], [step, value], ...] with rising steps"
        raise SettingsError(f"{name}: {text}, found {value!r}")
    check(value[0][1], _RANGES.get(name, Finite), name, SettingsError)
    for _, number in value[1:]:
        check(number, _LAST.get(name, Finite), name, SettingsError)


def _require_layers(model_config: Mapping[str, Any]) -> None:
    """Every layer has a neuron, and there is one layer at least before the heads."""
    for name, sizes in model_config.items():
        if not name.endswith("_hiddens") or sizes is None:
            continue
        if any(size < 1 for size in sizes) or (name == "fcnet_hiddens" and not sizes):
            wanted = "one size of a layer or more, each" if name == "fcnet_hiddens" else "sizes of layers of"
            raise SettingsError(f"model_config.{name}: expected {wanted} at least 1, found {sizes!r}")
