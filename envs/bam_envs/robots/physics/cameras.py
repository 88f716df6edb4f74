"""Cameras of simulated robots: small images of many environments, and looks that differ each episode.

What makes small images cheap without a GPU: one sample a pixel, no shadows, reflections and sky, coarse cylinders. The
pixels hardly count.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import FARTHEST, SEGMENTS, Array, CameraSpec, EnvIds
from bam_envs.robots.physics.mujoco_batch import Physics, mujoco
from bam_envs.robots.physics.rendering import FastCamera

Images = dict[str, NDArray[Any]]
SALT = 0xCA3E4A
"""Goes with an episode's seed into the generator of its looks."""
_DRAWS = 64
_SURFACES = ("table", "checked", "speckled")
"""Materials that a table can have, all of its colour."""
_COLOURS = {
    "table": ((0.3, 0.4, 0.4), (0.85, 0.95, 0.95)),
    "arm": ((0.6, 0.6, 0.6), (0.95, 0.95, 0.95)),
    "joint": ((0.05, 0.2, 0.3), (0.4, 0.6, 0.9)),
    "gripper": ((0.08, 0.08, 0.08), (0.35, 0.35, 0.35)),
    "pad": ((0.2, 0.2, 0.2), (0.5, 0.5, 0.5)),
}
"""Least and greatest red, green and blue of each material."""
_OBJECT = ((0.65, 0.1, 0.05), (1.0, 0.4, 0.35))
_FAR_AWAY = ((0.1, 0.1, 0.1), (0.9, 0.9, 0.9))
_CAMERA_MOVES = {"front": (0.01, 0.02), "wrist": (0.003, 0.015)}
"""Greatest differences of each camera's position along each axis [m], and of its rotation about each [rad]."""


class Cameras:
    """Draws the images of the robots of one `Physics`, in a thread of its own, to which its OpenGL context belongs.

    More threads are no faster: they wait for each other in OpenGL.

    Args:
        scene: Makes the `mujoco.MjSpec` of the robots.
        physics: The robots.
        specs: The cameras.
        random: Whether light, colours, the table's texture and the cameras' poses are drawn for each episode.
    """

    def __init__(
        self, scene: Callable[[], Any], physics: Physics, specs: Sequence[CameraSpec], *, random: bool
    ) -> None:
        self._scene, self._physics, self._specs, self._random = scene, physics, tuple(specs), random
        self.draws: Array = np.full((physics.num_envs, _DRAWS), 0.5)
        """Random numbers in [0, 1) that decide the looks of each environment. Shape: (n, 64)."""
        self._images: Images = {}
        self._painter: _Painter | None = None
        self._thread: Any = None

    def begin(self, env_ids: EnvIds, seeds: NDArray[np.int64]) -> None:
        """Draw the looks of new episodes."""
        if self._random:
            self.draws = self.draws.copy()
            for env, seed in zip(env_ids, seeds, strict=True):
                self.draws[env] = np.random.default_rng([int(seed), SALT]).random(_DRAWS)

    def look(self, env_ids: EnvIds) -> Images:
        """Images of all environments by signal, (n, ...) each; only those of `env_ids` are new."""
        n = self._physics.num_envs
        if not self._images:
            boxes = {name: box for spec in self._specs for name, box in spec.spaces().items()}
            self._images = {name: np.zeros((n, *box.shape), box.dtype) for name, box in boxes.items()}
        elif len(env_ids):  # images that were handed out keep their pixels
            self._images = {name: images.copy() for name, images in self._images.items()}
        if self._painter is None:
            self._thread = ThreadPoolExecutor(1, "bam-camera")
            self._painter = self._thread.submit(_Painter, self._scene, self._specs).result()
        self._thread.submit(self._draw, self._painter, env_ids).result()
        return dict(self._images)

    def _draw(self, painter: _Painter, env_ids: EnvIds) -> None:
        for env in env_ids.tolist():
            draws = self.draws[env] if self._random else None
            painter.pose(self._physics.model_of(env), self._physics.qpos[env], draws)
            painter.draw({name: images[env] for name, images in self._images.items()})

    def close(self) -> None:
        """Free the OpenGL contexts. Idempotent."""
        painter, self._painter = self._painter, None
        if painter is not None:
            with contextlib.suppress(RuntimeError):  # Python ends, and has ended the thread and its context
                self._thread.submit(painter.close).result()
            self._thread.shutdown()

    def __getstate__(self) -> dict[str, Any]:
        """The state without the thread, which belongs to this process."""
        return {**self.__dict__, "_painter": None, "_thread": None}


def _visual_model(scene: Callable[[], Any], width: int, height: int) -> Any:
    """The model of a scene with cheap graphics, surroundings, and textures for its table."""
    spec = scene()
    quality = spec.visual.quality
    quality.offsamples, quality.numslices, quality.numstacks = 0, 12, 6
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    for name, builtin, mark in (("checked", "CHECKER", "NONE"), ("speckled", "FLAT", "RANDOM")):
        spec.add_texture(
            name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=64, height=64, random=0.3,
            builtin=getattr(mujoco.mjtBuiltin, f"mjBUILTIN_{builtin}"), mark=getattr(mujoco.mjtMark, f"mjMARK_{mark}"),
            rgb1=[1, 1, 1], rgb2=[0.75, 0.75, 0.75], markrgb=[0.6, 0.6, 0.6],
        )  # fmt: skip
        textures = [""] * int(mujoco.mjtTextureRole.mjNTEXROLE)
        textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
        spec.add_material(name=name, textures=textures, texrepeat=[4, 4], specular=0.1)
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(name="floor", type=box, pos=[0, 0, -0.8], size=[5, 5, 0.02], rgba=[0.5, 0.52, 0.55, 1])
    return spec.compile()


class _Painter:
    """An OpenGL context of the thread that makes it, and a model of its own, for one environment after the other."""

    def __init__(self, scene: Callable[[], Any], specs: Sequence[CameraSpec]) -> None:
        self._specs, width, height = specs, specs[0].width, specs[0].height
        self._model: Any = _visual_model(scene, width, height)
        self._nominal = copy.copy(self._model)
        self._data = mujoco.MjData(self._model)
        self._camera = FastCamera(self._model, width, height)
        self._object = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_GEOM, "object")  # -1: there is none

    def pose(self, model: Any, qpos: Array, draws: Array | None) -> None:
        """Show the robot at `qpos` (nq,), the object as large as in `model`, with the looks of `draws` (64,)."""
        self._data.qpos[:] = qpos
        if self._object >= 0:
            self._model.geom_size[self._object] = model.geom("object").size
        if draws is not None:
            self._wear(draws)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def _wear(self, draws: Array) -> None:
        model, nominal, colours = self._model, self._nominal, draws[:24].reshape(8, 3)
        for (name, (low, high)), draw in zip(_COLOURS.items(), colours, strict=False):
            colour = _between(low, high, draw)
            for one in _SURFACES if name == "table" else (name,):
                model.mat_rgba[model.material(one).id, :3] = colour
        model.geom_matid[model.geom("table").id] = model.material(_SURFACES[int(3 * draws[24])]).id
        model.geom_rgba[model.geom("floor").id, :3] = _between(*_FAR_AWAY, colours[5])
        if self._object >= 0:
            model.geom_rgba[self._object, :3] = _between(*_OBJECT, colours[6])
        head = model.vis.headlight
        head.ambient[:], head.diffuse[:] = 0.2 + 0.3 * draws[25], 0.3 + 0.4 * draws[26]
        model.light_diffuse[0] = 0.25 + 0.4 * draws[27]
        model.light_dir[0] = nominal.light_dir[0] + 0.8 * (draws[28:31] - 0.5)
        for number, (name, (shift, turn)) in enumerate(_CAMERA_MOVES.items()):
            camera, draw = model.camera(name).id, 2 * draws[32 + 8 * number : 40 + 8 * number] - 1
            model.cam_pos[camera] = nominal.cam_pos[camera] + shift * draw[:3]
            model.cam_quat[camera] = nominal.cam_quat[camera]
            mujoco.mju_quatIntegrate(model.cam_quat[camera], turn * draw[3:6], 1.0)
            model.cam_fovy[camera] = nominal.cam_fovy[camera] * (1 + 0.03 * draw[6])

    def draw(self, images: Images) -> None:
        """Draw every camera's images into these arrays."""
        for spec in self._specs:
            images[spec.name][:] = self._camera.look(self._model, self._data, spec.name)
            if spec.depth:
                images[f"{spec.name}_depth"][:, :, 0] = np.minimum(
                    self._camera.depth(self._model), np.float32(FARTHEST)
                )
            if spec.segmentation:
                images[f"{spec.name}_segmentation"][:, :, 0] = self._segments()

    def _segments(self) -> NDArray[np.uint8]:
        """Indices of `SEGMENTS`; geoms are drawn again, in colours that are their numbers."""
        scene = self._camera.scene
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            scene.flags[flag] = 1
        pixels = self._camera.draw()
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            scene.flags[flag] = 0
        kinds = np.zeros(scene.ngeom + 1, np.uint8)
        for geom in scene.geoms[: scene.ngeom]:
            kinds[geom.segid + 1] = self._kind(geom.objid)
        return kinds[pixels[:, :, 0]]

    def _kind(self, geom: int) -> int:
        """The index of `SEGMENTS` of a geom of the model, by its name or group."""
        named = {"table": "table", "floor": "nothing", "object": "object"}
        grouped = {1: "arm", 2: "gripper"}
        group = int(self._model.geom_group[geom])
        return SEGMENTS.index(named.get(self._model.geom(geom).name) or grouped[group])

    def close(self) -> None:
        """Free the context."""
        self._camera.close()


def _between(low: Sequence[float], high: Sequence[float], draw: Array) -> Array:
    colour: Array = np.array(low) + draw * (np.array(high) - np.array(low))
    return colour
