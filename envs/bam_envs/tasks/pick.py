"""Pick: grasp a cube that lies anywhere in 30 x 40 cm with any yaw, lift it 10 cm and hold it for 0.25 s."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.arms.description import ArmDescription, cube_edge
from bam_envs.arms.description import robot_model as model_called
from bam_envs.core.kinematics import cube_yaw_phase
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.task import Array, Floats, Label, Memory, Score, draw_seeds, labelled_box, limited
from bam_envs.tasks.tool_control import ToolControl, WorkSpace, hand_state

HOLD_STEPS = 5
"""Steps for which it must be held there: 0.25 s at 20 Hz."""
TABLE_EDGE = -0.03
"""An object below this height has left the table [m]."""


class CubeTable(WorkSpace):
    """The table with the cube before an arm: where cube and tool begin, sized to the work area and the gripper."""

    def __init__(self, description: ArmDescription) -> None:
        super().__init__(description)
        length, height = self.half[0] / 0.2, self.box[1, 2] - self.box[0, 2]
        self.cube_area = np.round(self.box[:, :2] + np.array([[0.05], [-0.05]]) * length, 6)
        """Range of the cube at the start: lowest and highest x, y [m]. Shape: (2, 2)."""
        across = np.round(self.middle[:2] + np.array([[-0.05], [0.05]]) * length, 6)
        up = np.round(self.box[0, 2] + np.array([[0.154], [0.214]]) * height / 0.334, 6)
        self.start_area = np.concatenate([across, up], axis=1)
        """Range of the tool at the start: lowest and highest x, y, z [m]. Shape: (2, 3)."""
        self.edge = cube_edge(description.gripper.open, description.chain.turns)
        """Edge of the cube [m]."""
        self.near = round(0.75 * self.edge, 6)
        """The object is within the gripper's reach at this distance from the tool [m]."""
        self.lift = round(min(0.10, 0.6 * height), 3)
        """Height to which the cube must be lifted [m]."""

    @property
    def object_labels(self) -> tuple[Label, ...]:
        """Meaning of the object's numbers in an observation."""
        (x, _, _), (half_x, half_y, _) = self.middle, self.half
        return (
            Label("object_x", "object, forward", "m", f"(x - {x:g}) / {half_x:g}", -2, 2),
            Label("object_y", "object, to the left", "m", f"y / {half_y:g}", -2, 2),
            Label("object_lift", "object above where it lay", "m", f"/ {self.lift:g}", -2, 2),
            Label("object_dx", "object from the tool, forward", "m", "/ 0.1", -2, 2),
            Label("object_dy", "object from the tool, to the left", "m", "/ 0.1", -2, 2),
            Label("object_dz", "object from the tool, up", "m", "/ 0.1", -2, 2),
            Label(
                "object_yaw_cos", "cos(4 yaw) of the object seen from the gripper; a cube repeats every 90 degrees", "1"
            ),
            Label("object_yaw_sin", "sin(4 yaw) of the object seen from the gripper", "1"),
        )


class CubeSense:
    """Tool and cube in the last state, computed once for `observe`, `command` and `score`."""

    def __init__(self, state: RobotState, table: CubeTable) -> None:
        self.state = state
        self.tool, self.x_axis = table.arm.tool_pose(state.signals["joint_position"])
        self.object = state.signals["object_position"]
        self.offset = self.object - self.tool
        self.distance: Array = np.sqrt(np.einsum("ij,ij->i", self.offset, self.offset))


class PickTask(Memory):
    """Grasp the cube, lift it by 10 cm and hold it for `HOLD_STEPS`.

    Args:
        robot_model: The arm: the name of a description, or its file. Lengths below are for a UR5e; another arm has a
            work area, a cube and a lift of its own size, in the same proportions.

    Start:
        The tool is between x 0.45 and 0.55 m, y -0.05 and 0.05 m, z 0.17 and 0.23 m, pointing straight down, the
        gripper open. The cube (edge 4 cm) lies flat between x 0.35 and 0.65 m, y -0.20 and 0.20 m, with any yaw.

    Reward:
        Each step 0.1 (1 - tanh(5 d)), where d is the distance of the tool from the cube [m]; -0.05 while the
        gripper is commanded to close 3 cm or more from the cube; while the cube is squeezed between the pads, 0.1
        more, and 0.5 times the share of 10 cm that it is lifted. At success 30, about the reward of holding the
        cube up for the rest of the episode, so that ending early never costs; -5 when the cube leaves the table.

    Success:
        The cube is at least 10 cm above where it lay for 5 steps in a row (0.25 s).

    End:
        Terminated at success, and when the cube is lower than 3 cm below the table top: it has left the table.

    Info:
        `distance` of the tool from the cube [m], `lift` of the cube above where it lay [m].
    """

    memory: Mapping[str, str] = {"rest_height": "rest_height", "held": "held"}
    mirrored = frozenset(
        ("tool_y", "target_dy", "yaw", "target_dyaw", "object_y", "object_dy", "object_yaw_sin", "dy", "dyaw")
    )
    near_starts = 0.0
    """Share of the episodes after one that failed that begin near the cube, to train on."""
    moves_straight = True  # the tool, along straight lines: singularities count

    def __init__(self, num_envs: int = 1, *, robot_model: Any = DEFAULT_ARM) -> None:
        self.num_envs, self.table = num_envs, CubeTable(model_called(robot_model))
        self.arm = self.table.arm
        self.action_labels = self.table.action_labels
        self.observation_labels = self.labels(self.table)
        self.robot_labels = (*self.table.hand_labels, *self.table.joint_labels)
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.control = ToolControl(num_envs, self.table)
        self.rest_height = np.zeros(num_envs)
        """Height of the object where it lay [m]. Shape: (n,)."""
        self.held = np.zeros(num_envs, dtype=np.int64)
        """Number of steps in a row with the object high enough. Shape: (n,)."""
        self._sense: CubeSense | None = None

    @staticmethod
    def labels(table: CubeTable) -> tuple[Label, ...]:
        """Meaning of an observation at `table`."""
        return (*table.hand_labels, *table.object_labels)

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """A tool position above the table, a cube pose on it."""
        draws = np.stack([rng.random(6) for rng in rngs])
        seeds = draw_seeds(rngs)
        start, area = self.table.start_area, self.table.cube_area
        tool = start[0] + draws[:, :3] * (start[1] - start[0])
        cube = np.empty((len(env_ids), 3))
        cube[:, :2] = area[0] + draws[:, 3:5] * (area[1] - area[0])
        cube[:, 2] = (2 * draws[:, 5] - 1) * np.pi
        yaw = np.zeros(len(env_ids))
        if self.near_starts:
            near = self._near(np.stack([rng.random(5) for rng in rngs], axis=1), cube)
            begins_near = (self.held[env_ids] < HOLD_STEPS) & near[0]
            tool[begins_near], yaw[begins_near] = near[1][begins_near], near[2][begins_near]
        joints = self.table.arm.reach_down(tool, yaw)
        return Initial({"joint_position": joints, "object_pose": cube}, seeds)

    def _near(self, draws: Array, cube: Array) -> tuple[Any, Array, Array]:
        """Whether an episode may begin near the cube; tool [m] and yaw [rad] of the open gripper there.

        It is around the cube, above it, or low and to a side, from where a policy must go up first; nothing touches it.
        The higher it is, the farther its yaw may be from the cube's.
        """
        chosen, height, aside, direction, turned = draws
        edge, angle, (low, high) = self.table.edge, 2 * np.pi * direction, self.table.box
        offset = 4 * edge * aside * np.stack([np.cos(angle), np.sin(angle)])
        place = limited(cube[:, :2] + offset.T, low[:2], high[:2])
        away = np.hypot(*(place - cube[:, :2]).T)
        is_beside = (away > 0.25 * edge) & (away < 2.25 * edge)
        up = edge * (0.5 + np.maximum(2.5 * height, 0.85 * is_beside))
        tool = np.column_stack([place, limited(up, low[2], high[2])])
        yaw = (cube[:, 2] + np.pi / 4) % (np.pi / 2) - np.pi / 4
        return chosen < self.near_starts, tool, yaw * (1 - height * turned)

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Record the measured joints and the height of the object."""
        self.control.start(env_ids, state.signals["joint_position"][env_ids])
        self.rest_height[env_ids] = state.signals["object_position"][env_ids, 2]
        self.held[env_ids] = 0

    def sense(self, state: RobotState) -> CubeSense:
        """Tool and cube of `state`, computed once."""
        if self._sense is None or self._sense.state is not state:
            self._sense = CubeSense(state, self.table)
        return self._sense

    def lift(self, sense: CubeSense) -> Array:
        """Height of the object above its start [m]. Shape: (n,)."""
        return sense.object[:, 2] - self.rest_height

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, k) float32."""
        observation = np.concatenate(self._columns(state), axis=1).astype(np.float32)
        return limited(observation, self.observation_space.low, self.observation_space.high)

    def _columns(self, state: RobotState) -> list[Array]:
        """Hand and cube, not clipped. Shape: (n, k) each."""
        sense = self.sense(state)
        # exp(4 i (yaw of the cube - yaw of the gripper))
        axis: Any = sense.x_axis[:, 0] - 1j * sense.x_axis[:, 1]
        phase = cube_yaw_phase(state.signals["object_quaternion"]) * (axis * axis) ** 2
        return [
            *hand_state(state, self.control, sense.tool, sense.x_axis),
            (sense.object[:, :2] - self.table.middle[:2]) / self.table.half[:2],
            self.lift(sense)[:, None] / self.table.lift,
            sense.offset / 0.1,
            phase.real[:, None],
            phase.imag[:, None],
        ]

    def robot_columns(self, state: RobotState) -> list[Array]:
        """See `robot_labels`: what the robot itself measures, not clipped. Shape: (n, k) each."""
        sense = self.sense(state)
        hand = hand_state(state, self.control, sense.tool, sense.x_axis)
        return [*hand, state.signals["joint_position"] / np.pi]

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joint positions [rad] and gripper width [m]. Shape: (n, joints + 1)."""
        width, self.control.width = state.signals["gripper_width"], state.command[:, -1]
        return self.control.command(action, self.sense(state).tool, state.command[:, :-1], width)

    def grasped(self, sense: CubeSense) -> Any:
        """Whether the closed gripper is stopped by the object between its pads. Shape: (n,) bool."""
        width = sense.state.signals["gripper_width"][:, 0]
        edge = self.table.edge
        return self.control.closed & (width > 0.6 * edge) & (width < 1.6 * edge) & (sense.distance < self.table.near)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward proximity to the cube, squeezing it and lifting it; success pays as much as holding it."""
        sense = self.sense(state)
        lift, grasped = self.lift(sense), self.grasped(sense)
        self.held = np.where(lift >= self.table.lift, self.held + 1, 0)
        success = self.held >= HOLD_STEPS
        fallen = sense.object[:, 2] < TABLE_EDGE
        early = self.control.closed & (sense.distance > self.table.near)
        reward = (
            0.1 * (1 - np.tanh(5 * sense.distance))
            - 0.05 * early
            + grasped * (0.1 + 0.5 * limited(lift / self.table.lift, 0.0, 1.0))
        )
        reward = reward + 30.0 * success - 5.0 * fallen
        return Score(reward, success | fallen, success, {"distance": sense.distance, "lift": lift})

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """None beyond the scene."""
        return []

    def state_dict(self) -> dict[str, Any]:
        """A copy of the arrays, and of those of the tool's control."""
        return {"control": self.control.state_dict(), **super().state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        super().load_state_dict(state)
        self.control.load_state_dict(state["control"])
