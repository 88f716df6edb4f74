"""The description of an arm: joints, limits, tool, gripper, outline and work area, as plain data in a TOML file."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.serial_chain import Arm, Capsule, SerialChain
from bam_envs.core import kinematics
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.kinematics import ArmGeometry
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.core.robot_models import Description, find_model
from bam_envs.core.validation import (
    Finite,
    Length,
    Mass,
    Metres,
    MetresPerS,
    NewtonMetres,
    Newtons,
    NonEmpty,
    NonNegative,
    NonNegativeInt,
    RadPerS,
    RadPerS2,
    RadPerS3,
)

Array = NDArray[np.float64]
Vector = tuple[Metres, Metres, Metres]
Quaternion = tuple[Finite, Finite, Finite, Finite]
Box = tuple[Vector, Vector]
"""Middle and half edges [m]."""
_MOST_CAPSULES = 100


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A pose in the frame of the link before."""

    xyz: Vector = (0.0, 0.0, 0.0)
    """Position [m]."""
    quat: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Orientation, a quaternion w, x, y, z of any length but 0."""

    def __post_init__(self) -> None:
        if not any(self.quat):
            raise InvalidValue("quat: the quaternion 0, 0, 0, 0 is no orientation; leave it out for none.")

    def matrix(self) -> Array:
        """The pose as a homogeneous matrix. Shape: (4, 4)."""
        w, x, y, z = np.array(self.quat) / np.linalg.norm(self.quat)
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, 3] = self.xyz
        return matrix


@dataclass(frozen=True, kw_only=True)
class JointRow(Placed):
    """One revolute joint and the link that it turns."""

    name: NonEmpty
    axis: tuple[Finite, Finite, Finite] = (0.0, 0.0, 1.0)
    """Axis in the joint's frame."""
    low: Finite
    """Lowest position [rad]."""
    high: Finite
    """Highest position [rad]."""
    velocity: RadPerS
    """Fastest motion [rad/s]."""
    acceleration: RadPerS2
    """Greatest acceleration [rad/s^2]."""
    jerk: RadPerS3
    """Greatest jerk [rad/s^3]."""
    effort: NewtonMetres
    """Greatest torque [N m]."""
    mass: Mass
    """Mass of the link [kg]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.axis):
            raise InvalidValue(f"{self.name}: axis: 0, 0, 0 is no direction.")


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A gripper with two parallel pads."""

    open: Length
    """Width between the pads when it is open [m]."""
    speed: MetresPerS = 0.1
    """Fastest change of the width [m/s]."""
    force: Newtons = 40.0
    """Force between the pads in simulation [N]."""
    mass: Mass = 0.5
    """Mass [kg]."""
    joint: NonEmpty = "gripper_width"
    """Name of its joint in a live robot's messages."""

    def boxes(self, tool: Array) -> tuple[float, tuple[Box, Box, Box]]:
        """Its shape, of a Robotiq 2F-85 in the size of this one, with its palm on the arm's flange.

        Args:
            tool: Pose of the tool in the frame of the last joint. Shape: (4, 4).

        Returns:
            Distance of the palm's base from the tool [m]. Palm, right finger and its pad: middle and half edges [m],
            from that base, in the tool's axes; finger and pad move along x with half the width, and the left ones
            against it.
        """
        size = float(np.clip(self.open / 0.085, 0.4, 1.2))
        palm = max(0.01, min(0.045 * size, 0.5 * (float(np.linalg.norm(tool[:3, 3])) - 0.06 * size)))
        deep, first, second = 0.011 * size, 0.022 * size, 0.058 * size
        return 2 * palm + 0.06 * size, (
            ((0.0, 0.0, palm), (0.5 * self.open + 0.0075, 0.032 * size, palm)),
            ((0.008, 0.0, 2 * palm + first), (0.006, deep, first)),
            ((0.004, 0.0, 2 * palm + second), (0.004, deep, 0.014 * size)),
        )


@dataclass(frozen=True, kw_only=True)
class ArmDescription(Description):
    """An arm with its gripper. Positions in ``base_link``: x forward, z up, z = 0 on the table that it stands on."""

    WHAT: ClassVar[str] = "an arm"
    PARTS: ClassVar[Mapping[str, type[Any]]] = {
        "joints": JointRow,
        "capsules": Capsule,
        "tool": Placed,
        "mount": Placed,
        "gripper": Gripper,
    }
    MOVING: ClassVar[tuple[str, ...]] = ("joints", "home", "tool", "gripper", "mount", "workspace")

    joints: tuple[JointRow, ...]
    """From the base to the flange."""
    home: tuple[Finite, ...]
    """Joint positions with the tool pointing down over the middle of the work area [rad]."""
    tool: Placed
    """Point between the pads in the frame of the last joint; z out of the gripper, pads close along x."""
    gripper: Gripper
    workspace: tuple[Vector, Vector]
    """Box of the tool's target: lowest and highest x, y, z [m]."""
    capsules: tuple[Capsule, ...]
    """Outline for collisions."""
    slack: tuple[tuple[NonNegativeInt, NonNegativeInt, NonNegative], ...] = ()
    """Two links, and how far their capsules overlap before the links themselves touch [m]."""
    mount: Placed = Placed()
    """Pose of the base."""
    geometry: str = ""
    """Name of a closed form in `bam_envs.core.kinematics`, such as ``UR5E``; empty: none."""

    def __post_init__(self) -> None:
        size = len(self.joints)
        if not 4 <= size <= 8:
            raise InvalidValue(f"{self.name}: an arm has 4 to 8 joints, and this one has {size}.")
        if len(self.home) != size:
            raise InvalidValue(f"{self.name}: home: expected {size} numbers, one a joint, found {len(self.home)}.")
        for name in self.joint_names:
            if self.joint_names.count(name) > 1:
                raise InvalidValue(f"{self.name}: joints: two of them are called {name!r}.")
        for row, home in zip(self.joints, self.home, strict=True):
            if not row.low < row.high:
                raise InvalidValue(f"{self.name}: joints: {row.name}: low must be below high.")
            if not row.low <= home <= row.high:
                raise InvalidValue(
                    f"{self.name}: home: {row.name} is {home:g} rad, outside {row.low:g} to {row.high:g}."
                )
        if not all(low < high for low, high in zip(*self.workspace, strict=True)):
            raise InvalidValue(f"{self.name}: workspace: the lowest corner must come first.")
        if len(self.capsules) > _MOST_CAPSULES:
            raise InvalidValue(f"{self.name}: capsules: at most {_MOST_CAPSULES}, found {len(self.capsules)}.")
        named = [("capsules", one.link) for one in self.capsules]
        named += [("slack", link) for one, other, _ in self.slack for link in (one, other)]
        for key, link in named:
            if link > size + 1:
                raise InvalidValue(f"{self.name}: {key}: there is no link {link}; the last is {size + 1}.")
        if self.geometry:
            self._check_geometry()

    def _check_geometry(self) -> None:
        """Refuse a closed form that is not that of the joints."""
        forms = [key for key, one in vars(kinematics).items() if type(one) is ArmGeometry]
        if self.geometry not in forms:
            raise UnknownName("geometry", self.geometry, forms)
        q = np.array(self.home) + np.linspace(-1.0, 1.0, 5)[:, None] * np.arange(1, 1 + self.num_joints)
        fits = self.num_joints == 6
        pairs = zip(self.arm.tool_pose(q), self.chain.tool_pose(q), strict=True) if fits else []
        off = max([float(np.abs(closed - chain).max()) for closed, chain in pairs], default=1.0)
        if off > 1e-6:
            raise InvalidValue(
                f"{self.name}: geometry: the closed form {self.geometry} is not that of these joints and this tool; "
                "leave the key out."
            )

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, from the base on."""
        return tuple(row.name for row in self.joints)

    @property
    def num_joints(self) -> int:
        """Number of joints, without those of the gripper."""
        return len(self.joints)

    @cached_property
    def chain(self) -> SerialChain:
        """Its kinematics as a chain of joints."""
        placements = np.array([row.matrix() for row in self.joints])
        placements[0] = self.mount.matrix() @ placements[0]
        axes = np.array([row.axis for row in self.joints])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        low, high = (np.array([getattr(row, end) for row in self.joints]) for end in ("low", "high"))
        home, tool = np.array(self.home), self.tool.matrix()
        mount, turns = self.mount.matrix(), self.num_joints > 5
        return SerialChain(placements, axes, tool, low, high, home, turns, self.capsules, self.slack, mount)

    @cached_property
    def arm(self) -> Arm:
        """Its kinematics: the closed form where there is one, else the chain."""
        if not self.geometry:
            return self.chain
        form: ArmGeometry = getattr(kinematics, self.geometry)
        return dataclasses.replace(form, tool=round(self.tool.xyz[2] - form.d6, 9))

    def spec(self, *, with_object: bool) -> RobotSpec:
        """The signals of the arm with its gripper, and those of a tracked object if there is one."""
        names, size = self.joint_names, self.num_joints
        low, high, speed = (tuple(getattr(row, key) for row in self.joints) for key in ("low", "high", "velocity"))
        width = self.gripper.open
        signals = [
            SignalSpec("joint_position", names, ("rad",) * size, low, high),
            SignalSpec("joint_velocity", names, ("rad/s",) * size, tuple(-one for one in speed), speed),
            SignalSpec("gripper_width", ("gripper_width",), ("m",), (0.0,), (width,)),
        ]
        if with_object:
            signals += OBJECT_SIGNALS
        command = SignalSpec(
            "command",
            (*names, "gripper_width"),
            (*("rad",) * size, "m"),
            (*low, 0.0),
            (*high, width),
            (*speed, self.gripper.speed),
            (*(row.acceleration for row in self.joints), math.inf),
            (*(row.jerk for row in self.joints), math.inf),
        )
        return RobotSpec(self.name, tuple(signals), command, period=0.05)


def cube_edge(opening: float, turns: bool) -> float:
    """Edge of the cube that an arm grasps: 4 cm, or less for a small gripper or one that cannot turn [m]."""
    return min(0.04, round((0.55 if turns else 0.4) * opening, 3))


OBJECT_SIGNALS = [
    SignalSpec("object_position", ("object_x", "object_y", "object_z"), ("m",) * 3, (-2.0,) * 3, (2.0,) * 3),
    SignalSpec(
        "object_quaternion", ("object_qw", "object_qx", "object_qy", "object_qz"), ("1",) * 4, (-1.0,) * 4, (1.0,) * 4
    ),
]
"""Pose of a tracked object, in ``base_link``."""


def robot_model(name: str | Mapping[str, Any] | Description) -> ArmDescription:
    """The arm called `name`; see `bam_envs.core.robot_models.find_model`."""
    return find_model(name, ArmDescription)
