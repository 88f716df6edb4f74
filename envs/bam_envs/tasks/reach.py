"""Reach: bring the tool within 2 cm of a point, with actions that turn the joints; and joints, without a goal.

`JointsTask` takes positions of the joints, as policies do that were trained elsewhere.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from gymnasium import spaces
from msgspec import Meta

from bam_envs.arms.description import ArmDescription
from bam_envs.arms.description import robot_model as model_called
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.task import Array, Floats, Label, Memory, Score, draw_seeds, labelled_box, limited, unscored
from bam_envs.core.validation import check
from bam_envs.tasks.tool_control import FASTEST, JOINT_STEP, PACE, PERIOD, JointPace, WorkSpace

START_NOISE = 0.1
"""The start differs from the home pose by at most this much in each joint [rad]."""
GOAL_RADIUS = 0.02  # the tool has arrived within this distance of the goal [m]
JOINT_MARGIN = 0.1  # commands stay this far from the joint limits [rad]
LEASH = 0.15
"""Farthest distance of the commanded joints from the measured ones [rad]."""

Rate = Annotated[float, Meta(ge=5, le=100, description="a number of actions a second from 5 to 100")]
WIDTH = "gripper_width"
"""Name of the gripper's number in observations, actions and commands."""


class GoalSpace(WorkSpace):
    """The work area of an arm with the goals of the tool, which are in it, somewhat to its sides and above it."""

    def __init__(self, description: ArmDescription) -> None:
        super().__init__(description)
        (x, _, z), (far, side, top) = self.box
        rise = (top - z) / 0.334
        self.home = np.array(description.home)
        """Joint positions about which an episode begins [rad]. Shape: (k,)."""
        low, high = [x, -1.2 * side, z + 0.084 * rise], [x + 0.875 * (far - x), 1.2 * side, z + 0.434 * rise]
        self.goals = np.round([low, high], 6)
        """Range of the goals: lowest and highest x, y, z [m]. Shape: (2, 3)."""
        self.lowest = round(z + 0.024 * rise, 6)
        """Commands that would bring the tool lower than this are not followed [m]."""
        rows = description.joints
        self.low = np.array([row.low for row in rows]) + JOINT_MARGIN
        self.high = np.array([row.high for row in rows]) - JOINT_MARGIN


class ReachTask(Memory):
    """Bring the tool within `GOAL_RADIUS` of a goal.

    Args:
        robot_model: The arm: the name of a description, or its file. Lengths below are for a UR5e; another arm has
            goals in its own work area, in the same proportions.

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

    memory: Mapping[str, str] = {"goal": "goal", "sent": "_sent"}

    def __init__(self, num_envs: int = 1, *, robot_model: Any = DEFAULT_ARM) -> None:
        self.num_envs, self.space = num_envs, GoalSpace(model_called(robot_model))
        self.arm = self.space.arm
        joints = self.space.description.joint_names
        self.action_labels = tuple(Label(f"d_{joint}", f"turn {joint}", "rad", "/ 0.05") for joint in joints)
        self.observation_labels = self.labels(self.space)
        self.robot_labels = self.observation_labels  # no tracker is needed, and the task gives the goal
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.goal = np.zeros((num_envs, 3))
        """Goals [m]. Shape: (n, 3)."""
        self._pace, self._sent = JointPace(self.space.description), np.zeros((num_envs, self.space.size))
        self._fastest = FASTEST

    @staticmethod
    def labels(space: GoalSpace) -> tuple[Label, ...]:
        """Meaning of an observation."""
        names = space.description.joint_names
        middle = "(from the middle of the goals) / 0.3"
        return (
            *(Label(one, "joint position from the home pose", "rad", "- home", -4, 4) for one in names),
            *(
                Label(f"target_{one}", "commanded joint position from measured", "rad", "/ 0.15", -2, 2)
                for one in names
            ),
            *(Label(f"tool_{axis}", f"tool, {axis}", "m", middle, -4, 4) for axis in "xyz"),
            *(Label(f"goal_d{axis}", f"goal from the tool, {axis}", "m", "/ 0.3", -4, 4) for axis in "xyz"),
            *(
                Label(f"goal_near_d{axis}", f"goal from the tool, {axis}, near", "m", "/ 0.05, clipped")
                for axis in "xyz"
            ),
        )

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """Joint positions about the home pose; a goal."""
        size, goals = self.space.size, self.space.goals
        draws = np.stack([rng.random(size + 3) for rng in rngs])
        seeds = draw_seeds(rngs)
        self.goal[env_ids] = goals[0] + draws[:, size:] * (goals[1] - goals[0])
        return Initial({"joint_position": self.space.home + START_NOISE * (2 * draws[:, :size] - 1)}, seeds)

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """The arm is at rest; commands continue from the one that was actually sent last."""
        self._sent = self._sent.copy()
        self._sent[env_ids] = state.command[env_ids, :-1]

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, 2 joints + 9) float32."""
        observation = np.concatenate(self.robot_columns(state), axis=1).astype(np.float32)
        return limited(observation, self.observation_space.low, self.observation_space.high)

    def robot_columns(self, state: RobotState) -> list[Array]:
        """See `robot_labels`: the observation, not clipped. Shape: (n, k) each."""
        joints = state.signals["joint_position"]
        tool = self.space.arm.tool_position(joints)
        offset = self.goal - tool
        return [
            joints - self.space.home,
            (state.command[:, :-1] - joints) / LEASH,
            (tool - self.space.goals.mean(axis=0)) / 0.3,
            offset / 0.3,
            offset / 0.05,
        ]

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joints [rad] as fast as tool and `JointPace` allow, and the open gripper [m]. Shape: (n, joints + 1)."""
        measured, sent = state.signals["joint_position"], state.command[:, :-1]
        before = limited(sent - self._sent, -self._pace.step, self._pace.step)
        wanted = sent + limited(action, -1.0, 1.0).astype(np.float64) * JOINT_STEP
        wanted = limited(limited(wanted, measured - LEASH, measured + LEASH), self.space.low, self.space.high)
        travel = self._pace.speed(wanted - sent) * (wanted - sent)
        travel = before + self._pace.change(travel, before) * (travel - before)
        tool = self.space.arm.tool_position(sent)
        for _ in range(3):
            step = self.space.arm.tool_position(sent + travel) - tool
            length = np.sqrt(np.einsum("ij,ij->i", step, step))
            if length.max() <= self._fastest:
                break
            travel *= np.where(length > self._fastest, 0.99 * self._fastest / np.maximum(length, 1e-9), 1.0)[:, None]
        sinks = (tool[:, 2] + step[:, 2] < self.space.lowest) & (step[:, 2] < 0)
        joints = sent + np.where(sinks[:, None], 0.0, travel)
        self._sent = sent
        return np.concatenate([joints, np.full((self.num_envs, 1), self.space.open)], axis=1)

    def action_for(self, command: Array, state: RobotState) -> Floats:
        """The action that leads to `command` (n, joints + 1), or as far that way as it can. Shape: (n, joints)."""
        turn = (command[:, :-1] - state.command[:, :-1]) / JOINT_STEP
        action: Floats = (turn / np.maximum(1.0, np.abs(turn).max(axis=1, keepdims=True))).astype(np.float32)
        return action

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward proximity; success pays as much as staying at the goal."""
        offset = self.goal - self.space.arm.tool_position(state.signals["joint_position"])
        distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        success = distance < GOAL_RADIUS
        reward = 0.2 * (1 - np.tanh(3 * distance)) + 10.0 * success
        return Score(reward, success, success, {"distance": distance})

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The goal."""
        return [(self.goal[0], (0.1, 0.7, 0.3, 0.6))]


class JointsTask(ReachTask):
    """Follow positions of the joints and of the gripper; what is done with them is up to the policy.

    Args:
        robot_model: The arm: the name of a description, or its file.
        rate: Actions in a second, 5 to 100.

    Start:
        Each joint is within 0.1 rad of the home pose.

    Action:
        Positions of the joints [rad] and width of the gripper [m], followed with at most 0.24 m/s of the tool, no lower
        than the work area.

    Reward:
        0.

    Success:
        Not known: infos have no ``is_success``.

    End:
        Never.

    Info:
        Nothing.
    """

    memory: Mapping[str, str] = {"sent": "_sent"}
    says_success = False

    def __init__(self, num_envs: int = 1, *, robot_model: Any = DEFAULT_ARM, rate: float = 1 / PERIOD) -> None:
        super().__init__(num_envs, robot_model=robot_model)
        description, period = self.space.description, 1 / check(rate, Rate, "rate= of bam/joints")
        self._pace, self._fastest = JointPace(description, period), FASTEST * period / PERIOD
        self.space.lowest = float(self.space.box[0, 2])
        self.action_labels = (
            *(Label(one.name, "joint position", "rad", low=one.low, high=one.high) for one in description.joints),
            Label(WIDTH, "opening of the gripper", "m", low=0.0, high=self.space.open),
        )
        self._slide = PACE * period * description.gripper.speed
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
        return unscored(self.num_envs)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """None beyond the scene."""
        return []
