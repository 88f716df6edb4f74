"""The description of a wheeled base: footprint, drive with its limits, and lasers, as plain data in a TOML file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import BaseBody, RobotSpec, Scanner, SignalSpec
from bam_envs.core.robot_models import Description, find_model
from bam_envs.core.validation import (
    Finite,
    Length,
    MetresPerS,
    MetresPerS2,
    NonEmpty,
    NonNegative,
    NonNegativeInt,
    Positive,
    RadPerS,
    RadPerS2,
)

Point = tuple[Finite, Finite]
Beams = Annotated[int, Meta(ge=2, le=4096)]
MOST_RAYS = 4096
"""Most rays of all lasers together."""
MOST_LASERS = 4
"""Most lasers of a base."""
PERIOD = 0.1
"""Time between two commands [s]."""
CLEARANCE = 0.02
"""A ray that ends nearer than this to the footprint, along itself, means that the base touches something [m]."""
_FAR = (1000.0, 1000.0, math.pi)


@dataclass(frozen=True, kw_only=True)
class Footprint:
    """What a base covers of the floor: a circle, a rectangle or a convex polygon."""

    radius: Length | None = None
    """Radius of a circle [m]."""
    length: Length | None = None
    """Length of a rectangle, along x [m]."""
    width: Length | None = None
    """Width of a rectangle [m]."""
    ahead: Finite = 0.0
    """Distance of the middle of a circle or a rectangle ahead of the base's frame [m]."""
    corners: tuple[Point, ...] = ()
    """Corners x, y of a convex polygon, one after the other [m]."""

    def __post_init__(self) -> None:
        given = [self.radius is not None, self.length is not None and self.width is not None, bool(self.corners)]
        if sum(given) != 1 or (self.length is None) != (self.width is None):
            raise InvalidValue("give either radius, or length and width, or corners.")
        if self.corners and self.ahead:
            raise InvalidValue("ahead is for a circle or a rectangle; corners say where they are.")
        if self.corners and len(self.corners) < 3:
            raise InvalidValue(
                f"corners: a footprint has at least 3 corners, and this one has {len(self.corners)}; "
                "a circle is { radius = 0.2 }."
            )
        if self.corners and not min(_turns(self.anticlockwise)) > 0.0:
            raise InvalidValue("corners: they must go round a convex polygon, one after the other.")

    @property
    def anticlockwise(self) -> tuple[Point, ...]:
        """Its corners, anticlockwise, or the middle of a circle [m]."""
        if self.radius is not None:
            return ((self.ahead, 0.0),)
        if self.length is not None and self.width is not None:
            front, back, side = self.ahead + self.length / 2, self.ahead - self.length / 2, self.width / 2
            return (front, -side), (front, side), (back, side), (back, -side)
        return self.corners if sum(_turns(self.corners)) > 0.0 else self.corners[::-1]


def _turns(corners: tuple[Point, ...]) -> list[float]:
    """Sine of the turn at each corner, times the lengths of its sides; positive to the left."""
    steps = [(x - x0, y - y0) for (x0, y0), (x, y) in zip(corners, (*corners[1:], corners[0]), strict=True)]
    return [x0 * y - y0 * x for (x0, y0), (x, y) in zip(steps, (*steps[1:], steps[0]), strict=True)]


@dataclass(frozen=True, kw_only=True)
class DriveRow:
    """How a base drives, and how fast."""

    kind: Literal["differential", "omnidirectional"] = "differential"
    speed: MetresPerS
    """Maximum speed forwards and backwards [m/s]."""
    turn: RadPerS
    """Maximum turning speed [rad/s]."""
    acceleration: MetresPerS2
    """Maximum acceleration [m/s^2]."""
    turn_acceleration: RadPerS2
    """Maximum turning acceleration [rad/s^2]."""
    sideways: MetresPerS | None = None
    """Maximum speed sideways [m/s]; None: that of an omnidirectional drive is `speed`."""

    def __post_init__(self) -> None:
        if self.sideways is not None and self.kind == "differential":
            raise InvalidValue('sideways: a differential drive does not go sideways; give kind = "omnidirectional".')


@dataclass(frozen=True, kw_only=True)
class LaserRow:
    """A laser scanner, in a plane above the floor."""

    name: NonEmpty = "laser"
    """What the numbers of its sectors are called in observations."""
    signal: NonEmpty = "scan"
    """Name of the signal of its ranges."""
    pose: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """x, y [m] and yaw [rad] in the base's frame."""
    height: Length = 0.2
    """Of its rays above the floor [m]."""
    range: tuple[NonNegative, Positive]
    """Least and greatest range that is measured [m]."""
    angles: tuple[Finite, Finite]
    """Bearing of the first and of the last ray, in the scanner's frame [rad]."""
    beams: Beams
    """Number of rays, equally far apart."""
    hidden: tuple[NonNegativeInt, NonNegativeInt] = (0, 0)
    """Number of rays that the robot's body hides at the beginning and at the end of a scan."""
    contact: Positive | None = None
    """A ray shorter than this means that the base touches something [m]; None: `CLEARANCE` from the footprint.

    None is for a scanner inside the footprint: a ray without a distance is then an obstacle there, and otherwise one at
    the scanner.
    """

    def __post_init__(self) -> None:
        if not self.range[0] < self.range[1]:
            raise InvalidValue(f"{self.name}: range: the least range must come first.")
        if not self.angles[0] < self.angles[1] <= self.angles[0] + 2 * math.pi + 1e-6:
            raise InvalidValue(f"{self.name}: angles: the last must be above the first, by at most a full turn.")
        if sum(self.hidden) >= self.beams:
            raise InvalidValue(f"{self.name}: hidden: {sum(self.hidden)} of {self.beams} rays leave none.")

    @property
    def bearings(self) -> tuple[float, ...]:
        """Direction of each ray that is not hidden, in the scanner's frame [rad]."""
        every = np.linspace(*self.angles, self.beams)
        return tuple(every[self.hidden[0] : self.beams - self.hidden[1]].tolist())

    def scanner(self, body: BaseBody) -> Scanner:
        """The laser of a base of this shape."""
        ways = [self.pose[2] + bearing for bearing in self.bearings]
        near = tuple(self.contact or CLEARANCE + _way_out(body, *self.pose[:2], way) for way in ways)
        least = near if self.contact is None else (0.0,) * len(near)
        seen = (self.pose, self.bearings, self.range, near, least, self.height, self.hidden)
        return Scanner(self.name, self.signal, *seen)


def _way_out(body: BaseBody, x: float, y: float, way: float) -> float:
    """Distance from a point to the edge of the footprint in the direction `way` [rad]; 0 from outside [m]."""
    if not body.holds(np.array(x), np.array(y)):
        return 0.0
    dx, dy = math.cos(way), math.sin(way)
    if body.radius:
        x, y = x - body.corners[0][0], y - body.corners[0][1]
        along = x * dx + y * dy
        return math.sqrt(along * along - x * x - y * y + body.radius * body.radius) - along
    outwards = [(nx * dx + ny * dy, far - nx * x - ny * y) for nx, ny, far in body.sides]
    return min(room / speed for speed, room in outwards if speed > 1e-9)


@dataclass(frozen=True, kw_only=True)
class BaseDescription(Description):
    """A wheeled base. Positions in its frame: x forward, z up, z = 0 on the floor."""

    WHAT: ClassVar[str] = "a wheeled base"
    PARTS: ClassVar[Mapping[str, type[Any]]] = {"footprint": Footprint, "drive": DriveRow, "lasers": LaserRow}
    MOVING: ClassVar[tuple[str, ...]] = ("footprint", "drive", "lasers")
    ANOTHER: ClassVar[str] = "Another base is described in a file robots/NAME.toml, such as turtlebot4.toml."

    footprint: Footprint
    drive: DriveRow
    lasers: tuple[LaserRow, ...] = ()
    height: Length = 0.3
    """Height, for pictures [m]."""

    def __post_init__(self) -> None:
        if len(self.lasers) > MOST_LASERS:
            raise InvalidValue(f"{self.name}: lasers: at most {MOST_LASERS}, found {len(self.lasers)}.")
        for key in ("name", "signal"):
            names = [getattr(laser, key) for laser in self.lasers]
            if len(set(names)) < len(names):
                raise InvalidValue(f"{self.name}: lasers: two of them have the same {key}.")
        if (rays := sum(laser.beams for laser in self.lasers)) > MOST_RAYS:
            raise InvalidValue(f"{self.name}: lasers: at most {MOST_RAYS} beams together, found {rays}.")

    @cached_property
    def body(self) -> BaseBody:
        """Its shape and its scanners."""
        bare = BaseBody(self.footprint.anticlockwise, self.footprint.radius or 0.0, ())
        return BaseBody(bare.corners, bare.radius, tuple(laser.scanner(bare) for laser in self.lasers))

    def spec(self, *, with_scans: bool = True) -> RobotSpec:
        """The signals of the base: pose in the map, speeds, and the ranges of its lasers."""
        drive, aside = self.drive, self.drive.kind == "omnidirectional"
        axes = [("linear_velocity", "m/s", drive.speed, drive.acceleration)]
        axes += [("lateral_velocity", "m/s", drive.sideways or drive.speed, drive.acceleration)] * aside
        axes += [("angular_velocity", "rad/s", drive.turn, drive.turn_acceleration)]
        names, units, fastest, change = zip(*axes, strict=True)
        velocity = SignalSpec("base_velocity", names, units, tuple(-one for one in fastest), fastest)
        command = SignalSpec("command", names, units, velocity.low, fastest, change)
        labels, low = ("base_x", "base_y", "base_yaw"), tuple(-one for one in _FAR)
        signals = [SignalSpec("base_pose", labels, ("m", "m", "rad"), low, _FAR), velocity]
        for scanner in self.body.scanners if with_scans else ():
            size = len(scanner.bearings)
            rays = tuple(f"{scanner.signal}_{ray}" for ray in range(size))
            signals.append(SignalSpec(scanner.signal, rays, ("m",) * size, (0.0,) * size, (scanner.range[1],) * size))
        return RobotSpec(self.name, tuple(signals), command, PERIOD, body=self.body)


def base_model(name: str | Mapping[str, Any] | Description) -> BaseDescription:
    """The base called `name`; see `bam_envs.core.robot_models.find_model`."""
    return find_model(name, BaseDescription)
