"""A simulated gripper that grasps from a table with random objects, one grasp or several a step, seen from above."""

from __future__ import annotations

import contextlib
import copy
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import PhysicsDiverged, ResetNeeded
from bam_envs.core.robot import Array, EnvIds, Initial, RobotState, checked_command
from bam_envs.robots.grasping import HIGH, LOW, NUMBERS, grasp_spec
from bam_envs.robots.physics.shapes import marked

if TYPE_CHECKING:
    from bam_envs.robots.physics.mujoco_batch import Physics
    from bam_envs.robots.physics.rendering import FastCamera, OffScreen, Window

BACK = 0.12
"""Distance from which the open gripper comes, against its fingers [m]."""
RISE = 0.10
"""Height to which it lifts [m]."""
HELD = 0.05
"""Least rise of an object that is held [m]."""
_GRIPPER = 2  # group of the gripper's geoms
_DOWN, _CLOSE, _UP = 70, 60, 70  # physics steps, 5 ms each
_BLOCKED = 0.01  # [m]
_EMPTY = 0.002  # width of the closed gripper [m]
_NOISE = 0.002  # standard deviation of the depth of a randomised camera [m]
_DRAWN = ("geom_type", "geom_size", "geom_rgba", "geom_pos", "geom_quat", "body_pos", "body_quat")


class GraspCell:
    """n grippers over tables, each with objects of its own.

    Its state has the pictures of the cameras above them as signals: ``color`` (n, size, size, 3) uint8 and ``depth``
    (n, size, size, 1) float32 [m]; and as truth, for every grasp of the last command (n, grasps): ``object``, the
    index of the object that was lifted, or -1; ``rise`` [m] of the object that rose most; ``reason``, an index of
    `REASONS`. A lifted object is taken away before the next grasp.

    Args:
        num_robots: Number of grippers stepped together.
        objects: Number of objects on each table.
        grasps: Grasps in a command.
        size: Width and height of the pictures [pixels].
        randomize: A noisy depth camera, masses and friction that differ each episode.
    """

    def __init__(
        self,
        num_robots: int = 1,
        *,
        objects: int = 5,
        grasps: int = 1,
        size: int = 100,
        randomize: bool = False,
    ) -> None:
        self.num_robots, self.randomize = num_robots, randomize
        self.spec = grasp_spec(grasps)
        self._objects, self._grasps, self._size = objects, grasps, size
        self._physics: Physics | None = None
        self._cell: Any = None
        self._camera: FastCamera | None = None
        self._thread: Any = None
        self._view: OffScreen | Window | None = None
        self._drawn: Any = None  # the model of `_view`
        self._seeds = np.zeros(num_robots, np.int64)
        self._command = np.tile((LOW + HIGH) / 2, (num_robots, grasps))
        self._truth = self._nothing()
        self._color = np.zeros((num_robots, size, size, 3), np.uint8)
        self._depth = np.zeros((num_robots, size, size, 1), np.float32)

    def _nothing(self) -> dict[str, NDArray[Any]]:
        shape = (self.num_robots, self._grasps)
        return {"object": np.full(shape, -1), "rise": np.zeros(shape), "reason": np.zeros(shape, np.int64)}

    def connect(self) -> None:
        """Build the physics."""
        if self._cell is None:
            from bam_envs.robots.physics import grasp_scene
            from bam_envs.robots.physics.mujoco_batch import Physics

            self._cell = grasp_scene.build(self._objects)
            self._physics = self._physics or Physics(self._cell.compile(), self.num_robots, varied=True)

    @property
    def physics(self) -> Physics:
        """The physics; `ResetNeeded` before `connect`."""
        if self._physics is None:
            raise ResetNeeded("The simulated robot is not connected. Call reset() first.")
        return self._physics

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Put new objects on these tables, drawn from the seeds of `initial`."""
        physics = self.physics
        physics.state, self._seeds = physics.state.copy(), self._seeds.copy()
        self._command, self._truth = self._command.copy(), {key: value.copy() for key, value in self._truth.items()}
        self._seeds[env_ids] = initial.seeds
        nothing = self._nothing()
        for env in env_ids.tolist():
            self._lay(env)
            self._command[env] = np.tile((LOW + HIGH) / 2, self._grasps)
            for key, values in nothing.items():
                self._truth[key][env] = values[env]
        return self._measure(env_ids)

    def _lay(self, env: int) -> None:
        """Make the model of an environment from its seed, and lay its objects."""
        from bam_envs.robots.physics import grasp_scene

        physics, rng = self.physics, np.random.default_rng(int(self._seeds[env]))
        model, qpos = grasp_scene.draw(self._cell, self._objects, rng, randomize=self.randomize)
        physics.replace(env, model)
        physics.time[env], physics.qvel[env], physics.qpos[env] = 0.0, 0.0, qpos
        physics.qpos[env, 1] = -BACK

    def step(self, command: Array) -> RobotState:
        """Make the grasps of `command` (n, 8 grasps), cut to their limits: x, y, z [m], orientation, width [m]."""
        physics = self.physics  # before the shape, as for every robot
        self._command = checked_command(command, (self.num_robots, NUMBERS * self._grasps))
        within = np.clip(self._command.reshape(self.num_robots, self._grasps, NUMBERS), LOW, HIGH)
        truth = self._nothing()
        for k in range(self._grasps):
            object_, rise, reason = self._grasp(within[:, k])
            truth["object"][:, k], truth["rise"][:, k], truth["reason"][:, k] = object_, rise, reason
            lifted = np.flatnonzero(object_ >= 0)
            if k + 1 < self._grasps:  # with the last one, a picture shows it
                columns = 4 + 7 * object_[lifted]
                physics.qpos[lifted, columns], physics.qpos[lifted, columns + 2] = 2.0 + 0.3 * object_[lifted], 0.05
        self._truth = truth
        return self._measure(np.arange(self.num_robots))

    def _grasp(self, grasp: Array) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
        """Execute one grasp (n, 8); returns the object that is held, or -1, its rise [m], and the reason. (n,) each."""
        physics, width = self.physics, grasp[:, 7]
        start = physics.qpos[:, 6::7].copy()  # heights of the objects
        physics.state = physics.state.copy()
        for env in range(self.num_robots):
            model = physics.model_of(env)
            model.body_pos[model.body("lift").id] = grasp[env, :3]
            model.body_quat[model.body("approach").id] = _unit(grasp[env, 3:7])
        physics.qpos[:, 0], physics.qpos[:, 1] = 0.0, -BACK
        physics.qpos[:, 2], physics.qpos[:, 3], physics.qvel[:, :4] = width / 2, width / 2, 0.0
        self._drive(_DOWN, (width, width), (0.0, 0.0), (-BACK, 0.0))
        blocked = np.abs(physics.qpos[:, 1]) > _BLOCKED
        self._drive(_CLOSE, (width, 0.0 * width), (0.0, 0.0), (0.0, 0.0))
        empty = physics.qpos[:, 2:4].sum(axis=1) < _EMPTY
        self._drive(_UP, (0.0 * width, 0.0 * width), (0.0, RISE), (0.0, 0.0))
        if not np.isfinite(physics.state.sum()):
            env_ids = np.flatnonzero(~np.isfinite(physics.state).all(axis=1)).tolist()
            raise PhysicsDiverged(f"The simulated state of environments {env_ids} is not finite. Reset them.")
        rises = physics.qpos[:, 6::7] - start
        highest = rises.argmax(axis=1)
        rise = rises[np.arange(self.num_robots), highest]
        held = np.array([rise[env] > HELD and self._touches(env, highest[env]) for env in range(self.num_robots)])
        reason = np.select([held, blocked, empty], [0, 1, 2], 3)
        return np.where(held, highest, -1), rise, reason

    def _drive(self, steps: int, width: tuple[Array, Array], lift: tuple[float, float], travel: Any) -> None:
        """Move the set points of fingers and slides, each linearly from its first value to its last."""
        ramp = np.minimum(np.arange(1, steps + 1) / (0.8 * steps), 1.0)  # and wait until they are there
        control = np.empty((self.num_robots, steps, 3))
        control[:, :, 0] = width[0][:, None] + (width[1] - width[0])[:, None] * ramp
        for column, (first, last) in ((1, lift), (2, travel)):
            control[:, :, column] = first + (last - first) * ramp
        self.physics.step(control)

    def _touches(self, env: int, index: int) -> bool:
        """Whether a finger touches an object."""
        model, data = self.physics.model_of(env), self.physics.data_of(env)
        bodies = model.geom_bodyid[data.contact.geom]
        fingers = [model.body(f"hand_{side}_finger").id for side in ("left", "right")]
        return bool(np.any(np.isin(bodies, fingers).any(1) & (bodies == model.body(f"object{index}").id).any(1)))

    def _measure(self, fresh: EnvIds) -> RobotState:
        """The state, with new pictures of the `fresh` environments."""
        physics = self.physics
        if self._camera is None:
            from bam_envs.robots.physics.rendering import FastCamera

            self._thread = ThreadPoolExecutor(1, "bam-camera")  # an OpenGL context belongs to a thread
            self._camera = self._thread.submit(FastCamera, physics.model, self._size, self._size, (_GRIPPER,)).result()
        self._color, self._depth = self._color.copy(), self._depth.copy()
        self._thread.submit(self._look, self._camera, fresh.tolist()).result()
        width = physics.qpos[:, 2:3] + physics.qpos[:, 3:4]
        signals: dict[str, Any] = {"gripper_width": width, "color": self._color, "depth": self._depth}
        return RobotState(signals, physics.time, self._command, dict(self._truth))

    def _look(self, camera: FastCamera, env_ids: list[int]) -> None:
        """Draw the pictures of these environments."""
        physics = self.physics
        for env in env_ids:
            model = physics.model_of(env)
            self._color[env] = camera.look(model, physics.data_of(env), "above")
            self._depth[env, :, :, 0] = camera.depth(model)
            if self.randomize:
                rng = np.random.default_rng([int(self._seeds[env]), round(1e3 * physics.time[env])])
                self._depth[env] += rng.normal(0.0, _NOISE, self._depth[env].shape).astype(np.float32)

    def halt(self) -> None:
        """Do nothing: between two commands, it rests."""

    def close(self) -> None:
        """Drop the physics, the camera and the window."""
        if self._camera is not None:
            with contextlib.suppress(RuntimeError):  # Python ends, and has ended its threads and their contexts
                self._thread.submit(self._camera.close).result()
            self._thread.shutdown()
        for part in (self._view, self._physics):
            if part is not None:
                part.close()
        self._view = self._camera = self._physics = self._cell = None

    def render(
        self, mode: str, marks: list[tuple[Array, tuple[float, float, float, float]]]
    ) -> NDArray[np.uint8] | None:
        """Show environment 0 and `marks`: an image (480, 640, 3) for ``rgb_array``, a window for ``human``."""
        from bam_envs.robots.physics.rendering import open_view

        if self._view is None:
            self._drawn = copy.copy(self.physics.model)
            self._view = open_view(self._drawn, mode, camera="overview")
        for name in _DRAWN:  # a view keeps its model
            getattr(self._drawn, name)[:] = getattr(self.physics.model_of(0), name)
        return self._view.show(self.physics.data_of(0), marked(marks))

    def state_dict(self) -> dict[str, Any]:
        """The complete state: positions, and the seeds that the shapes follow from."""
        arrays = {"physics": self.physics.state, "seeds": self._seeds, "command": self._command, **self._truth}
        return {name: array.copy() for name, array in arrays.items()}

    def load_state_dict(self, state: dict[str, Any]) -> RobotState:
        """Restore the result of `state_dict`; returns the state."""
        self.connect()
        self._seeds, self._command = np.array(state["seeds"]), np.array(state["command"])
        self._truth = {name: np.array(state[name]) for name in self._truth}
        for env in range(self.num_robots):
            self._lay(env)
        self.physics.state = np.array(state["physics"])
        return self._measure(np.arange(self.num_robots))

    def __getstate__(self) -> dict[str, Any]:
        """The state without what belongs to this process, or is made again."""
        return {**self.__dict__, **dict.fromkeys(("_cell", "_camera", "_thread", "_view", "_drawn"))}


def _unit(quaternion: Array) -> Array:
    """A rotation; straight down for zeros. Shape: (4,)."""
    length = float(np.linalg.norm(quaternion))
    unit: Array = quaternion / length if length > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])
    return unit
