"""Isaac reach: bring the flange to a pose, position and orientation, with Isaac Lab's observations and actions."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bam_envs.core.env_options import finite_numbers
from bam_envs.core.errors import InvalidValue
from bam_envs.core.kinematics import angle_between, from_angles, quaternions
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Flags, Floats, Label, Score, limited
from bam_envs.core.validation import Positive, check
from bam_envs.robots.ur import JOINTS
from bam_envs.tasks.ur_arm import AboveZero, UrTask, collisions, frame_keys, joint_labels, joint_option, wire_states

DEFAULT = (0.0, -1.712, 1.712, 0.0, 0.0, 0.0)
"""Joint positions [rad] that actions and observations are measured from."""
TARGETS = np.array([[0.35, -0.2, 0.15], [0.65, 0.2, 0.5]])
"""Range of the targets: lowest and highest x, y, z [m]."""
PITCH = np.pi / 2  # of targets [rad]: the x axis of the frame at the flange points down
CLOSE, ALIGNED = 0.02, 0.05
"""The flange has arrived within this distance [m] and this angle [rad]."""
SPAN = np.pi
"""Joint angle from `DEFAULT` that is 1 in actions and observations [rad]."""
EE_LINK = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Axes of ``ee_link`` in ``tool0``: at the flange, x out of it, as in Isaac's model."""
TOOL1 = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""Axes of ``tool1`` in ``tool0``: robo-gym's launch file has yaw pi, pitch -pi/2; 90 degrees about x from the other."""


class IsaacReachTask(UrTask):
    """Bring ``ee_link``, the frame at the flange whose x axis points out of it, to the target pose.

    Start:
        The joints are at the default pose, [0, -1.712, 1.712, 0, 0, 0] rad, or at the reset option ``joint_positions``
        (6) [rad]; after an episode that ended without a collision they stay where it ended, unless a seed is given. The
        target is between x 0.35 and 0.65 m, y -0.2 and 0.2 m, z 0.15 and 0.5 m, the flange pointing down, with any
        yaw; or it is the reset option ``ee_target_pose``: x, y, z [m] and roll, pitch, yaw [rad], or x, y, z and a
        quaternion x, y, z, w.

    Action:
        Target positions of the six joints, from the default pose, in units of pi. The joints move there at a fifth of
        their maximum speed, and slower when they are near.

    Reward:
        Each step -0.005 d - 0.05 a, where d is the distance from the target [m] and a the angle [rad]; instead 2 at
        success and -1 at a collision.

    Success:
        The flange is within 0.02 m and 0.05 rad of the target.

    End:
        Terminated at success, and at a collision of the arm with itself or the table.

    Info:
        `dist_coord` [m] (also as `distance`), `dist_rot` [rad], `target_coord` [m], `target_rot` as x, y, z, w,
        `rs_state` with `rs_state_to_info`, and at the end `final_status`: "success", "collision"
        or "max_steps_exceeded".

    Args:
        ur_model: ur3, ur3e, ur5, ur5e, ur10, ur10e or ur16e; the smallest do not reach every target.
        isaac_scale: With ``parity``, the joint angle of an action of 1 [rad].
        continue_except_collision: Whether episodes begin where the last one ended.
        ee_distance_threshold: Distance that counts as success [m].
        ee_rotation_threshold: Angle that counts as success, if it is less [rad].
        ee_target_pose: Default of the reset option of that name.
        rs_state_to_info: Whether infos have robo-gym's wire state.
    """

    rate, velocity_scale, max_steps = 30.0, 0.2, 600
    reset_options = ("joint_positions", "ee_target_pose")
    yaw: float = np.pi  # of targets, to either side [rad]
    frame: Array = EE_LINK  # axes in ``tool0`` of the frame that is brought to the target
    unscaled = False  # whether actions are Isaac Lab's, in units of `isaac_scale`
    memory: Mapping[str, str] = {
        "target": "target",
        "quaternion": "quaternion",
        "steps": "elapsed",
        "last_action": "_last_action",
        "ended": "_ended",
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        ur_model: str = "ur10",
        isaac_scale: float = 0.5,
        continue_except_collision: bool = True,
        rs_state_to_info: bool = False,
        ee_distance_threshold: float = CLOSE,
        ee_rotation_threshold: float = ALIGNED,
        ee_target_pose: Sequence[float] | None = None,
    ) -> None:
        isaac_scale = check(isaac_scale, Positive, "isaac_scale [rad]")
        self._close = check(ee_distance_threshold, AboveZero, "ee_distance_threshold [m]")
        self._aligned = check(ee_rotation_threshold, AboveZero, "ee_rotation_threshold [rad]")
        self._default_target = _target(ee_target_pose)
        self.continue_except_collision = continue_except_collision
        self.scale = isaac_scale if self.unscaled else SPAN
        """Joint angle from `DEFAULT` of an action of 1 [rad]."""
        self._default = np.array(DEFAULT)
        super().__init__(num_envs, ur_model=ur_model, fix_wrist_3=False, rs_state_to_info=rs_state_to_info)
        self.target, self.quaternion = np.zeros((num_envs, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (num_envs, 1))
        """Targets: position [m], shape (n, 3), and quaternion x, y, z, w, shape (n, 4)."""
        self._last_action = np.zeros((num_envs, 6))
        self._ended = np.full((num_envs, 6), np.nan)  # joints where the last episode ended, if the next begins there
        self._rngs: list[np.random.Generator | None] = [None] * num_envs

    def _action_labels(self) -> tuple[Label, ...]:
        return joint_labels("", "joint target from the default pose", "rad", f"/ {self.scale:g}")

    def _observation_labels(self) -> tuple[Label, ...]:
        box = "in the targets' box"
        return (
            *joint_labels("", "joint position from the default pose", "rad", "/ pi", 2.0),
            *(Label(f"{joint}_speed", "joint velocity", "rad/s", "/ 0.2 of the fastest") for joint in JOINTS),
            *(Label(f"target_{axis}", f"target, {axis}", "m", box, -5.0, 5.0) for axis in "xyz"),
            *self._pose_and_action_labels(),
        )

    def _pose_and_action_labels(self) -> tuple[Label, ...]:
        return (
            *(Label(f"target_q{axis}", f"target's quaternion, {axis}", "1") for axis in "wxyz"),
            *(
                Label(f"last_{one.name}", "last action", one.unit, one.scale, one.low, one.high)
                for one in self.action_labels
            ),
        )

    def sample_initial(
        self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """A target in `TARGETS`; the joints where the last episode ended, or at `DEFAULT`."""
        options = options or {}
        draws = np.stack([rng.random(4) for rng in rngs])
        self.target[env_ids] = TARGETS[0] + draws[:, :3] * (TARGETS[1] - TARGETS[0])
        yaw = (2 * draws[:, 3] - 1) * self.yaw
        self.quaternion[env_ids] = from_angles(np.stack([0.0 * yaw, 0.0 * yaw + PITCH, yaw], axis=1))
        given = _target(options.get("ee_target_pose"))
        pose = self._default_target if given is None else given
        if pose is not None:
            self.target[env_ids], self.quaternion[env_ids] = pose[:3], pose[3:]
        joints = self._ended[env_ids]
        for k, (env, rng) in enumerate(zip(env_ids, rngs, strict=True)):
            # A new generator means that a seed was given: the episode then depends on the seed alone.
            if np.isnan(joints[k, 0]) or self._rngs[env] not in (None, rng):
                joints[k] = self._default
            self._rngs[env] = rng
        if options.get("joint_positions") is not None:
            joints[:] = joint_option(options, DEFAULT, self.model)
        self._last_action[env_ids], self._ended[env_ids] = 0.0, np.nan
        return self.initial(joints, rngs)

    def _columns(self, state: RobotState) -> list[Array]:
        joints, speeds = state.signals["joint_position"] - self._default, state.signals["joint_velocity"]
        middle = TARGETS.mean(axis=0)
        return [
            joints / SPAN,
            speeds / self.speed,
            (self.target - middle) / (TARGETS[1] - middle),
            self.quaternion[:, [3, 0, 1, 2]],
            self._last_action,
        ]

    def command(self, action: Floats, state: RobotState) -> Array:
        """One period on the way to the default pose plus `action`. Shape: (n, 6)."""
        cut = limited(action, self.action_space.low, self.action_space.high)
        self._last_action = cut.astype(np.float64)
        return self.toward(limited(self._default + self.scale * self._last_action, *self.model.joint_limits), state)

    def action_to(self, joints: Array) -> Floats:
        """The action whose targets are `joints` (n, 6) [rad]. Shape: (n, 6)."""
        share = (joints - self._default) / self.scale
        return limited(share, self.action_space.low, self.action_space.high).astype(np.float32)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward proximity and alignment."""
        self.elapsed = self.elapsed + 1
        position, rotation = self._tool(state, self.frame)
        way = self.target - position
        distance = np.sqrt(np.einsum("ij,ij->i", way, way))
        angle = angle_between(quaternions(rotation), self.quaternion)
        collision, late = collisions(state), self.elapsed >= self.max_steps
        success: Flags = (distance <= self._close) & (angle < self._aligned) & ~collision
        reward = np.where(collision, -1.0, np.where(success, 2.0, -0.005 * distance - 0.05 * angle))
        continues = ((success | late) & ~collision)[:, None] & self.continue_except_collision
        self._ended = np.where(continues, state.signals["joint_position"], np.nan)
        terminated, status = self.ends(collision, success, late)
        values = {"final_status": status, "distance": distance, "dist_coord": distance.copy(), "dist_rot": angle}
        values |= {"target_coord": self.target.copy(), "target_rot": self.quaternion.copy()}
        return Score(reward, terminated, success, self.info(state, **values))

    def _tool(self, state: RobotState, frame: Array) -> tuple[Array, Array]:
        """Pose of a `frame` at the flange. Shapes: (n, 3), (n, 3, 3)."""
        position, rotation = self.model.geometry.flange_pose(state.signals["joint_position"])
        return position, np.einsum("nij,jk->nik", rotation, frame)

    def rs_state(self, state: RobotState) -> list[dict[str, float]]:
        """robo-gym's wire state of each environment, 27 named numbers; its end effector is ``tool1``."""
        turned = quaternions(self._tool(state, TOOL1)[1]).tolist()
        wire = wire_states(self.model, state, self.target)
        return [one | dict(zip(frame_keys("ee")[3:], q, strict=True)) for one, q in zip(wire, turned, strict=True)]

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The target, and a point 5 cm before it in the direction of the flange."""
        x, y, z, w = self.quaternion[0]
        ahead = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
        return [(self.target[0], (0.1, 0.7, 0.3, 0.6)), (self.target[0] + 0.05 * ahead, (0.1, 0.4, 0.8, 0.6))]

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; the current generators count as known."""
        super().load_state_dict(state)
        self._rngs = [None] * self.num_envs


def _target(given: Any) -> Array | None:
    """Position [m] and unit quaternion x, y, z, w of ``ee_target_pose``. Shape: (7,)."""
    if given is None:
        return None
    if np.array(given, dtype=object).shape == (7,):
        pose = finite_numbers(given, 7, "ee_target_pose")
        length = float(np.sqrt((pose[3:] ** 2).sum()))
        if abs(length - 1) > 1e-3:
            raise InvalidValue(f"The quaternion of ee_target_pose must have length 1, not {length:.4g}.")
        pose[3:] /= length
        return pose
    pose = finite_numbers(given, 6, "ee_target_pose")
    return np.concatenate([pose[:3], from_angles(pose[None, 3:])[0]])
