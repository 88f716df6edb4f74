"""Track: follow a recorded joint trajectory and make way for an obstacle that flies about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from bam_envs.core.robot import Initial, RobotState, Rows
from bam_envs.core.splines import splines_through
from bam_envs.core.task import Array, Floats, Label, Score
from bam_envs.robots.physics.obstacles import PATH_POINTS
from bam_envs.robots.ur import DEFAULT_MODEL
from bam_envs.tasks.joint_trajectory import load_trajectory
from bam_envs.tasks.ur_control import normalised
from bam_envs.tasks.ur_obstacle import ObstacleSense, UrObstacleTask, joint_labels

NEAREST = 0.45
"""Distance of the obstacle from flange or elbow that costs [m]."""
RAPID = 0.4
"""Change of an action that costs, in a joint [rad]."""
CLOSE = 0.1
"""Share of its limit that a joint may be off the reference while it is worth something."""
ARRIVED = 0.1
"""A waypoint at the end of a segment is reached with every joint within this [rad]."""
BONUS = 0.05
"""Reward of reaching it."""
COLLISION = -0.1
"""Reward of a collision."""
AREA = np.array([[-1.0, -1.0, 0.1], [1.0, 1.0, 1.0]])
"""Where the points of the obstacle's paths are: lowest and highest x, y, z [m]."""
AXIS, BASE = 0.2, 0.35
"""How far paths keep from the z axis and from the base [m]."""
AROUND = (8000, 12000)
"""How long a path takes once around: least and most hundredths of a second."""
FIXED_PATHS, FIXED_AROUND = 50, 4000
"""How many paths `fixed_paths` has, and how long they take once around [1/100 s]."""


def draw_path(rng: np.random.Generator, samples: int) -> Array:
    """Ten points of a closed path whose `samples` points all keep away from the z axis and the base. Shape: (10, 3).

    Points are uniform in `AREA`; the first, which is also the last, has x and y of 0.5 to 1 m either way.
    """
    while True:
        points = AREA[0] + rng.random((1, PATH_POINTS, 3)) * (AREA[1] - AREA[0])
        points[0, 0, :2] = rng.uniform(0.5, 1.0, 2) * rng.choice((-1.0, 1.0), 2)
        points[0, -1] = points[0, 0]
        # A coarse look first: about one path in seven is good.
        if _keeps_away(points, 200) and _keeps_away(points, samples):
            path: Array = points[0]
            return path


@lru_cache(maxsize=FIXED_PATHS)
def fixed_path(number: int) -> Array:
    """One of the paths that are always the same. Shape: (10, 3)."""
    return draw_path(np.random.default_rng([number, FIXED_PATHS]), FIXED_AROUND)


def _keeps_away(points: Array, samples: int) -> bool:
    place = splines_through(points).at(np.linspace(0.0, 1.0, samples)[None])[0]
    flat = place[:, 0] ** 2 + place[:, 1] ** 2
    return bool((flat > AXIS**2).all() and (flat + place[:, 2] ** 2 > BASE**2).all())


class UrTrackTask(UrObstacleTask):
    """Follow the trajectory and keep 45 cm away from the obstacle.

    Start:
        The arm is at the first waypoint, or at the reset option ``joint_positions`` (6) [rad]. The obstacle, a sphere
        of 5 cm, is at the start of a closed path through ten random points, x and y within 1 m of the base and 0.1 to
        1 m high, which takes it 80 to 120 s and goes nowhere nearer than 0.2 m to the z axis or 0.35 m to the base; or
        it stays at the reset option ``fixed_object_position`` (3) [m].

    Action:
        Where the joints are to be, beside the waypoint of the step [rad]. They go there at a fifth of their fastest
        speed, and slower when they are near. At the end of a segment its last waypoint waits until every joint is
        within 0.1 rad of it; then the next segment begins, after the last the first.

    Reward:
        Each step, in thousandths: the mean over the joints of 1 - s / 0.1 where its offset s from the waypoint, in
        shares of its limit, is below 0.1; 1.5 (1 - the mean square of the action); -0.2 for each joint whose action
        changed by more than 0.4; -2 while the obstacle is within 0.45 m of flange or elbow. At the end of a segment
        0.05. At a collision -0.1 and nothing else.

    Success:
        No collision in 1000 steps.

    End:
        Terminated at a collision, of the arm with itself, the table or the obstacle; a live arm does not notice any.

    Info:
        `targets_reached`, the ends of segments; `target_coord` of the obstacle [m], its `distance` from flange or
        elbow, the nearer one [m], `rs_state` where it is asked for, and at the end `final_status`: "success" or
        "collision".

    With ``parity=True`` nothing is scaled, the end of a segment is worth nothing and is counted one step later, the
    arm starts at the first waypoint whatever the reset option says, and 1000 steps terminate, as in robo-gym. The
    trajectory is still this package's own; ``trajectory`` names robo-gym's.

    Args:
        num_rows: How many robots are scored together.
        ur_model: ur3, ur3e, ur5, ur5e, ur10, ur10e or ur16e.
        parity: robo-gym's arithmetic, with its bugs and without scaling.
        fix_base: Take the joint out of the action; so do the other five.
        fix_shoulder: See above.
        fix_elbow: See above.
        fix_wrist_1: See above.
        fix_wrist_2: See above.
        fix_wrist_3: See above.
        include_polar_to_elbow: Whether the observation has the obstacle seen from the elbow, or zeros.
        fixed_object_position: Where the obstacle stays in every episode [m].
        rs_state_to_info: Whether infos have robo-gym's wire state.
        trajectory: A JSON file with another trajectory, in robo-gym's form; see `bam_envs.tasks.joint_trajectory`.
            robo-gym's own, up to 0.67 rad from the default, is ``trajectory_raad_2022.json`` in its package.
        fixed_paths: For tests of policies: the obstacle is on one of 50 paths that are always the same, and faster
            (40 s once around). Which one is drawn; with ``parity`` they come one after the other.
    """

    def __init__(
        self,
        num_rows: int = 1,
        *,
        ur_model: str = DEFAULT_MODEL,
        parity: bool = False,
        fix_base: bool = False,
        fix_shoulder: bool = False,
        fix_elbow: bool = False,
        fix_wrist_1: bool = False,
        fix_wrist_2: bool = False,
        fix_wrist_3: bool = True,
        include_polar_to_elbow: bool = True,
        fixed_object_position: Sequence[float] | None = None,
        rs_state_to_info: bool = False,
        trajectory: str | None = None,
        fixed_paths: bool = False,
    ) -> None:
        super().__init__(
            num_rows,
            (fix_base, fix_shoulder, fix_elbow, fix_wrist_1, fix_wrist_2, fix_wrist_3),
            ur_model=ur_model,
            parity=parity,
            include_polar_to_elbow=include_polar_to_elbow,
            fixed_object_position=fixed_object_position,
            rs_state_to_info=rs_state_to_info,
        )
        self.trajectory = load_trajectory(trajectory, self.model.joint_limits)
        self.fixed_paths = fixed_paths
        self.segment, self.step_in_segment = np.zeros(num_rows, dtype=np.int64), np.zeros(num_rows, dtype=np.int64)
        """Which segment is followed, and how many steps of it have been. Shape: (n,)."""
        self.waits = np.zeros(num_rows, dtype=bool)
        """Whether the reference is a segment's last waypoint, waiting for the arm. Shape: (n,)."""
        self.targets_reached = np.zeros(num_rows, dtype=np.int64)
        """Ends of segments that were reached. Shape: (n,)."""
        self._episodes = np.zeros(num_rows, dtype=np.int64)

    def _labels(self) -> tuple[Label, ...]:
        bound = 1.1 if self.parity else 1.0
        waits = Label("waits", "1 while the last waypoint of a segment waits for the arm", "1", low=0.0)
        return (*super()._labels(), *joint_labels("to_", "the waypoint", "/ joint limit", bound), waits)

    def sample_initial(
        self, rows: Rows, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] = MappingProxyType({})
    ) -> Initial:
        """The first waypoint, and an obstacle on a path or staying."""
        self._episodes[rows] += 1
        self.segment[rows] = self.step_in_segment[rows] = self.targets_reached[rows] = 0
        self.reference[rows], self.waits[rows] = self.trajectory.waypoints[0, 0], False
        joints, place = self.begin_rows(rows, options, self.trajectory.waypoints[0, 0])
        if self.parity:
            joints = self.reference[rows]
        obstacle = self._paths(rows, rngs) if place is None else {"obstacle_position": place}
        seeds = np.array([rng.integers(2**63) for rng in rngs], dtype=np.int64)
        return Initial({"joint_position": joints, **obstacle}, seeds)

    def _paths(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> dict[str, Array]:
        if self.fixed_paths:
            numbers = self._episodes[rows] if self.parity else [rng.integers(FIXED_PATHS) for rng in rngs]
            paths = [fixed_path(int(number) % FIXED_PATHS) for number in numbers]
            samples = [FIXED_AROUND] * len(paths)
        else:
            samples = [int(rng.uniform(*AROUND)) for rng in rngs]
            paths = [draw_path(rng, around) for rng, around in zip(rngs, samples, strict=True)]
        return {"obstacle_path": np.stack(paths), "obstacle_samples": np.array(samples, dtype=np.float64)}

    def on_reset(self, rows: Rows, state: RobotState) -> None:
        """The reference is the first waypoint, wherever exactly the arm is."""

    def _columns(self, sense: ObstacleSense) -> list[Array]:
        waits = self.waits[:, None].astype(np.float64)
        return [*super()._columns(sense), normalised(self.model, self.reference), waits]

    def command(self, action: Floats, state: RobotState) -> Array:
        """One period on the way to the next waypoint plus `action` [rad]. Shape: (n, 6)."""
        self.step_in_segment = self.step_in_segment + 1
        self.reference, self.waits = self.trajectory.at(self.segment, self.step_in_segment)
        return super().command(action, state)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Following closely, acting little and smoothly, away from the obstacle."""
        sense = self.sense(state)
        offset = self.offset(sense)
        if self.parity:
            offset = offset.astype(np.float32).astype(np.float64)  # robo-gym reads it from its observation
        off = np.abs(offset)
        near = np.minimum(sense.tool[:, 0], sense.elbow[:, 0]) < NEAREST
        reward = np.where(off < CLOSE, 1 - off / CLOSE, 0.0).sum(axis=1) / 6000 - 0.002 * near
        reward = reward + self.effort(action, weight=1.5, rapid=RAPID)
        counted = self.targets_reached
        reached = self._advance(state)
        collision, arrived = self.ends(state)
        if not self.parity:
            reward, counted = reward + BONUS * reached, self.targets_reached
        reward = np.where(collision, COLLISION, reward)
        info = self.info(state, collision, arrived) | {"targets_reached": counted.copy()}
        return Score(reward, collision | arrived if self.parity else collision, arrived, info)

    def _advance(self, state: RobotState) -> Any:
        """Go on to the next segment where the arm is at the end of one; which rows. Shape: (n,) bool."""
        joints = state.signals["joint_position"]
        near = np.abs(self.reference - joints) <= ARRIVED + 1e-5 * np.abs(joints)  # as NumPy's isclose has it
        reached = self.waits & near.all(axis=1)
        self.segment = np.where(reached, (self.segment + 1) % len(self.trajectory.lengths), self.segment)
        self.step_in_segment = np.where(reached, 0, self.step_in_segment)
        self.targets_reached = self.targets_reached + reached
        return reached

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""
        return super().state_dict() | {
            "segment": self.segment.copy(),
            "step_in_segment": self.step_in_segment.copy(),
            "waits": self.waits.copy(),
            "targets_reached": self.targets_reached.copy(),
            "episodes": self._episodes.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned."""
        super().load_state_dict(state)
        self.segment, self.step_in_segment = np.array(state["segment"]), np.array(state["step_in_segment"])
        self.waits, self.targets_reached = np.array(state["waits"]), np.array(state["targets_reached"])
        self._episodes = np.array(state["episodes"])
