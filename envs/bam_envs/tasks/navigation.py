"""Drive a wheeled base to a target on an open floor; `DriveTask` is the base class of the tasks of bases.

Poses are x, y [m] and yaw [rad].
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.core.env_options import finite_numbers
from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.robot_models import DEFAULT_BASE
from bam_envs.core.task import Array, Flags, Floats, Label, Memory, Score, as_objects, draw_seeds, labelled_box, limited
from bam_envs.robots.base_description import base_model

FASTEST = {"m/s": 0.5, "rad/s": 0.7}
"""Speeds of an action of 1 by unit, or the maximum of a base that is slower; the guards of a live base allow them."""
AXES = {
    "linear_velocity": ("forward", "speed forward"),
    "lateral_velocity": ("sideways", "speed to the left"),
    "angular_velocity": ("turn", "speed of turning anticlockwise"),
}
"""The numbers of an action, by those of the command, and what they mean."""
ARRIVED = 0.2
"""The base has arrived when it is nearer than this to its target [m]."""
MAX_STEPS = 500
"""Steps of an episode."""
BOUNDARY = 10.0
"""Extent of the floor from the origin, along x and along y [m]."""
NEARER, ARRIVING, FAILING, TIME, POWER = 0.5, 2.0, -2.0, 0.005, (0.003, 0.0003)
"""Rewards of a metre nearer, of success and of failure; costs of a step and of full speed, forward and turning."""
DISTANCE_SCALE = 4.0  # of the distance that is observed [m]
START, TARGET = 2.0, 1.0
"""Starts and targets are drawn at most this far from the origin, along x and along y [m]."""
MIN_DISTANCE = 1.0  # a target that is drawn is at least this far from the start [m]
CANDIDATES = 64  # targets that are drawn; the first one that is far enough from the start is used
START_TOLERANCE = 0.2  # a base nearer than this to its start pose is there [m], [rad]


class DriveTask(Memory):
    """Drive to within `ARRIVED` of a target; the heading there does not matter.

    Args:
        robot_model: The base: the name of a description, or its file.
        rs_state_to_info: Add the state of robo-gym's robot server to the info as ``rs_state``; for a MiR100.

    Raises:
        InvalidValue: `robot_model` is no base, or no MiR100 where robo-gym's state is asked for.
    """

    reset_options = ("start_pose", "target_pose")
    memory: Mapping[str, str] = {"target": "target", "elapsed": "elapsed", "previous": "_previous"}
    failure: str  # ``final_status`` of a failure
    draws: int  # number of random numbers that `starts` and `targets` take for each environment

    def __init__(self, num_envs: int = 1, *, robot_model: Any = DEFAULT_BASE, rs_state_to_info: bool = False) -> None:
        self.num_envs, self.rs_state_to_info = num_envs, rs_state_to_info
        self.base = base_model(robot_model)
        if rs_state_to_info:
            self.require_mir100("rs_state_to_info")
        self.body, command = self.base.body, self.base.spec(with_scans=False).command
        rows = list(zip(command.labels, command.units, command.high, strict=True))
        self.fastest = np.array([min(FASTEST[unit], most) for _, unit, most in rows])
        """Speeds of an action of 1 [m/s, rad/s]. Shape: (m,)."""
        scales = [f"/ {fastest:g}" for fastest in self.fastest]
        self.action_labels: tuple[Label, ...] = tuple(
            Label(*AXES[name], unit, scale) for (name, unit, _), scale in zip(rows, scales, strict=True)
        )
        self.observation_labels: tuple[Label, ...] = self._observation_labels()
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.target = np.zeros((num_envs, 3))
        """x, y [m] and yaw [rad]. Shape: (n, 3)."""
        self.elapsed = np.zeros(num_envs, dtype=np.int64)  # steps since the episode began
        self._previous = np.full(num_envs, np.nan)  # distance one step ago [m]
        self._draws, self._asked = np.zeros((num_envs, self.draws)), np.full((num_envs, 2, 3), np.nan)

    def require_mir100(self, option: str) -> None:
        """`InvalidValue` if an option of robo-gym is given for another base."""
        if self.base.name != DEFAULT_BASE:
            raise InvalidValue(f"{option} is for robo-gym's base, {DEFAULT_BASE}, and not for {self.base.name}.")

    def _observation_labels(self) -> tuple[Label, ...]:
        speeds = zip(self.base.spec(with_scans=False).command.labels, self.action_labels, strict=True)
        return (
            Label("target_distance", "target from the base", "m", f"/ {DISTANCE_SCALE:g}", 0.0, 6.0),
            Label("target_bearing", "where the target is, seen from the base", "rad", "/ pi"),
            *(Label(name, axis.meaning, axis.unit, axis.scale, -2.5, 2.5) for name, axis in speeds),
        )

    def starts(self, draws: Array) -> Array:
        """Hook: start poses out of `draws` from [0, 1). Shapes: (k, draws) -> (k, 3)."""
        raise NotImplementedError

    def targets(self, draws: Array, start: Array) -> Array:
        """Hook: targets for bases that stand at `start` (k, 3). Shapes: (k, draws) -> (k, 3)."""
        raise NotImplementedError

    def scene(
        self, env_ids: EnvIds, draws: Array, start: Array, rngs: Sequence[np.random.Generator]
    ) -> dict[str, Array]:
        """Hook: start values of signals other than the pose, for the environments that begin.

        `start` (k, 3) has the chosen start poses, NaN without one; `draws` may be replaced if something is there.
        """
        return {}

    def seen(self, state: RobotState) -> list[Floats]:
        """Hook: further observations. Shape: (n, ...) each."""
        return []

    def failed(self, state: RobotState) -> Flags:
        """Hook: mask of the episodes that have failed. Shape: (n,)."""
        raise NotImplementedError

    def sample_initial(
        self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """A start pose; the target is chosen when the real pose of the base is known."""
        draws = np.stack([rng.random(self.draws) for rng in rngs])
        seeds = draw_seeds(rngs)
        for which, name in enumerate(self.reset_options):
            value = (options or {}).get(name)
            self._asked[env_ids, which] = np.nan if value is None else floor_pose(name, value)
        asked = self._asked[env_ids, 0]
        start = np.where(np.isnan(asked), self.starts(draws), asked)
        scene = self.scene(env_ids, draws, asked, rngs)
        self._draws[env_ids] = draws
        return Initial({"base_pose": start, **scene}, seeds)

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Choose the target for the measured pose of the base.

        Raises:
            InvalidValue: The start pose is that of another place, and the robot does not move at a reset.
        """
        pose = state.signals["base_pose"][env_ids]
        off = self._asked[env_ids, 0] - pose
        off[:, 2] = half_turn(off[:, 2])
        wrong = np.flatnonzero((np.abs(off) > START_TOLERANCE).any(axis=1))
        if len(wrong):
            there, here = self._asked[env_ids[wrong[0]], 0].tolist(), np.round(pose[wrong[0]], 3).tolist()
            raise InvalidValue(
                f"start_pose: this robot stays where it is, at {here}, and does not start at {there} (x, y [m], yaw "
                "[rad]). Drive it there, or leave start_pose out."
            )
        asked = self._asked[env_ids, 1]
        self.target[env_ids] = np.where(np.isnan(asked), self.targets(self._draws[env_ids], pose), asked)
        self.elapsed[env_ids] = 0
        self._previous[env_ids] = self.distance(state)[env_ids]

    def distance(self, state: RobotState) -> Array:
        """Distance of the target [m]. Shape: (n,)."""
        pose = state.signals["base_pose"]
        dx, dy = self.target[:, 0] - pose[:, 0], self.target[:, 1] - pose[:, 1]
        distance: Array = np.sqrt(dx * dx + dy * dy)
        return distance

    def bearing(self, state: RobotState) -> Array:
        """Bearing of the target, seen from the base, from -pi to pi [rad]. Shape: (n,)."""
        pose = state.signals["base_pose"]
        return half_turn(np.arctan2(self.target[:, 1] - pose[:, 1], self.target[:, 0] - pose[:, 0]) - pose[:, 2])

    def _columns(self, state: RobotState) -> list[Array]:
        """The first numbers of an observation. Shape: (n,) each."""
        speeds = state.signals["base_velocity"] / self.fastest
        return [self.distance(state) / DISTANCE_SCALE, self.bearing(state) / math.pi, *speeds.T]

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, k) float32."""
        driving = np.stack(self._columns(state), axis=1).astype(np.float32)
        return self._bounded(np.concatenate([driving, *self.seen(state)], axis=1))

    def _bounded(self, observation: Floats) -> Floats:
        return limited(observation, self.observation_space.low, self.observation_space.high)

    def command(self, action: Floats, state: RobotState) -> Array:
        """Speeds of the base [m/s, rad/s]. Shape: (n, m)."""
        command: Array = limited(action, -1.0, 1.0).astype(np.float64) * self.fastest
        return command

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward approaching the target, less time and power; success and failure have their own rewards instead."""
        distance, failed = self.distance(state), self.failed(state)
        success = (distance < ARRIVED) & ~failed
        *driven, turn = np.abs(limited(action, -1.0, 1.0)).astype(np.float64).T
        reward = NEARER * (self._previous - distance) - POWER[0] * sum(driven) - POWER[1] * turn - TIME
        reward = np.where(failed, FAILING, np.where(success, ARRIVING, reward))
        self.elapsed = self.elapsed + 1
        terminated = failed | success
        status = np.where(self.elapsed >= MAX_STEPS, "max_steps_exceeded", "")
        status = np.where(success, "success", np.where(failed, self.failure, status))
        return self._scored(state, distance, reward, terminated, success, status)

    def _scored(
        self, state: RobotState, distance: Array, reward: Array, terminated: Flags, success: Flags, status: Any
    ) -> Score:
        self._previous = distance.copy()  # the info keeps the other array
        info: dict[str, Any] = {"distance": distance, "final_status": status, "target_coord": self.target.copy()}
        if self.rs_state_to_info:
            info["rs_state"] = as_objects(self.rs_state(state))
        return Score(reward, terminated, success, info)

    def rs_state(self, state: RobotState) -> list[list[float]]:
        """The states as robo-gym's robot server sends them, 1030 numbers each; see `bam_envs.robo_gym.rs_state`."""
        n, obstacles, scanners = self.num_envs, self._wire_obstacles(state), self.body.scanners
        columns = [
            self.target,
            state.signals["base_pose"],
            state.signals["base_velocity"],
            *(state.signals.get(one.signal, np.full((n, len(one.bearings)), one.range[1])) for one in scanners),
            state.truth.get("collision", np.zeros(n))[:, None],
            obstacles if obstacles.shape[1] else np.zeros((n, 9)),
        ]
        numbers: list[list[float]] = np.concatenate(columns, axis=1).tolist()
        return numbers

    def _wire_obstacles(self, state: RobotState) -> Array:
        return state.truth.get("obstacle_pose", np.zeros((self.num_envs, 0, 3))).reshape(self.num_envs, -1)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The target."""
        return [(np.array([self.target[0, 0], self.target[0, 1], 0.0]), (0.1, 0.7, 0.3, 0.6))]


class NavigationTask(DriveTask):
    """Drive to within 20 cm of a target, nothing in the way.

    An action of 1 is 0.5 m/s and 0.7 rad/s, or the maximum of a base that is slower; a base that can drive sideways has
    an action for it.

    Start:
        The base is at rest between x and y -2 and 2 m, with any yaw; a live one where it is. The target is between x
        and y -1 and 1 m, at least 1 m from the base. The reset options ``start_pose`` and ``target_pose`` (x, y [m],
        yaw [rad]) choose them.

    Reward:
        Each step 0.5 for each metre nearer, less 0.005 for the time, 0.003 |forward| and 0.0003 |turn|. At success 2
        instead, and -2 instead when the floor is left.

    Success:
        The base is nearer than 20 cm to the target. Its heading does not matter.

    End:
        Terminated at success, and outside the floor of 20 x 20 m about the origin.

    Info:
        `distance` of the target [m], `target_coord` (x, y [m], yaw [rad]), at the end `final_status`: "success",
        "out of boundary" or "max_steps_exceeded".
    """

    failure = "out of boundary"
    draws = 3 + 2 * CANDIDATES

    def starts(self, draws: Array) -> Array:
        """Start poses near the origin. Shape: (k, 3)."""
        return np.concatenate([spread(draws[:, :2], -START, START), spread(draws[:, 2:3], -math.pi, math.pi)], axis=1)

    def targets(self, draws: Array, start: Array) -> Array:
        """The first candidate that is far enough; the last if none is. Shape: (k, 3)."""
        candidates = spread(draws[:, 3:], -TARGET, TARGET).reshape(-1, CANDIDATES, 2)
        offset = candidates - start[:, None, :2]
        enough = (offset * offset).sum(axis=2) >= MIN_DISTANCE**2
        enough[:, -1] = True
        chosen = candidates[np.arange(len(start)), enough.argmax(axis=1)]
        return np.concatenate([chosen, np.zeros((len(start), 1))], axis=1)

    def failed(self, state: RobotState) -> Flags:
        """Whether the base left the floor. Shape: (n,)."""
        outside: Flags = np.any(np.abs(state.signals["base_pose"][:, :2]) > BOUNDARY, axis=1)
        return outside


def spread(draws: Array, low: float, high: float) -> Array:
    """`draws` from [0, 1) as numbers from `low` to `high`."""
    return low + draws * (high - low)


def half_turn(angles: Array) -> Array:
    """The same angles, from -pi to pi [rad]."""
    return np.mod(angles + math.pi, 2 * math.pi) - math.pi


def floor_pose(name: str, value: Any) -> Array:
    """The reset option `name` as a pose on the floor, x, y [m] and yaw from -pi to pi [rad]. Shape: (3,)."""
    pose = finite_numbers(value, 3, f"{name} (x, y [m], yaw [rad])")
    if np.abs(pose[:2]).max() > BOUNDARY:
        raise InvalidValue(f"{name} must be within {BOUNDARY:g} m of the origin along x and y, not {pose.tolist()}.")
    pose[2:] = half_turn(pose[2:])
    return pose
