"""UR reach: bring the flange of a UR arm to a point; robo-gym's EndEffectorPositioningUR."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bam_envs.core.env_options import finite_numbers
from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Flags, Floats, Label, Score
from bam_envs.core.validation import check
from bam_envs.robots.ur import UrModel
from bam_envs.tasks.ur_arm import (
    AboveZero,
    UrTask,
    collisions,
    in_frame,
    joint_labels,
    joint_option,
    normalised,
    wire_states,
)

START = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)
"""Joint positions at the start of an episode [rad]."""
START_OFFSET = np.array([1.5, 0.25, 0.5, 1.0, 0.4, 3.14])
"""With `randomize_start`, maximum distance of each joint from `START` [rad]."""
WRIST_1_RANGE = (-3.48, 0.31)
"""With `restrict_wrist_1`, the range of its action [rad], in which it does not fold back onto the forearm."""
NEAR = 0.1  # the flange has arrived within this distance of the target [m]
FAR = 3.0  # greatest length in observations, in workspace radii
_WRIST_1 = 3


class UrReachTask(UrTask):
    """Bring the flange within 10 cm of a target.

    Start:
        The arm is at the start pose, or at the reset option ``joint_positions`` (6) [rad]; with ``randomize_start``
        each joint is up to 1.5, 0.25, 0.5, 1.0, 0.4 and 3.14 rad from there; with ``continue_on_success`` it is where
        the last episode ended, if that was a success. The target is anywhere in the arm's recommended workspace, a
        half-ball about the base without a cylinder about its axis, or at the first three numbers of the reset option
        ``ee_target_pose`` (6) [m].

    Action:
        Target joint positions, from one end of their range at -1 to the other at 1; wrist 1 from -3.48 to 0.31 rad.
        The joints move there at a tenth of their maximum speed, and slower when they are near.

    Reward:
        Each step -0.005 d, where d is the distance of the flange from the target [m]; instead 2 at success and -1 at a
        collision.

    Success:
        The flange is within 10 cm of the target.

    End:
        Terminated at success and at a collision: of the arm with itself, the table or the ground.

    Info:
        `target_coord` [m], `distance` [m], at the end `final_status`: "success", "collision" or "max_steps_exceeded".

    Args:
        restrict_wrist_1: The action of wrist 1 means -3.48 to 0.31 rad.
        ee_distance_threshold: Distance that counts as success [m].
        ee_target_pose: Default of the reset option of that name. The next two likewise.
        randomize_start: See above.
        continue_on_success: See above.
        modular: Observations and infos of robo-gym's EndEffectorPositioning2UR: the last action is that of the free
            joints; the distance is also `dist_coord`. With `parity`, wrist 1 starts at 0 rad and its action has its
            whole range, and the default target is the origin.
    """

    rate, velocity_scale, max_steps = 10.0, 0.1, 300
    reset_options = ("joint_positions", "ee_target_pose", "randomize_start", "continue_on_success")
    start: tuple[float, ...] = START
    forgets_success = True  # whether ``continue_on_success`` looks at the last episode only
    must_be_in_reach = True  # whether a target that the arm cannot reach is refused
    memory: Mapping[str, str] = {
        name: name for name in ("target", "elapsed", "_held", "_actions", "_continues", "_last_end")
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        restrict_wrist_1: bool = True,
        ee_distance_threshold: float = NEAR,
        ee_target_pose: Sequence[float] | None = None,
        randomize_start: bool = False,
        continue_on_success: bool = False,
        modular: bool = False,
        **options: Any,
    ) -> None:
        self._near = check(ee_distance_threshold, AboveZero, "ee_distance_threshold [m]")
        self.modular = modular
        super().__init__(num_envs, **options)
        self._restrict = restrict_wrist_1 and _WRIST_1 in self.free
        self.target = np.zeros((num_envs, 3))
        """Targets of the flange [m]. Shape: (n, 3)."""
        self._actions = np.zeros((2, num_envs, 6))  # the last one and the one before, of all joints
        self._defaults = {"ee_target_pose": ee_target_pose, "randomize_start": randomize_start}
        self._defaults["continue_on_success"] = continue_on_success
        self._given_target(self._defaults)
        self._continues = np.zeros(num_envs, dtype=bool)  # whether the last episode was a success, which ended ...
        self._last_end = np.tile(START, (num_envs, 1))  # ... here

    def _observation_labels(self) -> tuple[Label, ...]:
        size, slow = f"/ {self.model.workspace_radius:g}", f"/ {self.velocity_scale:g} of its fastest"
        actions = joint_labels("action_", "last action", "rad", "/ its limit")
        return (
            *(Label(f"target_d{one}", f"target as the flange sees it, {one}", "m", size, -FAR, FAR) for one in "xyz"),
            *joint_labels("", "joint position", "rad", "/ its limit"),
            *joint_labels("speed_", "joint velocity", "rad/s", slow, 3),
            *(Label(f"target_{one}", f"target, {one}", "m", size, -FAR, FAR) for one in "xyz"),
            *(Label(f"flange_{one}", f"flange, {one}", "m", size, -FAR, FAR) for one in "xyz"),
            *(actions[joint] for joint in self._seen_actions()),
        )

    def _seen_actions(self) -> Any:
        return self.free if self.modular else range(6)

    def sample_initial(
        self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """The start pose, or that of the options; a target in the workspace."""
        options = self._defaults | {name: value for name, value in (options or {}).items() if value is not None}
        randomize = check(options["randomize_start"], bool, "reset option randomize_start")
        continues = check(options["continue_on_success"], bool, "reset option continue_on_success")
        joints = np.tile(joint_option(options, self.start, self.model), (len(env_ids), 1))
        target = self._given_target(options)
        for k, (env, rng) in enumerate(zip(env_ids, rngs, strict=True)):
            if randomize:
                joints[k] = np.clip(joints[k] + rng.uniform(-1.0, 1.0, 6) * START_OFFSET, *self.model.joint_limits)
            self.target[env] = workspace_point(self.model, rng) if target is None else target
        if continues:
            joints = np.where(self._continues[env_ids, None], self._last_end[env_ids], joints)
        if self.forgets_success:
            self._continues[env_ids] = False
        return self.initial(joints, rngs)

    def _given_target(self, options: Mapping[str, Any]) -> Array | None:
        """The position in ``ee_target_pose`` [m]; None if a target is to be drawn. Shape: (3,)."""
        if options.get("ee_target_pose") is None:
            return None
        target = finite_numbers(options["ee_target_pose"], 6, "ee_target_pose")[:3]
        shape = self.model.geometry
        reach = abs(shape.a2) + abs(shape.a3) + float(np.linalg.norm([shape.d4, shape.d5, shape.d6])) + self._near
        far = float(np.linalg.norm(target - [0.0, 0.0, shape.d1]))
        if far > reach and self.must_be_in_reach:
            raise InvalidValue(
                f"ee_target_pose is {far:.3g} m from the shoulder of a {self.model.name}, which reaches {reach:.3g} m."
            )
        return target

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Reset the last actions to 0."""
        super().on_reset(env_ids, state)
        self._actions[:, env_ids] = 0.0

    def _columns(self, state: RobotState) -> list[Array]:
        joints, velocity = state.signals["joint_position"], state.signals["joint_velocity"]
        place, axes = self.model.geometry.flange_pose(joints)
        radius = self.model.workspace_radius
        return [
            in_frame(self.target, place, axes) / radius,
            normalised(self.model, joints),
            velocity / self.speed,
            self.target / radius,
            place / radius,
            self._actions[0][:, self._seen_actions()],
        ]

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joint positions [rad] on the way to the action's. Shape: (n, 6)."""
        full = self.full_action(action, self._held)
        self._actions = np.stack([full, self._actions[0]])
        goal: Array = full * self.model.joint_limits[1]
        if self._restrict:
            low, high = WRIST_1_RANGE
            goal[:, _WRIST_1] = (full[:, _WRIST_1] + 1.0) * (high - low) / 2.0 + low
        return self.toward(goal, state)

    def action_to(self, joints: Array) -> Floats:
        """The action whose targets are `joints` (n, 6) [rad]. Shape: (n, a)."""
        goal = joints.copy()
        if self._restrict:
            low, high = WRIST_1_RANGE
            goal[:, _WRIST_1] = ((goal[:, _WRIST_1] - low) * 2.0 / (high - low) - 1.0) * self.model.joint_limits[1, 3]
        return super().action_to(goal)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward proximity; success and a collision end the episode."""
        self.elapsed = self.elapsed + 1
        joints, collision = state.signals["joint_position"], collisions(state)
        x, y, z = (self.target - self.model.geometry.tool_position(joints)).T
        distance = np.sqrt(x * x + y * y + z * z)
        success: Flags = (distance <= self._near) & ~collision
        reward = np.where(collision, -1.0, np.where(success, 2.0, -0.005 * distance))
        terminated, status = self.ends(collision, success, self.elapsed >= self.max_steps)
        ended_well = status == "success"
        self._continues = self._continues | ended_well
        self._last_end = np.where(ended_well[:, None], joints, self._last_end)
        info = self.info(state, distance=distance, final_status=status, target_coord=self.target.copy())
        if self.modular:
            info["dist_coord"] = distance.copy()
        return Score(reward, terminated, success, info)

    def rs_state(self, state: RobotState) -> list[dict[str, float]]:
        """robo-gym's wire state of each environment: 27 named numbers."""
        return wire_states(self.model, state, self.target)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The target."""
        return [(self.target[0], (0.1, 0.7, 0.3, 0.6))]


def workspace_point(model: UrModel, rng: np.random.Generator) -> Array:
    """A uniformly random point of the recommended workspace [m]. Shape: (3,)."""
    while True:
        share, up, turn = rng.random(3)
        radius, height = model.workspace_radius * np.cbrt(share), up
        across = radius * np.sqrt(1.0 - height * height)
        if across > model.workspace_inner:
            angle = 2 * np.pi * turn
            return np.array([across * np.cos(angle), across * np.sin(angle), radius * height])
