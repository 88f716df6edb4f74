"""Universal Robots arms of seven sizes: limits, speeds, workspaces, outlines; the signals of one, simulated or live.

The command is six joints. The shipped profile ``ur5e`` has them; its gripper, if any, is not commanded.

Sources: user manuals of the UR3, UR5 and UR10 (CB3) and of the e-Series (+-360 degrees on all joints; speeds;
recommended workspaces); ROS-Industrial's ur_description (the elbow cannot fold by more than 180 degrees; offsets and
radii of the links, measured from models).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bam_envs.core import kinematics
from bam_envs.core.errors import UnknownName
from bam_envs.core.kinematics import ArmGeometry, ArmOutline
from bam_envs.core.robot import RobotSpec
from bam_envs.robots.ur5e import COMMAND, arm_spec
from bam_envs.robots.ur5e import JOINTS as JOINTS

Array = NDArray[np.float64]
DEFAULT_MODEL = "ur5"
"""The default model: that of robo-gym, so that its policies fit."""
START = (0.0, -2.5, 1.5, 0.0, -1.4, 0.0)
"""Joint positions [rad] with every model's flange in the air before it, clear of itself and of the table."""


@dataclass(frozen=True, eq=False)
class UrModel:
    """One size of arm."""

    name: str
    geometry: ArmGeometry
    joint_limits: Array
    """Lowest and highest joint positions [rad]. Shape: (2, 6)."""
    max_velocity: Array
    """Fastest joints [rad/s]. Shape: (6,)."""
    workspace_radius: float
    """Radius of the recommended workspace, a half-ball around the base [m]."""
    workspace_inner: float
    """Radius of the cylinder about the base's axis that is left out of it [m]."""
    outline: ArmOutline


def _model(name: str, geometry: ArmGeometry, degrees: tuple[int, int], workspace: tuple[float, float]) -> UrModel:
    """A model; `degrees` are the speeds of shoulder and wrists [degrees/s], an elbow does 180."""
    turn, elbow = 2 * math.pi, math.pi
    high = np.array([turn, turn, elbow, turn, turn, turn])
    speeds = np.radians([degrees[0], degrees[0], 180, degrees[1], degrees[1], degrees[1]])
    for array in (limits := np.stack([-high, high]), speeds):
        array.setflags(write=False)
    return UrModel(name, geometry, limits, speeds, *workspace, geometry.outline)  # type: ignore[arg-type]


_MODELS = [
    _model("ur3", kinematics.UR3, (180, 360), (0.45, 0.2)),
    _model("ur3e", kinematics.UR3E, (180, 360), (0.45, 0.2)),
    _model("ur5", kinematics.UR5, (180, 180), (0.75, 0.2)),
    _model("ur5e", kinematics.UR5E, (180, 180), (0.75, 0.2)),
    _model("ur10", kinematics.UR10, (120, 180), (1.3, 0.3)),
    _model("ur10e", kinematics.UR10E, (120, 180), (1.3, 0.3)),
    _model("ur16e", kinematics.UR16E, (120, 180), (0.8, 0.3)),
]
UR_MODELS = {model.name: model for model in _MODELS}
"""Models by name."""


def ur_model(name: str) -> UrModel:
    """The model called `name`; `UnknownName`, with the closest match, if there is none."""
    if name not in UR_MODELS:
        raise UnknownName("ur_model", str(name), UR_MODELS, examples=UR_MODELS, similar=0.85)  # ur7 is not ur5
    return UR_MODELS[name]


def ur_spec(model: UrModel, period: float, with_object: bool) -> RobotSpec:
    """The signals of an arm, and those of a tracked object if there is one."""
    position, velocity, _, *tracked = arm_spec(model.name, with_object=with_object).signals  # no gripper
    speeds = tuple(model.max_velocity.tolist())
    velocity = replace(velocity, low=tuple(-speed for speed in speeds), high=speeds)
    command = replace(COMMAND.part(JOINTS), max_rate=speeds)
    return RobotSpec(model.name, (position, velocity, *tracked), command, period)
