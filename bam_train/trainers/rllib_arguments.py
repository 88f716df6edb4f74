"""Arguments of RLlib's algorithms that are hyperparameters here, with their types and ranges; imports no RLlib."""

from collections.abc import Mapping
from typing import Any, Literal

from bam_envs.core.validation import Fraction, NonNegative, NonNegativeInt, Positive, PositiveInt, check
from bam_envs.core.wording import brief
from bam_train.errors import SettingsError
from bam_train.settings import NAMES
from bam_train.trainers.algorithms import Algorithm
from bam_train.trainers.library_arguments import fits, inherited, require_known

HYPERPARAMETERS: dict[str, Any] = {
    **dict.fromkeys(("gamma", "lambda_", "tau", "expectile", "epsilon"), Fraction),
    **dict.fromkeys(("lr", "actor_lr", "critic_lr", "alpha_lr", "value_lr", "adam_epsilon"), Positive),
    **dict.fromkeys(("clip_param", "kl_target", "initial_alpha", "temperature"), Positive),
    **dict.fromkeys(("grad_clip", "vf_clip_param"), Positive | None),
    **dict.fromkeys(("action_init_scale", "entropy_coeff", "vf_loss_coeff", "vf_coeff"), NonNegative),
    **dict.fromkeys(("kl_coeff", "beta", "sigma0"), NonNegative),
    **dict.fromkeys(("bc_logstd_coeff", "lagrangian_thresh", "log_std_init", "min_q_weight"), float),
    **dict.fromkeys(("moving_average_sqd_adv_norm_start", "moving_average_sqd_adv_norm_update_rate"), float),
    **dict.fromkeys(("target_worker_clipping", "v_max", "v_min"), float),
    **dict.fromkeys(("vtrace_clip_pg_rho_threshold", "vtrace_clip_rho_threshold"), float | None),
    **dict.fromkeys(("train_batch_size_per_learner", "num_epochs", "num_atoms", "n_quantiles", "n_step"), PositiveInt),
    **dict.fromkeys(
        ("n_critics", "num_actions", "broadcast_interval", "noise_steps", "simple_queue_size"), PositiveInt
    ),
    **dict.fromkeys(("circular_buffer_num_batches", "circular_buffer_iterations_per_batch"), PositiveInt),
    **dict.fromkeys(("num_steps_sampled_before_learning_starts", "target_network_update_freq"), NonNegativeInt),
    "top_quantiles_to_drop_per_net": NonNegativeInt,
    **dict.fromkeys(("burn_in_len", "burnin_len"), int),
    "minibatch_size": PositiveInt | None,
    "rollout_fragment_length": PositiveInt | Literal["auto"],
    "target_entropy": float | Literal["auto"] | None,
    **dict.fromkeys(("clip_actions", "deterministic_backup", "double_q", "dueling", "lagrangian", "noisy"), bool),
    **dict.fromkeys(("shuffle_batch_per_epoch", "twin_q", "use_circular_buffer", "use_critic", "use_gae"), bool),
    **dict.fromkeys(("use_kl_loss", "vtrace"), bool),
    **dict.fromkeys(("grad_clip_by", "td_error_loss_fn"), str),
    **dict.fromkeys(("model_config", "replay_buffer_config"), dict),
}
"""Type and range of every hyperparameter; with some other values RLlib hangs."""
SCHEDULES = frozenset({"lr", "actor_lr", "critic_lr", "alpha_lr", "value_lr", "entropy_coeff", "epsilon"})
"""Hyperparameters that may be a schedule ``[[step, value], ...]`` too, whose range is that of its first value."""
OURS: dict[str, Any] = {
    "model_config": {},
    "rollout_fragment_length": "auto",
    "log_std_init": None,
    "noise_steps": 1,
    "action_init_scale": 1.0,
}
"""Hyperparameters that ``training()`` does not take, with their defaults where RLlib has none."""

_GPUS, _CPUS = "env runners use no GPU, and --num-gpus is for the learners", "each env runner has one CPU"
_ENVS = "use --num-envs, which is of all runners together"
ELSEWHERE = {
    "train_batch_size": "use train_batch_size_per_learner",
    "num_sgd_iter": "use num_epochs",
    "lr_schedule": "use lr, which takes a schedule too",
    "entropy_coeff_schedule": "use entropy_coeff, which takes a schedule too",
    "model": "use model_config",
    "vf_share_layers": "use model_config.vf_share_layers",
    "policy_model_config": "use model_config",
    "q_model_config": "use model_config",
    "hiddens": "use model_config.head_fcnet_hiddens",
    "optimization_config": "use actor_lr, critic_lr and alpha_lr",
    "learning_rate": "use lr",
    "observation_filter": "use normalize=true",
    **dict.fromkeys(("num_workers", "num_rollout_workers"), "use --num-env-runners"),
    **dict.fromkeys(("num_envs_per_worker", "num_envs_per_env_runner"), _ENVS),
    "seed": "use --seed",
    **dict.fromkeys(("num_gpus_per_worker", "num_gpus_per_env_runner"), _GPUS),
    **dict.fromkeys(("num_cpus_per_worker", "num_cpus_per_env_runner"), _CPUS),
    "log_level": "RLlib's log is off",
    **dict.fromkeys(("horizon", "soft_horizon"), "the environment ends its episodes"),
    "framework": "RLlib has nothing but torch any more",
}
"""Arguments of RLlib that are not hyperparameters here, and the replacement or reason."""
_OLD = "it belongs to RLlib's old API stack, or bam-train takes care of it"
_OLD_HERE = {"impala": {"epsilon"}, "appo": {"epsilon", "use_critic"}}
"""Arguments by algorithm that belong to its old API stack, and are hyperparameters of other algorithms."""


def hyperparameters_of(algorithm: Algorithm) -> tuple[dict[str, Any], dict[str, str]]:
    """Types of an algorithm's hyperparameters by name, and the reason why each other name of RLlib is none."""
    taken = {name: None for one in inherited(algorithm.reference, "training") for name in one} | OURS
    known = HYPERPARAMETERS.keys() - _OLD_HERE.get(algorithm.name, set())
    return {name: HYPERPARAMETERS[name] for name in taken if name in known}, {
        **{name: _OLD for name in taken if name not in known and name != "self" and not name.startswith("_")},
        **ELSEWHERE,
    }


def take_hyperparameters(algorithm: Algorithm, given: Mapping[str, Any]) -> dict[str, Any]:
    """Check hyperparameters by name, type and range at once: importing RLlib takes many seconds.

    Raises:
        SettingsError: An unknown name (with the closest match), a wrong type or a number out of range.
    """
    kinds, elsewhere = hyperparameters_of(algorithm)
    require_known(given, kinds, f"{algorithm.name} hyperparameter", elsewhere, NAMES)
    return {name: value if value is None else _fitting(name, value, kinds[name]) for name, value in given.items()}


def _fitting(name: str, value: Any, kind: Any) -> Any:
    if name == "n_step" and isinstance(value, list):  # drawn between two numbers
        if not (fits(value, tuple[int, int]) and 1 <= value[0] <= value[1]):
            raise SettingsError(f"{name}: expected [least, most] of at least 1, found {value!r}")
        return value
    if name not in SCHEDULES or (isinstance(value, (int, float)) and not isinstance(value, bool)):
        return check(value, kind, name, SettingsError)
    if not fits(value, list[list[int | float]]):
        raise SettingsError(f"{name}: expected a number or a schedule [[step, value], ...], found {brief(value)}")
    steps = [pair[0] for pair in value if len(pair) == 2]
    if len(steps) < max(2, len(value)) or steps[0] != 0 or sorted(set(steps)) != steps:
        text = "expected a number or a schedule [[0, value], [step, value], ...] with rising steps"
        raise SettingsError(f"{name}: {text}, found {value!r}")
    for place, (_, number) in enumerate(value):  # a rate may fall to 0
        check(number, NonNegative if place and kind is Positive else kind, name, SettingsError)
    return value
