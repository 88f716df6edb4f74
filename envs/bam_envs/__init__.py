"""Gymnasium environments for robot arms, simulated and live; importing this registers them and imports no simulator."""

from bam_envs import aliases
from bam_envs.core.registry import ENVIRONMENTS, register

__all__ = ["ENVIRONMENTS"]
__version__ = "0.1.0"

aliases.register()
register()
