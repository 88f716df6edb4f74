"""Other ids of these environments: those in BAM's own package, and former ones; importing this is cheap."""

from bam_envs.core.registry import ENVIRONMENTS, Alias, register_alias

_SEED = {"seed": "table_seed"}
BAM_NAMES = {
    "GridWorldEnv-v0": Alias("bam/grid-world-v0"),
    "ClassicBandit-v0": Alias("bam/classic-bandit-v0", options=_SEED),
    "ContextBandit-v0": Alias("bam/context-bandit-v0", options=_SEED),
    "MNISTEnv-v0": Alias("bam/mnist-v0"),
    "GraspXY-v0": Alias("bam/grasp-xy-v0"),
    "ObsEnv-v0": Alias("bam/obs-v0"),
    "GraspXYR-v0": Alias("bam/grasp-xyr-v0"),
}
FORMER_NAMES = {
    "bam/mir100-navigation-v0": Alias("bam/navigation-v0"),
    "bam/mir100-avoidance-v0": Alias("bam/avoidance-v0"),
}
"""Ids from before these tasks were for any base, in checkpoints and in people's commands."""


def register() -> None:
    """Add these ids; idempotent."""
    for name, alias in {**BAM_NAMES, **FORMER_NAMES}.items():
        register_alias(name, alias, "bam_envs.make_env", ENVIRONMENTS[alias.env_id].time_limit)
