"""An arm with a parallel gripper, simulated: position control, 20 Hz commands or others, 5 ms physics or finer."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.description import robot_model as model_called
from bam_envs.core.errors import InvalidValue, PhysicsDiverged, ResetNeeded
from bam_envs.core.robot import CameraSpec, EnvIds, Initial, RobotState, checked_command
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.robots.physics.shapes import marked

if TYPE_CHECKING:
    from bam_envs.robots.physics.cameras import Cameras
    from bam_envs.robots.physics.domain_randomization import Imperfection
    from bam_envs.robots.physics.mujoco_batch import Physics
    from bam_envs.robots.physics.rendering import OffScreen, Window

Array = NDArray[np.float64]

GRIPPER_LEASH = 0.011
"""Farthest distance of the gripper's set point ahead of its fingers [m]: enough for full force, and to open at once."""
LAG = 0.05  # delay of the joints behind their set points [s]: damping by stiffness of the actuators
PHYSICS_STEPS = 10  # per period of up to 50 ms; a longer one has twice as many, and so on


class SimulatedArm:
    """n simulated arms, each on a separate table.

    The joint set points move linearly from the last command to the new one within a period, as a UR controller
    interpolates; the gripper's set point moves at the speed of the description.

    Args:
        num_robots: Number of arms stepped together.
        with_object: Whether there is a cube, measured by a tracker.
        randomize: Masses, friction, sizes and gains that differ each episode, a noisy tracker and delayed commands.
        cameras: Its cameras, ``front`` and ``wrist``, whose images are signals.
        robot_model: The arm; see `bam_envs.arms.description.robot_model`.
        rate: Commands in a second.
        looks: ``"random"`` for light, colours, texture and poses of cameras that differ each episode, or ``"fixed"``.
    """

    def __init__(
        self,
        num_robots: int = 1,
        *,
        with_object: bool = True,
        randomize: bool = False,
        cameras: tuple[CameraSpec, ...] = (),
        looks: str = "fixed",
        robot_model: Any = DEFAULT_ARM,
        rate: float = 20.0,
    ) -> None:
        self.num_robots, self.description = num_robots, model_called(robot_model)
        self.randomize, self._looks = randomize, looks
        self.coarse = False
        """Whether `connect` builds coarse physics, to train on; see `coarse_physics`."""
        usual = self.description.spec(with_object=with_object)
        self.spec = replace(usual, period=1 / rate, lag=LAG, cameras=cameras)
        self._steps, self._is_usual = PHYSICS_STEPS * math.ceil(1 / rate / usual.period), rate * usual.period == 1.0
        self._joints, self._open = self.description.num_joints, self.description.gripper.open
        command = self.spec.command
        self._lowest, self._highest, self._max_rate = map(np.array, (command.low, command.high, command.max_rate))
        self._with_object = with_object
        self._physics: Physics | None = None
        self._imperfection: Imperfection | None = None
        self._cameras: Cameras | None = None
        self._view: OffScreen | Window | None = None
        self._all = np.arange(num_robots)
        self._setpoint = np.zeros((num_robots, self._joints + 1))
        self._command = np.zeros((num_robots, self._joints + 1))
        self._ramp = (np.arange(1, self._steps + 1) / self._steps)[None, :, None]

    def connect(self) -> None:
        """Build the physics."""
        if self._physics is not None:
            return
        from bam_envs.robots.physics.arm_model import scene_spec
        from bam_envs.robots.physics.coarse_physics import CoarsePhysics
        from bam_envs.robots.physics.domain_randomization import Imperfection
        from bam_envs.robots.physics.mujoco_batch import Physics

        scene = partial(scene_spec, self.description, with_object=self._with_object)
        if self.coarse and self._is_usual:
            given: dict[str, Any] = {"with_object": self._with_object, "varied": self.randomize}
            self._physics = CoarsePhysics(self.description, self.num_robots, **given)
        else:
            model = scene().compile()
            if not self._is_usual:
                model.opt.timestep = self.spec.period / self._steps
            self._physics = Physics(model, self.num_robots, varied=self.randomize)
        self._imperfection = Imperfection(self._physics) if self.randomize else None
        if self.spec.cameras:
            from bam_envs.robots.physics.cameras import Cameras

            self._cameras = Cameras(scene, self._physics, self.spec.cameras, random=self._looks == "random")

    @property
    def tool_position(self) -> Any:
        """Forward kinematics: the function of joint positions (n, k) [rad] that gives those of the tool (n, 3) [m]."""
        return self.description.arm.tool_position

    @property
    def physics(self) -> Physics:
        """The physics behind the robot; `ResetNeeded` before `connect`."""
        if self._physics is None:
            raise ResetNeeded("The simulated robot is not connected. Call reset() first.")
        return self._physics

    @property
    def setpoint(self) -> Array:
        """Current set points: joint positions [rad] and the gripper's width [m]. Shape: (n, joints + 1)."""
        setpoint: Array = self._setpoint.copy()
        return setpoint

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Set these environments to the initial joint positions and object pose, at rest, the gripper open."""
        physics, joints = self.physics, initial.signals["joint_position"]
        physics.state = physics.state.copy()  # states returned earlier are views of the old array
        physics.time[env_ids], physics.qvel[env_ids] = 0.0, 0.0
        size = self._joints
        physics.qpos[env_ids, :size], physics.qpos[env_ids, size : size + 2] = joints, self._open / 2
        self._setpoint[env_ids, :size], self._setpoint[env_ids, size] = joints, self._open
        self._command = self._command.copy()  # so does the command
        self._command[env_ids] = self._setpoint[env_ids]
        return self._begin(env_ids, initial.signals["object_pose"] if self._with_object else None, initial.seeds)

    def place_object(self, pose: Array | None, seeds: NDArray[np.int64]) -> RobotState:
        """Put the object at `pose` (n, 3), x, y [m] and yaw [rad], or leave it; `seeds` (n,) are of the new episode.

        The arms keep their positions, at rest: a drive whose force saturates could otherwise oscillate forever.

        Raises:
            InvalidValue: There is no object.
        """
        physics = self.physics
        if pose is not None and not self._with_object:
            raise InvalidValue(f"The robot {self.spec.name!r} has no object that could be placed.")
        physics.state = physics.state.copy()  # states returned earlier are views of the old array
        physics.qvel[:, : self._joints + 2 if pose is None else None] = 0.0
        return self._begin(self._all, pose, seeds)

    def _begin(self, env_ids: EnvIds, pose: Array | None, seeds: NDArray[np.int64]) -> RobotState:
        """Draw an episode's differences; the object lies flat on the table at x, y [m] and yaw [rad] of `pose`."""
        physics = self.physics
        if self._imperfection is not None:
            for env, seed in zip(env_ids, seeds, strict=True):
                self._imperfection.reset(int(env), int(seed), self._command[env])
        if self._cameras is not None:
            self._cameras.begin(env_ids, seeds)
        if pose is not None:
            object_pose, geom = physics.qpos[:, self._joints + 2 :], physics.model.geom("object").id
            half = pose[:, 2] / 2
            object_pose[env_ids, :2] = pose[:, :2]
            object_pose[env_ids, 2] = [physics.model_of(int(env)).geom_size[geom, 2] for env in env_ids]
            object_pose[env_ids, 3], object_pose[env_ids, 4:6], object_pose[env_ids, 6] = (
                np.cos(half),
                0.0,
                np.sin(half),
            )
        return self._measure(env_ids)

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, joints + 1), joint positions [rad] and the gripper's width [m]; measure a period later."""
        return next(self.slices(command, 1))

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """Send `command` (n, joints + 1), and yield the state after each of `parts` equal parts of the period.

        Set points and the last state are those of `step`, except for the last bits: in a contact, the solver of the
        physics restarts with each part. A halt between two parts holds for the rest of the period. If the iteration is
        abandoned, the next command begins in the middle of the period.

        Raises:
            InvalidValue: `parts` is not 1, 2, 5 or 10, or another divisor of the physics steps of a period.
        """
        if parts not in range(1, self._steps + 1) or self._steps % parts:
            raise InvalidValue(f"A period has {self._steps} physics steps; it cannot be divided into {parts!r}.")
        return self._slices(self._travel(checked_command(command, self._command.shape)), parts)

    def rest(self, resting: NDArray[np.bool_]) -> None:
        """Leave the arms of a mask (n,) as they are in the next steps; see `RobotVectorEnv.rest`."""
        if self._physics is not None:
            self._physics.resting = resting

    def _travel(self, command: Array) -> Array:
        """Change of the set points in this period, if `command` is sent now. Shape: (n, joints + 1)."""
        reach, last = self._max_rate * self.spec.period, self._joints
        within = np.clip(command, self._command - reach, self._command + reach)  # no faster than the arm can
        within[:, last] = command[:, last]  # the gripper takes a width and goes there at its own speed
        self._command = np.clip(within, self._lowest, self._highest)
        arriving = self._command if self._imperfection is None else self._imperfection.delayed(self._command)
        travel = arriving - self._setpoint
        # The gripper's set point goes at its own speed, and stays near the fingers.
        qpos = self.physics.qpos
        fingers, limit = qpos[:, last] + qpos[:, last + 1], reach[last]
        width = self._setpoint[:, last] + np.clip(travel[:, last], -limit, limit)
        travel[:, last] = np.clip(width, fingers - GRIPPER_LEASH, fingers + GRIPPER_LEASH) - self._setpoint[:, last]
        return travel

    def _slices(self, travel: Array, parts: int) -> Iterator[RobotState]:
        start = here = self._setpoint
        for ramp in np.split(self._ramp, parts, axis=1):
            if self._setpoint is not here:  # halted between two parts
                start, travel = self._setpoint, np.zeros_like(travel)
            self.physics.step(start[:, None] + travel[:, None] * ramp)
            self._setpoint = here = start + travel * ramp[:, -1]
            last = ramp[0, -1, 0] == 1.0
            yield self._measure(self._all if last else self._all[:0])

    def _measure(self, fresh: EnvIds) -> RobotState:
        """The state of all environments; a noisy tracker and cameras measure only the `fresh` ones again."""
        physics, size = self.physics, self._joints
        qpos, qvel = physics.qpos, physics.qvel
        if not np.isfinite(physics.state.sum()):
            env_ids = np.flatnonzero(~np.isfinite(physics.state).all(axis=1)).tolist()
            raise PhysicsDiverged(f"The simulated state of environments {env_ids} is not finite. Reset them.")
        signals = {"joint_position": qpos[:, :size], "joint_velocity": qvel[:, :size]}
        signals["gripper_width"] = qpos[:, size : size + 1] + qpos[:, size + 1 : size + 2]
        if self._with_object:
            pose = qpos[:, size + 2 :]
            if self._imperfection is not None:
                self._imperfection.look(fresh, pose[fresh])
                pose = self._imperfection.seen.copy()
            signals |= {"object_position": pose[:, :3], "object_quaternion": pose[:, 3:]}
        if self._cameras is not None:
            signals |= self._cameras.look(fresh)
        return RobotState(signals, physics.time, self._command)

    def halt(self) -> None:
        """Hold the measured joint positions; delayed commands are dropped."""
        physics, imperfection = self._physics, self._imperfection  # `close` may come from another thread
        if physics is None:
            return
        setpoint = np.concatenate([physics.qpos[:, : self._joints], self._setpoint[:, self._joints :]], axis=1)
        self._setpoint, self._command = setpoint, setpoint.copy()
        if imperfection is not None:
            imperfection.forget(setpoint)

    def close(self) -> None:
        """Halt, drop the physics and the window."""
        self.halt()
        if self._view is not None:
            self._view.close()
        if self._cameras is not None:
            self._cameras.close()
        if self._physics is not None:
            self._physics.close()
        self._view = self._physics = self._imperfection = self._cameras = None

    def render(
        self, mode: str, marks: list[tuple[Array, tuple[float, float, float, float]]]
    ) -> NDArray[np.uint8] | None:
        """Show environment 0 and `marks`: an image (480, 640, 3) for ``rgb_array``, a window for ``human``."""
        from bam_envs.robots.physics.rendering import open_view

        if self._view is None:
            self._view = open_view(self.physics.model_of(0), mode, camera="overview")
        return self._view.show(self.physics.data_of(0), marked(marks))

    def show(self, state: RobotState) -> None:
        """Put the arm and object of the one environment where `state` measured them, to draw it."""
        signals, size = state.signals, self._joints
        joints, fingers, thing = np.split(self.physics.qpos, [size, size + 2], axis=1)
        joints[:], fingers[:] = signals["joint_position"], signals["gripper_width"] / 2
        if self._with_object:
            thing[:, :3], thing[:, 3:] = signals["object_position"], signals["object_quaternion"]

    def state_dict(self) -> dict[str, Any]:
        """The complete state of the simulated robots."""
        arrays = {"physics": self.physics.state, "setpoint": self._setpoint, "command": self._command}
        extra: dict[str, Any] = {} if self._imperfection is None else {"imperfection": self._imperfection.state_dict()}
        if self._cameras is not None:
            extra["looks"] = self._cameras.draws.copy()
        return {name: array.copy() for name, array in arrays.items()} | extra

    def load_state_dict(self, state: dict[str, Any]) -> RobotState:
        """Restore the result of `state_dict`; returns the state."""
        self.connect()
        if self._imperfection is not None:
            self._imperfection.load_state_dict(state["imperfection"])
        self.physics.state = np.array(state["physics"])
        self._setpoint, self._command = np.array(state["setpoint"]), np.array(state["command"])
        if self._cameras is not None:
            self._cameras.draws = np.array(state["looks"])
            self._cameras.look(self._all)
        return self._measure(self._all[:0])


cube_scene = partial(SimulatedArm, with_object=True)
arm_scene = partial(SimulatedArm, with_object=False)
