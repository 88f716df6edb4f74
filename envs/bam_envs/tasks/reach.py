"""Reach: bring the tool within 2 cm of a point, with actions that turn the joints."""

from collections.abc import Mapping, Sequence

import numpy as np
from gymnasium import spaces

from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Floats, Label, Memory, Score, draw_seeds, labelled_box, limited
from bam_envs.robots.ur5e import GEOMETRY, GRIPPER_OPEN, JOINTS
from bam_envs.tasks.tool_control import JOINT_STEP, TOOL_STEP

HOME = np.array([-0.27, -1.54, 1.89, -1.93, -1.57, -1.84])
"""Joint positions with the tool at about (0.5, 0, 0.2) m, pointing down [rad]."""
START_NOISE = 0.1
"""The start differs from `HOME` by at most this much in each joint [rad]."""
GOAL_AREA = np.array([[0.30, -0.30, 0.10], [0.65, 0.30, 0.45]])
"""Range of the goals: lowest and highest x, y, z [m]."""
GOAL_RADIUS = 0.02  # the tool has arrived within this distance of the goal [m]
LOWEST_TOOL = 0.04  # commands that would bring the tool lower than this are not followed [m]
JOINT_MARGIN = 0.1  # commands stay this far from the joint limits [rad]
LEASH = 0.15
"""Farthest distance of the commanded joints from the measured ones [rad]."""

_LOW = np.array([-2 * np.pi, -2 * np.pi, -np.pi, -2 * np.pi, -2 * np.pi, -2 * np.pi]) + JOINT_MARGIN


class ReachTask(Memory):
    """Bring the tool within `GOAL_RADIUS` of a goal.

    Start:
        Each joint is within 0.1 rad of the home pose, in which the tool is at about (0.5, 0, 0.2) m and points down.
        The goal is between x 0.30 and 0.65 m, y -0.30 and 0.30 m, z 0.10 and 0.45 m.

    Reward:
        Each step 0.2 (1 - tanh(3 d)), where d is the distance of the tool from the goal [m]. At success 10, about the
        worth of staying there.

    Success:
        The tool is within 2 cm of the goal.

    End:
        Terminated at success.

    Info:
        `distance` of the tool from the goal [m].
    """

    memory: Mapping[str, str] = {"goal": "goal"}
    action_labels = tuple(Label(f"d_{joint}", f"turn {joint}", "rad", "/ 0.05") for joint in JOINTS)
    observation_labels = (
        *(Label(joint, "joint position from the home pose", "rad", "- home", -4, 4) for joint in JOINTS),
        *(Label(f"target_{one}", "commanded joint position from measured", "rad", "/ 0.15", -2, 2) for one in JOINTS),
        *(Label(f"tool_{axis}", f"tool, {axis}", "m", "(from the middle of the goals) / 0.3", -4, 4) for axis in "xyz"),
        *(Label(f"goal_d{axis}", f"goal from the tool, {axis}", "m", "/ 0.3", -4, 4) for axis in "xyz"),
        *(Label(f"goal_near_d{axis}", f"goal from the tool, {axis}, near", "m", "/ 0.05, clipped") for axis in "xyz"),
    )

    robot_labels = observation_labels  # no tracker is needed, and the task gives the goal

    def __init__(self, num_envs: int = 1) -> None:
        self.num_envs = num_envs
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.goal = np.zeros((num_envs, 3))
        """Goals [m]. Shape: (n, 3)."""

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """Joint positions about `HOME`; a goal in `GOAL_AREA`."""
        draws = np.stack([rng.random(9) for rng in rngs])
        seeds = draw_seeds(rngs)
        self.goal[env_ids] = GOAL_AREA[0] + draws[:, 6:] * (GOAL_AREA[1] - GOAL_AREA[0])
        return Initial({"joint_position": HOME + START_NOISE * (2 * draws[:, :6] - 1)}, seeds)

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Do nothing: commands continue from the one that was actually sent last."""

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, 21) float32."""
        observation = np.concatenate(self.robot_columns(state), axis=1).astype(np.float32)
        return limited(observation, self.observation_space.low, self.observation_space.high)

    def robot_columns(self, state: RobotState) -> list[Array]:
        """See `robot_labels`: the observation, not clipped. Shape: (n, k) each."""
        joints = state.signals["joint_position"]
        tool = GEOMETRY.tool_position(joints)
        offset = self.goal - tool
        return [
            joints - HOME,
            (state.command[:, :6] - joints) / LEASH,
            (tool - GOAL_AREA.mean(axis=0)) / 0.3,
            offset / 0.3,
            offset / 0.05,
        ]

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joint positions [rad] within `TOOL_STEP` and `JOINT_STEP`, and the open gripper [m]. Shape: (n, 7)."""
        measured, sent = state.signals["joint_position"], state.command[:, :6]
        wanted = sent + limited(action, -1.0, 1.0).astype(np.float64) * JOINT_STEP
        wanted = limited(limited(wanted, measured - LEASH, measured + LEASH), _LOW, -_LOW)
        travel = wanted - sent
        travel *= np.minimum(1.0, 0.999 * JOINT_STEP / np.maximum(np.abs(travel).max(axis=1), 1e-9))[:, None]
        tool = GEOMETRY.tool_position(sent)
        for _ in range(3):
            step = GEOMETRY.tool_position(sent + travel) - tool
            length = np.sqrt(np.einsum("ij,ij->i", step, step))
            if length.max() <= TOOL_STEP:
                break
            travel *= np.where(length > TOOL_STEP, 0.99 * TOOL_STEP / np.maximum(length, 1e-9), 1.0)[:, None]
        sinks = (tool[:, 2] + step[:, 2] < LOWEST_TOOL) & (step[:, 2] < 0)
        joints = sent + np.where(sinks[:, None], 0.0, travel)
        return np.concatenate([joints, np.full((self.num_envs, 1), GRIPPER_OPEN)], axis=1)

    def action_for(self, command: Array, state: RobotState) -> Floats:
        """The action that leads to `command` (n, 7), or as far that way as it can. Shape: (n, 6)."""
        turn = (command[:, :6] - state.command[:, :6]) / JOINT_STEP
        action: Floats = (turn / np.maximum(1.0, np.abs(turn).max(axis=1, keepdims=True))).astype(np.float32)
        return action

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward proximity; success pays as much as staying at the goal."""
        offset = self.goal - GEOMETRY.tool_position(state.signals["joint_position"])
        distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        success = distance < GOAL_RADIUS
        reward = 0.2 * (1 - np.tanh(3 * distance)) + 10.0 * success
        return Score(reward, success, success, {"distance": distance})

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The goal."""
        return [(self.goal[0], (0.1, 0.7, 0.3, 0.6))]
