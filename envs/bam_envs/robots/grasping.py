"""A gripper over a table that grasps where it is told: its command, its signals, and the geometry of its camera.

The frame is that of the UR5e: x forward, z up, metres, the table at z = 0. The camera looks straight down, so that
columns of its pictures go along x, and rows against y.
"""

from collections.abc import Sequence

import numpy as np

from bam_envs.core.robot import Array, RobotSpec, SignalSpec
from bam_envs.robots.ur5e import GRIPPER_OPEN

MIDDLE = (0.5, 0.0)
"""x, y of the middle of the picture [m]."""
CAMERA_HEIGHT = 0.7
"""Height of the camera above the table [m]."""
VIEW = 0.4
"""Width and height of what the picture shows of the table [m]."""
REACH = 0.3
"""Greatest height of a grasp above the table [m]."""
PERIOD = 1.0
"""Time of a grasp: down, close, up [s]."""
NUMBERS = 8
"""Numbers of one grasp in a command: x, y, z, the quaternion w, x, y, z, and the width."""
REASONS = np.array(["", "blocked", "missed", "dropped"])
"""Why a grasp failed: the gripper did not get to its pose; it closed on nothing; the object was not held up."""
_LABELS = ("x", "y", "z", "qw", "qx", "qy", "qz", "width")
_UNITS = ("m", "m", "m", "1", "1", "1", "1", "m")
_HALF = VIEW / 2
_LOW = (MIDDLE[0] - _HALF, MIDDLE[1] - _HALF, 0.0, -1.0, -1.0, -1.0, -1.0, 0.0)
_HIGH = (MIDDLE[0] + _HALF, MIDDLE[1] + _HALF, REACH, 1.0, 1.0, 1.0, 1.0, GRIPPER_OPEN)
LOW, HIGH = np.array(_LOW), np.array(_HIGH)
"""Limits of the numbers of one grasp."""


def grasp_spec(grasps: int) -> RobotSpec:
    """A gripper that is sent `grasps` grasps at once, and makes them one after the other."""
    width = SignalSpec("gripper_width", ("gripper_width",), ("m",), (0.0,), (GRIPPER_OPEN,))
    names = _LABELS if grasps == 1 else tuple(f"grasp{k}_{label}" for k in range(grasps) for label in _LABELS)
    endless = (np.inf,) * len(names)  # every grasp begins wherever it is told
    command = SignalSpec("command", names, _UNITS * grasps, _LOW * grasps, _HIGH * grasps, endless)
    return RobotSpec("gripper", (width,), command, PERIOD)


def to_metres(column: Array, row: Array, depth: Array, size: Sequence[int]) -> Array:
    """The points that pixels show. Shapes: (n,) each -> (n, 3) [m].

    Args:
        column: From the left edge of the picture, 0.5 in the middle of the first one [pixels].
        row: From the upper edge [pixels].
        depth: Distance from the camera's plane [m].
        size: Height and width of the picture [pixels].
    """
    scale = depth * VIEW / (CAMERA_HEIGHT * size[0])  # metres a pixel at that distance
    x, y = MIDDLE[0] + (column - size[1] / 2) * scale, MIDDLE[1] - (row - size[0] / 2) * scale
    return np.stack([x, y, CAMERA_HEIGHT - depth], axis=-1)


def straight_down(yaw: Array) -> Array:
    """Orientations of a gripper that points down and closes along `yaw` [rad]: w, x, y, z. Shape: (n,) -> (n, 4)."""
    zero = np.zeros_like(yaw)
    return np.stack([zero, np.cos(yaw / 2), np.sin(yaw / 2), zero], axis=-1)
