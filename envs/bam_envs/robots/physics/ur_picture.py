"""What a simulated arm looks like: the capsules that its contacts are found with, the table, and the ball."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bam_envs.robots.physics.contacts import TABLE, Capsules
from bam_envs.robots.physics.obstacles import RADIUS
from bam_envs.robots.physics.shapes import BLUE, GREY, RED, WOOD, Shape, View

Array = NDArray[np.float64]


def view_of(reach: float) -> View:
    """From the front, so far away that an arm of `reach` [m] fits."""
    return View((0.0, 0.1 * reach, 0.35 * reach), max(1.6, 2.6 * reach), 140.0, -25.0)


def table_shape() -> Shape:
    """The table that the arm stands on."""
    x, y, z = (TABLE[1] - TABLE[0]).tolist()
    return Shape("box", TABLE.mean(axis=0), (x, y, z), WOOD)


def arm_shapes(arms: Capsules) -> list[Shape]:
    """The tubes of the first arm; those around joints are blue."""
    shapes = []
    for link, (start, end, radius) in enumerate(zip(arms.start[0], arms.end[0], arms.radius, strict=True)):
        colour = GREY if link in (2, 3) else BLUE
        shapes.append(Shape("capsule", start, (float(radius),), colour, to=end))
    return shapes


def ball_shape(position: Array) -> Shape:
    """The obstacle at `position` (3,) [m]."""
    return Shape("sphere", position, (RADIUS,), RED)
