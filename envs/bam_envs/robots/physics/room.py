"""Where a simulated base drives: a rectangle of walls or none, and boxes; whether the base touches them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bam_envs.robots.mir100 import FOOTPRINT, FOOTPRINT_AHEAD

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
BOX_EDGE = 0.5
"""Edge of a box [m]."""
NOWHERE = (1000.0, 1000.0, 0.0)
"""Pose of a box that is not there: out of everybody's sight [m, m, rad]."""
_HALF = (FOOTPRINT[0] / 2, FOOTPRINT[1] / 2)


@dataclass(frozen=True)
class Room:
    """Four walls; what is inside them is free."""

    low: tuple[float, float]
    """Lowest x and y [m]."""
    high: tuple[float, float]
    """Highest x and y [m]."""


LAB = Room((-2.877, -3.836), (2.823, 3.864))
"""The inside of robo-gym's world ``lab_6x8``."""


def touches(pose: Array, room: Room | None, boxes: Array) -> Flags:
    """Whether the footprint of each base touches a wall or a box.

    Args:
        pose: Of the bases: x, y [m], yaw [rad]. Shape: (n, 3).
        room: The walls; None for none.
        boxes: Of each base: x, y [m], yaw [rad]. Shape: (n, b, 3).

    Returns:
        Shape: (n,).
    """
    yaw = pose[:, 2].copy()
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = pose[:, 0] + FOOTPRINT_AHEAD * cos, pose[:, 1] + FOOTPRINT_AHEAD * sin
    hit = np.zeros(len(pose), dtype=bool)
    if room is not None:
        hit |= _beyond(x, _HALF[0] * np.abs(cos) + _HALF[1] * np.abs(sin), room.low[0], room.high[0])
        hit |= _beyond(y, _HALF[0] * np.abs(sin) + _HALF[1] * np.abs(cos), room.low[1], room.high[1])
    for box in range(boxes.shape[1]):
        hit |= _overlaps(x, y, cos, sin, *np.ascontiguousarray(boxes[:, box].T))
    return hit


def _beyond(middle: Array, reach: Array, low: float, high: float) -> Flags:
    beyond: Flags = (middle - reach < low) | (middle + reach > high)
    return beyond


def _overlaps(x: Array, y: Array, cos: Array, sin: Array, box_x: Array, box_y: Array, box_yaw: Array) -> Flags:
    """Whether rectangle and square overlap: no side of either separates them. Shape: (n,) each."""
    box_cos, box_sin = np.cos(box_yaw), np.sin(box_yaw)
    dx, dy = box_x - x, box_y - y
    turn_cos, turn_sin = np.abs(cos * box_cos + sin * box_sin), np.abs(cos * box_sin - sin * box_cos)
    half = BOX_EDGE / 2
    reach = half * (turn_cos + turn_sin)
    apart = np.abs(dx * cos + dy * sin) > _HALF[0] + reach
    apart |= np.abs(dy * cos - dx * sin) > _HALF[1] + reach
    apart |= np.abs(dx * box_cos + dy * box_sin) > half + _HALF[0] * turn_cos + _HALF[1] * turn_sin
    apart |= np.abs(dy * box_cos - dx * box_sin) > half + _HALF[0] * turn_sin + _HALF[1] * turn_cos
    return ~apart
