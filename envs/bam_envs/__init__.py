"""Gymnasium environments for robot arms, simulated and live; importing this registers them and imports no simulator."""

from bam_envs.aliases import bam_names, robo_gym_names
from bam_envs.core.registry import ENVIRONMENTS, register

__all__ = ["ENVIRONMENTS"]
__version__ = "0.1.0"

robo_gym_names.register()
bam_names.register()
register()
