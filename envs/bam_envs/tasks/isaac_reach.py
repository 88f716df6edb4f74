"""Isaac reach: bring the flange to a pose, position and orientation, with Isaac Lab's observations and actions.

Longer than other tasks because both forms of its spaces, scaled and Isaac's own, are described in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue
from bam_envs.core.kinematics import quaternions
from bam_envs.core.robot import Initial, RobotState, Rows
from bam_envs.core.rotations import angle_between, from_angles
from bam_envs.core.task import Array, Floats, Label, Score, labelled_box
from bam_envs.robots.ur import JOINTS
from bam_envs.robots.ur import ur_model as model_called
from bam_envs.tasks.ur_control import UrControl, collisions, joint_option, number_option
from bam_envs.tasks.ur_wire import as_objects, frame_keys, wire_states

RATE = 30.0
"""Commands a second [Hz]."""
VELOCITY_SCALE = 0.2
"""Share of the fastest speed that joints go at."""
MAX_STEPS = 600
"""Steps of an episode."""
DEFAULT = (0.0, -1.712, 1.712, 0.0, 0.0, 0.0)
"""Joint positions [rad] that actions and observations are measured from."""
TARGETS = np.array([[0.35, -0.2, 0.15], [0.65, 0.2, 0.5]])
"""Where targets are: lowest and highest x, y, z [m]."""
PITCH = np.pi / 2
"""Of targets [rad]: the x axis of the frame at the flange points down."""
YAW = np.pi, 3.14
"""Of targets, to either side [rad]; 3.14 with ``parity=True``, as in robo-gym."""
CLOSE, ALIGNED = 0.02, 0.05
"""The flange has arrived within this distance [m] and this angle [rad]."""
SPAN = np.pi
"""Joint angle from `DEFAULT` that is 1 in actions and observations [rad]."""
EE_LINK = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Axes of ``ee_link`` in ``tool0``: at the flange, x out of it, as in Isaac's model."""
TOOL1 = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""Axes of ``tool1`` in ``tool0``: robo-gym's launch file has yaw pi, pitch -pi/2; 90 degrees about x from the other."""


class IsaacReachTask:
    """Bring ``ee_link``, the frame at the flange whose x axis points out of it, to the target pose.

    Start:
        The joints are at the default pose, [0, -1.712, 1.712, 0, 0, 0] rad, or at the reset option ``joint_positions``
        (6) [rad]; after an episode that ended without a collision they stay where it ended, unless a seed is given. The
        target is between x 0.35 and 0.65 m, y -0.2 and 0.2 m, z 0.15 and 0.5 m, the flange pointing down, turned
        anyhow; or it is the reset option ``ee_target_pose``: x, y, z [m] and roll, pitch, yaw [rad], or x, y, z and a
        quaternion x, y, z, w.

    Action:
        Where the six joints are to be, from the default pose, in units of pi. They go there at a fifth of their fastest
        speed, and slower when they are near.

    Reward:
        Each step -0.005 d - 0.05 a, where d is the distance from the target [m] and a the angle [rad]; instead of it 2
        at success and -1 at a collision.

    Success:
        The flange is within 0.02 m and 0.05 rad of the target.

    End:
        Terminated at success, and at a collision of the arm with itself or the table.

    Info:
        `dist_coord` [m] (also as `distance`), `dist_rot` [rad], `target_coord` [m], `target_rot` as x, y, z, w,
        `rs_state` where it is asked for, and at the end `final_status`: "success", "collision"
        or "max_steps_exceeded".

    With ``parity=True`` nothing is scaled, an action is in units of 0.5 rad and as large as the joints' limits let
    it be, 600 steps terminate as "max_steps_exceeded", and the frame is robo-gym's ``tool1``, which is ``ee_link``
    turned by 90 degrees about x. Observations and actions are then those of Isaac Lab's policies.

    Args:
        num_rows: How many robots are scored together.
        ur_model: ur3, ur3e, ur5, ur5e, ur10, ur10e or ur16e; the smallest do not reach every target.
        parity: robo-gym's arithmetic.
        isaac_scale: With ``parity``, the joint angle of an action of 1 [rad].
        continue_except_collision: Whether episodes begin where the last one ended.
        ee_distance_threshold: Distance that counts as success [m].
        ee_rotation_threshold: Angle that counts as success, if it is less [rad].
        ee_target_pose: What the reset option of that name is where a reset does not give it.
        rs_state_to_info: Whether infos have robo-gym's wire state.
    """

    reset_options = ("joint_positions", "ee_target_pose")

    def __init__(
        self,
        num_rows: int = 1,
        *,
        ur_model: str = "ur10",
        parity: bool = False,
        isaac_scale: float = 0.5,
        continue_except_collision: bool = True,
        rs_state_to_info: bool = False,
        ee_distance_threshold: float = CLOSE,
        ee_rotation_threshold: float = ALIGNED,
        ee_target_pose: Sequence[float] | None = None,
    ) -> None:
        if not 0 < isaac_scale < np.inf:
            raise InvalidValue(f"isaac_scale must be a joint angle above 0 rad, not {isaac_scale!r}.")
        for name, limit in (
            ("ee_distance_threshold", ee_distance_threshold),
            ("ee_rotation_threshold", ee_rotation_threshold),
        ):
            if not limit > 0:
                raise InvalidValue(f"{name} must be above 0 {'m' if 'distance' in name else 'rad'}, not {limit!r}.")
        self.num_rows, self.parity, self.ends_by_itself = num_rows, parity, parity
        self._close, self._aligned = ee_distance_threshold, ee_rotation_threshold
        self._standing = _target({"ee_target_pose": ee_target_pose})
        self.continue_except_collision, self.rs_state_to_info = continue_except_collision, rs_state_to_info
        self.model = model_called(ur_model)
        self.control = UrControl(self.model, num_rows, RATE, VELOCITY_SCALE)
        self._scale = isaac_scale if parity else SPAN
        self._default, (self._low, self._high) = np.array(DEFAULT), self.model.joint_limits
        self._frame = TOOL1 if parity else EE_LINK
        self.action_labels = self._action_labels()
        self.observation_labels = self._observation_labels()
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.target, self.quaternion = np.zeros((num_rows, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (num_rows, 1))
        """Where to [m], shape (n, 3), and how turned, x, y, z, w, shape (n, 4)."""
        self.steps = np.zeros(num_rows, dtype=np.int64)
        """Steps since each row's episode began. Shape: (n,)."""
        self._last_action = np.zeros((num_rows, 6))
        self._ended = np.full((num_rows, 6), np.nan)  # joints where the last episode ended, if the next begins there
        self._rngs: list[np.random.Generator | None] = [None] * num_rows

    def _action_labels(self) -> tuple[Label, ...]:
        low, high = -np.ones(6), np.ones(6)
        if self.parity:
            low, high = (self._low - self._default) / self._scale, (self._high - self._default) / self._scale
        unit = f"/ {self._scale:g}"
        ends = zip(JOINTS, low.tolist(), high.tolist(), strict=True)
        return tuple(Label(joint, "joint target from the default pose", "rad", unit, *both) for joint, *both in ends)

    def _observation_labels(self) -> tuple[Label, ...]:
        inf, farthest = float("inf"), np.full(6, 2.0)
        low, high = -farthest, farthest
        if self.parity:  # robo-gym lets a joint be a tenth of its range beyond it
            low, high = 1.2 * self._low - self._default, 1.2 * self._high - self._default
        scale, speed, place = (
            ("1", "1", "1") if self.parity else ("/ pi", "/ 0.2 of the fastest", "in the targets' box")
        )
        ends = zip(JOINTS, low.tolist(), high.tolist(), strict=True)
        far, fast = (inf, inf) if self.parity else (5.0, 1.0)
        return (
            *(Label(joint, "joint position from the default pose", "rad", scale, *both) for joint, *both in ends),
            *(Label(f"{joint}_speed", "joint velocity", "rad/s", speed, -fast, fast) for joint in JOINTS),
            *(Label(f"target_{axis}", f"target, {axis}", "m", place, -far, far) for axis in "xyz"),
            *(Label(f"target_q{axis}", f"target's quaternion, {axis}", "1") for axis in "wxyz"),
            *(
                Label(f"last_{one.name}", "last action", one.unit, one.scale, one.low, one.high)
                for one in self.action_labels
            ),
        )

    def sample_initial(
        self, rows: Rows, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] = MappingProxyType({})
    ) -> Initial:
        """A target in `TARGETS`; the joints where the last episode ended, or at `DEFAULT`."""
        draws = np.stack([rng.random(4) for rng in rngs])
        seeds = np.array([rng.integers(2**63) for rng in rngs], dtype=np.int64)
        self.target[rows] = TARGETS[0] + draws[:, :3] * (TARGETS[1] - TARGETS[0])
        yaw = (2 * draws[:, 3] - 1) * YAW[self.parity]
        angles = np.stack([np.zeros(len(rows)), np.full(len(rows), PITCH), yaw], axis=1)
        self.quaternion[rows] = from_angles(angles)
        pose = self._standing if options.get("ee_target_pose") is None else _target(options)
        if pose is not None:
            self.target[rows], self.quaternion[rows] = pose[:3], pose[3:]
        joints = self._starts(rows, rngs)
        if options.get("joint_positions") is not None:
            joints[:] = joint_option(options, "joint_positions", (), self.model)
        self.steps[rows], self._last_action[rows], self._ended[rows] = 0, 0.0, np.nan
        return Initial({"joint_position": joints}, seeds)

    def _starts(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Array:
        """Where the last episodes ended, or the default pose. Shape: (k, 6).

        A generator that the row did not have before is one that was seeded: what follows depends on the seed alone.
        """
        joints = self._ended[rows]
        for k, (row, rng) in enumerate(zip(rows, rngs, strict=True)):
            if np.isnan(joints[k, 0]) or self._rngs[row] not in (None, rng):
                joints[k] = self._default
            self._rngs[row] = rng
        return joints

    def on_reset(self, rows: Rows, state: RobotState) -> None:
        """There is nothing to note."""

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, 25) float32."""
        joints, speeds = state.signals["joint_position"] - self._default, state.signals["joint_velocity"]
        target = self.target
        if not self.parity:
            joints, speeds = joints / SPAN, speeds / (VELOCITY_SCALE * self.model.max_velocity)
            target = (target - TARGETS.mean(axis=0)) / (TARGETS[1] - TARGETS.mean(axis=0))
        turned = self.quaternion[:, [3, 0, 1, 2]]
        observation = np.concatenate([joints, speeds, target, turned, self._last_action], axis=1).astype(np.float32)
        if self.parity:
            return observation
        return np.clip(observation, self.observation_space.low, self.observation_space.high)

    def command(self, action: Floats, state: RobotState) -> Array:
        """One period on the way to the default pose plus `action`. Shape: (n, 6)."""
        cut = np.clip(action, self.action_space.low, self.action_space.high)
        self._last_action = cut.astype(np.float64)
        goal = np.clip(self._default + self._scale * self._last_action, self._low, self._high)
        return self.control.command(goal, state)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Nearer and straighter is better."""
        position, rotation = self._tool(state, self._frame)
        way = self.target - position
        distance = np.sqrt(np.einsum("ij,ij->i", way, way))
        angle = angle_between(quaternions(rotation), self.quaternion)
        self.steps = self.steps + 1
        collision = collisions(state)
        success = (distance <= self._close) & (angle < self._aligned) & ~collision
        last = (self.steps >= MAX_STEPS) & ~collision
        reward = np.where(collision, -1.0, np.where(success, 2.0, -0.005 * distance - 0.05 * angle))
        goes_on = (success | last)[:, None] & self.continue_except_collision
        self._ended = np.where(goes_on, state.signals["joint_position"], np.nan)
        late = last & (self.parity | ~success)  # there, also of an arrival in the last step
        status = np.where(late, "max_steps_exceeded", np.where(success, "success", ""))
        info: dict[str, Any] = {
            "final_status": np.where(collision, "collision", status),
            "distance": distance,
            "dist_coord": distance.copy(),
            "dist_rot": angle,
            "target_coord": self.target.copy(),
            "target_rot": self.quaternion.copy(),
        }
        if self.rs_state_to_info:
            info["rs_state"] = as_objects(self.rs_state(state))
        terminated = collision | success | last if self.parity else collision | success
        return Score(reward, terminated, success, info)

    def _tool(self, state: RobotState, frame: Array) -> tuple[Array, Array]:
        """Pose of a `frame` at the flange. Shapes: (n, 3), (n, 3, 3)."""
        position, rotation = self.model.geometry.flange_pose(state.signals["joint_position"])
        return position, np.einsum("nij,jk->nik", rotation, frame)

    def rs_state(self, state: RobotState) -> list[Any]:
        """robo-gym's wire state, a dict of 27 floats a row; the end effector is ``tool1``, with and without parity."""
        turned = quaternions(self._tool(state, TOOL1)[1]).tolist()
        wire = wire_states(self.model, state, self.target)
        return [row | dict(zip(frame_keys("ee")[3:], q, strict=True)) for row, q in zip(wire, turned, strict=True)]

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The target, and a point 5 cm before it where the flange points."""
        x, y, z, w = self.quaternion[0]
        ahead = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
        return [(self.target[0], (0.1, 0.7, 0.3, 0.6)), (self.target[0] + 0.05 * ahead, (0.1, 0.4, 0.8, 0.6))]

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""
        return {
            "target": self.target.copy(),
            "quaternion": self.quaternion.copy(),
            "steps": self.steps.copy(),
            "last_action": self._last_action.copy(),
            "ended": self._ended.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned; the generators are taken for those of the time."""
        self.target, self.quaternion = np.array(state["target"]), np.array(state["quaternion"])
        self.steps, self._last_action = np.array(state["steps"]), np.array(state["last_action"])
        self._ended = np.array(state["ended"])
        self._rngs = [None] * self.num_rows


def _target(options: Mapping[str, Any]) -> Array | None:
    """Position [m] and unit quaternion x, y, z, w that ``ee_target_pose`` gives. Shape: (7,)."""
    given = options.get("ee_target_pose")
    if given is None:
        return None
    if np.array(given, dtype=object).shape == (7,):
        pose = number_option(options, "ee_target_pose", (), 7)
        length = float(np.sqrt((pose[3:] ** 2).sum()))
        if abs(length - 1) > 1e-3:
            raise InvalidValue(f"The quaternion of ee_target_pose must have length 1, not {length:.4g}.")
        pose[3:] /= length
        return pose
    pose = number_option(options, "ee_target_pose", (), 6)
    return np.concatenate([pose[:3], from_angles(pose[None, 3:])[0]])
