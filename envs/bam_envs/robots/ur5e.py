"""The UR5e with a parallel gripper, simulated or live: its signals, limits and lengths.

Sources: UR5e data sheet and user manual, Universal Robots (+-360 degrees and 180 degrees/s on all joints; the elbow
cannot fold by more than 180 degrees); Robotiq 2F-85 instruction manual (85 mm stroke, 20 to 150 mm/s).
"""

import math

from bam_envs.core.kinematics import UR5E_GRIPPER, UR_JOINTS
from bam_envs.core.robot import RobotSpec, SignalSpec

JOINTS = UR_JOINTS
GRIPPER_OPEN = 0.085
"""Width of the open gripper [m] (Robotiq 2F-85)."""
GRIPPER_SPEED = 0.15
"""Speed of the gripper's width [m/s]; the 2F-85 does 0.02 to 0.15."""
GEOMETRY = UR5E_GRIPPER
"""Kinematics of the arm with this gripper."""
TOOL_LENGTH = GEOMETRY.tool
"""Flange to the middle of the gripper's pads [m]."""

_TURN, _SPEED = 2 * math.pi, math.pi
_LOW = (-_TURN, -_TURN, -math.pi, -_TURN, -_TURN, -_TURN)
_HIGH = (_TURN, _TURN, math.pi, _TURN, _TURN, _TURN)

_POSITION = SignalSpec("joint_position", JOINTS, ("rad",) * 6, _LOW, _HIGH)
_VELOCITY = SignalSpec("joint_velocity", JOINTS, ("rad/s",) * 6, (-_SPEED,) * 6, (_SPEED,) * 6)
_WIDTH = SignalSpec("gripper_width", ("gripper_width",), ("m",), (0.0,), (GRIPPER_OPEN,))
_OBJECT_POSITION = SignalSpec(
    "object_position", ("object_x", "object_y", "object_z"), ("m",) * 3, (-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)
)
_OBJECT_QUATERNION = SignalSpec(
    "object_quaternion", ("object_qw", "object_qx", "object_qy", "object_qz"), ("1",) * 4, (-1.0,) * 4, (1.0,) * 4
)
COMMAND = SignalSpec(
    "command",
    (*JOINTS, "gripper_width"),
    (*("rad",) * 6, "m"),
    (*_LOW, 0.0),
    (*_HIGH, GRIPPER_OPEN),
    (*(_SPEED,) * 6, GRIPPER_SPEED),
)


def arm_spec(name: str, *, with_object: bool) -> RobotSpec:
    """The signals of a UR5e with a gripper, and those of a tracked object if there is one."""
    signals = (_POSITION, _VELOCITY, _WIDTH)
    tracked = (_OBJECT_POSITION, _OBJECT_QUATERNION) if with_object else ()
    return RobotSpec(name, (*signals, *tracked), COMMAND, period=0.05)
