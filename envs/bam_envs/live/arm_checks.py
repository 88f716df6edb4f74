"""Checks of a live arm against the arm of a policy: kinematics, sense of the joints, and their limits.

The pose of the tool, as measured by the arm's own controller, is compared with the pose computed from the joints. A
difference reveals swapped and mirrored joints, other units, and another arm.

Longer than most files: the checks of an arm, and the URDF that they read.
"""

import itertools
import math
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.serial_chain import Arm, SerialChain
from bam_envs.core.errors import ProtocolError
from bam_envs.core.kinematics import UR5E_GRIPPER, UR_JOINTS, ArmGeometry, angle_between, quaternions
from bam_envs.core.robot import RobotSpec
from bam_envs.live.examination import DESCRIPTION, TOOL_POSE, Inspection
from bam_envs.live.robot_checks import FACTORS, Check
from bam_envs.robots.ur import UR_MODELS

Array = NDArray[np.float64]
OFF_AXIS, ROTATION = 0.015, 0.06
"""Tolerance of the tool's pose: distance from the flange's axis [m], and angle [rad]; calibrations are smaller."""
LONGEST_TOOL = 0.4
"""Longest tool of a robot whose policy moves the flange [m]."""
LARGEST_URDF = 8 * 2**20
"""Maximum length of a URDF [characters]."""
_STILL = 0.05  # maximum motion of a joint at rest [rad]


AXES, AXES_TURN = 0.005, 0.02
"""Tolerance of the axes of a described arm: distance [m] and angle [rad]."""
TOOL_OFF, TOOL_CENTRE = 0.02, re.compile(r"(?i).*tcp.*|tool")
"""Tolerance of the tool centre point in a URDF [m], which makers put at the tips of the fingers, and tasks between the
pads; and the names of links that are one."""
TOOL_TURN = 0.26
"""Tolerance of the directions in which a gripper points and closes [rad]."""
Axis = tuple[Array, Array]


class Pose(NamedTuple):
    """A measured pose of a tool in ``base_link``."""

    position: Array  # (3,) [m]
    quaternion: Array | None  # x, y, z, w, or None if it is not measured


class UrdfJoint(NamedTuple):
    """A joint of a robot's URDF (its description in XML)."""

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

    def pose(self, position: float) -> Array:
        """Pose of the child in the parent at `position` [rad, m]. Shape: (4, 4)."""
        moved = np.eye(4)
        if self.kind in ("revolute", "continuous"):
            moved[:3, :3] = _rotation(self.axis, position)
        elif self.kind == "prismatic":
            moved[:3, 3] = position * self.axis
        pose: Array = self.origin @ moved
        return pose


class Urdf(dict[str, UrdfJoint]):
    """The joints of a robot by name."""

    def axes(self, names: Sequence[str], positions: Sequence[float]) -> list[Axis]:
        """A point (3,) [m] and the direction (3,) of the axes of some joints at `positions` [rad].

        They are in the link that the first of them turns in.
        """
        base = self[names[0]].parent
        at, found = dict(zip(names, positions, strict=True)), []
        for name in names:
            pose = self.pose(base, self[name].child, at)
            if pose is None:  # a joint that is not named moves on the way
                return [(np.full(3, np.nan), np.full(3, np.nan))] * len(names)
            found.append((pose[0], pose[1] @ self[name].axis))
        return found

    def root(self, link: str) -> str:
        """The link at the root of the tree that has `link`."""
        parents = {joint.child: joint.parent for joint in self.values()}
        for _ in range(len(self)):
            link = parents.get(link, link)
        return link

    def pose(self, base: str, link: str, positions: Mapping[str, float]) -> tuple[Array, Array] | None:
        """Position (3,) [m] and rotation (3, 3) of `link` in `base`; None if a joint or link between them is missing.

        `positions` are those of the joints that move [rad, m].
        """
        by_child, pose = {joint.child: (name, joint) for name, joint in self.items()}, np.eye(4)
        for _ in range(len(self)):
            name, joint = by_child.get(link, ("", None))
            if link == base or joint is None or (joint.kind != "fixed" and name not in positions):
                break
            pose, link = joint.pose(positions.get(name, 0.0)) @ pose, joint.parent
        return (pose[:3, 3], pose[:3, :3]) if link == base else None


def arm_in(task: object, spec: RobotSpec) -> Arm | None:
    """The arm that `task` is made for; if it does not say, a UR5e with a gripper for joints with those names."""
    arm: Arm | None = getattr(task, "arm", None)
    return UR5E_GRIPPER if arm is None and spec.command.labels[:6] == UR_JOINTS else arm


def arm_checks(spec: RobotSpec, geometry: ArmGeometry, margin: float, inspection: Inspection) -> Iterator[Check]:
    """Lines about limits, kinematics and sense of the measured joints of an arm.

    Args:
        spec: Signals and commands of the task.
        geometry: The arm that the task is made for.
        margin: Distance that the guards keep from the end of a joint's travel [rad].
        inspection: The messages of the arm.
    """
    urdf, why = _description(inspection)
    yield from _limits(spec, margin, urdf, why)
    joints = measured_joints(inspection, spec)
    if joints is None:  # the line of the signal is refused
        return
    if urdf is not None:
        yield from _described_kinematics(geometry, joints, urdf)
    pose, why = _tool_pose(inspection)
    expected = f"as computed, within {OFF_AXIS:g} m and {math.degrees(ROTATION):.0f} degrees"
    if np.ptp(joints, axis=0).max() > _STILL:
        pose, why = None, "the arm moves"
    if pose is None:
        yield Check("tool pose", expected, why, fits=None)
        yield Check("sense of the joints", "as the arm has it", "not shown without the tool's pose", fits=None)
        return
    q = np.median(joints, axis=0)
    beside, along, turned = _gap(geometry, q, pose)
    if not _near(beside, turned):
        yield Check("tool pose", expected, _explained(geometry, q, pose), fits=False)
        return
    text = f"{beside:.3f} m, {math.degrees(turned):.1f} degrees" if pose.quaternion is not None else f"{beside:.3f} m"
    yield Check("tool pose", expected, text, fits=True)
    yield _tool_length(geometry, along)
    yield _senses(geometry, q, pose)


def described_checks(spec: RobotSpec, chain: SerialChain, margin: float, inspection: Inspection) -> Iterator[Check]:
    """Lines about a described arm by its URDF: limits, kinematics, mount and tool.

    Every two axes are compared, by their angle and their distance, because frames of the same arm differ from file to
    file. The mount is where the first two are in the frame of the profile's poses, in ``base_link`` or in the link that
    the first joint turns in; that frame has to be upright in the URDF. The tool is compared where a link is called a
    tool centre point, with the axis along which it points; and the axis along which the gripper closes is compared with
    the first joints that move behind the last one of the arm.
    """
    for line in _described(spec, chain, margin, inspection):
        yield replace(line, remedy=f"correct the robot or the description of {spec.name}")


def _described(spec: RobotSpec, chain: SerialChain, margin: float, inspection: Inspection) -> Iterator[Check]:
    urdf, why = _description(inspection)
    names = [name for name, unit in zip(spec.command.labels, spec.command.units, strict=True) if unit == "rad"]
    state = inspection.profile.state
    theirs = next((one.names for one in state if one.signal == "joint_position"), ())
    names = list(theirs) if len(theirs) == len(names) else names
    yield from _limits(spec, margin, urdf, why, (*names, *spec.command.labels[len(names) :]))
    if urdf is None:
        return
    if missing := [name for name in names if name not in urdf]:
        found = f"another arm: {', '.join(missing)} not in it"
        yield Check(f"kinematics in {DESCRIPTION}", ", ".join(names), found, fits=False)
        return
    expected = f"every two axes within {1000 * AXES:g} mm and {math.degrees(AXES_TURN):.0f} degree"
    there, frames = urdf.axes(names, chain.home.tolist()), chain.link_frames(chain.home[None])[0]
    here = [(frame[:3, 3], frame[:3, :3] @ axis) for frame, axis in zip(frames, chain.axes, strict=False)]
    wrong = [
        f"{names[one]} and {names[other]}"
        for one, other in itertools.combinations(range(len(names)), 2)
        if not np.allclose(_between(here[one], here[other]), _between(there[one], there[other]), 0.0, [AXES, AXES_TURN])
    ]
    found = f"another arm or calibration: {', '.join(wrong[:3])} are not as in its description"
    yield Check(f"kinematics in {DESCRIPTION}", expected, found if wrong else "as described", fits=not wrong)
    if wrong:
        return
    base = urdf[names[0]].parent
    frames_of_poses = [one.frame for one in state if one.signal == "object_position"]
    known = [one for one in (*frames_of_poses, "base_link", base) if urdf.pose(one, base, {}) is not None]
    frame = known[0]
    yield _mount(urdf, frame, base, names, list(zip(here, there, strict=True))[:2])
    at = dict(zip(names, chain.home.tolist(), strict=True))
    yield from _tool_centre(urdf, frame, names[-1], at, frames[-1])


def _mount(urdf: Urdf, frame: str, base: str, names: Sequence[str], axes: Sequence[tuple[Axis, Axis]]) -> Check:
    """`frame` is upright, and joints have their axes where they are here.

    `axes` has, for each of the first joints, its axis here in `frame` and there in the link `base`.
    """
    what, expected, root = f"mount in {DESCRIPTION}", f"upright, and as described in {frame}", urdf.root(frame)
    upright, placed = urdf.pose(root, frame, {}), urdf.pose(frame, base, {})
    if upright is None or placed is None:
        return Check(what, expected, f"{frame} is on something that moves", fits=None)
    tilt = math.acos(min(1.0, max(-1.0, upright[1][2, 2])))
    if tilt > AXES_TURN:
        return Check(what, expected, f"{frame} is tilted by {math.degrees(tilt):.0f} degrees in {root}", fits=False)
    position, rotation = placed
    for name, ((point, along), (place, direction)) in zip(names, axes, strict=False):
        gap, there = rotation @ place + position - point, rotation @ direction
        off, turned = float(np.linalg.norm(np.cross(gap, along))), float(np.linalg.norm(np.cross(along, there)))
        if off > AXES or turned > AXES_TURN or along @ there < 0.0:
            angle = math.degrees(math.atan2(turned, along @ there))
            found = f"another mount: the axis of {name} is {1000 * off:.0f} mm and {angle:.0f} degrees off in {frame}"
            return Check(what, expected, found, fits=False)
    return Check(what, expected, "as described", fits=True)


def _tool_centre(urdf: Urdf, frame: str, last: str, at: Mapping[str, float], tool: Array) -> Iterator[Check]:
    """A tool centre point that is fixed to the `last` joint is where `tool` (4, 4) is in `frame`, with joints `at`.

    It points as `tool` does, and a gripper on that joint closes along the x axis of `tool`.
    """
    what, expected = f"tool in {DESCRIPTION}", f"within {1000 * TOOL_OFF:g} mm of the description's"
    fixed = {name: joint for name, joint in urdf.items() if joint.kind == "fixed"}
    carried, gaps = {urdf[last].child}, list[tuple[float, float, str]]()
    for _ in range(len(fixed)):
        carried |= {joint.child for joint in fixed.values() if joint.parent in carried}
    for link in sorted(carried):
        pose = urdf.pose(frame, link, at) if TOOL_CENTRE.fullmatch(link) else None
        if pose is not None:
            gaps.append((float(np.linalg.norm(pose[0] - tool[:3, 3])), _turn(pose[1][:, 2], tool[:3, 2]), link))
    if gaps:
        gap, turn, link = min(gaps)
        found, fits = f"{link} is {1000 * gap:.0f} mm from it", gap <= TOOL_OFF and turn <= TOOL_TURN
        found += f", and points {math.degrees(turn):.0f} degrees elsewhere" if turn > TOOL_TURN else ""
        yield Check(what, expected, found if fits else f"another tool: {found}", fits=fits)
    else:
        yield Check(what, expected, "no link is called tool or *tcp*", fits=None)
    turns = [min(turn, math.pi - turn) for turn in _closing(urdf, frame, carried, at, tool)]
    if turns:
        found, fits = f"{math.degrees(min(turns)):.0f} degrees off", min(turns) <= TOOL_TURN
        found += "" if fits else ": the gripper is turned on the flange; turn it, or tool.quat of the description"
        yield Check(f"fingers in {DESCRIPTION}", "close along x of the description's tool", found, fits=fits)


def _closing(urdf: Urdf, frame: str, carried: Container[str], at: Mapping[str, float], tool: Array) -> Iterator[float]:
    """Angle of x of `tool` to the way in which each finger on the links `carried` moves [rad]."""
    for joint in urdf.values():
        pose = urdf.pose(frame, joint.parent, at) if joint.kind != "fixed" and joint.parent in carried else None
        if pose is not None:
            axis = pose[1] @ joint.origin[:3, :3] @ joint.axis
            way = axis if joint.kind == "prismatic" else np.cross(axis, tool[:3, 2])
            if np.linalg.norm(np.cross(way, tool[:3, 2])) > 0.5:  # else the gripper turns, or grows
                yield _turn(way, tool[:3, 0])


def _turn(one: Array, other: Array) -> float:
    """Angle of two vectors [rad]."""
    return math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other))


def measured_joints(inspection: Inspection, spec: RobotSpec) -> Array | None:
    """The measured joints (k, 6) [rad], or None if they are outside their range or unreadable."""
    signal = next(signal for signal in spec.signals if signal.name == "joint_position")
    reading = inspection.readings["joint_position"]
    inside = (reading.values >= np.array(signal.low)).all() and (reading.values <= np.array(signal.high)).all()
    return reading.values if len(reading.values) and not reading.error and inside else None


def _between(one: Axis, other: Axis) -> tuple[float, float]:
    """Distance [m] and angle [rad] of two axes."""
    gap, normal = other[0] - one[0], np.cross(one[1], other[1])
    sine, cosine = float(np.linalg.norm(normal)), float(one[1] @ other[1])
    parallel = sine < 0.05
    distance = np.linalg.norm(np.cross(gap, one[1])) if parallel else abs(gap @ normal) / sine
    return float(distance), math.atan2(sine, cosine)


def _tool_pose(inspection: Inspection) -> tuple[Pose | None, str]:
    """The measured pose of the tool; or None, and why it is not known."""
    found: dict[str, Array] = {}
    for name in TOOL_POSE:
        reading = inspection.readings.get(name)
        if reading is not None and reading.error:
            return None, reading.error.removesuffix(".")
        if reading is not None and reading.count:
            found[name] = np.median(reading.values, axis=0)
    if "tool_position" not in found:
        return None, "the robot does not report the pose of its tool"
    quaternion = found.get("tool_quaternion")
    if quaternion is None or not 0.9 < np.linalg.norm(quaternion) < 1.1:
        return Pose(found["tool_position"], None), ""
    return Pose(found["tool_position"], np.roll(quaternion, -1) / np.linalg.norm(quaternion)), ""  # w comes last


def _gap(geometry: ArmGeometry, q: Array, pose: Pose) -> tuple[float, float, float]:
    """Measured pose minus the flange computed from joints `q` (6,): off its axis [m], along it [m], rotation [rad]."""
    flange, axes = geometry.flange_pose(q[None])
    x, y, along = axes[0].T @ (pose.position - flange[0])
    turned = 0.0 if pose.quaternion is None else float(angle_between(quaternions(axes), pose.quaternion[None])[0])
    return math.hypot(x, y), float(along), turned


def _near(beside: float, turned: float) -> bool:
    return beside <= OFF_AXIS and turned <= ROTATION


def _fits(geometry: ArmGeometry, q: Array, pose: Pose) -> bool:
    beside, along, turned = _gap(geometry, q, pose)
    return _near(beside, turned) and -OFF_AXIS <= along <= LONGEST_TOOL


def _tool_length(geometry: ArmGeometry, along: float) -> Check:
    """The tool has the length of the policy's tool, or 0 if the robot reports the pose of its flange."""
    if geometry.tool == 0.0:
        fits, expected = -OFF_AXIS <= along <= LONGEST_TOOL, f"0 to {LONGEST_TOOL:g} m before the flange"
    else:
        fits = min(abs(along - geometry.tool), abs(along)) <= OFF_AXIS
        expected = f"{geometry.tool:g} m, or 0 for the flange"
    hint = (
        f": if its gripper is that of the policy, set the tool centre point (TCP) to {geometry.tool:g} m; for another "
    )
    hint += "gripper, train a policy with its length"
    return Check("tool length", expected, f"{along:.3f} m{'' if fits else hint}", fits=fits)


def _senses(geometry: ArmGeometry, q: Array, pose: Pose) -> Check:
    """The sense of a joint is shown if the opposite angle would put the tool at another pose."""
    hidden = [name for i, name in enumerate(UR_JOINTS) if _fits(geometry, np.where(np.arange(6) == i, -q, q), pose)]
    found = (
        "shown by the tool's pose"
        if not hidden
        else f"not shown at 0 or 180 degrees: {', '.join(hidden)}; move it a little and try again"
    )
    return Check("sense of the joints", "as the arm has it", found, fits=None if hidden else True)


def _explained(geometry: ArmGeometry, q: Array, pose: Pose) -> str:
    """Describe a pose that does not fit, by the common mistake that explains it or by its distance."""
    for text, arm, joints, measured in _common_mistakes(geometry, q, pose):
        if _fits(arm, joints, measured):
            return text
    beside, along, turned = _gap(geometry, q, pose)
    return f"{math.hypot(beside, along - geometry.tool):.3f} m and {math.degrees(turned):.0f} degrees away"


def _common_mistakes(geometry: ArmGeometry, q: Array, pose: Pose) -> Iterator[tuple[str, ArmGeometry, Array, Pose]]:
    """Text of each mistake, and arm, joints and pose without it."""
    for i, name in enumerate(UR_JOINTS):
        yield f"{name} has the opposite sign", geometry, np.where(np.arange(6) == i, -q, q), pose
    for i, j in itertools.combinations(range(6), 2):
        swapped = q.copy()
        swapped[[i, j]] = q[[j, i]]
        yield f"{UR_JOINTS[i]} and {UR_JOINTS[j]} are swapped", geometry, swapped, pose
    yield "the joints are in degrees", geometry, np.radians(q), pose
    for unit, factor in FACTORS["m"].items():
        yield f"the tool's position is in {unit}", geometry, q, Pose(pose.position / factor, pose.quaternion)
    for name, model in UR_MODELS.items():
        yield f"the kinematics of a {name}", model.geometry, q, pose
    half_turn = Pose(pose.position * (-1, -1, 1), None)
    yield "the tool's pose is turned by 180 degrees about z: base instead of base_link", geometry, q, half_turn


def _description(inspection: Inspection) -> tuple[Urdf | None, str]:
    """The robot's URDF; or None, and why it is not known."""
    letters = inspection.letters.get(DESCRIPTION, ())
    if not letters:
        return None, f"nobody publishes {DESCRIPTION}"
    message: Any = letters[-1].message
    try:
        return read_urdf(message.get("data") if isinstance(message, dict) else None), ""
    except ProtocolError as error:
        return None, str(error)


def _limits(spec: RobotSpec, margin: float, urdf: Urdf | None, why: str, names: Sequence[str] = ()) -> Iterator[Check]:
    """The range of each joint in the URDF includes the range that the guards allow; `names` are those of the URDF."""
    command = spec.command
    rows = enumerate(names or command.labels)
    joints = [(i, urdf[name]) for i, name in rows if urdf is not None and name in urdf]
    if not joints:
        yield Check("joint limits", "as in the profile", why or f"{DESCRIPTION} has none of the joints", fits=None)
    for i, joint in joints:
        low, high = command.low[i], command.high[i]
        enough = joint.low <= low + margin + 1e-6 and joint.high >= high - margin - 1e-6
        sane = joint.kind == "continuous" or joint.high - joint.low < 10 * (high - low)
        kinds = ("revolute", "continuous") if command.units[i] == "rad" else ("prismatic",)
        what, expected = f"limits of {command.labels[i]}", f"{low:.4g} to {high:.4g} {command.units[i]}"
        found = f"{joint.low:.4g} to {joint.high:.4g}" if joint.kind in kinds else f"a {joint.kind} joint"
        hint = "" if sane else " (degrees?)" if command.units[i] == "rad" else " (millimetres?)"
        yield Check(what, expected, found + hint, fits=joint.kind in kinds and enough and sane)


def _described_kinematics(geometry: ArmGeometry, joints: Array, urdf: Urdf) -> Iterator[Check]:
    """The URDF puts the flange where the task's arm has it at the measured joints."""
    q = joints[-1]
    described = urdf.pose("base_link", "tool0", dict(zip(UR_JOINTS, q, strict=True)))
    if described is None:
        return
    pose = Pose(described[0], quaternions(described[1][None])[0])
    beside, along, turned = _gap(geometry, q, pose)
    fits = _near(beside, turned) and abs(along) <= OFF_AXIS
    found = f"{math.hypot(beside, along):.3f} m" if fits else _explained_model(geometry, q, pose)
    yield Check(f"kinematics in {DESCRIPTION}", f"flange within {OFF_AXIS:g} m", found, fits=fits)
    if fits:
        yield _mount(urdf, "base_link", "base_link", (), ())  # its axes were compared with the flange
        at, tool, (position, axes) = (
            dict(zip(UR_JOINTS, q.tolist(), strict=True)),
            np.eye(4),
            geometry.tool_pose(q[None]),
        )
        tool[:3, :3], tool[:3, 3] = axes[0], position[0]
        lines = _tool_centre(urdf, "base_link", UR_JOINTS[-1], at, tool) if geometry.tool else ()
        yield from (line for line in lines if line.fits is not None)  # the tool's pose shows it better


def _explained_model(geometry: ArmGeometry, q: Array, pose: Pose) -> str:
    names: Sequence[str] = [
        name
        for name, model in UR_MODELS.items()
        if (gap := _gap(model.geometry, q, pose)) and _near(gap[0], gap[2]) and abs(gap[1]) <= OFF_AXIS
    ]
    beside, along, _ = _gap(geometry, q, pose)
    return f"those of a {names[0]}" if names else f"{math.hypot(beside, along):.3f} m away"


def read_urdf(text: object) -> Urdf:
    """The joints in the text of a URDF.

    Raises:
        ProtocolError: The text is not a URDF.
    """
    if not isinstance(text, str) or len(text) > LARGEST_URDF or "<!" in text.replace("<!--", ""):  # declared entities
        raise ProtocolError("the robot's description is no URDF")
    try:
        root = ElementTree.fromstring(text)  # without entity declarations nothing is expanded
        return Urdf({str(element.get("name")): _joint(element) for element in root.findall("joint")})
    except (ElementTree.ParseError, ValueError, AttributeError) as error:
        raise ProtocolError(f"the robot's description is no URDF: {error}") from error


def _joint(element: Any) -> UrdfJoint:
    kind, limit, low, high = str(element.get("type")), element.find("limit"), -math.inf, math.inf
    if limit is not None and kind != "continuous":
        low, high = float(limit.get("lower", 0.0)), float(limit.get("upper", 0.0))
    parent, child = (element.find(end).get("link") for end in ("parent", "child"))
    place, axis, origin = element.find("origin"), _vector(element.find("axis"), "xyz", "1 0 0"), np.eye(4)
    roll, pitch, yaw = (_rotation(about, angle) for about, angle in zip(np.eye(3), _vector(place, "rpy"), strict=True))
    origin[:3, :3], origin[:3, 3] = yaw @ pitch @ roll, _vector(place, "xyz")
    return UrdfJoint(kind, parent, child, low, high, origin, axis / max(float(np.linalg.norm(axis)), 1e-9))


def _vector(element: Any, name: str, default: str = "0 0 0") -> Array:
    values = np.array([float(text) for text in (default if element is None else element.get(name, default)).split()])
    if values.shape != (3,):
        raise ValueError(f"{name} has {len(values)} numbers instead of 3")
    return values


def _rotation(axis: Array, angle: float) -> Array:
    """Rodrigues' formula: 1 + sin(a) K + (1 - cos(a)) K^2, where K x = axis x x. Shape: (3, 3)."""
    cross = np.cross(np.eye(3), axis)
    turned: Array = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    return turned
