"""From tool actions (dx, dy, dz, dyaw, grip) to commands of joints and gripper, as smooth as the guards ask for.

The actions move a tool *target*, not the measured tool, which sags and lags; the target stays within `LEASH` of the
measured tool and inside the workspace, and continues from the command that was actually sent if guards changed it.
The tool always points straight down, and the joints follow by the inverse kinematics of the arm's description. Target
and joints gain and lose speed together (`JointPace`), along a straight line: a joint at its limit slows down all.
"""

import math
from collections.abc import Mapping

import numpy as np

from bam_envs.arms.description import ArmDescription, robot_model
from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.task import Array, Floats, Label, Memory, limited
from bam_envs.core.timing import CLOSEST
from bam_envs.safety.arm_guards import SHARE_AT_ONCE
from bam_envs.safety.guard import Limits

PERIOD = 0.05
"""Time between two commands [s]."""
PACE = CLOSEST
"""Share of a limit that commands use: the guards hold a command that is sent 2 ms early to a period of 48 ms, and an
acceleration to its square."""
FASTEST = PACE * PERIOD * Limits().tool_speed
"""Maximum motion of the tool target in a period [m]; the tool stays below 0.25 m/s, as in a UR's recovery mode."""
TOOL_STEP = 0.0124
"""Motion of the tool target that an action of 1 asks for [m]."""
JOINT_STEP = 0.05
"""Turn of a joint that an action of 1 asks for [rad]."""
YAW_STEP = 0.05
"""Turn of the gripper that an action of 1 asks for [rad]."""
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


class JointPace:
    """Brings steps of the joints within speed, acceleration and jerk, so that the guards of a live arm change nothing.

    A limit is the lower one of the description and of the default guards. An acceleration is reached within a period,
    so the jerk limits it too. The guards take each command for the last one: a step is so short that the arm can stop
    at its end.

    Args:
        description: The arm.
        period: Time between two commands [s].
    """

    def __init__(self, description: ArmDescription, period: float = PERIOD) -> None:
        usual, rows = Limits(), description.joints
        gains = [min(row.acceleration, row.jerk * period, usual.joint_acceleration) for row in rows]
        speeds = [SHARE_AT_ONCE * min(row.velocity, usual.joint_speed) for row in rows]
        self.change_limit = (PACE * period) ** 2 * np.array(gains)
        """Greatest change of a step [rad]. Shape: (k,)."""
        braking = (PACE * period) ** 2 * usual.joint_acceleration
        self.step = np.minimum(PACE * period * np.array(speeds), braking)
        """Longest step [rad]. Shape: (k,)."""
        self.brakes = float(min(1.0, (self.change_limit / self.step).min()))
        """Share of the distance from an end of the work area that a step may cover: the arm can stop there."""

    def speed(self, way: Array) -> Array:
        """The share of the steps `way` (n, k) that is slow enough for all joints. Shape: (n, 1)."""
        share: Array = 1.0 / np.maximum(1.0, (np.abs(way) / self.step).max(axis=1))
        return share[:, None]

    def room(self, way: Array, more: Array) -> Array:
        """The share of `more` (n, k) that is slow enough in addition to the steps `way`, which are. Shape: (n, 1)."""
        left = np.maximum(0.0, np.where(more < 0.0, self.step + way, self.step - way))
        share: Array = 1.0 / np.maximum(1.0, (np.abs(more) / np.maximum(left, 1e-12)).max(axis=1))
        return share[:, None]

    def change(self, way: Array, before: Array) -> Array:
        """The share of the change from the steps `before` (n, k) to `way` that all joints can make. Shape: (n, 1)."""
        share: Array = 1.0 / np.maximum(1.0, (np.abs(way - before) / self.change_limit).max(axis=1))
        return share[:, None]


class ToolControl(Memory):
    """The commanded tool of n environments: target, yaw, commanded joints and their last changes, gripper."""

    memory: Mapping[str, str] = {
        "target": "target",
        "yaw": "yaw",
        "closed": "closed",
        "joints": "_joints",
        "travel": "_travel",
        "turn": "_turn",
        "step": "_step",
        "width": "width",
    }

    def __init__(self, num_envs: int, space: WorkSpace = _DEFAULT) -> None:
        self.space, self._arm = space, space.arm
        self._low, self._high = space.box
        self._pace, self._slide = JointPace(space.description), PACE * PERIOD * space.description.gripper.speed
        self.target = np.zeros((num_envs, 3))
        """Tool target [m]. Shape: (n, 3)."""
        self.yaw = np.zeros(num_envs)
        """Commanded yaw [rad]. Shape: (n,)."""
        self.closed = np.zeros(num_envs, dtype=bool)
        """Whether the gripper was commanded to close. Shape: (n,)."""
        self.width = np.zeros(num_envs)
        """Width of the gripper that was sent last [m]; a task whose guards may change it sets it. Shape: (n,)."""
        self._joints = np.zeros((num_envs, space.size))
        # Changes of target, yaw and joints by the last command.
        self._travel, self._turn, self._step = np.zeros((num_envs, 3)), np.zeros(num_envs), np.zeros_like(self._joints)

    def start(self, env_ids: EnvIds, joints: Array) -> None:
        """Begin at rest at the measured `joints` (k, joints) [rad] of these environments."""
        self._continue_from(env_ids, joints)
        self._travel[env_ids], self._turn[env_ids], self._step[env_ids] = 0.0, 0.0, 0.0
        self.closed[env_ids], self.width[env_ids] = False, self.space.open

    def _continue_from(self, env_ids: EnvIds, joints: Array) -> None:
        """Begin at `joints` (k, joints) [rad], which were sent after the last but one command."""
        self.own_memory()
        position, x_axis = self._arm.tool_pose(joints)
        yaw = np.arctan2(x_axis[:, 1], x_axis[:, 0])
        for now, change, most, value in (
            (self.target, self._travel, TOOL_STEP, position),
            (self.yaw, self._turn, YAW_STEP, yaw),
            (self._joints, self._step, self._pace.step, joints),
        ):
            change[env_ids] = limited(value - (now - change)[env_ids], -most, most)
            now[env_ids] = value

    def command(self, action: Floats, tool: Array, sent: Array, width: Array | None = None) -> Array:
        """Joint positions [rad] and gripper width [m] for an action, as `WorkSpace.action_labels` says.

        Args:
            action: In [-1, 1]. Shape: (n, 5), or (n, 4) without ``dyaw``.
            tool: Measured tool position [m]. Shape: (n, 3).
            sent: Joints that were actually sent last [rad]; if guards changed them, the target begins there.
                Shape: (n, joints).
            width: Measured width of the gripper [m], around an object more than the commanded one; that by default.
                Shape: (n, 1).
        """
        width = self.width[:, None] if width is None else width
        if len(action) == 1:
            return self._command_one(action, tool, sent, width)
        changed = sent != self._joints
        if changed.any():
            held = np.flatnonzero(changed.any(axis=1))
            self._continue_from(held, sent[held])
        moves: Array = limited(action, -1.0, 1.0).astype(np.float64)
        travel = limited(self.target + moves[:, :3] * TOOL_STEP, tool - LEASH, tool + LEASH) - self.target
        brakes = self._pace.brakes
        travel = limited(travel, brakes * (self._low - self.target), brakes * (self._high - self.target))
        x, y, z = travel.T
        length = np.sqrt(x * x + z * z + y * y)
        travel = travel * np.minimum(1.0, FASTEST / np.maximum(length, 1e-9))[:, None]
        turn = np.zeros(len(action))
        if self.space.turns:
            turn = limited(self.yaw + moves[:, 3] * YAW_STEP, -YAW_LIMIT, YAW_LIMIT) - self.yaw
        way = self._arm.reach_down(self.target + travel, self.yaw, self._joints) - self._joints
        speed = self._pace.speed(way)
        travel, way = speed * travel, speed * way
        if self.space.turns:  # the gripper turns as fast as the motion of the tool leaves room for
            more = self._arm.reach_down(self.target + travel, self.yaw + turn, self._joints) - self._joints - way
            room = self._pace.room(way, more)
            way, turn = way + room * more, room[:, 0] * turn
        change = self._pace.change(way, self._step)
        self._step = self._step + change * (way - self._step)
        self._travel = self._travel + change * (travel - self._travel)
        self._turn = self._turn + change[:, 0] * (turn - self._turn)
        self._joints = self._joints + self._step
        self._travel = limited(self.target + self._travel, self._low, self._high) - self.target
        self.target, self.yaw = self.target + self._travel, self.yaw + self._turn
        self.closed = action[:, -1] > 0
        fingers, last = width[:, 0], self.width
        low, high = np.minimum(fingers, last) - self._slide, np.maximum(fingers, last) + self._slide
        self.width = limited(np.where(self.closed, 0.0, self.space.open), low, high)
        return np.concatenate([self._joints, self.width[:, None]], axis=1)

    def _command_one(self, action: Floats, tool: Array, sent: Array, width: Array) -> Array:
        """`command` of one environment: the same arithmetic in plain numbers, which take a third of the time."""
        if sent[0].tolist() != self._joints[0].tolist():
            self._continue_from(np.zeros(1, np.int64), sent)
        dx, dy, dz, *turns, grip = action[0].tolist()
        here, yaw, joints = self.target[0].tolist(), self.yaw.item(), self._joints[0].tolist()
        travel, lows, highs = [], self._low.tolist(), self._high.tolist()
        brakes = self._pace.brakes
        for at, move, measured, low, high in zip(here, (dx, dy, dz), tool[0].tolist(), lows, highs, strict=True):
            way = _limited(at + _limited(move, -1.0, 1.0) * TOOL_STEP, measured - LEASH, measured + LEASH) - at
            travel.append(_limited(way, brakes * (low - at), brakes * (high - at)))
        x, y, z = travel
        part = min(1.0, FASTEST / max(math.sqrt(x * x + z * z + y * y), 1e-9))
        travel, turn, steps = [way * part for way in travel], 0.0, self._pace.step.tolist()

        def ways(turn: float) -> list[float]:
            x, y, z = [at + way for at, way in zip(here, travel, strict=True)]
            goal = self._arm.joints_down(x, y, z, yaw + turn, joints)
            return [one - at for one, at in zip(goal, joints, strict=True)]

        way = ways(0.0)
        speed = 1.0 / max(1.0, *(abs(one) / step for one, step in zip(way, steps, strict=True)))
        travel, way = [speed * one for one in travel], [speed * one for one in way]
        if turns:
            turn = _limited(yaw + _limited(turns[0], -1.0, 1.0) * YAW_STEP, -YAW_LIMIT, YAW_LIMIT) - yaw
            more = [both - one for both, one in zip(ways(turn), way, strict=True)]
            left = [
                max(0.0, step + one if add < 0.0 else step - one)
                for one, add, step in zip(way, more, steps, strict=True)
            ]
            room = 1.0 / max(1.0, *(abs(add) / max(free, 1e-12) for add, free in zip(more, left, strict=True)))
            way, turn = [one + room * add for one, add in zip(way, more, strict=True)], room * turn
        before, limits = self._step[0].tolist(), self._pace.change_limit.tolist()
        rows = zip(way, before, limits, strict=True)
        change = 1.0 / max(1.0, *(abs(one - old) / limit for one, old, limit in rows))

        def paced(way: list[float], before: list[float]) -> list[float]:
            return [old + change * (one - old) for one, old in zip(way, before, strict=True)]

        way, travel = paced(way, before), paced(travel, self._travel[0].tolist())
        [turn] = paced([turn], [self._turn.item()])
        places = zip(here, travel, lows, highs, strict=True)
        travel = [_limited(at + one, low, high) - at for at, one, low, high in places]
        joints = [at + one for at, one in zip(joints, way, strict=True)]
        self._step, self._travel, self._turn = np.array([way]), np.array([travel]), np.array([turn])
        self.target = np.array([[at + one for at, one in zip(here, travel, strict=True)]])
        self.yaw, self._joints, self.closed = np.array([yaw + turn]), np.array([joints]), np.array([grip > 0])
        fingers, last, wanted = width.item(), self.width.item(), 0.0 if grip > 0 else self.space.open
        opened = _limited(wanted, min(fingers, last) - self._slide, max(fingers, last) + self._slide)
        self.width = np.array([opened])
        return np.array([[*joints, opened]])


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
