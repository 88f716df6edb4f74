"""Bodies of an image that are in no MuJoCo model: boxes, capsules and spheres. The first image imports MuJoCo."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ResetNeeded
from bam_envs.core.robot import RobotState

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

    kind: Literal["box", "capsule", "sphere"]
    position: Array
    """Its middle, or the middle of a capsule's first end. Shape: (3,)."""
    size: tuple[float, ...]
    """Edges of a box, or only the radius of a capsule or sphere."""
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


class Drawn:
    """A robot simulated in NumPy that can be rendered; a subclass defines `slices`, `halt` and `picture`."""

    floor: float = 0.0  # height of the floor [m]
    mark_radius: float = 0.02  # radius of the task's marks [m]
    _renderer: Any = None
    _connected = False

    def connect(self) -> None:
        """Accept commands from now on."""
        self._connected = True

    def _require_link(self) -> None:
        if not self._connected:
            raise ResetNeeded("The simulated robot is not connected. Call reset() first.")

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """Send `command` (n, m), and yield the state after each of `parts` equal parts of the period."""
        raise NotImplementedError

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, m), in the units of the spec; one period later, measure."""
        return next(self.slices(command, 1))

    def halt(self) -> None:
        """Hold the current position."""
        raise NotImplementedError

    def close(self) -> None:
        """Halt, and close the window; commands are refused until `connect`."""
        self.halt()
        if self._renderer is not None:
            self._renderer.close()
        self._renderer, self._connected = None, False

    def picture(self) -> tuple[list[Shape], View]:
        """The shapes of environment 0, and the view of them."""
        raise NotImplementedError

    def render(self, mode: str, marks: Sequence[tuple[Array, Colour]]) -> NDArray[np.uint8] | None:
        """Show environment 0 and `marks`: an image (480, 640, 3) for ``rgb_array``, a window for ``human``."""
        from bam_envs.robots.physics.rendering import ShapeRenderer

        if self._renderer is None:
            self._renderer = ShapeRenderer(mode, self.floor)
        shapes, view = self.picture()
        image: NDArray[np.uint8] | None = self._renderer.render([*marked(marks, self.mark_radius), *shapes], view)
        return image


def turned(yaw: float) -> Array:
    """The rotation by `yaw` [rad] about the vertical. Shape: (3, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
