"""Descriptions of arms: joints, limits, tool, gripper, outline and work area of one arm, as plain data in a TOML file.

Simulation, kinematics, guards and live profiles all read the same description, so that an arm is described once. Those
in the folder ``descriptions`` are shipped; ``./robots`` and this user's configuration folder hold a user's own, and
installed packages offer theirs by the entry point group ``bam_envs.robots``. No simulator is needed.
"""

import dataclasses
import hashlib
import importlib
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import metadata, resources
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.arms.serial_chain import Arm, Capsule, SerialChain
from bam_envs.core import kinematics
from bam_envs.core.config_folder import config_folder
from bam_envs.core.errors import BamEnvsError, InvalidValue, UnknownName
from bam_envs.core.kinematics import ArmGeometry
from bam_envs.core.robot import RobotSpec, SignalSpec
from bam_envs.core.validation import Finite, NonEmpty, NonNegative, NonNegativeInt, Positive, check, read_table

tomllib: Any = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

T = TypeVar("T")
Array = NDArray[np.float64]
Vector = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]
ModelName = Annotated[
    str, Meta(pattern=r"^[A-Za-z0-9][\w.-]{0,63}\Z", description="at most 64 letters, digits and . _ -")
]
ENTRY_POINTS = "bam_envs.robots"
"""Entry point group of packages with descriptions: each names a package that holds ``NAME.toml`` files."""
MOVING = ("joints", "home", "tool", "gripper", "mount", "workspace")
"""Tables that decide how an arm moves."""
DEFAULT_MODEL = "ur5e"
"""The arm of an environment without another ``robot_model``."""
_MOST_CAPSULES = 100
_MOST = 8  # differences that are listed
SHIPPED = resources.files("bam_envs.arms") / "descriptions"
"""The folder of the shipped descriptions."""


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
    axis: Vector = (0.0, 0.0, 1.0)
    """Axis in the joint's frame."""
    low: Finite
    """Lowest position [rad]."""
    high: Finite
    """Highest position [rad]."""
    velocity: Positive
    """Fastest motion [rad/s]."""
    acceleration: Positive
    """Greatest acceleration [rad/s^2]."""
    jerk: Positive
    """Greatest jerk [rad/s^3]."""
    effort: Positive
    """Greatest torque [N m]."""
    mass: Positive
    """Mass of the link [kg]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.axis):
            raise InvalidValue(f"{self.name}: axis: 0, 0, 0 is no direction.")


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A gripper with two parallel pads."""

    open: Positive
    """Width between the pads when it is open [m]."""
    speed: Positive = 0.1
    """Fastest change of the width [m/s]."""
    force: Positive = 40.0
    """Force between the pads in simulation [N]."""
    mass: Positive = 0.5
    """Mass [kg]."""
    joint: NonEmpty = "gripper_width"
    """Name of its joint in a live robot's messages."""


@dataclass(frozen=True, kw_only=True)
class ArmDescription:
    """An arm with its gripper. Positions in ``base_link``: x forward, z up, z = 0 on the table that it stands on."""

    name: ModelName
    title: NonEmpty
    """What the arm is, in a few words."""
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
    sources: Mapping[str, str] = field(default_factory=dict)
    """Where lengths, limits and masses come from."""
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
        )
        return RobotSpec(self.name, tuple(signals), command, period=0.05)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of `MOVING`, what decides how the arm moves, in hexadecimal."""
        table = dataclasses.asdict(self)
        moving = {key: table[key] for key in MOVING}
        return hashlib.sha256(repr(moving).encode()).hexdigest()

    def differences(self, other: "ArmDescription") -> Iterator[tuple[str, Any, Any]]:
        """What differs from `other` in what decides how the arm moves: name, value here, value there."""
        here, there = (dict(_leaves(dataclasses.asdict(one))) for one in (self, other))
        for name in sorted({*here, *there}):
            if name.split(".")[0] in MOVING and here.get(name) != there.get(name):
                yield name, here.get(name), there.get(name)


def cube_edge(description: ArmDescription) -> float:
    """Edge of the cube that an arm grasps: 4 cm, or less for a small gripper or one that cannot turn [m]."""
    share = 0.55 if description.chain.turns else 0.4
    return min(0.04, round(share * description.gripper.open, 3))


OBJECT_SIGNALS = [
    SignalSpec("object_position", ("object_x", "object_y", "object_z"), ("m",) * 3, (-2.0,) * 3, (2.0,) * 3),
    SignalSpec(
        "object_quaternion", ("object_qw", "object_qx", "object_qy", "object_qz"), ("1",) * 4, (-1.0,) * 4, (1.0,) * 4
    ),
]
"""Pose of a tracked object, in ``base_link``."""


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    pairs = (
        value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, (tuple, list)) else ()
    )
    if not pairs:
        yield name, value
    for key, part in pairs:
        yield from _leaves(part, f"{name}.{key}" if name else str(key))


def read_description(path: Any) -> ArmDescription:
    """The description in the TOML file `path`.

    Raises:
        InvalidValue: The file cannot be read, or a key or value does not fit; it names which.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidValue(f"The robot description {path} cannot be read: {error}.") from error
    return _in_text(text, str(path))


@lru_cache(maxsize=32)
def _in_text(text: str, where: str) -> ArmDescription:
    try:
        table = tomllib.loads(text)
    except ValueError as error:
        raise InvalidValue(f"{where} is not TOML: {error}.") from error
    return description_of(table, where)


def description_of(table: Mapping[str, Any], where: str) -> ArmDescription:
    """The description in `table`, with the tables in it; `where` begins errors."""
    kinds = {"joints": JointRow, "capsules": Capsule, "tool": Placed, "mount": Placed, "gripper": Gripper}
    read = dict(table)
    for key, kind in kinds.items():
        if key not in read:
            continue
        rows = read[key]
        if key in ("joints", "capsules"):
            rows = check(rows, list[dict[str, Any]], f"{where}: {key}")
            read[key] = tuple(_read(kind, row, f"{where}: {key}[{at}]") for at, row in enumerate(rows))
        else:
            read[key] = _read(kind, rows, f"{where}: {key}")
    return _read(ArmDescription, read, where)


def _read(kind: type[T], table: object, where: str) -> T:
    """`read_table`; also an error in what several values mean together begins with `where`."""
    try:
        return read_table(kind, table, where)
    except BamEnvsError as error:
        text = str(error)
        raise InvalidValue(text if text.startswith(where) else f"{where}: {text}") from error


def description_folders() -> Iterator[Any]:
    """The folders that are searched, in order: the project's, this user's, those of packages, the shipped one."""
    yield Path("robots")
    yield config_folder() / "robots"
    for point in metadata.entry_points(group=ENTRY_POINTS):
        yield resources.files(point.value)
    yield SHIPPED


def known_models() -> dict[str, Any]:
    """File of every description, by its name; the first folder that has a name wins."""
    known: dict[str, Any] = {}
    for folder in description_folders():
        if folder.is_dir():
            for entry in sorted(folder.iterdir(), key=lambda one: one.name):
                if entry.name.endswith(".toml"):
                    known.setdefault(entry.name.removesuffix(".toml"), entry)
    return known


def robot_model(name: "str | Mapping[str, Any] | ArmDescription") -> ArmDescription:
    """The arm called `name`, or in a file ``NAME.toml``, or in a table; a description is returned as it is.

    Raises:
        UnknownName: There is none; with the closest match.
        InvalidValue: Its file or table does not fit.
    """
    if isinstance(name, ArmDescription):
        return name
    if isinstance(name, Mapping):
        return _in_table(name)
    check(name, NonEmpty, "robot_model")
    path = Path(name)
    if path.suffix == ".toml":
        return read_description(path)
    known = known_models()
    if name not in known:
        raise UnknownName("robot model", name, known)
    return read_description(known[name])


def portable_model(name: "str | Mapping[str, Any] | ArmDescription") -> str | dict[str, Any]:
    """`name`, or the whole description in its place, for a checkpoint: any but the default one, with its digest."""
    arm = robot_model(name)
    if arm.name == DEFAULT_MODEL and name == DEFAULT_MODEL:
        return DEFAULT_MODEL
    table = dataclasses.asdict(arm)
    return {**json.loads(json.dumps(table)), "digest": arm.digest}


def _in_table(table: Mapping[str, Any]) -> ArmDescription:
    """The description in a table of a checkpoint; `InvalidValue` if it is not the one with its digest."""
    plain = {key: value for key, value in table.items() if key != "digest"}
    arm = description_of(plain, "robot_model")
    if "digest" in table and table["digest"] != arm.digest:
        raise InvalidValue(f"robot_model: the description of {arm.name} was changed: it does not have its digest.")
    return arm


def require_same_arm(table: object, name: str | None = None) -> None:
    """Refuse a description in a checkpoint if the one here is of another arm: `name`, None for the one of its name.

    Raises:
        UnknownName: There is none called `name`.
        InvalidValue: What differs, in the checkpoint and here.
    """
    if not isinstance(table, Mapping) and name is None:
        return
    there: Any = robot_model(table if isinstance(table, (Mapping, str)) else DEFAULT_MODEL)
    path: Any = known_models().get(there.name) if name is None else name
    here = there if path is None else robot_model(name) if name is not None else read_description(path)
    if here.digest == there.digest:
        return
    rows = [f"{name}: {theirs}, here {ours}" for name, theirs, ours in there.differences(here)]
    more = f", and {len(rows) - _MOST} more" if len(rows) > _MOST else ""
    if name is not None:
        raise InvalidValue(
            f"{there.name}, and {name} moves otherwise: {'; '.join(rows[:_MOST])}{more}. Give the description with "
            "which the policy was trained, or train a policy for this one."
        )
    raise InvalidValue(
        f"{there.name} is another arm here ({path}): {'; '.join(rows[:_MOST])}{more}. Give the description with which "
        "the policy was trained another name, or train a policy for this one."
    )
