"""Avoidance: stay at a pose, and avoid an obstacle that moves up and down beside it.

`UrObstacleTask` is shared with `bam_envs.tasks.ur_track`. Frames are robo-gym's: ``tool0`` is the end effector,
``forearm_link`` the elbow; positions are in ``base_link``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bam_envs.core.env_options import finite_numbers
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Flags, Floats, Label, Score, limited
from bam_envs.robots.physics.obstacles import wave_signals
from bam_envs.tasks.ur_arm import (
    FOREARM,
    UrTask,
    collisions,
    in_frame,
    joint_labels,
    joint_option,
    normalised,
    spherical,
    wire_states,
)

FAR = 2.0  # distance that is 1 in observations [m]
OFFSET = 0.1  # share of the joint limits off the reference that is 1 in observations
COLLISION = -0.1
"""Reward of a collision."""
POSE = (-1.57, -1.31, -1.31, -2.18, 1.57, 0.0)
"""Joint positions to stay at [rad]; the obstacle moves past the flange."""
NEAREST = 0.30  # distance of the obstacle from flange and elbow that costs [m]
RAPID = 0.5  # change of an action that costs, in a joint [rad]
SPREAD = 0.6  # sum of the joints' offsets, as shares of their limits, below which they are rewarded


def obstacle_labels(
    frame: str,
    scales: tuple[str, str, str] = (f"/ {FAR:g}, clipped", "/ pi", "/ pi"),
    lows: tuple[float, float, float] = (0.0, 0.0, -1.0),
    high: float = 1.0,
) -> tuple[Label, ...]:
    """Labels of the obstacle's spherical coordinates in `frame`."""
    names = ("distance", "polar", "azimuth")
    meanings = ("obstacle's distance", "obstacle's angle from z", "obstacle's angle from x about z")
    lines = zip(names, meanings, ("m", "rad", "rad"), scales, lows, strict=True)
    return tuple(
        Label(f"{frame}_{name}", f"{meaning} in the frame {frame}", unit, scale, low, high)
        for name, meaning, unit, scale, low in lines
    )


class ObstacleSense:
    """The obstacle relative to the arm in one state, computed once for `observe` and `score`."""

    def __init__(self, task: UrObstacleTask, state: RobotState) -> None:
        self.state = state
        positions, rotations = task.model.geometry.link_poses(state.signals["joint_position"])
        self.obstacle = state.signals["object_position"]
        from_tool = in_frame(self.obstacle, positions[:, -1], rotations[:, -1])
        from_elbow = in_frame(self.obstacle, positions[:, FOREARM], rotations[:, FOREARM])
        self.tool, self.elbow = spherical(from_tool), spherical(from_elbow)
        """Distance [m] and two angles [rad] of the obstacle. Shape: (n, 3) each."""
        self.nearest: Array = np.minimum(self.tool[:, 0], self.elbow[:, 0])
        """Distance of the obstacle from flange or elbow, the nearer one [m]. Shape: (n,)."""
        self.joints = normalised(task.model, state.signals["joint_position"])


class UrObstacleTask(UrTask):
    """Base class of tasks with a reference to follow and an obstacle to avoid.

    Args:
        include_polar_to_elbow: Whether the observation has the obstacle seen from the elbow, or zeros.
        fixed_object_position: Position of an obstacle that stays at rest in every episode (3) [m].
    """

    rate, velocity_scale, max_steps = 20.0, 0.2, 1000
    reset_options = ("joint_positions", "fixed_object_position")
    action_meaning = ("joint target beside the reference", "rad", "1")
    memory: Mapping[str, str] = {"reference": "reference", "steps": "elapsed", "last_action": "_last_action"}

    def __init__(
        self,
        num_envs: int = 1,
        *,
        include_polar_to_elbow: bool = False,
        fixed_object_position: Sequence[float] | None = None,
        **options: Any,
    ) -> None:
        self.include_polar_to_elbow = include_polar_to_elbow
        super().__init__(num_envs, **options)
        self._place = _place(fixed_object_position)
        self.reference = np.zeros((num_envs, 6))
        """Reference joint positions [rad]. Shape: (n, 6)."""
        self._last_action = np.zeros((num_envs, 6))
        self._sense: ObstacleSense | None = None

    def _observation_labels(self) -> tuple[Label, ...]:
        return (
            *obstacle_labels("tool0"),
            *joint_labels("", "joint position", "rad", "/ joint limit"),
            *joint_labels(
                "off_", "joint position from the reference", "rad", f"/ joint limit / {OFFSET:g}, clipped", 2.0
            ),
            *obstacle_labels("forearm_link"),
        )

    def begin(self, env_ids: EnvIds, options: Mapping[str, Any], joints: Array) -> tuple[Array, Array | None]:
        """Start of the arms (k, 6) [rad], `joints` (6,) or that of the options, and of obstacles at rest (k, 3) [m]."""
        start = joint_option(options, joints.tolist(), self.model)
        place = _place(options.get("fixed_object_position"))
        place = self._place if place is None else place
        self._last_action[env_ids] = 0.0
        stays = None if place is None else np.tile(place, (len(env_ids), 1))
        return np.tile(start, (len(env_ids), 1)), stays

    def sense(self, state: RobotState) -> ObstacleSense:
        """The obstacle in `state`, computed once."""
        if self._sense is None or self._sense.state is not state:
            self._sense = ObstacleSense(self, state)
        return self._sense

    def offset(self, state: RobotState) -> Array:
        """Joints from the reference, as shares of their limits. Shape: (n, 6)."""
        return self.sense(state).joints - normalised(self.model, self.reference)

    def _columns(self, state: RobotState) -> list[Array]:
        sense, units = self.sense(state), np.array([FAR, np.pi, np.pi])
        elbow = sense.elbow / units if self.include_polar_to_elbow else np.zeros_like(sense.elbow)
        return [sense.tool / units, sense.joints, self.offset(state) / OFFSET, elbow]

    def command(self, action: Floats, state: RobotState) -> Array:
        """One period on the way to the reference plus `action` [rad]; fixed joints keep to it. Shape: (n, 6)."""
        return self.toward(self.reference + self.full_action(action), state)

    def action_to(self, joints: Array) -> Floats:
        """The action whose targets are `joints` (n, 6) [rad]. Shape: (n, a)."""
        action: Floats = limited(joints - self.reference, -1.0, 1.0)[:, self.free].astype(np.float32)
        return action

    def effort(self, action: Floats, weight: float, rapid: float) -> Array:
        """Reward for small actions (n,), less for each joint whose action jumps by more than `rapid`."""
        full = self.full_action(action)
        jumps = (np.abs(full - self._last_action) > rapid).sum(axis=1)
        self._last_action = full
        effort: Array = (weight * (1 - np.einsum("ij,ij->i", full, full) / 6) - 0.2 * jumps) / 1000
        return effort

    def ends(self, collision: Flags, success: Flags, late: Flags) -> tuple[Flags, Any]:
        """A collision ends an episode; success is the time limit without a collision."""
        return collision, np.where(collision, "collision", np.where(success, "success", ""))

    def scored(self, state: RobotState, reward: Array, collision_reward: float | None, **values: Any) -> Score:
        """Count the step: `reward`, or `collision_reward` at a collision, and the infos of both tasks."""
        self.elapsed = self.elapsed + 1
        collision = collisions(state)
        success = (self.elapsed >= self.max_steps) & ~collision
        terminated, status = self.ends(collision, success, success)
        if collision_reward is not None:
            reward = np.where(collision, collision_reward, reward)
        sense = self.sense(state)
        values |= {"final_status": status, "target_coord": sense.obstacle.copy(), "distance": sense.nearest.copy()}
        return Score(reward, terminated, success, self.info(state, **values))

    def rs_state(self, state: RobotState) -> list[dict[str, float]]:
        """robo-gym's wire state of each environment: 34 named numbers."""
        return wire_states(self.model, state, state.signals["object_position"], with_forearm=True)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The flange at the reference; the robot shows the obstacle."""
        return [(self.model.geometry.flange_pose(self.reference[:1])[0][0], (0.1, 0.7, 0.3, 0.6))]


def _place(given: Any) -> Array | None:
    return None if given is None else finite_numbers(given, 3, "fixed_object_position")


class UrAvoidanceTask(UrObstacleTask):
    """Stay at the pose and 30 cm away from the obstacle.

    Start:
        The arm is at [-1.57, -1.31, -1.31, -2.18, 1.57, 0] rad, or at the reset option ``joint_positions`` (6) [rad]:
        the pose to keep. The obstacle, a sphere of 5 cm, is at x 0.12 and y 0.34 m, at the bottom of a triangle wave
        of 0.125 Hz whose middle is 0.2 to 0.6 m above the base, and which goes 0.09 to 0.35 m up and down; or it
        stays at the reset option ``fixed_object_position`` (3) [m].

    Action:
        Target joint positions, relative to the pose [rad]. The joints move there at a fifth of their maximum speed, and
        slower when they are near.

    Reward:
        Each step, in thousandths: 1 - s / 0.6 while the sum s of the joints' offsets from the pose, in shares of their
        limits, is below 0.6; 1 - the mean square of the action; -0.2 for each joint whose action changed by more than
        0.5; -2 while the obstacle is within 0.30 m of flange or elbow. At a collision -0.1 only.

    Success:
        No collision in 1000 steps.

    End:
        Terminated at a collision of the arm with itself, the table or the obstacle, which a live arm does not detect.

    Info:
        `target_coord` of the obstacle [m], its `distance` from flange or elbow, the nearer one [m], `rs_state` where it
        is asked for, and at the end `final_status`: "success" or "collision".
    """

    pose: tuple[float, ...] = POSE
    collision_reward: float | None = COLLISION

    def sample_initial(
        self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """The pose, and an obstacle that goes up and down or stays."""
        draws = np.stack([rng.random(2) for rng in rngs])
        joints, place = self.begin(env_ids, options or {}, np.array(self.pose))
        self.reference[env_ids] = joints
        return self.initial(joints, rngs, **(wave_signals(draws) if place is None else {"obstacle_position": place}))

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward staying at the pose, small and smooth actions, and distance from the obstacle."""
        off, gate = self.spread(state)
        reward = np.where(gate < SPREAD, (1 - off / SPREAD) / 1000, 0.0)
        reward = reward + self.effort(action, weight=1.0, rapid=RAPID)
        reward = reward - 0.002 * (self.sense(state).nearest < NEAREST)
        return self.scored(state, reward, self.collision_reward)

    def spread(self, state: RobotState) -> tuple[Array, Array]:
        """Offset of the joints from the pose, and the number that must be below `SPREAD`. Shape: (n,) each."""
        off = np.abs(self.offset(state)).sum(axis=1)
        return off, off
