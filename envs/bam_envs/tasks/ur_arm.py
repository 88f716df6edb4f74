"""What the tasks of UR arms share, and the one without a goal; how an arm is sent to joint targets, robo-gym's states.

robo-gym's trajectory controller moves an arm so: a target c is the one point of a trajectory that takes
T = max(max_i |c_i - q_i| / (s vmax_i), 0.5 s), and the next one takes its place after 1 / rate. In one period the
joints go (c - q) / (rate T): the fastest at s vmax at most, all of them in proportion, and slower and slower within
half a second of the target. Here q is where the controller has got to, the last command that was sent; a live arm
follows it a little later. So simulated and live arms get the same set points.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from gymnasium import spaces
from msgspec import Meta

from bam_envs.core.env_options import finite_numbers
from bam_envs.core.errors import InvalidValue
from bam_envs.core.kinematics import LINKS, quaternions
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import (
    Array,
    Flags,
    Floats,
    Label,
    Memory,
    Score,
    as_objects,
    draw_seeds,
    labelled_box,
    limited,
)
from bam_envs.robots.ur import DEFAULT_MODEL, JOINTS, START, UrModel
from bam_envs.robots.ur import ur_model as model_called

AboveZero = Annotated[float, Meta(gt=0)]
SHORTEST = 0.5  # shortest time that a trajectory takes [s]
LEASH = 0.2
"""An arm measured farther than this from its last command [rad] was halted or held; motion begins at its position."""
FOREARM = LINKS.index("forearm_link")
WIRE_JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")  # robo-gym's names of the joints
POSITIONS = tuple(f"{joint}_joint_position" for joint in WIRE_JOINTS)
VELOCITIES = tuple(f"{joint}_joint_velocity" for joint in WIRE_JOINTS)


class UrTask(Memory):
    """Base class of the tasks of UR arms: the arm's options, the count of steps, and infos.

    Args:
        ur_model: ur3, ur3e, ur5, ur5e, ur10, ur10e or ur16e.
        fix_base: Exclude the joint from the action; the task sets its position. The next five do the same.
        fix_shoulder: See above.
        fix_elbow: See above.
        fix_wrist_1: See above.
        fix_wrist_2: See above.
        fix_wrist_3: See above; it turns the flange about its own axis.
        rs_state_to_info: Add robo-gym's robot server state to the info as ``rs_state``, a dict of floats.

    Raises:
        InvalidValue: All joints are fixed.
    """

    reset_options: tuple[str, ...] = ("joint_positions",)
    rate: float  # commands a second [Hz]
    velocity_scale: float  # share of the fastest speed that the joints go at
    max_steps: int  # steps of an episode
    action_meaning = ("where the joint is to be", "rad", "/ its limit")
    """Meaning, unit and scale of each number of an action."""

    def __init__(
        self,
        num_envs: int = 1,
        *,
        ur_model: str = DEFAULT_MODEL,
        fix_base: bool = False,
        fix_shoulder: bool = False,
        fix_elbow: bool = False,
        fix_wrist_1: bool = False,
        fix_wrist_2: bool = False,
        fix_wrist_3: bool = True,
        rs_state_to_info: bool = False,
    ) -> None:
        fixed = (fix_base, fix_shoulder, fix_elbow, fix_wrist_1, fix_wrist_2, fix_wrist_3)
        if all(fixed):
            raise InvalidValue(
                "At least one of the six joints must be free to move: set one of the fix_ options False."
            )
        self.num_envs, self.model, self.rs_state_to_info = num_envs, model_called(ur_model), rs_state_to_info
        self.arm = self.model.geometry
        self.speed: Array = self.velocity_scale * self.model.max_velocity
        """Speeds of the joints [rad/s]. Shape: (6,)."""
        self.free = np.flatnonzero(~np.array(fixed, dtype=bool))
        """Indices of the joints that are in the action. Shape: (a,)."""
        self.action_labels = self._action_labels()
        self.observation_labels = self._observation_labels()
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.elapsed = np.zeros(num_envs, dtype=np.int64)
        """Steps since each episode began. Shape: (n,)."""
        self._held = np.zeros((num_envs, 6))  # normalised start, where fixed joints stay

    def _action_labels(self) -> tuple[Label, ...]:
        return tuple(Label(JOINTS[joint], *self.action_meaning) for joint in self.free)

    def _observation_labels(self) -> tuple[Label, ...]:
        raise NotImplementedError

    def _columns(self, state: RobotState) -> list[Array]:
        """The numbers of an observation, before they are clipped to their space. Shape: (n, k) each."""
        raise NotImplementedError

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, k) float32."""
        observation = np.concatenate(self._columns(state), axis=1).astype(np.float32)
        return limited(observation, self.observation_space.low, self.observation_space.high)

    def full_action(self, action: Floats, held: Array | float = 0.0) -> Array:
        """The action of all joints in [-1, 1]: clipped `action` for free ones, `held` for fixed ones. Shape: (n, 6)."""
        full: Array = np.empty((self.num_envs, 6))
        full[:] = held
        full[:, self.free] = limited(action, -1.0, 1.0)
        return full

    def toward(self, target: Array, state: RobotState) -> Array:
        """The set points after one period on the way from those in `state` to `target`. Shape: (n, 6) [rad] both."""
        joints = _begin(state)
        way = target - joints
        duration = np.maximum((np.abs(way) / self.speed).max(axis=1), SHORTEST)
        step = way * ((1.0 / self.rate) / duration)[:, None]
        command: Array = limited(joints + step, *self.model.joint_limits)
        return command

    def action_for(self, command: Array, state: RobotState) -> Floats:
        """The action that leads to `command` (n, 6), or that way as far as it can. Shape: (n, a)."""
        begin = _begin(state)
        return self.action_to(begin + (command - begin) * (SHORTEST * self.rate))

    def action_to(self, joints: Array) -> Floats:
        """The action whose targets are `joints` (n, 6) [rad]; fixed ones do not count. Shape: (n, a)."""
        return limited(joints / self.model.joint_limits[1], -1.0, 1.0)[:, self.free].astype(np.float32)

    def initial(self, joints: Array, rngs: Sequence[np.random.Generator], **signals: Array) -> Initial:
        """Start at `joints` (k, 6) [rad]; each generator draws the seed of its robot now."""
        return Initial({"joint_position": joints, **signals}, draw_seeds(rngs))

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """The steps are counted anew; fixed joints stay where they are measured."""
        self.elapsed[env_ids] = 0
        self._held[env_ids] = normalised(self.model, state.signals["joint_position"][env_ids])

    def ends(self, collision: Flags, success: Flags, late: Flags) -> tuple[Flags, Any]:
        """Which episodes are over, and what `final_status` says: here, success and collision end one. Shapes: (n,)."""
        status = np.where(success, "success", np.where(late, "max_steps_exceeded", ""))
        return collision | success, np.where(collision, "collision", status)

    def info(self, state: RobotState, **values: Any) -> dict[str, Any]:
        """The infos `values`, and robo-gym's wire state with `rs_state_to_info`."""
        return values | ({"rs_state": as_objects(self.rs_state(state))} if self.rs_state_to_info else {})

    def rs_state(self, state: RobotState) -> list[dict[str, float]]:
        """robo-gym's wire state of each environment."""
        return wire_states(self.model, state)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """None beyond the scene."""
        return []


class UrEmptyTask(UrTask):
    """Move a UR arm about, for trying out actions.

    Start:
        The arm is at the start pose, or at the reset option ``joint_positions`` (6) [rad].

    Action:
        Target joint positions, from one end of their range at -1 to the other at 1. The joints move there at a fifth of
        their maximum speed, and slower when they are near. A fixed joint stays at its start.

    Reward:
        0.

    Success:
        None; with ``parity=True`` 300 steps without a collision.

    End:
        Terminated at a collision of the arm with itself, the table or the ground.

    Info:
        `final_status` at the end: "collision" or "max_steps_exceeded".
    """

    rate, velocity_scale, max_steps = 20.0, 0.2, 300
    memory: Mapping[str, str] = {"elapsed": "elapsed", "held": "_held"}

    def _observation_labels(self) -> tuple[Label, ...]:
        speed = f"/ {self.velocity_scale:g} of its fastest"
        return (
            *joint_labels("", "joint position", "rad", "/ its limit"),
            *joint_labels("speed_", "joint velocity", "rad/s", speed, 3),
        )

    def sample_initial(
        self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """The start pose, or that of the options."""
        joints = joint_option(options or {}, START, self.model)
        return self.initial(np.tile(joints, (len(env_ids), 1)), rngs)

    def _columns(self, state: RobotState) -> list[Array]:
        return [normalised(self.model, state.signals["joint_position"]), state.signals["joint_velocity"] / self.speed]

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joint positions [rad] on the way to the action's. Shape: (n, 6)."""
        return self.toward(self.full_action(action, self._held) * self.model.joint_limits[1], state)

    def score(self, state: RobotState, action: Floats) -> Score:
        """No reward; a collision ends the episode."""
        self.elapsed = self.elapsed + 1
        success = np.zeros(self.num_envs, dtype=bool)
        terminated, status = self.ends(collisions(state), success, self.elapsed >= self.max_steps)
        return Score(np.zeros(self.num_envs), terminated, success, self.info(state, final_status=status))


def _begin(state: RobotState) -> Array:
    """Where a motion begins: at the last command, or at an arm that was halted or held. Shape: (n, 6) [rad]."""
    measured, sent = state.signals["joint_position"], state.command
    return np.where(np.abs(sent - measured).max(axis=1, keepdims=True) <= LEASH, sent, measured)


def collisions(state: RobotState) -> Flags:
    """Mask of the arms that have touched something; False if it is not known, as of a live robot. Shape: (n,)."""
    touched: Any = state.truth.get("collision")
    return np.zeros(len(state.stamp), dtype=bool) if touched is None else touched


def normalised(model: UrModel, joints: Array) -> Array:
    """Joint positions [rad] as shares of their limits, in [-1, 1]. Shape: (n, 6)."""
    shares: Array = np.clip(joints / model.joint_limits[1], -1.0, 1.0)  # limits are the same both ways
    return shares


def spherical(vector: Array) -> Array:
    """Length, angle from z in [0, pi], and angle from x about z in [-pi, pi]. Shape: (n, 3) -> (n, 3)."""
    x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
    length = np.sqrt(x * x + y * y + z * z)
    cosine = np.divide(z, length, out=np.ones_like(z), where=length > 0)
    return np.stack([length, np.arccos(np.clip(cosine, -1.0, 1.0)), np.arctan2(y, x)], axis=1)


def in_frame(point: Array, position: Array, rotation: Array) -> Array:
    """`point` in the frame at `position` with the axes `rotation`. Shapes: (n, 3), (n, 3), (n, 3, 3) -> (n, 3)."""
    offset = (point - position)[:, :, None]
    # Written out: the sum for one environment does not depend on how many there are.
    return rotation[:, 0] * offset[:, 0] + rotation[:, 1] * offset[:, 1] + rotation[:, 2] * offset[:, 2]


def joint_labels(prefix: str, meaning: str, unit: str, scale: str, bound: float = 1.0) -> tuple[Label, ...]:
    """One label for each of the six joints."""
    return tuple(Label(f"{prefix}{joint}", meaning, unit, scale, -bound, bound) for joint in JOINTS)


def joint_option(options: Mapping[str, Any], default: Sequence[float], model: UrModel) -> Array:
    """Joint positions [rad] inside their limits: those of the option ``joint_positions``, or `default`. Shape: (6,)."""
    chosen = options.get("joint_positions")
    joints = finite_numbers(default if chosen is None else chosen, 6, "The reset option joint_positions")
    for label, value, least, most in zip(JOINTS, joints, *model.joint_limits, strict=True):
        if not least <= value <= most:
            raise InvalidValue(
                f"The reset option joint_positions has {label} at {value:g} rad, outside {least:.4g} to {most:.4g} rad."
            )
    return joints


def frame_keys(frame: str) -> tuple[str, ...]:
    """Seven keys of a frame's pose: translation x, y, z, rotation x, y, z, w."""
    axes = (*(f"translation_{axis}" for axis in "xyz"), *(f"rotation_{axis}" for axis in "xyzw"))
    return tuple(f"{frame}_to_ref_{axis}" for axis in axes)


def wire_states(
    model: UrModel, state: RobotState, object_position: Array | None = None, *, with_forearm: bool = False
) -> list[dict[str, float]]:
    """The states under robo-gym's names, a dict for each: 20 keys, 7 more with an object, 7 more with the forearm.

    `object_position` (n, 3) is that of the target or obstacle [m]; its orientation is that of ``base_link``.
    """
    joints = state.signals["joint_position"]
    keys, columns = [*POSITIONS, *VELOCITIES], [joints, state.signals["joint_velocity"]]
    if object_position is not None:
        keys += frame_keys("object_0")
        columns += [object_position, np.tile([0.0, 0.0, 0.0, 1.0], (len(joints), 1))]
    positions, rotations = model.geometry.link_poses(joints)
    for frame, link in (("ee", -1), ("forearm", FOREARM)) if with_forearm else (("ee", -1),):
        keys += frame_keys(frame)
        columns += [positions[:, link], quaternions(rotations[:, link])]
    numbers = np.concatenate([*columns, collisions(state)[:, None].astype(np.float64)], axis=1)
    return [dict(zip([*keys, "in_collision"], row, strict=True)) for row in numbers.tolist()]
