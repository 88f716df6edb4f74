"""Closed-form forward and inverse kinematics of Universal Robots arms, batched.

Six joints with the Denavit-Hartenberg structure alpha = (90, 0, 0, 90, -90, 0) degrees: joints 2, 3 and 4 have
parallel axes, so a tool that points straight down has an exact inverse. Positions are in the ROS ``base_link`` frame
(x forward, z up; the DH frame turned by 180 degrees about z), in metres; angles in radians.

Link frames are those of ROS-Industrial's ur_description (kinematics since its version 1.3): each link's frame is at its
joint, which turns it about its z axis; ``tool0`` is at the flange, its z axis pointing out of it.

Source of the constants: Universal Robots, "DH parameters for calculations of kinematics and dynamics", article 45257.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Column = Any
"""A number of each of n poses (n,); of one pose, a plain number."""
LINKS = ("shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "tool0")
"""Frames of `ArmGeometry.link_poses`, in its order. ``tool0`` is also the frame of ``wrist_3_link``."""


@dataclass(frozen=True)
class ArmOutline:
    """Offsets and radii of the tubes of an arm [m]."""

    upper_arm_offset: float
    """Offset of the upper arm's tube from the arm's middle plane, along the shoulder axis."""
    forearm_offset: float
    """Offset of the forearm's tube, along the same axis."""
    base: float
    """Radius of base and shoulder."""
    upper_arm: float
    """Radius of the upper arm."""
    forearm: float
    """Radius of the forearm."""
    wrist: float
    """Radius of the wrists and of the flange."""


@dataclass(frozen=True)
class ArmGeometry:
    """The six lengths of a Universal Robots arm and its tool [m], and the tubes around them."""

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
    outline: ArmOutline | None = None
    """The arm's tubes; None if they are not known."""

    def tool_pose(self, q: Array) -> tuple[Array, Array]:
        """Position of the tool and the direction of its x axis.

        Args:
            q: Joint positions [rad]. Shape: (n, 6).

        Returns:
            position [m], shape (n, 3), and unit vector of the tool's x axis, shape (n, 3).
        """
        (c1, c2, _, _, c5, c6, c23, c234), (s1, s2, _, _, s5, s6, s23, s234) = _cosines_and_sines(q)
        end = self.d6 + self.tool
        # In the arm's vertical plane: radial along x1, sideways along the shoulder axis, height along z.
        radial = self.a2 * c2 + self.a3 * c23 + self.d5 * s234 - end * s5 * c234
        sideways = self.d4 + end * c5
        height = self.d1 + self.a2 * s2 + self.a3 * s23 - self.d5 * c234 - end * s5 * s234
        position = _rows(-(radial * c1 + sideways * s1), sideways * c1 - radial * s1, height)
        # x6 = c6 (c5 e + s5 z1) - s6 z4 with e = (c234, 0, s234) and z4 = (s234, 0, -c234) in that plane.
        x_radial, x_sideways = c6 * c5 * c234 - s6 * s234, c6 * s5
        x_height = c6 * c5 * s234 + s6 * c234
        return position, _rows(-(x_radial * c1 + x_sideways * s1), x_sideways * c1 - x_radial * s1, x_height)

    def tool_position(self, q: Array) -> Array:
        """Position of the tool [m]. Shape: (n, 6) -> (n, 3)."""
        return self.tool_pose(q)[0]

    def tool_point(self, q: Sequence[float]) -> tuple[float, float, float]:
        """`tool_position` of one pose (6,) [rad] in plain numbers, which take a tenth of the time; x, y, z [m]."""
        cos, sin, (q1, q2, q3, q4, q5, _) = math.cos, math.sin, q
        q23 = q2 + q3
        q234 = q23 + q4
        c1, s1, c234, s234, a2, a3, d5 = cos(q1), sin(q1), cos(q234), sin(q234), self.a2, self.a3, self.d5
        end = self.d6 + self.tool
        across = end * sin(q5)
        radial = a2 * cos(q2) + a3 * cos(q23) + d5 * s234 - across * c234
        sideways = self.d4 + end * cos(q5)
        height = self.d1 + a2 * sin(q2) + a3 * sin(q23) - d5 * c234 - across * s234
        return -(radial * c1 + sideways * s1), sideways * c1 - radial * s1, height

    def flange_pose(self, q: Array) -> tuple[Array, Array]:
        """Pose of ``tool0`` in ``base_link``; the tool's length does not count.

        Args:
            q: Joint positions [rad]. Shape: (n, 6).

        Returns:
            position [m], shape (n, 3), and rotation matrix, whose columns are the axes of ``tool0``, shape (n, 3, 3).
        """
        positions, rotations = self.link_poses(q)
        return positions[:, -1], rotations[:, -1]

    def link_poses(self, q: Array) -> tuple[Array, Array]:
        """Poses of the frames `LINKS` in ``base_link``.

        Args:
            q: Joint positions [rad]. Shape: (n, 6).

        Returns:
            positions [m], shape (n, 6, 3), and rotation matrices, whose columns are the axes, shape (n, 6, 3, 3).
        """
        c, s = np.cos(q), np.sin(q)
        level = np.empty((len(q), 4))  # angles of x axes in the arm's vertical plane
        level[:, 0], level[:, 1] = 0.0, q[:, 1]
        level[:, 2] = q[:, 1] + q[:, 2]
        level[:, 3] = level[:, 2] + q[:, 3]
        along = np.stack([np.cos(level), np.zeros_like(level), np.sin(level)], axis=2)
        across = np.stack([-along[:, :, 2], np.zeros_like(level), along[:, :, 0]], axis=2)
        # In the plane's own coordinates: radial along x1, sideways along the shoulder axis, height along z.
        axes = np.zeros((len(q), 6, 3, 3))
        axes[:, :4, :, 0], axes[:, :4, :, 1], axes[:, 1:4, 1, 2] = along, across, 1.0
        axes[:, 0, :, 1], axes[:, 0, :, 2] = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)
        x, y = along[:, 3], np.array([0.0, 1.0, 0.0])
        axes[:, 4, :, 0] = c[:, 4:5] * x + s[:, 4:5] * y
        axes[:, 4, :, 1] = c[:, 4:5] * y - s[:, 4:5] * x
        axes[:, 4, :, 2] = -across[:, 3]
        axes[:, 5, :, 0] = c[:, 5:6] * axes[:, 4, :, 0] + s[:, 5:6] * across[:, 3]
        axes[:, 5, :, 1] = c[:, 5:6] * across[:, 3] - s[:, 5:6] * axes[:, 4, :, 0]
        axes[:, 5, :, 2] = axes[:, 4, :, 1]
        places = np.zeros((len(q), 6, 3))
        places[:, :, 2] = self.d1
        places[:, 2:] += self.a2 * along[:, 1, None]
        places[:, 3:] += self.a3 * along[:, 2, None]
        places[:, 3:, 1] += self.d4
        places[:, 4:] -= self.d5 * across[:, 3, None]
        places[:, 5] += self.d6 * axes[:, 5, :, 2]
        return turned(places, c[:, 0], s[:, 0]), turned(axes.swapaxes(2, 3), c[:, 0], s[:, 0]).swapaxes(2, 3)

    def jacobian(self, q: Sequence[float]) -> list[list[float]]:
        """Velocity of the tool [m/rad] and axis of each joint at the joints `q` (6,) [rad]. Shape: (6, 6), a row each.

        Velocities and axes are in the arm's vertical plane (radial, sideways, height); `turned` brings them from and to
        ``base_link``.
        """
        low = q[1] + q[2] + q[3]
        sine, cosine, s5, c5 = math.sin(low), math.cos(low), math.sin(q[4]), math.cos(q[4])
        end = self.d6 + self.tool
        out = -s5 * cosine, c5, -s5 * sine
        # From each joint to the tool, radially (x) and in height (z); joints 2 to 6 are `d4` beside the plane.
        x5, z5 = end * out[0], end * out[2]
        x4, z4 = x5 + self.d5 * sine, z5 - self.d5 * cosine
        x3, z3 = x4 + self.a3 * math.cos(q[1] + q[2]), z4 + self.a3 * math.sin(q[1] + q[2])
        x2, z2 = x3 + self.a2 * math.cos(q[1]), z3 + self.a2 * math.sin(q[1])
        beside = end * c5
        rows = [[self.d4 + beside, -x2, 0.0, 0.0, 0.0, 1.0]]
        rows += [[-z, 0.0, x, 0.0, 1.0, 0.0] for x, z in ((x2, z2), (x3, z3), (x4, z4))]
        axis = sine, 0.0, -cosine
        rows += [[-cosine * beside, cosine * x5 + sine * z5, -sine * beside, *axis], [0.0, 0.0, 0.0, *out]]
        return rows

    def tool_jacobian(self, q: Sequence[float]) -> Array:
        """Velocity of the tool [m/rad] and axes of the joints, in ``base_link``, at the joints `q` (6,). (6, 6)."""
        rows = np.array(self.jacobian(q)).reshape(1, 6, 2, 3)
        jacobian: Array = turned(rows, np.cos(q[:1]), np.sin(q[:1]))[0].reshape(6, 6).T
        return jacobian

    def reach_down(self, position: Array, yaw: Array, near: Array | None = None) -> Array:
        """Joint positions that put the tool at `position`, pointing straight down, its x axis at `yaw` from world x.

        The elbow is up, the wrist is not flipped. A position out of reach gets the stretched arm in its direction, so
        the result is always finite.

        Args:
            position: Tool position [m]. Shape: (n, 3).
            yaw: Angle of the tool's x axis about world z [rad]. Shape: (n,).
            near: Not needed: for `bam_envs.arms.serial_chain.SerialChain`.

        Returns:
            Joint positions [rad], the last of which follows `yaw` without a jump. Shape: (n, 6).
        """
        x, y, z = position.T
        # Seen from above, (radial, d4) turned by q1 is (x, y): the wrist passes beside the base at distance d4.
        radial = np.sqrt(np.maximum(x * x + y * y - self.d4**2, 1e-12))
        q1 = np.arctan2(y, x) - np.arctan2(self.d4, radial)
        # In that plane: wrist 1 from the shoulder.
        along, height = self.d5 - radial, z + self.d6 + self.tool - self.d1
        cosine = (along * along + height * height - self.a2**2 - self.a3**2) / (2 * self.a2 * self.a3)
        q3 = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0))
        first = np.arctan2(self.a3 * np.sin(q3), self.a2 + self.a3 * np.cos(q3))
        q2 = np.arctan2(height, along) - first
        q2 = q2 - 2 * np.pi * np.rint((q2 + np.pi / 2) / (2 * np.pi))  # the branch around -90 degrees
        return _rows(q1, q2, q3, -np.pi / 2 - q2 - q3, -np.pi / 2, q1 - yaw - np.pi / 2)

    def joints_down(self, x: float, y: float, z: float, yaw: float, near: object = None) -> list[float]:
        """`reach_down` of one tool position in plain numbers: the same bits, by the same functions of NumPy."""
        radial = math.sqrt(max(x * x + y * y - self.d4**2, 1e-12))
        q1 = float(np.arctan2(y, x) - np.arctan2(self.d4, radial))
        along, height = self.d5 - radial, z + self.d6 + self.tool - self.d1
        cosine = (along * along + height * height - self.a2**2 - self.a3**2) / (2 * self.a2 * self.a3)
        q3 = float(np.arccos(min(max(cosine, -1.0), 1.0)))
        first = np.arctan2(self.a3 * np.sin(q3), self.a2 + self.a3 * np.cos(q3))
        q2 = float(np.arctan2(height, along) - first)
        q2 = q2 - 2 * math.pi * float(np.rint((q2 + math.pi / 2) / (2 * math.pi)))
        return [q1, q2, q3, -math.pi / 2 - q2 - q3, -math.pi / 2, q1 - yaw - math.pi / 2]


def _columns(rows: Array) -> Sequence[Column]:
    """The columns of an array (n, k) for arithmetic; if n is 1, they are plain numbers, which are quicker."""
    columns: Sequence[Column] = rows[0].tolist() if len(rows) == 1 else rows.T
    return columns


def _rows(*columns: Column) -> Array:
    """The array (n, k) of k columns (n,), or (1, k) of k numbers."""
    if not isinstance(columns[0], np.ndarray):
        return np.array([columns])
    rows = np.empty((len(columns[0]), len(columns)))
    for at, column in enumerate(columns):
        rows[:, at] = column
    return rows


def _cosines_and_sines(q: Array) -> tuple[Sequence[Column], Sequence[Column]]:
    """Columns of the six joints (n, 6) [rad], then of the sums of joints 2 and 3, and of joints 2, 3 and 4."""
    angles = np.empty((8, len(q)))
    angles[:6] = q.T
    np.add(q[:, 1], q[:, 2], out=angles[6])
    np.add(angles[6], q[:, 3], out=angles[7])
    return _columns(np.cos(angles).T), _columns(np.sin(angles).T)


_SMALL, _MIDDLE, _LARGE = (0.060, 0.048, 0.040, 0.0315), (0.070, 0.054, 0.042, 0.0375), (0.085, 0.075, 0.055, 0.045)
"""Radii of base, upper arm, forearm and wrists [m]: ROS-Industrial's ur_description, measured from models."""


def _arm(
    lengths: tuple[float, float, float, float, float, float], offsets: tuple[float, float], radii: tuple[float, ...]
) -> ArmGeometry:
    """An arm of the lengths d1, a2, a3, d4, d5 and d6 [m]; the offsets are of upper arm and forearm."""
    return ArmGeometry(*lengths, outline=ArmOutline(*offsets, *radii))


UR3 = _arm((0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819), (0.1198, 0.0273), _SMALL)
UR3E = _arm((0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921), (0.1200, 0.0270), _SMALL)
UR5 = _arm((0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823), (0.13585, 0.0165), _MIDDLE)
UR5E = _arm((0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996), (0.1380, 0.0070), _MIDDLE)
UR10 = _arm((0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922), (0.220941, 0.049041), _LARGE)
UR10E = _arm((0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655), (0.1762, 0.0393), _LARGE)
UR16E = _arm((0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655), (0.1760, 0.0390), _LARGE)
UR5E_GRIPPER = replace(UR5E, tool=0.15)
"""A UR5e with a parallel gripper; the tool is the middle of the gripper's pads."""
UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""Names of the joints of a Universal Robots arm, from its base on."""


def turned(vectors: Array, c1: Array, s1: Array) -> Array:
    """Vectors (n, ..., 3) of the arm's vertical plane (radial, sideways, height) in ``base_link``, and back.

    `c1` and `s1` are cosine and sine of joint 1. Shape: (n,). The two frames mirror each other, so one turn does both.
    """
    shape = (len(c1), *[1] * (vectors.ndim - 2))
    c1, s1 = c1.reshape(shape), s1.reshape(shape)
    turned = np.empty_like(vectors)
    turned[..., 0] = -(vectors[..., 0] * c1 + vectors[..., 1] * s1)
    turned[..., 1] = vectors[..., 1] * c1 - vectors[..., 0] * s1
    turned[..., 2] = vectors[..., 2]
    return turned


def quaternions(rotation: Array) -> Array:
    """Unit quaternions x, y, z, w of rotation matrices, w not negative. Shape: (n, 3, 3) -> (n, 4).

    Each component is computed from the one that is largest, so that nothing is divided by a small number.
    """
    m = rotation
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    # The symmetric matrix 4 q q^T: its column with the largest diagonal element is a multiple of q.
    square = np.empty((len(m), 4, 4))
    for i in range(3):
        square[:, i, i] = 1 + 2 * m[:, i, i] - trace
        for j in range(i):
            square[:, i, j] = square[:, j, i] = m[:, i, j] + m[:, j, i]
    square[:, 3, 3] = 1 + trace
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        square[:, i, 3] = square[:, 3, i] = m[:, k, j] - m[:, j, k]
    largest = np.einsum("nii->ni", square).argmax(axis=1)
    column: Array = square[np.arange(len(m)), :, largest]
    x, y, z, w = column.T
    column /= np.sqrt(x * x + y * y + z * z + w * w)[:, None]
    column[column[:, 3] < 0] *= -1.0
    return column


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


def from_angles(angles: Array) -> Array:
    """Quaternions x, y, z, w of roll about x, then pitch about y, then yaw about z, of fixed axes. Shape: (n, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles / 2).T, np.sin(angles / 2).T
    columns = [sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy]
    return np.stack([*columns, cr * cp * cy + sr * sp * sy], axis=1)


def angle_between(one: Array, other: Array) -> Array:
    """Angles between rotations, unit quaternions x, y, z, w [rad]. Shapes: (n, 4) -> (n,)."""
    v, w, other_v, other_w = one[:, :3], one[:, 3:], other[:, :3], other[:, 3:]
    vector = w * other_v - other_w * v - np.cross(v, other_v)
    real = (w * other_w)[:, 0] + np.einsum("ij,ij->i", v, other_v)
    angle: Array = 2 * np.arctan2(np.sqrt(np.einsum("ij,ij->i", vector, vector)), np.abs(real))
    return angle
