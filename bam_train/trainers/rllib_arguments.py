"""Arguments of RLlib's algorithms: which are hyperparameters here, and their ranges; imports no RLlib."""

from collections.abc import Mapping
from typing import Any

from bam_envs.core.validation import Finite, Fraction, NonNegative, Positive, PositiveInt, check
from bam_train.errors import SettingsError
from bam_train.settings import NAMES
from bam_train.trainers.algorithms import Algorithm
from bam_train.trainers.library_arguments import require_known
from bam_train.trainers.library_source import inherited

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
    **dict.fromkeys(
        (
            *("optimizer", "learner_class", "learner_connector", "add_default_connectors_to_learner_pipeline"),
            *("learner_config_dict", "num_aggregator_actors_per_learner", "store_buffer_in_checkpoints", "decay"),
            *("max_requests_in_flight_per_aggregator_actor", "max_requests_in_flight_per_aggregator_worker"),
            *("max_requests_in_flight_per_sampler_worker", "num_aggregation_workers", "before_learn_on_batch"),
            *("categorical_distribution_temperature", "num_gpu_loader_threads", "num_multi_gpu_tower_stacks"),
            *("minibatch_buffer_size", "replay_proportion", "replay_buffer_num_slots", "learner_queue_size"),
            *("learner_queue_timeout", "timeout_s_sampler_manager", "timeout_s_aggregator_manager", "opt_type"),
            *("momentum", "target_update_frequency", "training_intensity", "bc_iters"),
        ),
        "it belongs to RLlib's old API stack, or bam-train takes care of it",
    ),
}
"""Arguments of RLlib that are not hyperparameters here, many of its old API stack, and the replacement or reason."""

OLD_HERE = {"impala": {"epsilon"}, "appo": {"epsilon", "use_critic"}}
"""Arguments by algorithm that belong to its old API stack, and are current in other algorithms."""

OURS = ("model_config", "rollout_fragment_length", "log_std_init", "action_init_scale")
"""Hyperparameters that ``training()`` does not take."""

# Ranges of numbers, schedules and layers with which an algorithm can learn; with some others RLlib hangs

_RATES = (
    *("lr", "actor_lr", "critic_lr", "alpha_lr", "value_lr", "adam_epsilon"),
    *("grad_clip", "clip_param", "vf_clip_param", "kl_target", "initial_alpha", "temperature"),
)
_COUNTS = (
    *("train_batch_size_per_learner", "minibatch_size", "num_epochs", "rollout_fragment_length", "n_step"),
    *("num_atoms", "n_quantiles", "n_critics", "num_actions", "broadcast_interval", "simple_queue_size"),
    *("circular_buffer_num_batches", "circular_buffer_iterations_per_batch"),
)
_WEIGHTS = (
    *("action_init_scale", "entropy_coeff", "vf_loss_coeff", "vf_coeff", "kl_coeff", "beta", "sigma0"),
    *("num_steps_sampled_before_learning_starts", "target_network_update_freq", "top_quantiles_to_drop_per_net"),
)
LAST: dict[str, Any] = {
    **dict.fromkeys(("gamma", "lambda_", "tau", "expectile", "epsilon"), Fraction),
    **dict.fromkeys((*_RATES, *_WEIGHTS), NonNegative),
}
"""Ranges of later values of a schedule, where a rate may be 0."""
RANGES = LAST | dict.fromkeys(_RATES, Positive) | dict.fromkeys(_COUNTS, PositiveInt)
"""Ranges of numbers, and of the first values of schedules; with some others RLlib hangs."""


def require_plausible(algorithm: Algorithm, given: Mapping[str, Any]) -> None:
    """Refuse unknown names and numbers out of range at once: importing RLlib takes many seconds."""
    found = {name for one in inherited(algorithm.reference, "training") for name in one}
    known = [name for name in found if name not in left_out(algorithm) and not name.startswith("_")]
    require_known(given, [*known, *OURS], f"{algorithm.name} hyperparameter", ELSEWHERE, NAMES)
    for name, value in given.items():
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            check(value, RANGES.get(name, Finite), name, SettingsError)


def left_out(algorithm: Algorithm) -> set[str]:
    """Arguments of ``training()`` that are no hyperparameters of an algorithm."""
    return {*ELSEWHERE, *OLD_HERE.get(algorithm.name, ()), "self", "kwargs"}
