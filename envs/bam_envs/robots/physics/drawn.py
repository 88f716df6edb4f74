"""Simulated robots without a MuJoCo model, which are drawn as shapes. The first image imports MuJoCo."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ResetNeeded
from bam_envs.core.robot import RobotState
from bam_envs.robots.physics.shapes import Array, Colour, Shape, View, marked


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
