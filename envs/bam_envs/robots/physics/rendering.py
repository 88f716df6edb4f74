"""Images of simulated robots: off screen through EGL or OSMesa, or in a window; of a MuJoCo model, or of shapes.

MuJoCo chooses its OpenGL backend on import, from the variable ``MUJOCO_GL``; its default needs a display. This module
instead uses the first backend that works, found when the first image is drawn; ``MUJOCO_GL`` takes precedence if it is
set.
"""

from __future__ import annotations

import atexit
import importlib
import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import BamEnvsError
from bam_envs.robots.physics.mujoco_batch import MODELS, mujoco
from bam_envs.robots.physics.shapes import Shape, View

WIDTH, HEIGHT = 640, 480
MOST_GEOMS = 1000
BACKENDS = ("egl", "osmesa")
_PROBE = "import sys, importlib; importlib.import_module('mujoco.' + sys.argv[1]).GLContext(16, 16).make_current()"


class RenderingUnavailable(BamEnvsError, RuntimeError):  # noqa: N818 - named for the cause
    """No OpenGL backend works; the text names the package to install."""


class OffScreen:
    """Draws into memory."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._gl: Any = gl_context(find_backend(), WIDTH, HEIGHT)
        self._scene = mujoco.MjvScene(model, maxgeom=MOST_GEOMS)
        self._option = mujoco.MjvOption()
        self.camera: Any = mujoco.MjvCamera()  # to be set
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        atexit.register(self.close)  # while OpenGL is still there

    def show(self, data: Any, shapes: Sequence[Shape]) -> NDArray[np.uint8]:
        """Draw the model in the state `data`, and `shapes`; returns an image (480, 640, 3)."""
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self.camera, everything, self._scene)
        _add_shapes(self._scene, shapes)
        view, image = mujoco.MjrRect(0, 0, WIDTH, HEIGHT), np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, view, self._context)
        return np.ascontiguousarray(image[::-1])  # OpenGL's first line is the lowest

    def close(self) -> None:
        """Free the context; idempotent."""
        if self._gl is None:
            return
        atexit.unregister(self.close)
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        self._gl = None


class FastCamera:
    """Small images of models that differ in shapes, poses and colours only, in the thread that makes it.

    It leaves out what makes small images slow without a GPU: several samples a pixel, shadows, reflections and the sky.
    Geoms of `hidden` groups are not drawn.
    """

    _OFF = ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_SKYBOX", "mjRND_HAZE", "mjRND_FOG")

    def __init__(self, model: Any, width: int, height: int, hidden: Sequence[int] = ()) -> None:
        self._gl: Any = gl_context(find_backend(), width, height)
        quality, screen = model.vis.quality, model.vis.global_
        before = quality.offsamples, screen.offwidth, screen.offheight
        quality.offsamples, screen.offwidth, screen.offheight = 0, width, height
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        quality.offsamples, screen.offwidth, screen.offheight = before
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self.scene: Any = mujoco.MjvScene(model, maxgeom=100)
        """What the last `look` saw."""
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._option.geomgroup[list(hidden)] = 0
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view = mujoco.MjrRect(0, 0, width, height)
        self._pixels, self._buffer = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)

    def look(self, model: Any, data: Any, camera: str) -> NDArray[np.uint8]:
        """The colours that a camera sees. Shape: (height, width, 3)."""
        self._gl.make_current()
        self._camera.fixedcamid = model.camera(camera).id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, everything, self.scene)
        for flag in self._OFF:
            self.scene.flags[getattr(mujoco.mjtRndFlag, flag)] = 0
        return self.draw()

    def draw(self) -> NDArray[np.uint8]:
        """Draw the scene again; a view of the pixels, which the next picture overwrites."""
        mujoco.mjr_render(self._view, self.scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._view, self._context)
        return self._pixels[::-1]  # OpenGL's first line is the lowest

    def depth(self, model: Any) -> NDArray[np.float32]:
        """Distances of the last picture from the camera's plane [m]. Shape: (height, width)."""
        mujoco.mjr_readPixels(None, self._buffer, self._view, self._context)
        # 1 in the buffer is the near clipping plane, 0 the far one.
        near, far = model.vis.map.znear * model.stat.extent, model.vis.map.zfar * model.stat.extent
        metres: NDArray[np.float32] = near * far / (near + self._buffer[::-1] * np.float32(far - near))
        return metres

    def close(self) -> None:
        """Free the context."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()


class Window:
    """Draws into a window of MuJoCo's viewer."""

    def __init__(self, model: Any) -> None:
        require_display()
        viewer = importlib.import_module("mujoco.viewer")
        self._model, self._data = model, mujoco.MjData(model)
        before = set(threading.enumerate())
        self._viewer: Any = viewer.launch_passive(model, self._data, show_left_ui=False, show_right_ui=False)
        self._threads = set(threading.enumerate()) - before
        self.camera: Any = self._viewer.cam  # the mouse moves it too

    def show(self, data: Any, shapes: Sequence[Shape]) -> None:
        """Update the window."""
        with self._viewer.lock():
            self._data.qpos[:], self._data.qvel[:], self._data.time = data.qpos, data.qvel, data.time
            mujoco.mj_forward(self._model, self._data)
            self._viewer.user_scn.ngeom = 0
            _add_shapes(self._viewer.user_scn, shapes)
        self._viewer.sync()

    def close(self) -> None:
        """Close the window, and wait for the viewer's thread: a process that ends before it crashes."""
        self._viewer.close()
        for thread in self._threads:
            thread.join(timeout=5)


def gl_context(backend: str, width: int, height: int) -> Any:
    """A new OpenGL context of `find_backend`, current in this thread; `RenderingUnavailable` if there is none."""
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
    except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
        raise RenderingUnavailable(f"MUJOCO_GL={backend} does not work here: {error}. Unset it, or try egl.") from error
    context.make_current()
    return context


def open_view(model: Any, mode: str, camera: str | None = None) -> OffScreen | Window:
    """A view of a model for ``rgb_array`` or ``human``, through one of its cameras or a free one."""
    view = OffScreen(model) if mode == "rgb_array" else Window(model)
    if camera is not None:
        view.camera.type, view.camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
    return view


class ShapeRenderer:
    """Draws shapes on a floor at the height `floor` [m], for ``rgb_array`` or ``human``."""

    def __init__(self, mode: str, floor: float = 0.0) -> None:
        scene = mujoco.MjSpec.from_file(str(MODELS / "floor.xml"))
        scene.geom("floor").pos = [0.0, 0.0, floor]
        model = scene.compile()
        self._data = mujoco.MjData(model)
        mujoco.mj_forward(model, self._data)
        self._view = open_view(model, mode)
        self._seen: View | None = None

    def render(self, shapes: Sequence[Shape], view: View) -> NDArray[np.uint8] | None:
        """An image (480, 640, 3), or None from a window, which the mouse turns: only a new target is followed there.

        Shapes beyond MuJoCo's most bodies are left out.
        """
        camera = self._view.camera
        if self._seen is None:
            camera.type = mujoco.mjtCamera.mjCAMERA_FREE
            camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
        if self._seen is None or self._seen.target != view.target:
            camera.lookat[:] = view.target
        self._seen = view
        return self._view.show(self._data, shapes)

    def close(self) -> None:
        """Free the OpenGL context or close the window; idempotent."""
        self._view.close()


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


def _add_shapes(scene: Any, shapes: Sequence[Shape]) -> None:
    """Append bodies that are in no model to an ``MjvScene``, as many as it has room for."""
    for shape in shapes[: scene.maxgeom - scene.ngeom]:
        edges = np.resize(np.asarray(shape.size, np.float64), 3)
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom,
            getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}"),
            edges / 2 if shape.kind == "box" else edges,
            np.asarray(shape.position, np.float64),
            (np.eye(3) if shape.rotation is None else shape.rotation).ravel(),
            np.array(shape.colour, np.float32),
        )
        if shape.to is not None:
            ends = (np.asarray(end, np.float64) for end in (shape.position, shape.to))
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, shape.size[0], *ends)
        scene.ngeom += 1


@cache
def find_backend() -> str:
    """The backend that ``MUJOCO_GL`` names, else the first that works here; `RenderingUnavailable` if none does."""
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
    """Try `backend` in a separate process, because PyOpenGL keeps its first platform."""
    environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    command = [sys.executable, "-c", _PROBE, backend]
    try:
        return subprocess.run(command, env=environment, capture_output=True, timeout=60, check=False).returncode == 0
    except subprocess.TimeoutExpired:
        return False
