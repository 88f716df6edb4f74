"""Pictures of a simulated robot: off screen through EGL or OSMesa, or in a window.

MuJoCo picks its OpenGL backend when it is imported, from the variable ``MUJOCO_GL``, and without it takes one that
needs a display. Here the first backend that works is found when the first picture is asked for; ``MUJOCO_GL`` still
wins where it is set.
"""

from __future__ import annotations

import atexit
import importlib
import os
import subprocess
import sys
import threading
import warnings
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bam_envs.errors import BamEnvsError
from bam_envs.robots.simulated.physics import Physics

Array = NDArray[np.float64]
Mark = tuple[Array, tuple[float, float, float, float]]
WIDTH, HEIGHT = 640, 480
CAMERA = "front"
MARK_RADIUS = 0.02
BACKENDS = ("egl", "osmesa")
_PROBE = "import sys, importlib; importlib.import_module('mujoco.' + sys.argv[1]).GLContext(16, 16).make_current()"


class RenderingUnavailable(BamEnvsError, RuntimeError):  # noqa: N818 - reads as what happened
    """No OpenGL backend works here; the text says what to install."""


class SceneRenderer:
    """Row 0 of a `Physics`, off screen or in a window."""

    def __init__(self, physics: Physics, mode: str) -> None:
        self._physics = physics
        self._view: OffScreen | Window = OffScreen(physics) if mode == "rgb_array" else Window(physics)

    def render(self, marks: list[Mark]) -> NDArray[np.uint8] | None:
        """An image (480, 640, 3), or None from a window."""
        return self._view.show(self._physics.data_of(0), marks)

    def close(self) -> None:
        """Free the OpenGL context or close the window."""
        self._view.close()


class OffScreen:
    """Draws into memory."""

    def __init__(self, physics: Physics) -> None:
        self._model = physics.model_of(0)
        self._gl: Any = gl_context(find_backend())
        self._gl.make_current()
        self._scene = mujoco.MjvScene(self._model, maxgeom=200)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = self._model.camera(CAMERA).id
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        atexit.register(self.close)  # while OpenGL is still there

    def show(self, data: Any, marks: list[Mark]) -> NDArray[np.uint8]:
        """Draw and read back an image (480, 640, 3)."""
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, everything, self._scene)
        add_marks(self._scene, marks)
        view, image = mujoco.MjrRect(0, 0, WIDTH, HEIGHT), np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, view, self._context)
        return np.ascontiguousarray(image[::-1])  # OpenGL's first line is the lowest

    def close(self) -> None:
        """Free the context; doing it twice is once."""
        if self._gl is None:
            return
        atexit.unregister(self.close)
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        self._gl = None


class Window:
    """Draws into a window of MuJoCo's own viewer."""

    def __init__(self, physics: Physics) -> None:
        require_display()
        viewer = importlib.import_module("mujoco.viewer")
        self._model = physics.model_of(0)
        self._data = mujoco.MjData(self._model)
        before = set(threading.enumerate())
        self._viewer: Any = viewer.launch_passive(self._model, self._data, show_left_ui=False, show_right_ui=False)
        self._threads = set(threading.enumerate()) - before
        self._viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._viewer.cam.fixedcamid = self._model.camera(CAMERA).id

    def show(self, data: Any, marks: list[Mark]) -> None:
        """Bring the window up to date."""
        with self._viewer.lock():
            self._data.qpos[:], self._data.qvel[:], self._data.time = data.qpos, data.qvel, data.time
            mujoco.mj_forward(self._model, self._data)
            self._viewer.user_scn.ngeom = 0
            add_marks(self._viewer.user_scn, marks)
        self._viewer.sync()

    def close(self) -> None:
        """Close the window, and wait for the viewer's thread: a process that ends before it crashes."""
        self._viewer.close()
        for thread in self._threads:
            thread.join(timeout=5)


def require_display() -> None:
    """Try the display first: MuJoCo's viewer ends the whole process when it cannot open one."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RenderingUnavailable(
            'A window needs a display, and DISPLAY is not set. Use render_mode="rgb_array", or run under xvfb-run.'
        )
    glfw = importlib.import_module("glfw")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        opened = glfw.init()
    if not opened:
        display = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
        raise RenderingUnavailable(f'The display {display} cannot be opened. Check it, or use render_mode="rgb_array".')
    glfw.terminate()


def add_marks(scene: Any, marks: list[Mark]) -> None:
    """Append a sphere for each mark to `scene`."""
    size, upright = np.array([MARK_RADIUS, 0.0, 0.0]), np.eye(3).ravel()
    for position, colour in marks:
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, position, upright, np.array(colour, np.float32))
        scene.ngeom += 1


def gl_context(backend: str) -> Any:
    """An OpenGL context of `backend`, for images of `WIDTH` x `HEIGHT`."""
    try:
        return importlib.import_module(f"mujoco.{backend}").GLContext(WIDTH, HEIGHT)
    except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
        raise RenderingUnavailable(f"MUJOCO_GL={backend} does not work here: {error}. Unset it, or try egl.") from error


@cache
def find_backend() -> str:
    """The backend that ``MUJOCO_GL`` names, else the first that works here.

    Raises:
        RenderingUnavailable: None does; the text says what to install.
    """
    named = os.environ.get("MUJOCO_GL", "").lower().strip()
    if named == "glfw":
        require_display()
    if named in ("glfw", *BACKENDS):
        return named
    for backend in BACKENDS:
        if works(backend):
            return backend
    raise RenderingUnavailable(
        "Pictures need OpenGL without a display, and neither EGL nor OSMesa works here. "
        "Run: apt-get install libegl1 libgl1-mesa-dri (or libosmesa6), or set MUJOCO_GL."
    )


def works(backend: str) -> bool:
    """Try `backend` in a process of its own: PyOpenGL keeps the first platform that it was given."""
    environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    command = [sys.executable, "-c", _PROBE, backend]
    try:
        return subprocess.run(command, env=environment, capture_output=True, timeout=60, check=False).returncode == 0
    except subprocess.TimeoutExpired:
        return False
