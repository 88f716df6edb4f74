"""A UR5e with a parallel gripper, simulated: position control, 20 Hz commands, 5 ms physics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, PhysicsDiverged, ResetNeeded
from bam_envs.core.robot import CameraSpec, EnvIds, Initial, RobotState, checked_command
from bam_envs.robots.physics.shapes import marked
from bam_envs.robots.ur5e import COMMAND, GRIPPER_OPEN, GRIPPER_SPEED, arm_spec

if TYPE_CHECKING:
    from bam_envs.robots.physics.cameras import Cameras
    from bam_envs.robots.physics.domain_randomization import Imperfection
    from bam_envs.robots.physics.mujoco_batch import Physics
    from bam_envs.robots.physics.rendering import OffScreen, Window

Array = NDArray[np.float64]

LOWEST, HIGHEST = np.array(COMMAND.low), np.array(COMMAND.high)
MAX_RATE = np.array(COMMAND.max_rate)
GRIPPER_LEASH = 0.011
"""Farthest distance of the gripper's set point ahead of its fingers [m]: enough for full force, and to open at once."""
LAG = 0.05  # delay of the joints behind their set points [s]: damping by stiffness of the actuators
PHYSICS_STEPS = 10  # per period


class SimulatedArm:
    """n simulated UR5e arms, each on a separate table.

    The joint set points move linearly from the last command to the new one within a period, as a UR controller
    interpolates; the gripper's set point moves at `GRIPPER_SPEED`.

    Args:
        num_robots: Number of arms stepped together.
        with_object: Whether there is a cube, measured by a tracker.
        randomize: Masses, friction, sizes and gains that differ each episode, a noisy tracker and delayed commands.
        cameras: Its cameras, ``front`` and ``wrist``, whose images are signals.
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
    ) -> None:
        self.num_robots = num_robots
        self.randomize, self._looks = randomize, looks
        self.spec = replace(arm_spec("ur5e", with_object=with_object), lag=LAG, cameras=cameras)
        self._with_object = with_object
        self._scene = "ur5e_cube.xml" if with_object else "ur5e_gripper.xml"
        self._physics: Physics | None = None
        self._imperfection: Imperfection | None = None
        self._cameras: Cameras | None = None
        self._view: OffScreen | Window | None = None
        self._all = np.arange(num_robots)
        self._setpoint = np.zeros((num_robots, 7))
        self._command = np.zeros((num_robots, 7))
        self._ramp = (np.arange(1, PHYSICS_STEPS + 1) / PHYSICS_STEPS)[None, :, None]

    def connect(self) -> None:
        """Build the physics."""
        if self._physics is not None:
            return
        from bam_envs.robots.physics.domain_randomization import Imperfection
        from bam_envs.robots.physics.mujoco_batch import Physics

        self._physics = Physics(self._scene, self.num_robots, varied=self.randomize)
        self._imperfection = Imperfection(self._physics) if self.randomize else None
        if self.spec.cameras:
            from bam_envs.robots.physics.cameras import Cameras

            self._cameras = Cameras(self._scene, self._physics, self.spec.cameras, random=self._looks == "random")

    @property
    def physics(self) -> Physics:
        """The physics behind the robot; `ResetNeeded` before `connect`."""
        if self._physics is None:
            raise ResetNeeded("The simulated robot is not connected. Call reset() first.")
        return self._physics

    @property
    def setpoint(self) -> Array:
        """Current set points: joint positions [rad] and the gripper's width [m]. Shape: (n, 7)."""
        setpoint: Array = self._setpoint.copy()
        return setpoint

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Set these environments to the initial joint positions and object pose, at rest, the gripper open."""
        physics, joints = self.physics, initial.signals["joint_position"]
        physics.state = physics.state.copy()  # states returned earlier are views of the old array
        physics.time[env_ids], physics.qvel[env_ids] = 0.0, 0.0
        physics.qpos[env_ids, :6], physics.qpos[env_ids, 6:8] = joints, GRIPPER_OPEN / 2
        self._setpoint[env_ids, :6], self._setpoint[env_ids, 6] = joints, GRIPPER_OPEN
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
        physics.qvel[:, : 8 if pose is None else None] = 0.0
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
            qpos, geom, half = physics.qpos, physics.model.geom("object").id, pose[:, 2] / 2
            qpos[env_ids, 8:10] = pose[:, :2]
            qpos[env_ids, 10] = [physics.model_of(int(env)).geom_size[geom, 2] for env in env_ids]
            qpos[env_ids, 11], qpos[env_ids, 12:14], qpos[env_ids, 14] = np.cos(half), 0.0, np.sin(half)
        return self._measure(env_ids)

    def step(self, command: Array) -> RobotState:
        """Send `command` (n, 7): six joint positions [rad] and the gripper's width [m]; one period later, measure."""
        return next(self.slices(command, 1))

    def slices(self, command: Array, parts: int) -> Iterator[RobotState]:
        """Send `command` (n, 7), and yield the state after each of `parts` equal parts of the period.

        Set points and the last state are those of `step`, except for the last bits: in a contact, the solver of the
        physics restarts with each part. A halt between two parts holds for the rest of the period. If the iteration is
        abandoned, the next command begins in the middle of the period.

        Raises:
            InvalidValue: `parts` is not 1, 2, 5 or 10.
        """
        if parts not in range(1, PHYSICS_STEPS + 1) or PHYSICS_STEPS % parts:
            raise InvalidValue(f"A period has {PHYSICS_STEPS} physics steps; it cannot be divided into {parts!r}.")
        return self._slices(self._travel(checked_command(command, (self.num_robots, 7))), parts)

    def _travel(self, command: Array) -> Array:
        """Change of the set points in this period, if `command` is sent now. Shape: (n, 7)."""
        reach = MAX_RATE * self.spec.period
        within = np.clip(command, self._command - reach, self._command + reach)  # no faster than the arm can
        within[:, 6] = command[:, 6]  # the gripper takes a width and goes there at its own speed
        self._command = np.clip(within, LOWEST, HIGHEST)
        arriving = self._command if self._imperfection is None else self._imperfection.delayed(self._command)
        travel = arriving - self._setpoint
        # The gripper's set point goes at its own speed, and stays near the fingers.
        fingers, limit = self.physics.qpos[:, 6] + self.physics.qpos[:, 7], GRIPPER_SPEED * self.spec.period
        width = self._setpoint[:, 6] + np.clip(travel[:, 6], -limit, limit)
        travel[:, 6] = np.clip(width, fingers - GRIPPER_LEASH, fingers + GRIPPER_LEASH) - self._setpoint[:, 6]
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
        physics = self.physics
        qpos, qvel = physics.qpos, physics.qvel
        if not np.isfinite(physics.state.sum()):
            env_ids = np.flatnonzero(~np.isfinite(physics.state).all(axis=1)).tolist()
            raise PhysicsDiverged(f"The simulated state of environments {env_ids} is not finite. Reset them.")
        signals = {"joint_position": qpos[:, :6], "joint_velocity": qvel[:, :6]}
        signals["gripper_width"] = qpos[:, 6:7] + qpos[:, 7:8]
        if self._with_object:
            pose = qpos[:, 8:15]
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
        setpoint = np.concatenate([physics.qpos[:, :6], self._setpoint[:, 6:]], axis=1)
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
        physics, signals = self.physics, state.signals
        physics.qpos[:, :6], physics.qpos[:, 6:8] = signals["joint_position"], signals["gripper_width"] / 2
        if self._with_object:
            physics.qpos[:, 8:11], physics.qpos[:, 11:15] = signals["object_position"], signals["object_quaternion"]

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
