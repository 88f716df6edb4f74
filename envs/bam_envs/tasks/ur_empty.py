"""UR empty: a UR arm without a goal; robo-gym's EmptyEnvironmentUR."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Floats, Label, Score
from bam_envs.robots.ur import START
from bam_envs.tasks.ur_arm import UrTask, collisions, joint_labels, joint_option, normalised


class UrEmptyTask(UrTask):
    """Move a UR arm about, for trying out actions.

    Start:
        The arm is at the start pose, or at the reset option ``joint_positions`` (6) [rad].

    Action:
        Target joint positions, from one end of their range at -1 to the other at 1. The joints move there at a fifth of
        their maximum speed, and slower when they are near. A fixed joint stays at its start.

    Reward:
        0.

    Success:
        None; with ``parity=True`` 300 steps without a collision.

    End:
        Terminated at a collision of the arm with itself, the table or the ground.

    Info:
        `final_status` at the end: "collision" or "max_steps_exceeded".
    """

    rate, velocity_scale, max_steps = 20.0, 0.2, 300
    memory: Mapping[str, str] = {"elapsed": "elapsed", "held": "_held"}

    def _observation_labels(self) -> tuple[Label, ...]:
        speed = f"/ {self.velocity_scale:g} of its fastest"
        return (
            *joint_labels("", "joint position", "rad", "/ its limit"),
            *joint_labels("speed_", "joint velocity", "rad/s", speed, 3),
        )

    def sample_initial(
        self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """The start pose, or that of the options."""
        joints = joint_option(options or {}, START, self.model)
        return self.initial(np.tile(joints, (len(env_ids), 1)), rngs)

    def _columns(self, state: RobotState) -> list[Array]:
        return [normalised(self.model, state.signals["joint_position"]), state.signals["joint_velocity"] / self.speed]

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joint positions [rad] on the way to the action's. Shape: (n, 6)."""
        return self.toward(self.full_action(action, self._held) * self.model.joint_limits[1], state)

    def score(self, state: RobotState, action: Floats) -> Score:
        """No reward; a collision ends the episode."""
        self.elapsed = self.elapsed + 1
        success = np.zeros(self.num_envs, dtype=bool)
        terminated, status = self.ends(collisions(state), success, self.elapsed >= self.max_steps)
        return Score(np.zeros(self.num_envs), terminated, success, self.info(state, final_status=status))
