"""The UR5e with a parallel gripper, simulated or live: the shipped description, whatever a project's own ur5e is."""

from dataclasses import replace

from bam_envs.arms.description import robot_model
from bam_envs.core.kinematics import UR5E_GRIPPER
from bam_envs.core.robot import RobotSpec
from bam_envs.core.robot_models import SHIPPED, read_description

_ARM = robot_model(read_description(SHIPPED / "ur5e.toml"))
JOINTS = _ARM.joint_names
GRIPPER_OPEN = _ARM.gripper.open
"""Width of the open gripper [m] (Robotiq 2F-85)."""
GEOMETRY = UR5E_GRIPPER
"""Kinematics of the arm with this gripper."""
TOOL_LENGTH = GEOMETRY.tool
"""Flange to the middle of the gripper's pads [m]."""
COMMAND = _ARM.spec(with_object=False).command


def arm_spec(name: str, *, with_object: bool) -> RobotSpec:
    """The signals of a UR5e with a gripper, and those of a tracked object if there is one."""
    return replace(_ARM.spec(with_object=with_object), name=name)
