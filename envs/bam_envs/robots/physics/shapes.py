"""Bodies of an image that are in no MuJoCo model: boxes, capsules and the like. The first image imports MuJoCo."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Colour = tuple[float, float, float, float]
"""Red, green, blue and alpha, each from 0 to 1."""
GREY: Colour = (0.80, 0.82, 0.85, 1.0)
BLUE: Colour = (0.25, 0.45, 0.68, 1.0)
DARK: Colour = (0.18, 0.19, 0.21, 1.0)
WOOD: Colour = (0.86, 0.82, 0.76, 1.0)
RED: Colour = (0.85, 0.30, 0.25, 1.0)


@dataclass(frozen=True)
class Shape:
    """One body of an image, in the world's frame [m]."""

    kind: Literal["box", "capsule", "cylinder", "sphere"]
    position: Array
    """Its middle, or the middle of a capsule's first end. Shape: (3,)."""
    size: tuple[float, ...]
    """Edges of a box, radius and half the height of an upright cylinder, or only the radius of a capsule or sphere."""
    colour: Colour = GREY
    rotation: Array | None = None
    """From a box's frame to the world's; None for upright. Shape: (3, 3)."""
    to: Array | None = None
    """The other end of a capsule. Shape: (3,)."""


@dataclass(frozen=True)
class View:
    """The view of an image: MuJoCo's free camera."""

    target: tuple[float, float, float]  # point in the middle [m]
    distance: float  # of the camera [m]
    azimuth: float  # direction of view, seen from above: 0 along x, 90 along y [deg]
    elevation: float  # -90 looks straight down [deg]


def marked(marks: Sequence[tuple[Array, Colour]], radius: float = 0.02) -> list[Shape]:
    """The spheres of a task's `marks`, of `radius` [m]."""
    return [Shape("sphere", position, (radius,), colour) for position, colour in marks]


def turned(yaw: float) -> Array:
    """The rotation by `yaw` [rad] about the vertical. Shape: (3, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
