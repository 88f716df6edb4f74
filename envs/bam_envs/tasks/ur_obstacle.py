"""What the two tasks with a UR arm and a moving obstacle share: what they see, what they are sent, robo-gym's states.

Frames are those of robo-gym: the end effector is ``tool0``, the elbow ``forearm_link``, places are in ``base_link``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.core.robot import RobotState, Rows
from bam_envs.core.task import Array, Flags, Floats, Label, labelled_box, require_inside
from bam_envs.robots.ur import JOINTS
from bam_envs.robots.ur import ur_model as model_called
from bam_envs.tasks.ur_control import (
    UrControl,
    collisions,
    in_frame,
    joint_option,
    normalised,
    number_option,
    spherical,
)
from bam_envs.tasks.ur_wire import FOREARM, as_objects, wire_states

RATE = 20.0
"""Commands a second [Hz]."""
VELOCITY_SCALE = 0.2
"""Share of the fastest speed that joints go at."""
MAX_STEPS = 1000
"""Steps of an episode."""
FAR = 2.0
"""Distance that is 1 in observations [m]."""
OFFSET = 0.1
"""Share of the joint limits off the reference that is 1 in observations."""


def obstacle_labels(frame: str, parity: bool, seen: bool) -> tuple[Label, ...]:
    """Of the obstacle's spherical coordinates in `frame`, which are zeros where it is not `seen` from there."""
    bound = 1.0
    if parity:
        bound = np.inf if seen else 0.0
        scales, lows = ("1", "1", "1"), (-bound, -bound, -bound)
    else:
        scales, lows = (f"/ {FAR:g}, clipped", "/ pi", "/ pi"), (0.0, 0.0, -bound)
    names = (("distance", "obstacle's distance", "m"), ("polar", "obstacle's angle from z", "rad"))
    rows = zip((*names, ("azimuth", "obstacle's angle from x about z", "rad")), scales, lows, strict=True)
    return tuple(
        Label(f"{frame}_{name}", f"{meaning} in the frame {frame}", unit, scale, low, bound)
        for (name, meaning, unit), scale, low in rows
    )


def joint_labels(prefix: str, meaning: str, scale: str, bound: float) -> tuple[Label, ...]:
    """One for each joint."""
    return tuple(Label(f"{prefix}{joint}", meaning, "rad", scale, -bound, bound) for joint in JOINTS)


class ObstacleSense:
    """Where the obstacle is, seen from the arm in one state; worked out once for `observe` and `score`."""

    def __init__(self, task: UrObstacleTask, state: RobotState) -> None:
        self.state = state
        positions, rotations = task.model.geometry.link_poses(state.signals["joint_position"])
        self.obstacle = state.signals["object_position"]
        from_tool = in_frame(self.obstacle, positions[:, -1], rotations[:, -1])
        from_elbow = in_frame(self.obstacle, positions[:, FOREARM], rotations[:, FOREARM])
        self.tool, self.elbow = spherical(from_tool), spherical(from_elbow)
        """Distance [m] and two angles [rad] of the obstacle. Shape: (n, 3) each."""
        self.joints = normalised(task.model, state.signals["joint_position"])


class UrObstacleTask:
    """An arm that keeps to a reference and away from an obstacle; what it is and what is rewarded is a task's own.

    Args:
        num_rows: How many robots are scored together.
        fixed: Which of the six joints are not in the action.
        ur_model: Which arm.
        parity: robo-gym's arithmetic.
        include_polar_to_elbow: Whether the observation has the obstacle seen from the elbow, or zeros.
        fixed_object_position: Where the obstacle stays [m], instead of moving.
        rs_state_to_info: Whether infos have robo-gym's wire state.
    """

    reset_options: tuple[str, ...] = ("joint_positions", "fixed_object_position")

    def __init__(
        self,
        num_rows: int,
        fixed: Sequence[bool],
        *,
        ur_model: str,
        parity: bool,
        include_polar_to_elbow: bool,
        fixed_object_position: Sequence[float] | None,
        rs_state_to_info: bool,
    ) -> None:
        self.num_rows, self.parity, self.ends_by_itself = num_rows, parity, parity
        self.model = model_called(ur_model)
        self.control = UrControl(self.model, num_rows, RATE, VELOCITY_SCALE, fixed)
        self.include_polar_to_elbow, self.rs_state_to_info = include_polar_to_elbow, rs_state_to_info
        self._place = _place({"fixed_object_position": fixed_object_position}, kind="option")
        self.action_labels = self.control.labels("joint target beside the reference", "rad", "1")
        self.observation_labels = self._labels()
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.reference = np.zeros((num_rows, 6))
        """Joint positions to keep to [rad]. Shape: (n, 6)."""
        self.steps = np.zeros(num_rows, dtype=np.int64)
        """Steps since each row's episode began. Shape: (n,)."""
        self._last_action = np.zeros((num_rows, 6))
        self._sense: ObstacleSense | None = None

    def _labels(self) -> tuple[Label, ...]:
        share = "/ joint limit"
        near = share if self.parity else f"{share} / {OFFSET:g}, clipped"
        bound, spread = (1.1, 1.1) if self.parity else (1.0, 2.0)
        return (
            *obstacle_labels("tool0", self.parity, seen=True),
            *joint_labels("", "joint position", share, bound),
            *joint_labels("off_", "joint position from the reference", near, spread),
            *obstacle_labels("forearm_link", self.parity, seen=self.include_polar_to_elbow),
        )

    def begin_rows(self, rows: Rows, options: Mapping[str, Any], joints: Array) -> tuple[Array, Array | None]:
        """Begin an episode on `rows` at `joints` (6,), or where the options say.

        Returns:
            Joint positions [rad], shape (k, 6), and where the obstacle stays [m], shape (k, 3), or None if it moves.
        """
        start = joint_option(options, "joint_positions", joints.tolist(), self.model)
        place = _place(options, self._place)
        self.steps[rows], self._last_action[rows] = 0, 0.0
        stays = None if place is None else np.tile(place, (len(rows), 1))
        return np.tile(start, (len(rows), 1)), stays

    def sense(self, state: RobotState) -> ObstacleSense:
        """The obstacle in `state`, worked out once."""
        if self._sense is None or self._sense.state is not state:
            self._sense = ObstacleSense(self, state)
        return self._sense

    def offset(self, sense: ObstacleSense) -> Array:
        """Joints from the reference, as shares of their limits. Shape: (n, 6)."""
        return sense.joints - normalised(self.model, self.reference)

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, k) float32."""
        observation = np.concatenate(self._columns(self.sense(state)), axis=1).astype(np.float32)
        if self.parity:
            return require_inside(observation, self.observation_space, self.observation_labels)
        return np.clip(observation, self.observation_space.low, self.observation_space.high)

    def _columns(self, sense: ObstacleSense) -> list[Array]:
        units = np.array([1.0, 1.0, 1.0]) if self.parity else np.array([FAR, np.pi, np.pi])
        elbow = sense.elbow / units if self.include_polar_to_elbow else np.zeros_like(sense.elbow)
        offset = self.offset(sense) if self.parity else self.offset(sense) / OFFSET
        return [sense.tool / units, sense.joints, offset, elbow]

    def command(self, action: Floats, state: RobotState) -> Array:
        """One period on the way to the reference plus `action` [rad]; fixed joints keep to it. Shape: (n, 6)."""
        return self.control.command(self.reference + self.control.full(action), state)

    def effort(self, action: Floats, weight: float, rapid: float) -> Array:
        """Worth of acting little, and the price of each joint whose action jumps by more than `rapid`. Shape: (n,).

        It also notes the action as the last one.
        """
        full = self.control.full(action)
        jumps = (np.abs(full - self._last_action) > rapid).sum(axis=1)
        self._last_action = full
        effort: Array = (weight * (1 - np.einsum("ij,ij->i", full, full) / 6) - 0.2 * jumps) / 1000
        return effort

    def ends(self, state: RobotState) -> tuple[Flags, Flags]:
        """Count the step; which rows collided, and which came to the last step without. Shapes: (n,)."""
        self.steps = self.steps + 1
        collision = collisions(state)
        return collision, (self.steps >= MAX_STEPS) & ~collision

    def info(self, state: RobotState, collision: Flags, arrived: Flags) -> dict[str, Any]:
        """Infos of both tasks."""
        sense = self.sense(state)
        info: dict[str, Any] = {
            "final_status": np.where(collision, "collision", np.where(arrived, "success", "")),
            "target_coord": sense.obstacle.copy(),
            "distance": np.minimum(sense.tool[:, 0], sense.elbow[:, 0]),
        }
        if self.rs_state_to_info:
            info["rs_state"] = as_objects(self.rs_state(state))
        return info

    def rs_state(self, state: RobotState) -> list[Any]:
        """robo-gym's wire state, a dict of 34 floats a row."""
        return list(wire_states(self.model, state, state.signals["object_position"], with_forearm=True))

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The flange at the reference; the robot shows the obstacle."""
        return [(self.model.geometry.flange_pose(self.reference[:1])[0][0], (0.1, 0.7, 0.3, 0.6))]

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""
        return {
            "reference": self.reference.copy(),
            "steps": self.steps.copy(),
            "last_action": self._last_action.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned."""
        self.reference, self.steps = np.array(state["reference"]), np.array(state["steps"])
        self._last_action = np.array(state["last_action"])
        self._sense = None


def _place(options: Mapping[str, Any], default: Array | None = None, kind: str = "reset option") -> Array | None:
    """Where the obstacle stays [m], or None where nothing says so. Shape: (3,)."""
    if options.get("fixed_object_position") is None:
        return default
    return number_option(options, "fixed_object_position", (), 3, kind)
