"""Pictures of robots without a MuJoCo model: boxes, capsules and spheres on a floor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bam_envs.robots.physics.rendering import Mark, add_geom, add_marks, mujoco, open_view
from bam_envs.robots.physics.shapes import Shape, View


class ShapeRenderer:
    """Draws shapes off screen or in a window; OpenGL is started by the first picture.

    Args:
        mode: ``"rgb_array"`` or ``"human"``.
        floor: Height of the floor [m].
        mark_radius: Radius of the marks [m].
    """

    def __init__(self, mode: str, *, floor: float = 0.0, mark_radius: float = 0.02) -> None:
        scene = mujoco.MjSpec.from_file(str(Path(__file__).parent / "models" / "floor.xml"))
        scene.geom("floor").pos = [0.0, 0.0, floor]
        model = scene.compile()
        self._data = mujoco.MjData(model)
        mujoco.mj_forward(model, self._data)
        self._view, self._mark_radius = open_view(model, mode), mark_radius
        self._seen: View | None = None

    def render(self, shapes: Sequence[Shape], marks: Sequence[Mark], view: View) -> NDArray[np.uint8] | None:
        """An image (480, 640, 3), or None from a window.

        Args:
            shapes: What there is; what is beyond MuJoCo's most bodies is left out.
            marks: Spheres: position (3,) [m] and colour.
            view: From where. In a window, the mouse turns it; only a new target is followed.
        """
        self._look(view)

        def draw(scene: object) -> None:
            add_marks(scene, marks, self._mark_radius)
            for shape in shapes:
                add_shape(scene, shape)

        return self._view.show(self._data, draw)

    def _look(self, view: View) -> None:
        camera = self._view.camera
        if self._seen is None:
            camera.type = mujoco.mjtCamera.mjCAMERA_FREE
            camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
        if self._seen is None or self._seen.target != view.target:
            camera.lookat[:] = view.target
        self._seen = view

    def close(self) -> None:
        """Free the OpenGL context or close the window; doing it twice is once."""
        self._view.close()


def add_shape(scene: object, shape: Shape) -> None:
    """Append one body to an ``MjvScene``."""
    edges = np.resize(np.asarray(shape.size, np.float64), 3)
    size = edges / 2 if shape.kind == "box" else edges
    rotation = np.eye(3) if shape.rotation is None else shape.rotation
    geom = add_geom(scene, shape.kind, shape.position, size.tolist(), shape.colour, rotation.ravel())
    if shape.to is not None and geom is not None:
        ends = (np.asarray(end, np.float64) for end in (shape.position, shape.to))
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, shape.size[0], *ends)
