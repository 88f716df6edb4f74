"""The gate to a live robot, and the guards in it."""

from bam_envs.safety.gate import ClearedCommand, SafeRobot
from bam_envs.safety.guard import Guard, Limits
from bam_envs.safety.guards import default_guards

__all__ = ["ClearedCommand", "Guard", "Limits", "SafeRobot", "default_guards"]
