"""What a simulated MiR100, its room, its boxes and its laser scans look like."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bam_envs.robots.mir100 import (
    BACK_MASKED,
    BACK_MOUNT,
    FOOTPRINT,
    FOOTPRINT_AHEAD,
    FRONT_MASKED,
    FRONT_MOUNT,
    SCAN_RANGE,
    SCAN_RAYS,
    SCAN_SPAN,
)
from bam_envs.robots.physics.room import BOX_EDGE, Room
from bam_envs.robots.physics.shapes import BLUE, DARK, GREY, RED, WOOD, Colour, Shape, View, turned

Array = NDArray[np.float64]
HEIGHT = 0.352
"""Of a MiR100 [m]."""
_FLOOR_TO_BODY = 0.05
_WALL = (0.15, 0.5)  # thickness and height [m]
_LASER_HEIGHT = 0.1914
_EVERY = 6
"""One of so many rays is drawn."""
_STAYS = 2.5
"""How far the base goes before the camera goes with it [m]."""


def view_of(pose: Array, room: Room | None) -> View:
    """From above: the whole room; without one, the camera goes along once the base has gone far. `pose`: (3,)."""
    x, y = pose[:2] - np.clip(pose[:2], -_STAYS, _STAYS) if room is None else (0.0, 0.0)
    return View((round(float(x), 3), round(float(y), 3), 0.0), 11.0, 90.0, -65.0)


def base_shapes(pose: Array) -> list[Shape]:
    """The base at `pose` (3,): x, y [m], yaw [rad]; a dark bar says which end is the front."""
    return [
        _body(pose, FOOTPRINT_AHEAD, (*FOOTPRINT, HEIGHT - _FLOOR_TO_BODY), HEIGHT, BLUE),
        _body(pose, FOOTPRINT_AHEAD + FOOTPRINT[0] / 2 - 0.1, (0.08, FOOTPRINT[1] - 0.1, 0.02), HEIGHT + 0.02, DARK),
    ]


def _body(pose: Array, ahead: float, edges: tuple[float, float, float], top: float, colour: Colour) -> Shape:
    rotation = turned(float(pose[2]))
    position = np.array([pose[0], pose[1], top - edges[2] / 2]) + rotation @ [ahead, 0.0, 0.0]
    return Shape("box", position, edges, colour, rotation)


def box_shapes(boxes: Array) -> list[Shape]:
    """The boxes at `boxes` (b, 3): x, y [m], yaw [rad]."""
    edges = (BOX_EDGE, BOX_EDGE, BOX_EDGE)
    return [Shape("box", np.array([x, y, BOX_EDGE / 2]), edges, WOOD, turned(yaw)) for x, y, yaw in boxes]


def wall_shapes(room: Room | None) -> list[Shape]:
    """The four walls around `room`."""
    if room is None:
        return []
    low, high, (thick, height) = np.array(room.low), np.array(room.high), _WALL
    middle, edges = (low + high) / 2, high - low + 2 * thick
    walls = []
    for side, out in ((low, -thick / 2), (high, thick / 2)):
        x, y = side + out
        walls.append(Shape("box", np.array([x, middle[1], height / 2]), (thick, float(edges[1]), height), GREY))
        walls.append(Shape("box", np.array([middle[0], y, height / 2]), (float(edges[0]), thick, height), GREY))
    return walls


def scan_shapes(pose: Array, front: Array, back: Array) -> list[Shape]:
    """Dots where some of the rays end, of the base at `pose` (3,) whose scanners measure `front` and `back` [m]."""
    dots = []
    for mount, masked, ranges in ((FRONT_MOUNT, FRONT_MASKED, front), (BACK_MOUNT, BACK_MASKED, back)):
        bearing = np.linspace(*SCAN_SPAN, SCAN_RAYS)[masked[0] : SCAN_RAYS - masked[1]]
        for x, y in _ends(pose, mount, bearing[::_EVERY], ranges[::_EVERY]):
            dots.append(Shape("sphere", np.array([x, y, _LASER_HEIGHT]), (0.03,), RED))
    return dots


def _ends(pose: Array, mount: tuple[float, float, float], bearing: Array, ranges: Array) -> Array:
    """Where rays end that end at all [m]. Shape: (k, 2)."""
    met = ranges < SCAN_RANGE[1]
    rotation = turned(float(pose[2]))[:2, :2]
    heading = float(pose[2]) + mount[2] + bearing[met]
    ways = ranges[met, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    ends: Array = pose[:2] + rotation @ np.array(mount[:2]) + ways
    return ends
