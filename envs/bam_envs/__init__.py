"""Gymnasium environments for robot arms, simulated and live; importing this registers them and imports no simulator."""

from bam_envs.core.registry import ENVIRONMENTS, register
from bam_envs.local import names as local_names
from bam_envs.robo_gym import table as robo_gym

__all__ = ["ENVIRONMENTS"]
__version__ = "0.1.0"

robo_gym.register()
local_names.register()
register()
