"""The Robot protocol: commands in, states out, n robots stepped together (n == 1 for a live one)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue

Array = NDArray[np.float64]
EnvIds = NDArray[np.int64]
"""Indices of some of the n environments that are stepped together. Shape: (k,)."""
FARTHEST = 4.0
"""Greatest distance in a depth image [m]; what is farther away, or nothing, counts as that far."""
SEGMENTS = ("nothing", "table", "arm", "gripper", "object")
"""Meaning of the ids in a segmentation."""


@dataclass(frozen=True)
class SignalSpec:
    """One named signal: names, units and limits of its numbers."""

    name: str
    """Key in `RobotState.signals`, or ``"command"``."""
    labels: tuple[str, ...]
    """Name of each number."""
    units: tuple[str, ...]
    """Unit of each number: rad, rad/s, m, or 1 for none."""
    low: tuple[float, ...]
    """Lowest value of each number."""
    high: tuple[float, ...]
    """Highest value of each number."""
    max_rate: tuple[float, ...] | None = None
    """Fastest change of each number [unit/s]; None for a measured signal."""
    max_acceleration: tuple[float, ...] | None = None
    """Greatest acceleration of each number of an arm's command [unit/s^2]; None if it is not known."""
    max_jerk: tuple[float, ...] | None = None
    """Greatest jerk of each number of an arm's command [unit/s^3]; None if it is not known."""

    def part(self, labels: tuple[str, ...]) -> SignalSpec:
        """The numbers called `labels`, in that order; the signal must have all of them."""
        places = [self.labels.index(label) for label in labels]
        rows = ((key, value) for key, value in vars(self).items() if isinstance(value, tuple))
        picked: dict[str, Any] = {key: tuple(value[one] for one in places) for key, value in rows}
        return replace(self, **picked)


@dataclass(frozen=True)
class Scanner:
    """A laser scanner of a base, in a plane above the floor."""

    name: str
    """What it is called in labels."""
    signal: str
    """Name of the signal of its ranges [m]."""
    pose: tuple[float, float, float]
    """x, y [m] and yaw [rad] in the base's frame."""
    bearings: tuple[float, ...]
    """Direction of each ray in the scanner's frame [rad]."""
    range: tuple[float, float]
    """Least and greatest range that is measured [m]."""
    contact: tuple[float, ...]
    """Range of each ray below which the base touches, or nearly touches, what the ray meets [m]."""
    least: tuple[float, ...]
    """Range as which a shorter range of each ray, or one that is not measured, counts for the guards [m]."""
    height: float
    """Of its rays above the floor [m]."""
    hidden: tuple[int, int] = (0, 0)
    """Number of rays that the robot's body hides, before the first of `bearings` and behind the last."""


@dataclass(frozen=True)
class BaseBody:
    """Shape of a base in its own frame, a convex polygon or a circle, and its scanners."""

    corners: tuple[tuple[float, float], ...]
    """Corners of the polygon, anticlockwise; or the middle of the circle alone [m]."""
    radius: float
    """Radius of the circle [m]; 0 for a polygon."""
    scanners: tuple[Scanner, ...]

    def reach(self, x: float, y: float) -> float:
        """How far the base extends from its frame in a direction, a unit vector [m]."""
        return max(corner_x * x + corner_y * y for corner_x, corner_y in self.corners) + self.radius

    @cached_property
    def front(self) -> float:
        """Distance of its front ahead of its frame [m]."""
        return self.reach(1.0, 0.0)

    @cached_property
    def back(self) -> float:
        """Distance of its back behind its frame [m]."""
        return self.reach(-1.0, 0.0)

    @cached_property
    def side(self) -> float:
        """Distance of its farther side from its frame [m]."""
        return max(self.reach(0.0, 1.0), self.reach(0.0, -1.0))

    @cached_property
    def size(self) -> float:
        """Distance of its farthest point from its frame [m]."""
        return max(math.hypot(x, y) for x, y in self.corners) + self.radius

    @cached_property
    def edge(self) -> tuple[tuple[float, float], ...]:
        """Corners to draw it with: of a circle those of a polygon with 32 of them, anticlockwise [m]."""
        if not self.radius:
            return self.corners
        ((x, y),), turns = self.corners, (math.tau * at / 32 for at in range(32))
        return tuple((x + self.radius * math.cos(turn), y + self.radius * math.sin(turn)) for turn in turns)

    @cached_property
    def sides(self) -> tuple[tuple[float, float, float], ...]:
        """Outward unit vector x, y of each side of the polygon, and how far the side is from the frame [m]."""
        pairs = zip(self.corners, (*self.corners[1:], self.corners[0]), strict=True)
        normals = [(y - y0, x0 - x, math.dist((x, y), (x0, y0))) for (x0, y0), (x, y) in pairs]
        return tuple((dx / far, dy / far, self.reach(dx / far, dy / far)) for dx, dy, far in normals if far)

    def holds(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Whether points in the base's frame [m] are inside it. Shapes: any, the same."""
        if self.radius:
            ((middle_x, middle_y),) = self.corners
            inside: NDArray[np.bool_] = np.hypot(x - middle_x, y - middle_y) <= self.radius
            return inside
        inside = np.ones(np.shape(x), bool)
        for dx, dy, far in self.sides:  # those of a rectangle are along x and y, which is quicker
            inside &= (x * dx + y * dy if dx and dy else x * dx if dx else y * dy) <= far
        return inside


@dataclass(frozen=True)
class CameraSpec:
    """One camera."""

    name: str
    """Name of the camera, and of its colour images, uint8 (height, width, 3) RGB, among the signals of a state."""
    width: int = 64
    """Width of its images [pixels]."""
    height: int = 64
    """Height of its images [pixels]."""
    depth: bool = False
    """Whether ``<name>_depth`` is a signal too: float32 (height, width, 1), distance from the camera's plane [m]."""
    segmentation: bool = False
    """Whether ``<name>_segmentation`` is a signal too: uint8 (height, width, 1), indices of `SEGMENTS`."""

    def spaces(self) -> dict[str, spaces.Box]:
        """Spaces of its images, by signal."""
        size = (self.height, self.width)
        images = {self.name: spaces.Box(0, 255, (*size, 3), np.uint8)}
        if self.depth:
            images[f"{self.name}_depth"] = spaces.Box(0.0, FARTHEST, (*size, 1), np.float32)
        if self.segmentation:
            images[f"{self.name}_segmentation"] = spaces.Box(0, len(SEGMENTS) - 1, (*size, 1), np.uint8)
        return images


@dataclass(frozen=True)
class RobotSpec:
    """The description of a robot, known before it is connected."""

    name: str
    signals: tuple[SignalSpec, ...]
    """The measured signals."""
    command: SignalSpec
    """The command."""
    period: float
    """Time between two commands [s]."""
    lag: float = field(default=0.0, compare=False)
    """Delay of a steadily moving joint behind its commands, at the end of a period [s]."""
    body: BaseBody | None = field(default=None, compare=False)
    """Shape and laser scanners of a base, if they are known."""
    cameras: tuple[CameraSpec, ...] = ()
    """Its cameras, whose images are signals without labels."""
    is_timed: bool = field(default=True, compare=False)
    """Whether a joint takes a period to reach a command; otherwise it goes there at once, as fast as it can."""

    def describe(self) -> dict[str, list[dict[str, Any]]]:
        """Labels, units and limits of state and command, as plain values."""
        state = [row for signal in self.signals for row in describe_signal(signal)]
        return {"state": state, "command": describe_signal(self.command)}


def describe_signal(signal: SignalSpec) -> list[dict[str, Any]]:
    """One row of plain values for each number of `signal`."""
    rows = zip(signal.labels, signal.units, signal.low, signal.high, strict=True)
    return [{"name": label, "unit": unit, "low": low, "high": high} for label, unit, low, high in rows]


@dataclass
class RobotState:
    """The measurements of n robots at one time."""

    signals: dict[str, NDArray[Any]]
    """Each signal in the order of its labels, (n, k), and the images of cameras, (n, height, width, channels)."""
    stamp: Array
    """Time of the measurement [s]: the robot's monotonic clock, or simulated time. Shape: (n,)."""
    command: Array
    """The command that was actually sent before the measurement. Shape: (n, m)."""
    truth: dict[str, Array] = field(default_factory=dict)
    """Quantities that only a simulation knows, such as contacts; {} of a live robot. Shape: (n, ...) each."""


@dataclass(frozen=True)
class Initial:
    """The start of an episode in k environments.

    A simulated robot is set to it; a live one goes to ``signals["joint_position"]`` slowly, and its object stays in
    place.
    """

    signals: Mapping[str, Array]
    """Start values of signals. Shape: (k, ...)."""
    seeds: NDArray[np.int64]
    """Seeds of the robots' own random numbers (noise, masses), one for each environment. Shape: (k,)."""


def checked_command(command: Array, shape: tuple[int, int]) -> Array:
    """A copy of `command`, which must have `shape` and be finite, as for every robot.

    Raises:
        InvalidValue: It has another shape, or is not finite.
    """
    array = np.array(command, dtype=np.float64)
    if array.shape != shape:
        raise InvalidValue(f"The command must have shape {shape}, not {array.shape}.")
    finite = np.isfinite(array)
    if not finite.all():
        env_ids = np.flatnonzero(~finite.all(axis=1)).tolist()
        raise InvalidValue(f"The command must be finite numbers; those of environments {env_ids} are not.")
    return array


@runtime_checkable
class Robot(Protocol):
    """n robots stepped together. The constructor does no I/O; `spec` is known before `connect`."""

    @property
    def spec(self) -> RobotSpec:
        """The description of the robot."""

    @property
    def num_robots(self) -> int:
        """Number of robots that are stepped together."""

    def connect(self) -> None:
        """Make the robot ready for `reset`. Moves nothing; idempotent."""

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Bring these environments to `initial` and return the state of all of them."""

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, m), SI units, and return the state one period later."""

    def halt(self) -> None:
        """Stop moving and keep the link. Thread-safe; idempotent; never raises."""

    def close(self) -> None:
        """Halt, then drop the link. Idempotent."""
