"""The gate to a live robot, and the guards in it."""

from bam_envs.robots.safety.guard import Guard, Limits
from bam_envs.robots.safety.guards import default_guards
from bam_envs.robots.safety.safe import ClearedCommand, SafeRobot

__all__ = ["ClearedCommand", "Guard", "Limits", "SafeRobot", "default_guards"]
