"""Observe: look through a robot's cameras; nothing moves."""

from collections.abc import Sequence

import numpy as np
from gymnasium import spaces

from bam_envs.arms.description import robot_model
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.task import Array, Floats, Label, Memory, Score, draw_seeds, labelled_box, limited, unscored
from bam_envs.tasks.pick import CubeTable
from bam_envs.tasks.reach import START_NOISE

_TABLE = CubeTable(robot_model(DEFAULT_ARM))
HOME, JOINTS = np.array(_TABLE.description.home), _TABLE.description.joint_names


class ObserveTask(Memory):
    """See what the sensors of a UR5e see: images of its cameras ``front`` and ``wrist``, its joints and its gripper.

    Action:
        One number, which moves nothing.

    Start:
        Each joint is within 0.1 rad of the home pose; a cube lies somewhere in front of the arm.

    Reward:
        0.

    Success:
        Not known: infos have no ``is_success``.

    End:
        Never.

    Info:
        Nothing.
    """

    says_success = False
    action_labels = (Label("nothing", "moves nothing", "1"),)
    observation_labels = (
        *(Label(joint, "joint position from the home pose", "rad", "- home", -4, 4) for joint in JOINTS),
        Label("gripper_width", "opening of the gripper", "m", "/ 0.0425 - 1", -2, 2),
    )
    robot_labels = observation_labels

    def __init__(self, num_envs: int = 1) -> None:
        self.num_envs = num_envs
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """Joint positions about `HOME`, and a cube on the table."""
        area = _TABLE.cube_area
        draws = np.stack([rng.random(9) for rng in rngs])
        cube = np.empty((len(env_ids), 3))
        cube[:, :2] = area[0] + draws[:, 6:8] * (area[1] - area[0])
        cube[:, 2] = (2 * draws[:, 8] - 1) * np.pi
        joints = HOME + START_NOISE * (2 * draws[:, :6] - 1)
        return Initial({"joint_position": joints, "object_pose": cube}, draw_seeds(rngs))

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Do nothing: there is no memory."""

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, 7) float32."""
        observation = np.concatenate(self.robot_columns(state), axis=1).astype(np.float32)
        return limited(observation, self.observation_space.low, self.observation_space.high)

    def robot_columns(self, state: RobotState) -> list[Array]:
        """Joints and gripper, not clipped. Shape: (n, k) each."""
        return [state.signals["joint_position"] - HOME, state.signals["gripper_width"] * (2 / _TABLE.open) - 1]

    def command(self, action: Floats, state: RobotState) -> Array:
        """The command that was sent last, again. Shape: (n, 7)."""
        return np.array(state.command)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Nothing is rewarded."""
        return unscored(self.num_envs)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """None beyond the scene."""
        return []
