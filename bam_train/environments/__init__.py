"""The environments that checkpoints belong to: made, and compared with the checkpoint before a robot moves."""

from bam_train.environments.interface import (
    AnyEnv,
    control_period,
    described,
    first_difference,
    fit_pairs,
    interface_in,
    interface_of,
    interface_pairs,
    names_and_units,
    require_fit,
    short_json,
)
from bam_train.environments.made_env import (
    ENTRY_POINTS,
    environment_of,
    held_out,
    is_batched,
    make_env,
    make_vector_env,
    must_be_named,
    parity_if_needed,
    require_env_kwargs,
)

__all__ = [
    "ENTRY_POINTS",
    "AnyEnv",
    "control_period",
    "described",
    "environment_of",
    "first_difference",
    "fit_pairs",
    "held_out",
    "interface_in",
    "interface_of",
    "interface_pairs",
    "is_batched",
    "make_env",
    "make_vector_env",
    "must_be_named",
    "names_and_units",
    "parity_if_needed",
    "require_env_kwargs",
    "require_fit",
    "short_json",
]
