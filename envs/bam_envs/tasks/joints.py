"""Joints: move the joints of an arm to positions, in SI units; for policies that were trained elsewhere."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bam_envs.core.robot import RobotState
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.task import Array, Floats, Label, Score, labelled_box, limited
from bam_envs.tasks.reach import GoalSpace, ReachTask
from bam_envs.tasks.tool_control import PACE, PERIOD

WIDTH = "gripper_width"
"""Name of the gripper's number in observations, actions and commands."""


class JointsTask(ReachTask):
    """Follow positions of the joints and of the gripper; what is done with them is up to the policy.

    Args:
        robot_model: The arm: the name of a description, or its file.

    Start:
        Each joint is within 0.1 rad of the home pose.

    Action:
        Positions of the joints [rad] and width of the gripper [m], followed with at most 0.24 m/s of the tool, no lower
        than the work area.

    Reward:
        0.

    Success:
        Never.

    End:
        Never.

    Info:
        Nothing.
    """

    memory: Mapping[str, str] = {"sent": "_sent"}

    def __init__(self, num_envs: int = 1, *, robot_model: Any = DEFAULT_ARM) -> None:
        super().__init__(num_envs, robot_model=robot_model)
        description = self.space.description
        self.space.lowest = float(self.space.box[0, 2])
        self.action_labels = (
            *(Label(one.name, "joint position", "rad", low=one.low, high=one.high) for one in description.joints),
            Label(WIDTH, "opening of the gripper", "m", low=0.0, high=self.space.open),
        )
        self._slide = PACE * PERIOD * description.gripper.speed
        self.action_step: Array = np.append(self._pace.step, self._slide)
        """Greatest change of each number of an action that is followed within a period. Shape: (joints + 1,)."""
        self.observation_labels = self.robot_labels = self.labels(self.space)
        self.action_space, self.observation_space = map(labelled_box, (self.action_labels, self.observation_labels))

    @staticmethod
    def labels(space: GoalSpace) -> tuple[Label, ...]:
        """Meaning of an observation."""
        return (
            *(Label(one, "joint position", "rad", low=-7.0, high=7.0) for one in space.description.joint_names),
            Label(WIDTH, "opening of the gripper", "m", low=-1.0, high=1.0),
        )

    def robot_columns(self, state: RobotState) -> list[Array]:
        """See `robot_labels`: the observation, not clipped. Shape: (n, k) each."""
        return [state.signals["joint_position"], state.signals["gripper_width"]]

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joints [rad] and gripper width [m], as near to `action` as a period allows. Shape: (n, joints + 1)."""
        wanted, sent = action.astype(np.float64), state.command[:, -1]
        command = super().command(super().action_for(wanted, state), state)
        width = limited(wanted[:, -1], 0.0, self.space.open)
        command[:, -1] = limited(width, sent - self._slide, sent + self._slide)
        return command

    def action_for(self, command: Array, state: RobotState) -> Floats:
        """The action that leads to `command` (n, joints + 1): the same numbers."""
        action: Floats = limited(command, self.action_space.low, self.action_space.high).astype(np.float32)
        return action

    def score(self, state: RobotState, action: Floats) -> Score:
        """Nothing is rewarded."""
        never = np.zeros(self.num_envs, dtype=bool)
        return Score(np.zeros(self.num_envs), never, never.copy())

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """None beyond the scene."""
        return []
