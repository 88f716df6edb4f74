"""Closed-form forward and inverse kinematics of Universal Robots arms, batched over rows.

Six joints with the Denavit-Hartenberg structure alpha = (90, 0, 0, 90, -90, 0) degrees: joints 2, 3 and 4 have
parallel axes, so a tool that points straight down has an exact inverse. Positions are in the ROS ``base_link`` frame
(x forward, z up; the DH frame turned by 180 degrees about z), in metres; angles in radians.

Source of the constants: Universal Robots, "DH parameters for calculations of kinematics and dynamics", article 45257.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArmGeometry:
    """The six lengths of a Universal Robots arm and its tool [m]."""

    d1: float
    """Height of the shoulder axis above the base."""
    a2: float
    """Upper arm, negative along x of its frame."""
    a3: float
    """Forearm, negative along x of its frame."""
    d4: float
    """Sideways offset of the wrist."""
    d5: float
    """Wrist 1 to wrist 2."""
    d6: float
    """Wrist 2 to the flange."""
    tool: float = 0.0
    """Flange to the tool's centre point along the flange axis."""

    def tool_pose(self, q: Array) -> tuple[Array, Array]:
        """Position of the tool and the direction of its x axis.

        Args:
            q: Joint positions [rad]. Shape: (n, 6).

        Returns:
            position [m], shape (n, 3), and unit vector of the tool's x axis, shape (n, 3).
        """
        c, s = np.cos(q), np.sin(q)
        q23 = q[:, 1] + q[:, 2]
        q234 = q23 + q[:, 3]
        c234, s234 = np.cos(q234), np.sin(q234)
        c1, s1, c5, s5, c6, s6 = c[:, 0], s[:, 0], c[:, 4], s[:, 4], c[:, 5], s[:, 5]
        end = self.d6 + self.tool
        # In the arm's vertical plane: radial along x1, sideways along the shoulder axis, height along z.
        radial = self.a2 * c[:, 1] + self.a3 * np.cos(q23) + self.d5 * s234 - end * s5 * c234
        sideways = self.d4 + end * c5
        position = np.empty((len(q), 3))
        position[:, 0] = -(radial * c1 + sideways * s1)
        position[:, 1] = sideways * c1 - radial * s1
        position[:, 2] = self.d1 + self.a2 * s[:, 1] + self.a3 * np.sin(q23) - self.d5 * c234 - end * s5 * s234
        # x6 = c6 (c5 e + s5 z1) - s6 z4 with e = (c234, 0, s234) and z4 = (s234, 0, -c234) in that plane.
        x_radial, x_sideways = c6 * c5 * c234 - s6 * s234, c6 * s5
        x_axis = np.empty((len(q), 3))
        x_axis[:, 0] = -(x_radial * c1 + x_sideways * s1)
        x_axis[:, 1] = x_sideways * c1 - x_radial * s1
        x_axis[:, 2] = c6 * c5 * s234 + s6 * c234
        return position, x_axis

    def tool_position(self, q: Array) -> Array:
        """Position of the tool [m]. Shape: (n, 6) -> (n, 3)."""
        return self.tool_pose(q)[0]

    def reach_down(self, position: Array, yaw: Array) -> Array:
        """Joint positions that put the tool at `position`, pointing straight down, its x axis at `yaw` from world x.

        The elbow is up, the wrist is not flipped. A position out of reach gets the stretched arm in its direction, so
        the result is always finite.

        Args:
            position: Tool position [m]. Shape: (n, 3).
            yaw: Angle of the tool's x axis about world z [rad]. Shape: (n,).

        Returns:
            Joint positions [rad], the last of which follows `yaw` without a jump. Shape: (n, 6).
        """
        x, y = position[:, 0], position[:, 1]
        # Seen from above, (radial, d4) turned by q1 is (x, y): the wrist passes beside the base at distance d4.
        radial = np.sqrt(np.maximum(x * x + y * y - self.d4**2, 1e-12))
        q1 = np.arctan2(y, x) - np.arctan2(self.d4, radial)
        height = position[:, 2] + self.d6 + self.tool - self.d1
        return self._fold(q1, self.d5 - radial, height, yaw)

    def _fold(self, q1: Array, radial: Array, height: Array, yaw: Array) -> Array:
        """Joints 2 to 6 for wrist 1 at (`radial`, `height`) [m] from the shoulder in the plane of `q1`."""
        reach2 = radial * radial + height * height
        cosine = (reach2 - self.a2**2 - self.a3**2) / (2 * self.a2 * self.a3)
        q = np.empty((len(q1), 6))
        q[:, 0] = q1
        q[:, 2] = np.arccos(np.clip(cosine, -1.0, 1.0))
        first = np.arctan2(self.a3 * np.sin(q[:, 2]), self.a2 + self.a3 * np.cos(q[:, 2]))
        q[:, 1] = np.arctan2(height, radial) - first
        q[:, 1] -= 2 * np.pi * np.round((q[:, 1] + np.pi / 2) / (2 * np.pi))  # the branch around -90 degrees
        q[:, 3] = -np.pi / 2 - q[:, 1] - q[:, 2]
        q[:, 4] = -np.pi / 2
        q[:, 5] = q1 - yaw - np.pi / 2
        return q


UR5E = ArmGeometry(d1=0.1625, a2=-0.425, a3=-0.3922, d4=0.1333, d5=0.0997, d6=0.0996)


def cube_yaw_phase(quaternion: Array) -> NDArray[np.complex128]:
    """exp(4 i yaw) of a cube, whichever of its faces is up.

    The sum over the body axes of ((x + i y) of the axis) ** 4, halved: the vertical axis adds nothing and the two
    horizontal ones, 90 degrees apart, add the same number. Shape: (n, 4) as w, x, y, z -> (n,) complex, of length 1
    when a face is level.
    """
    w, x, y, z = quaternion.T
    plane: Any = np.empty((len(w), 3), dtype=np.complex128)
    plane.real[:, 0], plane.imag[:, 0] = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z)
    plane.real[:, 1], plane.imag[:, 1] = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z)
    plane.real[:, 2], plane.imag[:, 2] = 2 * (x * z + w * y), 2 * (y * z - w * x)
    square = plane * plane
    result: NDArray[np.complex128] = 0.5 * (square * square).sum(axis=1)
    return result
