"""Joints of a robot's URDF (its description in XML): limits, and forward kinematics."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError

Array = NDArray[np.float64]
LARGEST = 8 * 2**20
"""Maximum length of a URDF [characters]."""


@dataclass(frozen=True)
class UrdfJoint:
    """One joint."""

    kind: str
    """``revolute``, ``continuous``, ``prismatic``, ``fixed``."""
    parent: str
    child: str
    low: float
    """Lowest position [rad, m]; -inf without a limit."""
    high: float
    """Highest position [rad, m]."""
    origin: Array
    """Pose of the child at position 0 in the parent. Shape: (4, 4)."""
    axis: Array
    """Unit vector. Shape: (3,)."""


class Urdf(dict[str, UrdfJoint]):
    """The joints of a robot by name."""

    def pose(self, base: str, link: str, positions: Mapping[str, float]) -> tuple[Array, Array] | None:
        """Position (3,) [m] and rotation (3, 3) of `link` in `base`; None if a joint or link between them is missing.

        `positions` are those of the joints that move [rad, m].
        """
        by_child, pose = {joint.child: (name, joint) for name, joint in self.items()}, np.eye(4)
        for _ in range(len(self)):
            if link == base:
                break
            if link not in by_child:
                return None
            name, joint = by_child[link]
            if joint.kind != "fixed" and name not in positions:
                return None
            pose, link = joint.origin @ _moved(joint, positions.get(name, 0.0)) @ pose, joint.parent
        return (pose[:3, 3], pose[:3, :3]) if link == base else None


def read_urdf(text: object) -> Urdf:
    """The joints in the text of a URDF.

    Raises:
        ProtocolError: The text is not a URDF.
    """
    if not isinstance(text, str) or len(text) > LARGEST or "<!" in text.replace("<!--", ""):  # no declared entities
        raise ProtocolError("the robot's description is no URDF")
    try:
        root = ElementTree.fromstring(text)  # without entity declarations nothing is expanded
        return Urdf({str(element.get("name")): _joint(element) for element in root.findall("joint")})
    except (ElementTree.ParseError, ValueError, AttributeError) as error:
        raise ProtocolError(f"the robot's description is no URDF: {error}") from error


def _joint(element: Any) -> UrdfJoint:
    kind, limit, origin, axis = element.get("type"), element.find("limit"), element.find("origin"), element.find("axis")
    low, high = -math.inf, math.inf
    if limit is not None and kind != "continuous":
        low, high = float(limit.get("lower", 0.0)), float(limit.get("upper", 0.0))
    turn = np.array([1.0, 0.0, 0.0]) if axis is None else _vector(axis, "xyz")
    return UrdfJoint(
        kind=str(kind),
        parent=element.find("parent").get("link"),
        child=element.find("child").get("link"),
        low=low,
        high=high,
        origin=np.eye(4) if origin is None else _pose(_vector(origin, "xyz"), _vector(origin, "rpy")),
        axis=turn / max(float(np.linalg.norm(turn)), 1e-9),
    )


def _vector(element: Any, name: str) -> Array:
    values = np.array([float(text) for text in element.get(name, "0 0 0").split()])
    if values.shape != (3,):
        raise ValueError(f"{name} has {len(values)} numbers instead of 3")
    return values


def _pose(position: Array, angles: Array) -> Array:
    pose = np.eye(4)
    roll, pitch, yaw = (_rotation(axis, angle) for axis, angle in zip(np.eye(3), angles, strict=True))
    pose[:3, :3], pose[:3, 3] = yaw @ pitch @ roll, position
    return pose


def _moved(joint: UrdfJoint, position: float) -> Array:
    """Transform of a joint at `position` [rad, m]. Shape: (4, 4)."""
    pose = np.eye(4)
    if joint.kind in ("revolute", "continuous"):
        pose[:3, :3] = _rotation(joint.axis, position)
    elif joint.kind == "prismatic":
        pose[:3, 3] = position * joint.axis
    return pose


def _rotation(axis: Array, angle: float) -> Array:
    """Rodrigues' formula: 1 + sin(a) K + (1 - cos(a)) K^2, where K x = axis x x. Shape: (3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Array = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    return turned
