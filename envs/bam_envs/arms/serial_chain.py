"""Kinematics of any serial chain of revolute joints, batched in NumPy: forward, Jacobian and damped inverse.

It has the interface of `bam_envs.core.kinematics.ArmGeometry`, whose closed form serves Universal Robots arms. A chain
is plain data: for each joint its frame in the frame of the joint before, and its axis. Positions are in the frame of
the base, x forward and z up, in metres; angles in radians. The tool's z axis points out of the gripper, and its fingers
close along its x axis.

The inverse is the Levenberg-Marquardt method of Sugihara, "Solvability-unconcerned inverse kinematics by the
Levenberg-Marquardt method" (IEEE Transactions on Robotics 27-5, 2011), whose damping grows with the error, so that a
position out of reach gets the joints nearest to it. What the tool's pose leaves free, such as the elbow of an arm with
seven joints, goes to the home pose.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.kinematics import ArmGeometry
from bam_envs.core.validation import Length, Metres, NonNegativeInt

Array = NDArray[np.float64]
TILT_LEVER = 0.3
"""Error of the tool's position that weighs as much as 1 rad of its orientation [m/rad]."""
HAND = 0.15
"""Length of the gripper in pictures [m]."""
HOMING = 0.1
"""Share of the way to the home pose that the joints go in each iteration, where the tool leaves them free."""
_DAMPING = 1e-7
_CLOSE = 1e-7  # error at which an iteration from afar ends [m]
_TRACKING, _SEARCHING = 2, 60  # iterations from joints nearby, and from the home pose
_CROSS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]]
)


Pose = tuple[float, ...]
"""Three rows of a homogeneous matrix, one after the other (12,), in ``base_link``; lengths in m."""


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A segment with a radius, fixed to a link."""

    link: NonNegativeInt
    """0 for the base, k for what joint k turns, one more than the joints for the gripper (in the tool's frame)."""
    start: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """One end, in the link's frame [m]."""
    end: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """The other end [m]."""
    radius: Length
    """Radius [m]."""


@dataclass(frozen=True, eq=False)
class SerialChain:
    """The joints of an arm from its base on, and its tool.

    Args:
        placements: Pose of each joint's frame in the frame of the joint before it, at zero. Shape: (k, 4, 4).
        axes: Axis of each joint in its own frame, unit vectors. Shape: (k, 3).
        tool_placement: Pose of the tool in the frame of the last joint. Shape: (4, 4).
        low: Lowest joint positions [rad]. Shape: (k,).
        high: Highest joint positions [rad]. Shape: (k,).
        home: Joint positions near the middle of the work, with the tool pointing down [rad]. Shape: (k,).
        turns: Whether the yaw of the tool can be chosen while it points down.
        capsules: Its outline; () if it is not known.
        slack: Two links, and how far their capsules overlap before the links themselves touch [m].
        mount: Pose of the base, for the capsules of link 0. Shape: (4, 4).
    """

    placements: Array
    axes: Array
    tool_placement: Array
    low: Array
    high: Array
    home: Array
    turns: bool = True
    capsules: tuple[Capsule, ...] = ()
    slack: tuple[tuple[int, int, float], ...] = ()
    mount: Array = field(default_factory=lambda: np.eye(4))
    _motion: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        skew = np.einsum("ki,iab->kab", self.axes, _CROSS)
        motion = np.zeros((3, *self.placements.shape))
        motion[0] = self.placements  # Rodrigues: placement (I + sin K + (1 - cos) K^2)
        motion[1, :, :3, :3] = self.placements[:, :3, :3] @ skew
        motion[2, :, :3, :3] = motion[1, :, :3, :3] @ skew
        object.__setattr__(self, "_motion", motion)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the compiled code, which is made again."""
        return {name: value for name, value in vars(self).items() if name not in ("_point", "_poses")}

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.axes)

    def link_frames(self, q: Array) -> Array:
        """Poses of the joints' frames, which turn with them, then of the tool. Shape: (n, k) -> (n, k + 1, 4, 4)."""
        sine, rest = np.sin(q)[:, :, None, None], (1.0 - np.cos(q))[:, :, None, None]
        steps = self._motion[0] + sine * self._motion[1] + rest * self._motion[2]
        frames = np.empty((len(q), q.shape[1] + 1, 4, 4))
        frames[:, 0] = steps[:, 0]
        for joint in range(1, q.shape[1]):
            np.matmul(frames[:, joint - 1], steps[:, joint], out=frames[:, joint])
        np.matmul(frames[:, -2], self.tool_placement, out=frames[:, -1])
        return frames

    def tool_pose(self, q: Array) -> tuple[Array, Array]:
        """Position of the tool [m] and the direction of its x axis. Shape: (n, k) [rad] -> (n, 3) each."""
        tool = self.link_frames(q)[:, -1]
        return tool[:, :3, 3], tool[:, :3, 0]

    def tool_position(self, q: Array) -> Array:
        """Position of the tool [m]. Shape: (n, k) -> (n, 3)."""
        return self.link_frames(q)[:, -1, :3, 3]

    def tool_point(self, q: Sequence[float]) -> tuple[float, float, float]:
        """`tool_position` of one pose (k,) [rad] in plain numbers, which take a fifth of the time; x, y, z [m]."""
        return self._point(q)

    @cached_property
    def _turns(self) -> Array:
        """Rotations that take z to each joint's axis. Shape: (k, 4, 4)."""
        return np.array([_towards(axis) for axis in self.axes])

    @cached_property
    def _point(self) -> Callable[[Sequence[float]], tuple[float, float, float]]:
        """`tool_point` as straight-line code: from the tool to the base, without the zeros of the placements."""
        turns = self._turns
        x, y, z = (repr(float(one)) for one in (turns[-1].T @ self.tool_placement)[:3, 3])
        lines = []
        for joint in reversed(range(self.num_joints)):
            place = self.placements[joint] @ turns[joint]
            if joint:
                place = turns[joint - 1].T @ place
            lines += [
                f"c = cos(q[{joint}]); s = sin(q[{joint}])",
                f"x, y, z = c * {x} - s * {y}, s * {x} + c * {y}, {z}",
                "x, y, z = " + ", ".join(_sum(row) for row in place[:3]),
            ]
            x, y, z = "x", "y", "z"
        point: Callable[[Sequence[float]], tuple[float, float, float]] = _compiled([*lines, "return x, y, z"])
        return point

    def poses(self, q: Sequence[float]) -> Sequence[Pose]:
        """`link_frames` of one pose (k,) [rad] in plain numbers, with `mount` before them; in a fifth of the time.

        Each is three rows of a homogeneous matrix, one after the other.
        """
        return self._poses(q)

    @cached_property
    def _poses(self) -> Callable[[Sequence[float]], Sequence[Pose]]:
        """`poses` as straight-line code, from the base to the tool, about joints that turn about their z axes."""
        lines: list[str] = []
        frame: list[list[float | str]] = [[*row] for row in np.eye(4).tolist()]
        frames = [self.mount[:3].ravel().tolist()]
        for joint in range(self.num_joints):
            c, s = f"c{joint}", f"s{joint}"
            lines.append(f"{c} = cos(q[{joint}]); {s} = sin(q[{joint}])")
            place = self.placements[joint] @ self._turns[joint]
            frame = _times(frame, self._turns[joint - 1].T @ place if joint else place, f"a{joint}_", lines)
            turn = np.array(
                [[c, f"-{s}", 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], object
            )
            frame = _times(frame, turn, f"b{joint}_", lines)
            frames.append([one for row in _times(frame, self._turns[joint].T, f"f{joint}_", lines)[:3] for one in row])
        last = self._turns[-1].T @ self.tool_placement
        frames.append([one for row in _times(frame, last, "t", lines)[:3] for one in row])
        rows = ", ".join(f"({', '.join(str(one) for one in row)})" for row in frames)
        poses: Callable[[Sequence[float]], Sequence[Pose]] = _compiled([*lines, f"return {rows}"])
        return poses

    def jacobians(self, q: Array) -> tuple[Array, Array]:
        """Poses as `link_frames` gives them, and velocities of the tool: linear [m/rad], then angular. (n, 6, k)."""
        frames = self.link_frames(q)
        axes = np.einsum("nkij,kj->nki", frames[:, :-1, :3, :3], self.axes)
        x, y, z = np.moveaxis(frames[:, -1:, :3, 3] - frames[:, :-1, :3, 3], 2, 0)
        u, v, w = np.moveaxis(axes, 2, 0)
        return frames, np.stack([v * z - w * y, w * x - u * z, u * y - v * x, u, v, w], axis=1)

    def tool_jacobian(self, q: Sequence[float]) -> Array:
        """Velocity of the tool [m/rad] and axes of the joints, in ``base_link``, at the joints `q` (k,). (6, k)."""
        _, *frames, tool = self.poses(q)
        columns = []
        for pose, (x, y, z) in zip(frames, self.axes.tolist(), strict=True):
            a, b, c, px, d, e, f, py, g, h, i, pz = pose
            u, v, w = a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
            px, py, pz = tool[3] - px, tool[7] - py, tool[11] - pz
            columns.append((v * pz - w * py, w * px - u * pz, u * py - v * px, u, v, w))
        jacobian: Array = np.array(columns).T
        return jacobian

    def flange_pose(self, q: Array) -> tuple[Array, Array]:
        """Pose of a gripper of `HAND` length that ends at the tool, as `ArmGeometry.flange_pose`. (n, 3), (n, 3, 3)."""
        tool = self.link_frames(q)[:, -1]
        return tool[:, :3, 3] - HAND * tool[:, :3, 2], tool[:, :3, :3]

    def reach_down(self, position: Array, yaw: Array, near: Array | None = None) -> Array:
        """Joint positions that put the tool at `position`, pointing straight down, its x axis at `yaw` from world x.

        A position out of reach gets the joints nearest to it, within their limits, so the result is always finite. An
        arm that cannot choose its yaw (`turns`) ignores it.

        Args:
            position: Tool position [m]. Shape: (n, 3).
            yaw: Angle of the tool's x axis about world z [rad]. Shape: (n,).
            near: Joint positions nearby, of the last command [rad]; the home pose by default. Shape: (n, k).

        Returns:
            Joint positions [rad]. Shape: (n, k).
        """
        c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
        wanted = np.array([[c, s, zero], [s, -c, zero], [zero, zero, zero - 1.0]]).transpose(2, 1, 0)
        q = np.tile(self.home, (len(yaw), 1)) if near is None else near.copy()
        there = np.zeros((len(q), 1), dtype=bool)  # each alone, so that a result does not depend on the others
        for _ in range(_SEARCHING if near is None else _TRACKING):
            nearer, error = self._nearer(q, position, wanted)
            q = np.where(there, q, nearer)
            there |= error < _CLOSE
            if there.all():
                break
        return q

    def joints_down(self, x: float, y: float, z: float, yaw: float, near: Sequence[float]) -> list[float]:
        """`reach_down` of one tool position, from joints nearby."""
        joints: list[float] = self.reach_down(np.array([[x, y, z]]), np.array([yaw]), np.array([near]))[0].tolist()
        return joints

    def _nearer(self, q: Array, position: Array, wanted: Array) -> tuple[Array, Array]:
        """One iteration towards `position` (n, 3) and the axes `wanted` (n, 3, 3), and the errors before it (n, 1)."""
        frames, jacobian = self.jacobians(q)
        error = np.empty((len(q), 6))
        error[:, :3] = position - frames[:, -1, :3, 3]
        have = frames[:, -1, :3, :3]
        turn = have @ wanted.transpose(0, 2, 1)  # antisymmetric part: the sum of the cross products of the axes
        error[:, 3] = turn[:, 1, 2] - turn[:, 2, 1]
        error[:, 4] = turn[:, 2, 0] - turn[:, 0, 2]
        error[:, 5] = turn[:, 0, 1] - turn[:, 1, 0]
        error[:, 3:] *= 0.5 * TILT_LEVER
        jacobian[:, 3:] *= TILT_LEVER
        if not self.turns:  # the tilt alone: turns about the two level axes
            error, jacobian = error[:, :5], jacobian[:, :5]
        squared = np.einsum("ni,ni->n", error, error)
        homing = HOMING * (self.home - q)
        square = jacobian @ jacobian.transpose(0, 2, 1)
        diagonal = np.arange(square.shape[1])
        square[:, diagonal, diagonal] += (0.5 * squared + _DAMPING)[:, None]
        rest = error - np.einsum("nij,nj->ni", jacobian, homing)
        step = homing + np.einsum("nji,nj->ni", jacobian, np.linalg.solve(square, rest[:, :, None])[:, :, 0])
        return np.minimum(np.maximum(q + step, self.low), self.high), np.sqrt(squared)[:, None]


def _towards(axis: Array) -> Array:
    """A rotation that takes z to `axis`. Shape: (4, 4)."""
    turn = np.eye(4)
    other = np.eye(3)[np.abs(axis).argmin()]
    x = np.cross(other, axis) if abs(axis[2]) < 1.0 else np.array([1.0, 0.0, 0.0])
    x = x / np.linalg.norm(x)
    turn[:3, 0], turn[:3, 1], turn[:3, 2] = x, np.cross(axis, x), axis
    return turn


def _compiled(lines: list[str]) -> Any:
    """A function of `q` with these lines."""
    names: dict[str, Any] = {"cos": math.cos, "sin": math.sin}
    exec("\n ".join(["def function(q):", *lines]), names)
    return names["function"]


def _times(frame: list[list[float | str]], other: Array, name: str, lines: list[str]) -> list[list[float | str]]:
    """The product of two homogeneous matrices of numbers and names; what must be computed is added to `lines`."""
    product = []
    for row, left in enumerate(frame):
        product.append(list[float | str]())
        for column in range(4):
            number, terms = 0.0, []
            for one, two in zip(left, other[:, column].tolist(), strict=True):
                factors = [round(part, 15) if isinstance(part, float) else part for part in (one, two)]
                if isinstance(one, float) and isinstance(two, float):
                    number += one * two
                elif 0.0 not in factors:
                    terms.append(" * ".join(str(part) for part in factors if part != 1.0).replace("-1.0 * ", "-"))
            if number and terms:
                terms.append(repr(number))
            if (len(terms) == 1 and terms[0].isidentifier()) or not terms:
                product[-1].append(terms[0] if terms else number)
            else:
                lines.append(f"{name}{row}{column} = {' + '.join(terms)}")
                product[-1].append(f"{name}{row}{column}")
    return product


def _sum(row: Array) -> str:
    """Code of a row of a placement times x, y, z and 1."""
    terms = [f"{value!r} * {name}" for value, name in zip(row[:3].tolist(), "xyz", strict=True) if abs(value) > 1e-15]
    return " + ".join([*terms, repr(float(row[3]))])


Arm = ArmGeometry | SerialChain
"""Kinematics of an arm, in closed form or as a chain."""


def chain_of(arm: Arm) -> SerialChain:
    """The joints and the outline of `arm`, up to its flange if it is a closed form."""
    if isinstance(arm, SerialChain):
        return arm
    ahead = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    placements = np.tile(np.eye(4), (6, 1, 1))
    placements[:, :3, :3] = np.diag([-1.0, -1.0, 1.0]), ahead, np.eye(3), np.eye(3), ahead, ahead.T
    placements[1, 2, 3], placements[2, 0, 3], placements[3, 0, 3] = arm.d1, arm.a2, arm.a3
    placements[4, 2, 3], placements[5, 2, 3] = arm.d4, arm.d5
    tool, turn = np.eye(4), np.full(6, 2 * math.pi)
    tool[2, 3] = arm.d6 + arm.tool
    capsules: list[Capsule] = []
    if (shape := arm.outline) is not None:
        upper, fore = shape.upper_arm_offset, shape.forearm_offset
        rows: list[tuple[int, Any, Any, float]] = [
            (0, (0.0, 0.0, 0.0), (0.0, 0.0, arm.d1), shape.base),
            (1, (0.0, 0.0, arm.d1), (0.0, -upper, arm.d1), shape.upper_arm),
            (2, (0.0, 0.0, upper), (arm.a2, 0.0, upper), shape.upper_arm),
            (2, (arm.a2, 0.0, upper), (arm.a2, 0.0, fore), shape.forearm),
            (3, (0.0, 0.0, fore), (arm.a3, 0.0, fore), shape.forearm),
            (4, (0.0, 0.0, fore), (0.0, 0.0, arm.d4), shape.wrist),
            (5, (0.0, 0.0, 0.0), (0.0, 0.0, arm.d5), shape.wrist),
            (6, (0.0, 0.0, 0.0), (0.0, 0.0, arm.d6), shape.wrist),
        ]
        capsules = [Capsule(link=link, start=start, end=end, radius=radius) for link, start, end, radius in rows]
    axes, home = np.tile([0.0, 0.0, 1.0], (6, 1)), np.zeros(6)
    return SerialChain(placements, axes, tool, -turn, turn, home, capsules=tuple(capsules))


def arm_of(tool_position: object) -> Arm | None:
    """The arm whose ``tool_position`` this is; None for any other function."""
    owner: Any = getattr(tool_position, "__self__", None)
    known = isinstance(owner, SerialChain) or type(owner) is ArmGeometry
    return owner if known and tool_position == owner.tool_position else None
