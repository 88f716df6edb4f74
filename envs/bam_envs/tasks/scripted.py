"""Hand-written policies that solve the MuJoCo tasks from their observations alone, as a reference.

They have no memory, so they act on any number of observations in any order, like a frozen policy.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bam_envs.arms.description import ArmDescription, robot_model
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.task import Array, Flags, Floats, Label
from bam_envs.tasks.grasping.scripted_grasps import ScriptedGrasps
from bam_envs.tasks.pick import CubeTable, PickTask
from bam_envs.tasks.pick_place import CARRY, PickPlaceTask
from bam_envs.tasks.reach import GoalSpace, ReachTask
from bam_envs.tasks.tool_control import JOINT_STEP, LEASH, TOOL_STEP, YAW_STEP

HOVER = 0.08  # height above the object from which the tool approaches [m]
DAMPING = 0.05  # keeps the joints slow when the arm is nearly stretched [m/rad]
PUT_DOWN = 0.004  # an object lower than this is released [m]
Take = Callable[..., Array]
"""Returns the numbers of the observations with these names, side by side. Shape: (n, names)."""


class ScriptedPolicy:
    """The part of a frozen policy that evaluation uses; `act` computes the actions (n, a) from named observations."""

    def __init__(self, labels: Sequence[Label], act: Callable[[Take], Floats]) -> None:
        self._columns, self._act = {label.name: column for column, label in enumerate(labels)}, act

    def act_batch(self, observations: Floats) -> Floats:
        """Actions for n observations. Shapes: (n, k) -> (n, a)."""
        return self._act(lambda *names: observations[:, [self._columns[name] for name in names]].astype(np.float64))

    def reset(self, env_ids: Sequence[int] | None = None) -> None:
        """Do nothing: there is no memory."""


def reach(take: Take, space: GoalSpace) -> Floats:
    """Turn the joints along the damped pseudo-inverse of the arm's Jacobian."""
    position = space.arm.tool_position
    joints = take(*space.description.joint_names) + space.home
    offset = 0.3 * take("goal_dx", "goal_dy", "goal_dz")
    step = 1e-6 * np.eye(joints.shape[1])
    ahead = [position(joints + one) - position(joints - one) for one in step]
    jacobian = np.stack(ahead, axis=2) / 2e-6  # of the tool position [m/rad]; shape (n, 3, joints)
    square = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING**2 * np.eye(3)
    turn = (jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, offset[:, :, None]))[:, :, 0]
    actions: Floats = (turn / np.maximum(np.abs(turn).max(axis=1, keepdims=True), JOINT_STEP)).astype(np.float32)
    return actions


class Sight:
    """Hand and object in the observations of n environments, in SI units."""

    def __init__(self, take: Take, table: CubeTable) -> None:
        self.table = table
        self.offset = 0.1 * take("object_dx", "object_dy", "object_dz")  # object from the tool [m] (n, 3)
        self.lead = LEASH * take("target_dx", "target_dy", "target_dz")  # tool target from the tool [m] (n, 3)
        self.lift = table.lift * take("object_lift")[:, 0]  # object above where it lay [m] (n,)
        cosine, sine = take("object_yaw_cos", "object_yaw_sin").T
        self.turn: Array = (
            np.arctan2(sine, cosine) / 4 * table.turns
        )  # object's yaw from the gripper's, the nearest of four [rad]
        grip, width = take("grip", "gripper_width").T
        # Whether the gripper was commanded to close on the object, and whether it stopped at the object's width. (n,)
        self.closed: Flags = (grip > 0) & (np.linalg.norm(self.offset, axis=1) < table.near)
        self.holding: Flags = self.closed & (width < 0.1)


def grasp(sight: Sight) -> tuple[Array, Array, Array]:
    """Approach the object from above through a funnel, with the gripper aligned, and close.

    Returns the motion of the tool target [m] (n, 3), its turn [rad] (n,), and 1 to close or -1 to open (n,).
    """
    across = np.hypot(sight.offset[:, 0], sight.offset[:, 1])
    astray = np.maximum((across - 0.007) / 0.015, (np.abs(sight.turn) - 0.08) / 0.15)
    low = (astray < 0.3) & (np.abs(sight.offset[:, 2]) < 0.01)
    travel = sight.offset - sight.lead
    travel[:, 2] += HOVER * np.clip(astray, 0.0, 1.0)
    travel[sight.closed] = 0.0
    grip = np.where(low | sight.closed, 1.0, -1.0)
    return travel, np.where(sight.closed, 0.0, sight.turn), grip


def tool_actions(travel: Array, turn: Array, grip: Array, table: CubeTable) -> Floats:
    """Actions (n, a) that move the tool target by `travel` [m] and `turn` [rad], at most one step."""
    turns = [turn[:, None] / YAW_STEP] if table.turns else []
    actions = np.concatenate([travel / TOOL_STEP, *turns, grip[:, None]], axis=1)
    clipped: Floats = np.clip(actions, -1.0, 1.0).astype(np.float32)
    return clipped


def pick(take: Take, table: CubeTable) -> Floats:
    """Grasp the cube and lift it."""
    sight = Sight(take, table)
    travel, turn, grip = grasp(sight)
    travel[sight.holding] = (0.0, 0.0, 1.0)
    return tool_actions(travel, turn, grip, table)


def pick_place(take: Take, table: CubeTable) -> Floats:
    """Grasp the cube, carry it to the goal, put it down and let go."""
    sight, goal = Sight(take, table), 0.2 * take("goal_dx", "goal_dy")
    travel, turn, grip = grasp(sight)
    over = np.hypot(goal[:, 0], goal[:, 1]) < 0.006
    travel[sight.holding] = carry(sight, goal, over)[sight.holding]
    there = (np.hypot(goal[:, 0], goal[:, 1]) < 0.015) & (sight.lift < PUT_DOWN)
    done = there & (~sight.closed | over)
    travel[done], turn[done], grip[done] = 0.0, 0.0, -1.0
    return tool_actions(travel, turn, grip, table)


def carry(sight: Sight, goal: Array, over: Flags) -> Array:
    """Motion of the tool target with the object grasped: up, across to `goal` (n, 2) [m], down. Shape: (n, 3) [m]."""
    height = np.where(over, 0.0, CARRY)
    travel = np.concatenate([goal - sight.lead[:, :2], (height - sight.lift)[:, None]], axis=1)
    travel[:, :2] *= (over | (sight.lift > 0.6 * CARRY))[:, None]
    travel[:, 2] = np.clip(travel[:, 2], -0.4 * TOOL_STEP, TOOL_STEP)
    return travel


SCRIPTED: dict[str, tuple[type[Any], Callable[[ArmDescription], Any], Callable[[Take, Any], Floats]]] = {
    "bam/reach-v0": (ReachTask, GoalSpace, reach),
    "bam/pick-v0": (PickTask, CubeTable, pick),
    "bam/pick-place-v0": (PickPlaceTask, CubeTable, pick_place),
}
"""Task, space and action function of each arm's environment that has a scripted policy."""
GRASP = "bam/grasp-xyr-v0"


def scripted_policy(env_id: str, arm: Any = DEFAULT_ARM) -> ScriptedPolicy | ScriptedGrasps:
    """The scripted policy for `env_id` with the arm of that name; see `bam_envs.arms.description.robot_model`.

    Raises:
        InvalidValue: The environment has none.
        UnknownName: There is no such environment, or no such arm.
    """
    known = (*SCRIPTED, GRASP)
    if env_id in ENVIRONMENTS and env_id not in known:
        raise InvalidValue(f"{env_id} has no scripted policy. These have one: {', '.join(known)}.")
    if env_id not in known:
        raise UnknownName("scripted policy", env_id, known)
    if env_id == GRASP:
        return ScriptedGrasps()
    task, kind, act = SCRIPTED[env_id]
    space = kind(robot_model(arm))
    return ScriptedPolicy(task.labels(space), lambda take: act(take, space))
