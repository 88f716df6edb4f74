"""robo-gym's arithmetic (2.1.0), to the last constant, oddities included: the tasks of ``parity=True``."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.core.errors import ProtocolError
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Flags, Floats, Label, Score
from bam_envs.robo_gym.rs_state import BACK_RAYS, FOOTPRINT, FRONT_RAYS
from bam_envs.robots.ur import JOINTS, START
from bam_envs.tasks.avoidance import AvoidanceTask
from bam_envs.tasks.isaac_reach import TOOL1, IsaacReachTask
from bam_envs.tasks.navigation import ARRIVED, BOUNDARY, MAX_STEPS, DriveTask, NavigationTask
from bam_envs.tasks.ur_arm import UrEmptyTask, UrTask, in_frame, joint_labels, normalised, spherical
from bam_envs.tasks.ur_avoidance import COLLISION, UrAvoidanceTask, UrObstacleTask, obstacle_labels
from bam_envs.tasks.ur_reach import UrReachTask
from bam_envs.tasks.ur_track import FIXED_PATHS, UrTrackTask

_INF = np.inf
_UNSCALED = ("1", "1", "1")
NEARER, FAILING, POWER = 50.0, -200.0, (0.30, 0.03)
"""Rewards of a metre nearer and of failure; cost of full speed, forward and turning."""
NEAREST = 0.15  # a ray shorter than this is a collision [m]
SAFETY_RADIUS = 0.40  # a corner of the base nearer than this to the middle of a box is a collision [m]
BEAMS = np.round(np.linspace(0, FRONT_RAYS + BACK_RAYS - 1, 16)).astype(np.int64)
"""The rays that are observed, out of those of the front and the back scanner."""
_CORNERS = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * np.array(FOOTPRINT) / 2


class UrParity(UrTask):
    """The last step of an episode terminates it as "max_steps_exceeded", unless there is a collision."""

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`; nothing is clipped to the space. Shape: (n, k) float32."""
        return np.concatenate(self._columns(state), axis=1).astype(np.float32)

    def ends(self, collision: Flags, success: Flags, late: Flags) -> tuple[Flags, Any]:
        """Collision, success and the last step end an episode. Shapes: (n,)."""
        status = np.where(late, "max_steps_exceeded", np.where(success, "success", ""))
        return collision | success | late, np.where(collision, "collision", status)


class UrEmptyParity(UrEmptyTask):
    """robo-gym's EmptyEnvironmentUR.

    With ``parity=True`` joint velocities are in rad/s, and after 300 steps an episode is terminated as "success".
    """

    def _observation_labels(self) -> tuple[Label, ...]:
        return (
            *joint_labels("", "joint position", "rad", "/ its limit", 1.1),
            *joint_labels("speed_", "joint velocity", "rad/s", "1", _INF),
        )

    def _columns(self, state: RobotState) -> list[Array]:
        return [normalised(self.model, state.signals["joint_position"]), state.signals["joint_velocity"]]

    def score(self, state: RobotState, action: Floats) -> Score:
        """Three hundred steps without a collision are a success."""
        score = super().score(state, action)
        score.success = (self.elapsed >= self.max_steps) & ~score.terminated
        score.info["final_status"] = np.where(score.success, "success", score.info["final_status"])
        score.terminated = score.terminated | score.success
        return score


class UrReachParity(UrParity, UrReachTask):
    """robo-gym's EndEffectorPositioningUR.

    With ``parity=True`` observations are robo-gym's numbers, in its units; the last six are the action before the
    last one; and after 300 steps an episode is terminated as "max_steps_exceeded".
    """

    must_be_in_reach = False

    def __init__(
        self, num_envs: int = 1, *, restrict_wrist_1: bool = True, modular: bool = False, **options: Any
    ) -> None:
        super().__init__(num_envs, restrict_wrist_1=restrict_wrist_1, modular=modular, **options)
        self._restrict = restrict_wrist_1 and not modular  # robo-gym maps a fixed wrist 1 too, and so moves it
        self.forgets_success = modular  # else a success of any earlier episode counts
        if modular:
            self.start = START

    def _observation_labels(self) -> tuple[Label, ...]:
        age, most = ("last action", 1.0) if self.modular else ("the action before the last one", 1.01)
        actions = joint_labels("action_", age, "rad", "/ its limit", most)
        return (
            Label("target_r", "target as the flange sees it, distance", "m", "1", -_INF, _INF),
            Label("target_polar", "target as the flange sees it, angle from its axis", "rad", "1", -_INF, _INF),
            Label("target_azimuth", "target as the flange sees it, angle about its axis", "rad", "1", -_INF, _INF),
            *joint_labels("", "joint position", "rad", "/ its limit", 1.1),
            *joint_labels("speed_", "joint velocity", "rad/s", "1", _INF),
            *(Label(f"target_{one}", f"target, {one}", "m", "1", -_INF, _INF) for one in "xyz"),
            *(Label(f"flange_{one}", f"flange, {one}", "m", "1", -_INF, _INF) for one in "xyz"),
            *(actions[joint] for joint in self._seen_actions()),
        )

    def _columns(self, state: RobotState) -> list[Array]:
        joints, velocity = state.signals["joint_position"], state.signals["joint_velocity"]
        place, axes = self.model.geometry.flange_pose(joints)
        seen, shares = spherical(in_frame(self.target, place, axes)), normalised(self.model, joints)
        actions = self._actions[0 if self.modular else 1][:, self._seen_actions()]
        return [seen, shares, velocity, self.target, place, actions]

    def _given_target(self, options: Mapping[str, Any]) -> Array | None:
        target = super()._given_target(options)
        return np.zeros(3) if target is None and self.modular else target  # robo-gym's sampler forgets the place


class IsaacReachParity(UrParity, IsaacReachTask):
    """robo-gym's IsaacReachUR.

    With ``parity=True`` nothing is scaled, an action is in units of 0.5 rad and as large as the joints' limits let
    it be, 600 steps terminate as "max_steps_exceeded", and the frame is robo-gym's ``tool1``, which is ``ee_link``
    turned by 90 degrees about x. Observations and actions are then those of Isaac Lab's policies.
    """

    yaw, frame, unscaled = 3.14, TOOL1, True

    def _action_labels(self) -> tuple[Label, ...]:
        low, high = (self.model.joint_limits - self._default) / self.scale
        ends, unit = zip(JOINTS, low.tolist(), high.tolist(), strict=True), f"/ {self.scale:g}"
        return tuple(Label(joint, "joint target from the default pose", "rad", unit, *both) for joint, *both in ends)

    def _observation_labels(self) -> tuple[Label, ...]:
        low, high = 1.2 * self.model.joint_limits - self._default  # a joint may be a tenth of its range beyond it
        ends = zip(JOINTS, low.tolist(), high.tolist(), strict=True)
        return (
            *(Label(joint, "joint position from the default pose", "rad", "1", *both) for joint, *both in ends),
            *(Label(f"{joint}_speed", "joint velocity", "rad/s", "1", -_INF, _INF) for joint in JOINTS),
            *(Label(f"target_{axis}", f"target, {axis}", "m", "1", -_INF, _INF) for axis in "xyz"),
            *self._pose_and_action_labels(),
        )

    def _columns(self, state: RobotState) -> list[Array]:
        joints, speeds = state.signals["joint_position"] - self._default, state.signals["joint_velocity"]
        return [joints, speeds, self.target, self.quaternion[:, [3, 0, 1, 2]], self._last_action]


class UrObstacleParity(UrObstacleTask):
    """Nothing is scaled, no observation is outside its space, and 1000 steps terminate."""

    def _observation_labels(self) -> tuple[Label, ...]:
        far = _INF if self.include_polar_to_elbow else 0.0
        return (
            *obstacle_labels("tool0", _UNSCALED, (-_INF, -_INF, -_INF), _INF),
            *joint_labels("", "joint position", "rad", "/ joint limit", 1.1),
            *joint_labels("off_", "joint position from the reference", "rad", "/ joint limit", 1.1),
            *obstacle_labels("forearm_link", _UNSCALED, (-far, -far, -far), far),
        )

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, k) float32."""
        observation = np.concatenate(self._columns(state), axis=1).astype(np.float32)
        return require_inside(observation, self.observation_space, self.observation_labels)

    def _columns(self, state: RobotState) -> list[Array]:
        sense = self.sense(state)
        elbow = sense.elbow if self.include_polar_to_elbow else np.zeros_like(sense.elbow)
        return [sense.tool, sense.joints, self.offset(state), elbow]

    def ends(self, collision: Flags, success: Flags, late: Flags) -> tuple[Flags, Any]:
        """A collision and the last step end an episode. Shapes: (n,)."""
        terminated, status = super().ends(collision, success, late)
        return terminated | success, status


class UrAvoidanceParity(UrObstacleParity, UrAvoidanceTask):
    """robo-gym's BasicAvoidanceUR.

    With ``parity=True`` the pose is robo-gym's [0, -2.5, 1.5, 0, -1.4, 0], the first reward depends on the sum over
    the observation's last six numbers, as robo-gym's does, a collision costs nothing, and 1000 steps terminate.
    """

    pose, collision_reward = START, None

    def spread(self, state: RobotState) -> tuple[Array, Array]:
        """The second is robo-gym's wrong slice: the last three offsets and the obstacle seen from the elbow."""
        seen = np.abs(self.observe(state).astype(np.float64))
        return seen[:, 9:15].sum(axis=1), seen[:, 12:18].sum(axis=1)


class UrTrackParity(UrObstacleParity, UrTrackTask):
    """robo-gym's AvoidanceRaad2022UR.

    With ``parity=True`` nothing is scaled, the end of a segment is worth nothing and is counted one step later, the
    arm starts at the first waypoint whatever the reset option says, and 1000 steps terminate, as in robo-gym. The
    trajectory is still this package's own; ``trajectory`` names robo-gym's.
    """

    def _observation_labels(self) -> tuple[Label, ...]:
        return (*super()._observation_labels(), *self._waypoint_labels(1.1))

    def _columns(self, state: RobotState) -> list[Array]:
        waits = self.waits[:, None].astype(np.float64)
        return [*super()._columns(state), normalised(self.model, self.reference), waits]

    def sample_initial(
        self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """The first waypoint, whatever `options` say of the joints."""
        initial = super().sample_initial(env_ids, rngs, options)
        return Initial({**initial.signals, "joint_position": self.reference[env_ids]}, initial.seeds)

    def _path_numbers(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> list[int]:
        """The paths in order."""
        return [int(number) % FIXED_PATHS for number in self._episodes[env_ids]]

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward close following, small and smooth actions, and distance from the obstacle."""
        offset = self.offset(state).astype(np.float32).astype(np.float64)  # robo-gym reads it from its observation
        reward, counted = self._following(state, offset, action), self.targets_reached
        self._advance(state)
        return self.scored(state, reward, COLLISION, targets_reached=counted.copy())


class DriveParity(DriveTask):
    """Observations in metres and radians; no reward for the first step's progress; 500 steps terminate."""

    success_reward: float

    def __init__(self, num_envs: int = 1, **options: Any) -> None:
        super().__init__(num_envs, **options)
        self.require_mir100("parity")

    def _observation_labels(self) -> tuple[Label, ...]:
        return (
            Label("target_distance", "target from the base", "m", low=-_INF, high=_INF),
            Label("target_bearing", "where the target is, seen from the base", "rad", low=-np.pi, high=np.pi),
            Label("linear_velocity", "speed forward", "m/s", low=-1.1, high=1.1),
            Label("angular_velocity", "speed of turning anticlockwise", "rad/s", low=-1.6, high=1.6),
        )

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Forget the previous distance."""
        super().on_reset(env_ids, state)
        self._previous[env_ids] = np.nan

    def _columns(self, state: RobotState) -> list[Array]:
        return [self.distance(state), self.bearing(state), *state.signals["base_velocity"].T]

    def _bounded(self, observation: Floats) -> Floats:
        return require_inside(observation, self.observation_space, self.observation_labels)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Success takes precedence over failure, and the last step over both."""
        distance, failed = self.distance(state), self.failed(state)
        success = distance < ARRIVED
        # The first step has no shaping but its power, which is float32 as the action.
        forward, turn = np.abs(action * np.array(POWER, np.float32)).T
        nearer = -NEARER * distance - -NEARER * self._previous
        first = np.isnan(self._previous)
        reward = np.where(first, (-forward - turn).astype(np.float64), nearer - forward - turn)
        reward = np.where(failed, FAILING, reward)
        reward = np.where(success, self.success_reward, reward)
        self.elapsed = self.elapsed + 1
        late = self.elapsed >= MAX_STEPS
        status = np.where(success, "success", np.where(failed, self.failure, ""))
        status = np.where(late, "max_steps_exceeded", status)
        return self._scored(state, distance, reward, failed | success | late, success, status)

    def _wire_obstacles(self, state: RobotState) -> Array:
        return np.zeros((self.num_envs, 9))


class Mir100NavigationParity(DriveParity, NavigationTask):
    """robo-gym's NoObstacleNavigationMir100.

    With ``parity=True`` observation, reward and end are those of robo-gym's `NoObstacleNavigationMir100`: metres and
    radians, the way at a hundred times this reward but none for that of the first step, 200 at success, -200 outside,
    y below -10 m is not noticed, and the episode is terminated after 500 steps as "max_steps_exceeded".
    """

    success_reward = 200.0

    def failed(self, state: RobotState) -> Flags:
        """Whether the base left the floor; robo-gym's misplaced parenthesis ignores a low y. Shape: (n,)."""
        x, y = state.signals["base_pose"][:, 0], state.signals["base_pose"][:, 1]
        failed: Flags = (np.abs(x) > BOUNDARY) | (y > BOUNDARY)
        return failed


class Mir100AvoidanceParity(DriveParity, AvoidanceTask):
    """robo-gym's ObstacleAvoidanceMir100.

    With ``parity=True`` observation, reward and end are those of robo-gym's `ObstacleAvoidanceMir100`: metres and
    radians, 16 single rays, the way at a hundred times this reward but none for that of the first step, 100 at
    success, -200 at a collision; it collides also when a corner comes near the middle of a box, never on a live robot
    and never by a ray that is not a number, and the episode is terminated after 500 steps as "max_steps_exceeded".
    """

    success_reward = 100.0

    def _observation_labels(self) -> tuple[Label, ...]:
        rays = (Label(f"range_{ray}", f"ray {ray} of both scanners", "m", low=0.0, high=29.0) for ray in BEAMS)
        return (*DriveParity._observation_labels(self), *rays)

    def seen(self, state: RobotState) -> list[Floats]:
        """Single rays. Shape: (n, 16) in two parts."""
        front, back = BEAMS[BEAMS < FRONT_RAYS], BEAMS[BEAMS >= FRONT_RAYS] - FRONT_RAYS
        rays = (state.signals["f_scan"][:, front], state.signals["b_scan"][:, back])
        return [np.nan_to_num(one).astype(np.float32) for one in rays]

    def failed(self, state: RobotState) -> Flags:
        """Whether the base touches something, or nearly does, in simulation. Shape: (n,)."""
        if not state.truth:
            return np.zeros(self.num_envs, dtype=bool)
        front, back = state.signals["f_scan"], state.signals["b_scan"]
        near: Flags = np.fmin(np.fmin.reduce(front, axis=1), np.fmin.reduce(back, axis=1)) < NEAREST
        near &= ~np.isnan(front[:, 0])  # Python's min() returns a NaN that comes first
        near |= self._corner_near_box(state.signals["base_pose"])
        touching: Any = state.truth.get("collision", False)
        failed: Flags = near | touching
        return failed

    def _corner_near_box(self, pose: Array) -> Flags:
        """Whether a corner is within `SAFETY_RADIUS` of the middle of a box; takes the base's frame as its middle."""
        cos, sin = np.cos(pose[:, 2].copy())[:, None], np.sin(pose[:, 2].copy())[:, None]
        x = pose[:, :1] + _CORNERS[:, 0] * cos - _CORNERS[:, 1] * sin
        y = pose[:, 1:2] + _CORNERS[:, 0] * sin + _CORNERS[:, 1] * cos
        dx, dy = x[:, :, None] - self.obstacles[:, None, :, 0], y[:, :, None] - self.obstacles[:, None, :, 1]
        near: Flags = (dx * dx + dy * dy <= SAFETY_RADIUS**2).any(axis=(1, 2))
        return near


def require_inside(observation: Floats, space: spaces.Box, labels: Sequence[Label]) -> Floats:
    """`observation` (n, k), if all of it is in `space`; robo-gym has no observation outside.

    Raises:
        ProtocolError: Names the first number that is not; robo-gym raises ``InvalidStateError``.
    """
    outside = ~((observation >= space.low) & (observation <= space.high))  # NaN included
    if outside.any():
        env, column = np.argwhere(outside)[0]
        label, value = labels[column], observation[env, column]
        raise ProtocolError(
            f"{label.name} is {value:.6g} {label.unit}, expected {label.low:.6g} to {label.high:.6g}, as in robo-gym: "
            "with parity=True there is no observation outside its space; leave parity out, or look at the sensor."
        )
    return observation
