"""robo-gym's arithmetic (2.1.0, ``envs/mir100``) of the MiR100's tasks, to the last constant, oddities included."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.task import Array, Flags, Floats, Label, Score
from bam_envs.robo_gym.parity_arms import require_inside
from bam_envs.robots.mir100 import BACK_RAYS, FOOTPRINT, FRONT_RAYS
from bam_envs.tasks.mir100_avoidance import NEAREST, Mir100AvoidanceTask
from bam_envs.tasks.mir100_navigation import ARRIVED, BOUNDARY, MAX_STEPS, DriveTask, Mir100NavigationTask

NEARER, FAILING, POWER = 50.0, -200.0, (0.30, 0.03)
"""Rewards of a metre nearer and of failure; cost of full speed, forward and turning."""
SAFETY_RADIUS = 0.40
"""A corner of the base nearer than this to the middle of a box is a collision [m]."""
BEAMS = np.round(np.linspace(0, FRONT_RAYS + BACK_RAYS - 1, 16)).astype(np.int64)
"""The rays that are observed, out of those of the front and the back scanner."""
_CORNERS = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * np.array(FOOTPRINT) / 2


class DriveParity(DriveTask):
    """Metres and radians; the way, but none for the first step; 500 steps terminate."""

    success_reward: float

    def labels(self) -> tuple[Label, ...]:
        """Nothing is scaled."""
        return (
            Label("target_distance", "target from the base", "m", low=-math.inf, high=math.inf),
            Label("target_bearing", "where the target is, seen from the base", "rad", low=-math.pi, high=math.pi),
            Label("linear_velocity", "speed forward", "m/s", low=-1.1, high=1.1),
            Label("angular_velocity", "speed of turning anticlockwise", "rad/s", low=-1.6, high=1.6),
        )

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """There is no distance of before."""
        super().on_reset(env_ids, state)
        self._previous[env_ids] = np.nan

    def _columns(self, state: RobotState) -> list[Array]:
        return [*self.way(state), *state.signals["base_velocity"].T]

    def _bounded(self, observation: Floats) -> Floats:
        return require_inside(observation, self.observation_space, self.observation_labels)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Arriving wins over failing, and the last step over both."""
        distance, failed = self.distance(state), self.failed(state)
        success = distance < ARRIVED
        reward = np.where(failed, FAILING, self._shaping(distance, action))
        reward = np.where(success, self.success_reward, reward)
        self.elapsed = self.elapsed + 1
        late = self.elapsed >= MAX_STEPS
        return self._scored(state, distance, reward, failed | success | late, success, failed, late)

    def _shaping(self, distance: Array, action: Floats) -> Array:
        """Nothing for the first step but its power, which is float32 as the action."""
        forward = np.abs(action[:, 0] * np.float32(POWER[0]))
        turn = np.abs(action[:, 1] * np.float32(POWER[1]))
        nearer = -NEARER * distance - -NEARER * self._previous
        shaping: Array = np.where(
            np.isnan(self._previous), (-forward - turn).astype(np.float64), nearer - forward - turn
        )
        return shaping

    def _wire_obstacles(self, state: RobotState) -> Array:
        return np.zeros((self.num_envs, 9))


class Mir100NavigationParity(DriveParity, Mir100NavigationTask):
    """robo-gym's NoObstacleNavigationMir100.

    With ``parity=True`` observation, reward and end are those of robo-gym's `NoObstacleNavigationMir100`: metres and
    radians, the way at a hundred times this reward but none for that of the first step, 200 at success, -200 outside,
    y below -10 m is not noticed, and the episode is terminated after 500 steps as "max_steps_exceeded".
    """

    success_reward = 200.0

    def failed(self, state: RobotState) -> Flags:
        """Whether the base left the floor; a misplaced parenthesis lets it go where y is low. Shape: (n,)."""
        x, y = state.signals["base_pose"][:, 0], state.signals["base_pose"][:, 1]
        outside: Flags = (np.abs(x) > BOUNDARY) | (y > BOUNDARY)
        return outside


class Mir100AvoidanceParity(DriveParity, Mir100AvoidanceTask):
    """robo-gym's ObstacleAvoidanceMir100.

    With ``parity=True`` observation, reward and end are those of robo-gym's `ObstacleAvoidanceMir100`: metres and
    radians, 16 single rays, the way at a hundred times this reward but none for that of the first step, 100 at
    success, -200 at a collision; it collides also when a corner comes near the middle of a box, never on a live robot
    and never by a ray that is not a number, and the episode is terminated after 500 steps as "max_steps_exceeded".
    """

    success_reward = 100.0

    def labels(self) -> tuple[Label, ...]:
        """Those of driving, and single rays."""
        rays = (Label(f"range_{ray}", f"ray {ray} of both scanners", "m", low=0.0, high=29.0) for ray in BEAMS)
        return (*DriveParity.labels(self), *rays)

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
        near &= ~np.isnan(front[:, 0])  # Python's min() never leaves a first number that is none
        near |= self._corner_near_box(state.signals["base_pose"])
        touching: Any = state.truth.get("collision", False)
        failed: Flags = near | touching
        return failed

    def _corner_near_box(self, pose: Array) -> Flags:
        """Whether a corner is within `SAFETY_RADIUS` of the middle of a box; as if the base's frame were its middle."""
        cos, sin = np.cos(pose[:, 2].copy())[:, None], np.sin(pose[:, 2].copy())[:, None]
        x = pose[:, :1] + _CORNERS[:, 0] * cos - _CORNERS[:, 1] * sin
        y = pose[:, 1:2] + _CORNERS[:, 0] * sin + _CORNERS[:, 1] * cos
        dx, dy = x[:, :, None] - self.obstacles[:, None, :, 0], y[:, :, None] - self.obstacles[:, None, :, 1]
        near: Flags = (dx * dx + dy * dy <= SAFETY_RADIUS**2).any(axis=(1, 2))
        return near
