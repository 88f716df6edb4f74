"""From tool actions (dx, dy, dz, dyaw, grip) to joint commands, slow enough for a robot near people.

The actions move a tool *target*, not the measured tool, which sags and lags; the target stays within `LEASH` of the
measured tool and inside the workspace, and continues from the command that was actually sent if guards changed it.
The tool always points straight down, and the joints follow by the inverse kinematics of the arm's description. From one
command to the next the tool target moves at most `TOOL_STEP` and no joint more than `JOINT_STEP`.
"""

import math
from collections.abc import Mapping

import numpy as np

from bam_envs.arms.description import ArmDescription, robot_model
from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.task import Array, Floats, Label, Memory, limited

TOOL_STEP = 0.0124
"""Maximum motion of the tool target in 0.05 s [m]; the tool stays below 0.25 m/s, as in a UR's recovery mode."""
JOINT_STEP = 0.05
"""Maximum motion of a joint in a period of 0.05 s [rad]: 1.0 rad/s."""
YAW_STEP = 0.05
"""Maximum turn of the gripper in a period [rad]."""
LEASH = 0.03
"""Maximum distance of the tool target from the measured tool, along each axis [m]."""
YAW_LIMIT = 1.2  # farthest the gripper turns from straight ahead [rad]; a cube needs pi/4


class WorkSpace:
    """The work area of an arm on its table, and what observations are scaled by."""

    def __init__(self, description: ArmDescription) -> None:
        self.description, self.arm = description, description.arm
        self.box = np.array(description.workspace)
        """Box for the tool target: lowest and highest x, y, z [m]. Shape: (2, 3)."""
        self.middle, self.half = self.box.mean(axis=0), (self.box[1] - self.box[0]) / 2
        self.open: float = description.gripper.open
        """Width of the open gripper [m]."""
        self.turns: bool = description.chain.turns
        """Whether the gripper can be turned while it points down."""
        self.size = len(description.joints)

    @property
    def action_labels(self) -> tuple[Label, ...]:
        """Meaning of an action; an arm that cannot turn its gripper has no ``dyaw``."""
        labels = (
            Label("dx", "move the tool target forward", "m", "/ 0.0124"),
            Label("dy", "move the tool target to the left", "m", "/ 0.0124"),
            Label("dz", "move the tool target up", "m", "/ 0.0124"),
            Label("dyaw", "turn the gripper anticlockwise, seen from above", "rad", "/ 0.05"),
            Label("grip", "close the gripper when positive, open it otherwise", "1"),
        )
        return tuple(label for label in labels if self.turns or label.name != "dyaw")

    @property
    def hand_labels(self) -> tuple[Label, ...]:
        """Meaning of the first numbers of an observation."""
        (x, _, z), (half_x, half_y, half_z) = self.middle, self.half
        labels = (
            Label("tool_x", "tool, forward", "m", f"(x - {x:g}) / {half_x:g}", -2, 2),
            Label("tool_y", "tool, to the left", "m", f"y / {half_y:g}", -2, 2),
            Label("tool_z", "tool, above the table", "m", f"(z - {z:g}) / {half_z:g}", -2, 2),
            Label("target_dx", "tool target from the tool, forward", "m", "/ 0.03", -2, 2),
            Label("target_dy", "tool target from the tool, to the left", "m", "/ 0.03", -2, 2),
            Label("target_dz", "tool target from the tool, up", "m", "/ 0.03", -2, 2),
            Label("yaw", "gripper, anticlockwise from straight ahead", "rad", "/ 1.2", -2, 2),
            Label("target_dyaw", "commanded yaw from the measured one", "rad", "/ 0.05", -2, 2),
            Label("gripper_width", "opening of the gripper", "m", f"/ {self.open / 2:g} - 1", -2, 2),
            Label("grip", "1 when the gripper was told to close, else -1", "1"),
        )
        return tuple(label for label in labels if self.turns or label.name != "target_dyaw")

    @property
    def joint_labels(self) -> tuple[Label, ...]:
        """Meaning of the joints' positions."""
        return tuple(Label(joint, "joint position", "rad", "/ pi", -2, 2) for joint in self.description.joint_names)


_DEFAULT = WorkSpace(robot_model(DEFAULT_ARM))
ACTION_LABELS, HAND_LABELS = _DEFAULT.action_labels, _DEFAULT.hand_labels
"""Labels of the default arm."""


class ToolControl(Memory):
    """The commanded tool of n environments: target, yaw, commanded joints, gripper."""

    memory: Mapping[str, str] = {"target": "target", "yaw": "yaw", "closed": "closed", "joints": "_joints"}

    def __init__(self, num_envs: int, space: WorkSpace = _DEFAULT) -> None:
        self.space, self._arm = space, space.arm
        self._low, self._high = space.box
        self.target = np.zeros((num_envs, 3))
        """Tool target [m]. Shape: (n, 3)."""
        self.yaw = np.zeros(num_envs)
        """Commanded yaw [rad]. Shape: (n,)."""
        self.closed = np.zeros(num_envs, dtype=bool)
        """Whether the gripper was commanded to close. Shape: (n,)."""
        self._joints = np.zeros((num_envs, space.size))

    def start(self, env_ids: EnvIds, joints: Array) -> None:
        """Begin at the measured `joints` (k, joints) [rad] of these environments."""
        self._continue_from(env_ids, joints)
        self.closed[env_ids] = False

    def _continue_from(self, env_ids: EnvIds, joints: Array) -> None:
        position, x_axis = self._arm.tool_pose(joints)
        self.target, self.yaw, self._joints = self.target.copy(), self.yaw.copy(), self._joints.copy()
        self.target[env_ids], self.yaw[env_ids] = position, np.arctan2(x_axis[:, 1], x_axis[:, 0])
        self._joints[env_ids] = joints

    def command(self, action: Floats, tool: Array, sent: Array) -> Array:
        """Joint positions [rad] and gripper width [m] for an action, as `WorkSpace.action_labels` says.

        Args:
            action: In [-1, 1]. Shape: (n, 5), or (n, 4) without ``dyaw``.
            tool: Measured tool position [m]. Shape: (n, 3).
            sent: Joints that were actually sent last [rad]; if guards changed them, the target begins there.
                Shape: (n, joints).
        """
        if len(action) == 1:
            return self._command_one(action, tool, sent)
        changed = sent != self._joints
        if changed.any():
            held = np.flatnonzero(changed.any(axis=1))
            self._continue_from(held, sent[held])
        moves: Array = limited(action, -1.0, 1.0).astype(np.float64)
        target = limited(self.target + moves[:, :3] * TOOL_STEP, tool - LEASH, tool + LEASH)
        travel = limited(target, self._low, self._high) - self.target
        x, y, z = travel.T
        length = np.sqrt(x * x + z * z + y * y)
        travel = travel * np.minimum(1.0, TOOL_STEP / np.maximum(length, 1e-9))[:, None]
        turn = np.zeros(len(action))
        if self.space.turns:
            turn = limited(self.yaw + moves[:, 3] * YAW_STEP, -YAW_LIMIT, YAW_LIMIT) - self.yaw
        self._move(travel, turn)
        self.closed = action[:, -1] > 0
        width = np.where(self.closed, 0.0, self.space.open)
        return np.concatenate([self._joints, width[:, None]], axis=1)

    def _command_one(self, action: Floats, tool: Array, sent: Array) -> Array:
        """`command` of one environment: the same arithmetic in plain numbers, which take a third of the time."""
        if sent[0].tolist() != self._joints[0].tolist():
            self._continue_from(np.zeros(1, np.int64), sent)
        dx, dy, dz, *turns, grip = action[0].tolist()
        here, yaw, before = self.target[0].tolist(), self.yaw.item(), self._joints[0].tolist()
        travel = []
        rows = zip(here, (dx, dy, dz), tool[0].tolist(), self._low.tolist(), self._high.tolist(), strict=True)
        for at, move, measured, low, high in rows:
            target = _limited(at + _limited(move, -1.0, 1.0) * TOOL_STEP, measured - LEASH, measured + LEASH)
            travel.append(_limited(target, low, high) - at)
        x, y, z = travel
        part = min(1.0, TOOL_STEP / max(math.sqrt(x * x + z * z + y * y), 1e-9))
        travel = [way * part for way in travel]
        turn = _limited(yaw + _limited(turns[0], -1.0, 1.0) * YAW_STEP, -YAW_LIMIT, YAW_LIMIT) - yaw if turns else 0.0
        share = 1.0
        for _ in range(3):
            x, y, z = [at + way * share for at, way in zip(here, travel, strict=True)]
            joints = self._arm.joints_down(x, y, z, yaw + turn * share, before)
            fastest = max(1e-9, *(abs(one - begin) for one, begin in zip(joints, before, strict=True)))
            if fastest <= JOINT_STEP:
                break
            share *= 0.98 * JOINT_STEP / fastest
        else:
            part = min(1.0, JOINT_STEP / fastest)
            joints = [begin + (one - begin) * part for one, begin in zip(joints, before, strict=True)]
        self.target = np.array([[at + way * share for at, way in zip(here, travel, strict=True)]])
        self.yaw, self._joints = np.array([yaw + turn * share]), np.array([joints])
        self.closed = np.array([grip > 0])
        return np.array([[*joints, 0.0 if grip > 0 else self.space.open]])

    def _move(self, travel: Array, turn: Array) -> None:
        """Move target and joints by as much of `travel` and `turn` as the joint speed allows."""
        share = np.ones(len(turn))
        for _ in range(3):
            goal, yaw = self.target + travel * share[:, None], self.yaw + turn * share
            joints = self._arm.reach_down(goal, yaw, self._joints)
            fastest = np.maximum(np.abs(joints - self._joints).max(axis=1), 1e-9)
            if fastest.max() <= JOINT_STEP:
                break
            share *= np.where(fastest > JOINT_STEP, 0.98 * JOINT_STEP / fastest, 1.0)
        else:
            joints = self._joints + (joints - self._joints) * np.minimum(1.0, JOINT_STEP / fastest)[:, None]
        self.target = self.target + travel * share[:, None]
        self.yaw = self.yaw + turn * share
        self._joints = joints


def _limited(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def hand_state(state: RobotState, control: ToolControl, tool: Array, x_axis: Array) -> list[Array]:
    """The first numbers of an observation; see `WorkSpace.hand_labels`. Shape: (n, k) each."""
    yaw, space = np.arctan2(x_axis[:, 1], x_axis[:, 0]), control.space
    return [
        (tool - space.middle) / space.half,
        (control.target - tool) / LEASH,
        yaw[:, None] / YAW_LIMIT,
        *([(control.yaw - yaw)[:, None] / YAW_STEP] if space.turns else []),
        state.signals["gripper_width"] * (2 / space.open) - 1,
        np.where(control.closed, 1.0, -1.0)[:, None],
    ]
