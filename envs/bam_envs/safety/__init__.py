"""The gate to a live robot, and the guards in it."""

from bam_envs.safety.guard import Guard, Limits
from bam_envs.safety.guards import default_guards
from bam_envs.safety.safe import ClearedCommand, SafeRobot

__all__ = ["ClearedCommand", "Guard", "Limits", "SafeRobot", "default_guards"]
