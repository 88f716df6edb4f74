"""Robots: they take commands and give states, in SI units.

The names below are imported when they are used, so that importing this package needs no simulator and no network.
"""

from bam_envs.core.lazy_imports import lazy_imports

_MODULES = {
    "FakeRobot": "bam_envs.robots.fake",
    "Initial": "bam_envs.core.robot",
    "Robot": "bam_envs.core.robot",
    "RobotSpec": "bam_envs.core.robot",
    "RobotState": "bam_envs.core.robot",
    "RosbridgeRobot": "bam_envs.live.rosbridge_robot",
    "SafeRobot": "bam_envs.safety.gate",
    "SignalSpec": "bam_envs.core.robot",
    "SimulatedBase": "bam_envs.robots.physics.kinematic_base",
    "live_robot": "bam_envs.live.building",
    "load_profile": "bam_envs.robots.profile",
}
"""Name to the module that has it."""

__all__ = [*_MODULES]
__getattr__, __dir__ = lazy_imports(__name__, _MODULES)
