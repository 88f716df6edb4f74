"""Unit quaternions x, y, z, w, batched over rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
