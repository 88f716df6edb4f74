"""What the MiR100's tasks share: driving to a place, its reward and its ends.

``parity=True`` is robo-gym's arithmetic (2.1.0, ``envs/mir100``) to the last constant, oddities included; otherwise it
is what was plainly meant, in a scale that is easily learnt.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.core.robot import Initial, RobotState, Rows
from bam_envs.core.task import Array, Flags, Floats, Label, Score, labelled_box, require_inside
from bam_envs.robots.mir100 import BACK_RAYS, FRONT_RAYS, SCAN_RANGE
from bam_envs.tasks.poses import floor_pose, preferred, require_at

FASTEST = np.array([0.5, 0.7])
"""Speeds of an action of 1: forward [m/s], turning anticlockwise [rad/s]."""
ARRIVED = 0.2
"""The base has arrived when it is nearer than this to its target [m]."""
MIN_DISTANCE = 1.0
"""A target that is drawn is at least this far from the start [m]."""
MAX_STEPS = 500
"""Length of an episode with ``parity=True``, which ends by itself."""
BOUNDARY = 10.0
"""The floor goes this far from the origin, along x and along y [m]."""
NEARER, ARRIVING, FAILING, TIME, POWER = 0.5, 2.0, -2.0, 0.005, (0.003, 0.0003)
"""Rewards without ``parity=True``: of a metre, of success and failure, and the costs of a step and of full speed."""
DISTANCE_SCALE = 4.0
"""Of the distance that is observed [m]."""
_NEARER, _FAILING, _POWER = 50.0, -200.0, (0.30, 0.03)  # of robo-gym
_RUNNING, _FAILED, _SUCCEEDED, _OVERTIME = range(4)

DRIVE_LABELS = (
    Label("target_distance", "target from the base", "m", f"/ {DISTANCE_SCALE:g}", 0.0, 6.0),
    Label("target_bearing", "where the target is, seen from the base", "rad", "/ pi"),
    Label("linear_velocity", "speed forward", "m/s", f"/ {FASTEST[0]:g}", -2.5, 2.5),
    Label("angular_velocity", "speed of turning anticlockwise", "rad/s", f"/ {FASTEST[1]:g}", -2.5, 2.5),
)
PARITY_LABELS = (
    Label("target_distance", "target from the base", "m", low=-math.inf, high=math.inf),
    Label("target_bearing", "where the target is, seen from the base", "rad", low=-math.pi, high=math.pi),
    Label("linear_velocity", "speed forward", "m/s", low=-1.1, high=1.1),
    Label("angular_velocity", "speed of turning anticlockwise", "rad/s", low=-1.6, high=1.6),
)


class DriveTask:
    """Drive to within `ARRIVED` of a target; the heading there does not matter.

    Args:
        num_rows: How many robots are scored together.
        parity: Robo-gym's arithmetic.
        rs_state_to_info: ``info["rs_state"]`` is the state as robo-gym's robot server would send it.
    """

    reset_options = ("start_pose", "target_pose")
    action_labels = (
        Label("forward", "speed forward", "m/s", f"/ {FASTEST[0]:g}"),
        Label("turn", "speed of turning anticlockwise", "rad/s", f"/ {FASTEST[1]:g}"),
    )
    parity_success: float
    """Reward of robo-gym for success."""
    failure: str
    """What ``final_status`` says when something went wrong."""
    draws: int
    """How many numbers `starts` and `targets` take of each row."""

    def __init__(self, num_rows: int = 1, *, parity: bool = False, rs_state_to_info: bool = False) -> None:
        self.num_rows, self.parity, self.ends_by_itself = num_rows, parity, parity
        self.rs_state_to_info = rs_state_to_info
        self.observation_labels = self.labels()
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.target = np.zeros((num_rows, 3))
        """x, y [m] and yaw [rad]. Shape: (n, 3)."""
        self.elapsed = np.zeros(num_rows, dtype=np.int64)
        """Steps since the episode began. Shape: (n,)."""
        self._previous = np.full(num_rows, np.nan)  # distance one step ago [m]; NaN: there was none
        self._draws, self._asked = np.zeros((num_rows, self.draws)), np.full((num_rows, 2, 3), np.nan)

    def labels(self) -> tuple[Label, ...]:
        """Hook: what each number of an observation means."""
        return PARITY_LABELS if self.parity else DRIVE_LABELS

    def starts(self, draws: Array) -> Array:
        """Hook: start poses, x, y [m] and yaw [rad], out of `draws` from [0, 1). Shapes: (k, draws) -> (k, 3)."""
        raise NotImplementedError

    def targets(self, draws: Array, start: Array) -> Array:
        """Hook: targets for bases that stand at `start` (k, 3). Shapes: (k, draws) -> (k, 3)."""
        raise NotImplementedError

    def make_way(self, start: Array, draws: Array, rngs: Sequence[np.random.Generator]) -> None:
        """Hook: draw anew, in `draws` (k, draws), what is where bases are to start, at `start` (k, 3)."""

    def scene(self, rows: Rows, draws: Array) -> dict[str, Array]:
        """Hook: start values of other signals than the pose."""
        return {}

    def failed(self, state: RobotState) -> Flags:
        """Hook: which episodes are over because something went wrong. Shape: (n,)."""
        raise NotImplementedError

    def sample_initial(
        self, rows: Rows, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """A start pose; the target is chosen when it is known where the base really is."""
        draws = np.stack([rng.random(self.draws) for rng in rngs])
        seeds = np.array([rng.integers(2**63) for rng in rngs], dtype=np.int64)
        given = [(name, (options or {}).get(name)) for name in self.reset_options]
        asked = [np.nan if value is None else floor_pose(name, value, BOUNDARY) for name, value in given]
        for which, pose in enumerate(asked):
            self._asked[rows, which] = pose
        start = preferred(self._asked[rows, 0], self.starts(draws))
        if given[0][1] is not None:
            self.make_way(start, draws, rngs)
        self._draws[rows] = draws
        return Initial({"base_pose": start, **self.scene(rows, draws)}, seeds)

    def on_reset(self, rows: Rows, state: RobotState) -> None:
        """Choose the target from where the base is.

        Raises:
            InvalidValue: A robot that stays where it is was asked to start elsewhere.
        """
        pose = state.signals["base_pose"][rows]
        require_at(self._asked[rows, 0], pose)
        self.target[rows] = preferred(self._asked[rows, 1], self.targets(self._draws[rows], pose))
        self.elapsed[rows] = 0
        self._previous[rows] = np.nan if self.parity else self.distance(state)[rows]

    def distance(self, state: RobotState) -> Array:
        """How far the target is [m]. Shape: (n,)."""
        pose = state.signals["base_pose"]
        dx, dy = self.target[:, 0] - pose[:, 0], self.target[:, 1] - pose[:, 1]
        distance: Array = np.sqrt(dx * dx + dy * dy)
        return distance

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, k) float32."""
        pose, (v, w) = state.signals["base_pose"], state.signals["base_velocity"].T
        dx, dy = self.target[:, 0] - pose[:, 0], self.target[:, 1] - pose[:, 1]
        bearing = np.mod(np.arctan2(dy, dx) - pose[:, 2] + math.pi, 2 * math.pi) - math.pi
        distance = np.sqrt(dx * dx + dy * dy)
        if self.parity:
            columns = [distance, bearing, v, w]
        else:
            columns = [distance / DISTANCE_SCALE, bearing / math.pi, v / FASTEST[0], w / FASTEST[1]]
        observation = np.stack(columns, axis=1).astype(np.float32)
        observation = np.concatenate([observation, *self.seen(state)], axis=1)
        if self.parity:
            return require_inside(observation, self.observation_space, self.observation_labels)
        clipped: Floats = np.clip(observation, self.observation_space.low, self.observation_space.high)
        return clipped

    def seen(self, state: RobotState) -> list[Floats]:
        """Hook: what is observed besides. Shape: (n, ...) each."""
        return []

    def command(self, action: Floats, state: RobotState) -> Array:
        """Speeds forward [m/s] and of turning [rad/s]. Shape: (n, 2)."""
        command: Array = np.clip(action, -1.0, 1.0).astype(np.float64) * FASTEST
        return command

    def score(self, state: RobotState, action: Floats) -> Score:
        """Getting nearer is good, time and power cost, arriving or failing has its own reward instead."""
        distance, failed = self.distance(state), self.failed(state)
        success = distance < ARRIVED
        self.elapsed = self.elapsed + 1
        if self.parity:  # arriving wins
            reward = np.where(failed, _FAILING, self._parity_shaping(distance, action))
            reward = np.where(success, self.parity_success, reward)
        else:
            success &= ~failed
            reward = np.where(success, ARRIVING, self._shaping(distance, action))
            reward = np.where(failed, FAILING, reward)
        self._previous = distance.copy()  # the info keeps its own
        return self._ended(state, reward, failed, success, distance)

    def _shaping(self, distance: Array, action: Floats) -> Array:
        forward, turn = np.abs(np.clip(action, -1.0, 1.0)).astype(np.float64).T
        reward: Array = NEARER * (self._previous - distance) - POWER[0] * forward - POWER[1] * turn - TIME
        return reward

    def _parity_shaping(self, distance: Array, action: Floats) -> Array:
        """Nothing for the first step but its power, which is float32 as the action."""
        forward = np.abs(action[:, 0] * np.float32(_POWER[0]))
        turn = np.abs(action[:, 1] * np.float32(_POWER[1]))
        nearer = -_NEARER * distance - -_NEARER * self._previous
        reward: Array = np.where(
            np.isnan(self._previous), (-forward - turn).astype(np.float64), nearer - forward - turn
        )
        return reward

    def _ended(self, state: RobotState, reward: Array, failed: Flags, success: Flags, distance: Array) -> Score:
        code = np.where(failed, _FAILED, _RUNNING)
        code[success] = _SUCCEEDED
        terminated, overtime = failed | success, self.elapsed >= MAX_STEPS
        code[overtime if self.parity else overtime & ~terminated] = _OVERTIME  # there, whatever else happened then
        if self.parity:
            terminated |= overtime
        words = np.array(["", self.failure, "success", "max_steps_exceeded"])
        info: dict[str, Any] = {"distance": distance, "final_status": words[code], "target_coord": self.target.copy()}
        if self.rs_state_to_info:
            info["rs_state"] = np.empty(self.num_rows, dtype=object)
            for row, sent in enumerate(self.rs_state(state)):
                info["rs_state"][row] = sent
        return Score(reward, terminated, success, info)

    def rs_state(self, state: RobotState) -> list[list[float]]:
        """The state of each row as robo-gym's robot server sends it: 1030 numbers.

        Target and base (x, y [m], yaw [rad]), speeds [m/s, rad/s], 501 ranges of the front and 511 of the back scanner
        [m], 1 for a collision, three obstacles (x, y [m], yaw [rad]; zeros where they are not known).
        """
        n = self.num_rows
        obstacles = state.truth.get("obstacle_pose", np.zeros((n, 0, 3))).reshape(n, -1)
        columns = [
            self.target,
            state.signals["base_pose"],
            state.signals["base_velocity"],
            state.signals.get("f_scan", np.full((n, FRONT_RAYS), SCAN_RANGE[1])),
            state.signals.get("b_scan", np.full((n, BACK_RAYS), SCAN_RANGE[1])),
            state.truth.get("collision", np.zeros(n))[:, None],
            obstacles if obstacles.shape[1] and not self.parity else np.zeros((n, 9)),
        ]
        rows: list[list[float]] = np.concatenate(columns, axis=1).tolist()
        return rows

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The target."""
        return [(np.array([self.target[0, 0], self.target[0, 1], 0.0]), (0.1, 0.7, 0.3, 0.6))]

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""
        return {"target": self.target.copy(), "elapsed": self.elapsed.copy(), "previous": self._previous.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned."""
        self.target, self.elapsed = np.array(state["target"]), np.array(state["elapsed"])
        self._previous = np.array(state["previous"])
