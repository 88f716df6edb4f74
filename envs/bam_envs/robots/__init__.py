"""Robots: they take commands and give states, in SI units."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bam_envs.core.lazy_imports import lazy_imports

if TYPE_CHECKING:
    from bam_envs.core.robot import Initial, Robot, RobotSpec, RobotState, SignalSpec
    from bam_envs.live.building import live_robot
    from bam_envs.live.rosbridge_robot import RosbridgeRobot
    from bam_envs.robots.fake import FakeRobot
    from bam_envs.robots.physics.mir100 import SimulatedBase
    from bam_envs.robots.profiles.profile import load_profile
    from bam_envs.safety.gate import SafeRobot

_MODULES = {
    "FakeRobot": "bam_envs.robots.fake",
    "Initial": "bam_envs.core.robot",
    "Robot": "bam_envs.core.robot",
    "RobotSpec": "bam_envs.core.robot",
    "RobotState": "bam_envs.core.robot",
    "RosbridgeRobot": "bam_envs.live.rosbridge_robot",
    "SafeRobot": "bam_envs.safety.gate",
    "SignalSpec": "bam_envs.core.robot",
    "SimulatedBase": "bam_envs.robots.physics.mir100",
    "live_robot": "bam_envs.live.building",
    "load_profile": "bam_envs.robots.profiles.profile",
}
"""Name to the module that has it."""

__all__ = [
    "FakeRobot",
    "Initial",
    "Robot",
    "RobotSpec",
    "RobotState",
    "RosbridgeRobot",
    "SafeRobot",
    "SignalSpec",
    "SimulatedBase",
    "live_robot",
    "load_profile",
]

__getattr__, __dir__ = lazy_imports(__name__, _MODULES)
