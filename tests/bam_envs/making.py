"""Tasks as `gymnasium.make` makes them, variants of plug-ins among them, without their robot."""

from bam_envs.core.registry import ENVIRONMENTS


def make_task(env_id, num_envs=1, **options):
    return ENVIRONMENTS[env_id].make_task(num_envs, options)
