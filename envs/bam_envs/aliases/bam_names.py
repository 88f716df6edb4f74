"""The ids of these environments in BAM's own package; importing this is cheap."""

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


def register() -> None:
    """Add BAM's ids; idempotent."""
    for name, alias in BAM_NAMES.items():
        register_alias(name, alias, "bam_envs.make_env", ENVIRONMENTS[alias.env_id].time_limit)
