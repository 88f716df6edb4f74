"""The MiR100 mobile base: its signals, limits and lasers.

Sources: MiR100 user guide and robot description (footprint 0.90 x 0.58 m, differential drive, two SICK S300 laser
scanners at opposite corners); SICK S300 data sheet (541 rays, 270 degrees, 0.05 to 29 m).
"""

import math
from dataclasses import replace

from bam_envs.core.robot import BaseBody, RobotSpec, Scanner, SignalSpec

PERIOD = 0.1
"""Time between two commands [s]."""
MAX_SPEED = (1.0, 1.5)
"""Maximum speed of the drive: forwards [m/s], turning [rad/s]."""
MAX_ACCELERATION = (2.0, 2.5)
"""Maximum acceleration of the drive: forwards [m/s^2], turning [rad/s^2]."""
FOOTPRINT = (0.90, 0.58)
"""Length and width [m]."""
FOOTPRINT_AHEAD = 0.0376
"""Distance of the middle of the footprint ahead of the base's frame [m]."""
SCAN_RAYS = 541
"""Rays of one scanner, half a degree apart."""
SCAN_SPAN = (math.radians(-135.0), math.radians(135.0))
"""Bearing of the first and of the last ray, in the scanner's frame [rad]."""
SCAN_RANGE = (0.05, 29.0)
"""Least and greatest range that is measured [m]."""
FRONT_MASKED, BACK_MASKED = (30, 10), (10, 20)
"""Number of rays that the robot's body hides at the beginning and at the end of a scan; the robot sends 0 for them."""
FRONT_RAYS = SCAN_RAYS - sum(FRONT_MASKED)
"""Unmasked rays of the front scanner: 501."""
BACK_RAYS = SCAN_RAYS - sum(BACK_MASKED)
"""Unmasked rays of the back scanner: 511."""
FRONT_MOUNT, BACK_MOUNT = (0.4288, 0.2358, math.radians(45.0)), (-0.3548, -0.2352, math.radians(-135.0))
"""Poses of the scanners in the base's frame: x, y [m], yaw [rad]."""


def _bearings(masked: tuple[int, int]) -> tuple[float, ...]:
    """The unmasked rays of a scanner, in its frame [rad]."""
    step = (SCAN_SPAN[1] - SCAN_SPAN[0]) / (SCAN_RAYS - 1)
    return tuple(SCAN_SPAN[0] + ray * step for ray in range(masked[0], SCAN_RAYS - masked[1]))


BODY = BaseBody(
    FOOTPRINT_AHEAD + FOOTPRINT[0] / 2,
    FOOTPRINT[0] / 2 - FOOTPRINT_AHEAD,
    FOOTPRINT[1] / 2,
    (
        Scanner("f_scan", FRONT_MOUNT, _bearings(FRONT_MASKED)),
        Scanner("b_scan", BACK_MOUNT, _bearings(BACK_MASKED)),
    ),
)


def _scan(name: str, rays: int) -> SignalSpec:
    labels = tuple(f"{name}_{ray}" for ray in range(rays))
    return SignalSpec(name, labels, ("m",) * rays, (0.0,) * rays, (SCAN_RANGE[1],) * rays)


_LOW, _HIGH = (-1000.0, -1000.0, -math.pi), (1000.0, 1000.0, math.pi)
_POSE = SignalSpec("base_pose", ("base_x", "base_y", "base_yaw"), ("m", "m", "rad"), _LOW, _HIGH)
_SPEEDS = ("linear_velocity", "angular_velocity")
_VELOCITY = SignalSpec("base_velocity", _SPEEDS, ("m/s", "rad/s"), (-MAX_SPEED[0], -MAX_SPEED[1]), MAX_SPEED)
COMMAND = replace(_VELOCITY, name="command", max_rate=MAX_ACCELERATION)


def base_spec(name: str = "mir100", *, with_scans: bool = True) -> RobotSpec:
    """The signals of a MiR100: pose in the map, speeds, and the ranges of its two scanners."""
    scans = (_scan("f_scan", FRONT_RAYS), _scan("b_scan", BACK_RAYS)) if with_scans else ()
    return RobotSpec(name, (_POSE, _VELOCITY, *scans), COMMAND, PERIOD, body=BODY)
