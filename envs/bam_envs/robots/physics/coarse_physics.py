"""Coarse physics, to train on: a period in 5 steps instead of 10, without the object where nothing touches it.

Set points are averages of those of the fine steps, which halves the error of the joints. A policy that was trained on
coarse physics is evaluated and deployed on the fine one.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.arms.description import ArmDescription, cube_edge
from bam_envs.core.errors import InvalidValue
from bam_envs.robots.physics.arm_model import scene_spec
from bam_envs.robots.physics.mujoco_batch import Array, Physics, mujoco

FINE, COARSE = 10, 5
"""Steps of a period."""
MARGIN = 0.02
"""An object that is farther from the gripper when a period begins, and where it is sent, stays untouched [m]."""
STILL = 2e-3
"""Velocity up to which an object is at rest [m/s, rad/s]."""


def coarse_model(description: ArmDescription, *, with_object: bool) -> Any:
    """The model of `scene_spec` with longer steps."""
    spec = scene_spec(description, with_object=with_object)
    spec.option.timestep *= FINE / COARSE
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)  # so few constraints are solved faster together
    return spec.compile()


class CoarsePhysics(Physics):
    """As `Physics`, of an arm and maybe its object."""

    def __init__(self, description: ArmDescription, num_envs: int, *, with_object: bool, varied: bool) -> None:
        super().__init__(coarse_model(description, with_object=with_object), num_envs, varied=varied)
        self._size, self._chain, gripper = description.num_joints, description.chain, description.gripper
        self._alone: Physics | None = None
        if with_object and not varied:
            self._alone = Physics(coarse_model(description, with_object=False), num_envs)
        self._edge = cube_edge(gripper.open, self._chain.turns)
        length, ((_, palm), (finger, thick), (pad, tip)) = gripper.boxes(description.tool.matrix())
        wide = max(palm[0], gripper.open / 2 + finger[0] + thick[0])
        reach = MARGIN + np.sqrt(0.75) * self._edge  # of the object around its centre
        # Box around the open gripper and the object's radius, in the tool's frame [m].
        self._low = np.array([-wide, -palm[1], -length]) - reach
        self._high = np.array([wide, palm[1], pad[2] + tip[2] - length]) + reach

    def step(self, control: Array) -> None:
        """Advance all environments by a period; `control` are the set points of its fine steps (n, FINE, nu).

        Raises:
            InvalidValue: It is a part of a period.
        """
        if control.shape[1] != FINE:
            raise InvalidValue(f"Coarse physics takes a whole period of {FINE} set points, not {control.shape[1]}.")
        control = control.reshape(len(control), COARSE, FINE // COARSE, -1).mean(axis=2)
        if self._alone is None:
            self.state = self.advanced(self.state, control, self._models)
            return
        free, after, size = self._untouched(control[:, -1, : self._size]), self.state.copy(), self._size + 2
        touched = np.flatnonzero(~free)
        if touched.size:
            after[touched] = self.advanced(self.state[touched], control[touched], [self.model])
        if free.any():
            own = np.r_[: 1 + size, 1 + self.model.nq : 1 + self.model.nq + size]  # time, arm and fingers
            rows = np.ix_(np.flatnonzero(free), own)
            after[rows] = self._alone.advanced(self.state[rows], control[free], [self._alone.model])
        self.state = after

    def _untouched(self, goal: Array) -> NDArray[np.bool_]:
        """Where the object rests on the table, far from the gripper on its way to the joints `goal` (n, k) [rad]."""
        size = self._size + 2
        height, still = self.qpos[:, size + 2] - self._edge / 2, np.abs(self.qvel[:, size:]).max(axis=1) < STILL
        tool = self._chain.link_frames(np.concatenate([self.qpos[:, : self._size], goal]))[:, -1]
        offset = np.tile(self.qpos[:, size : size + 3], (2, 1)) - tool[:, :3, 3]
        place = np.einsum("nji,nj->ni", tool[:, :3, :3], offset)
        far = ((place < self._low) | (place > self._high)).any(axis=1).reshape(2, -1).all(axis=0)
        untouched: NDArray[np.bool_] = far & still & (height > -1e-3) & (height < 5e-4)  # flat on the table
        return untouched

    def close(self) -> None:
        """Stop the threads."""
        super().close()
        if self._alone is not None:
            self._alone.close()
