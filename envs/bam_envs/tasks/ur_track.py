"""Track: follow a recorded joint trajectory and avoid a moving obstacle.

The trajectory is segments of waypoints 1/20 s apart, in a JSON file of robo-gym's form:
``{"trajectory": [[[base, shoulder, elbow, wrist 1, wrist 2, wrist 3], ...], ...]}``: segments, waypoints, joints [rad].
"""

import json
import stat
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Flags, Floats, Label, Score
from bam_envs.core.validation import Finite, check
from bam_envs.robots.physics.obstacles import PATH_POINTS
from bam_envs.robots.splines import splines_through
from bam_envs.tasks.ur_arm import joint_labels, normalised
from bam_envs.tasks.ur_avoidance import COLLISION, UrObstacleTask

RECORDED = "ur_track.json"
"""The shipped trajectory; ``tests/bam_envs/tasks/make_ur_track.py`` makes it."""
_MOST_BYTES = 2**24  # of a trajectory, whose file may be named by an untrusted checkpoint
_Waypoint = Annotated[tuple[Finite, Finite, Finite, Finite, Finite, Finite], Meta(description="six joint positions")]
_Segment = Annotated[list[_Waypoint], Meta(min_length=1, description="a list of waypoints")]
_Segments = Annotated[list[_Segment], Meta(min_length=1, description="a list of segments")]
NEAREST = 0.45  # distance of the obstacle from flange or elbow that costs [m]
RAPID = 0.4  # change of an action that costs, in a joint [rad]
CLOSE = 0.1  # offset of a joint from the reference, as a share of its limit, below which it is rewarded
ARRIVED = 0.1  # a waypoint at the end of a segment is reached with every joint within this [rad]
BONUS = 0.05  # reward of reaching it
AREA = np.array([[-1.0, -1.0, 0.1], [1.0, 1.0, 1.0]])
"""Range of the points of the obstacle's paths: lowest and highest x, y, z [m]."""
AXIS, BASE = 0.2, 0.35
"""Least distances of paths from the z axis and from the base [m]."""
AROUND = (8000, 12000)  # least and greatest duration of a path [1/100 s]
FIXED_PATHS, FIXED_AROUND = 50, 4000
"""Number of paths of `fixed_paths`, and their duration [1/100 s]."""


def draw_path(rng: np.random.Generator, samples: int) -> Array:
    """Ten points of a closed path whose `samples` points all keep away from the z axis and the base. Shape: (10, 3)."""
    while True:
        points = AREA[0] + rng.random((1, PATH_POINTS, 3)) * (AREA[1] - AREA[0])
        points[0, 0, :2] = rng.uniform(0.5, 1.0, 2) * rng.choice((-1.0, 1.0), 2)  # also the last point
        points[0, -1] = points[0, 0]
        # A coarse check first: about one path in seven passes.
        if _keeps_away(points, 200) and _keeps_away(points, samples):
            path: Array = points[0]
            return path


@lru_cache(maxsize=FIXED_PATHS)
def fixed_path(number: int) -> Array:
    """The fixed path of that number. Shape: (10, 3)."""
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
        Target joint positions, relative to the waypoint of the step [rad]. The joints move there at a fifth of their
        maximum speed, and slower when they are near. At the end of a segment its last waypoint waits until every joint
        is within 0.1 rad of it; then the next segment begins, after the last one the first.

    Reward:
        Each step, in thousandths: the mean over the joints of 1 - s / 0.1 where its offset s from the waypoint, in
        shares of its limit, is below 0.1; 1.5 (1 - the mean square of the action); -0.2 for each joint whose action
        changed by more than 0.4; -2 while the obstacle is within 0.45 m of flange or elbow. At the end of a segment
        0.05. At a collision -0.1 only.

    Success:
        No collision in 1000 steps.

    End:
        Terminated at a collision of the arm with itself, the table or the obstacle, which a live arm does not detect.

    Info:
        `targets_reached`, the ends of segments; `target_coord` of the obstacle [m], its `distance` from flange or
        elbow, the nearer one [m], `rs_state` with `rs_state_to_info`, and at the end `final_status`: "success" or
        "collision".

    Args:
        include_polar_to_elbow: Whether the observation has the obstacle seen from the elbow, or zeros.
        trajectory: A JSON file with another trajectory, in robo-gym's form.
            robo-gym's own, up to 0.67 rad from the default, is ``trajectory_raad_2022.json`` in its package.
        fixed_paths: For tests of policies: the obstacle follows one of 50 fixed paths, which are faster (40 s). The
            path is drawn; with ``parity=True`` they follow in order.
    """

    memory: Mapping[str, str] = {
        **UrObstacleTask.memory,
        **{name: name for name in ("segment", "step_in_segment", "waits", "targets_reached")},
        "episodes": "_episodes",
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        include_polar_to_elbow: bool = True,
        trajectory: str | None = None,
        fixed_paths: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(num_envs, include_polar_to_elbow=include_polar_to_elbow, **options)
        self._waypoints, self._lengths = load_trajectory(trajectory, self.model.joint_limits)
        self.fixed_paths = fixed_paths
        self.segment, self.step_in_segment, self.targets_reached, self._episodes = np.zeros((4, num_envs), np.int64)
        """The current segment, the steps in it, and the number of ends reached. Shape: (n,) each."""
        self.waits = np.zeros(num_envs, dtype=bool)
        """Whether the reference is a segment's last waypoint, waiting for the arm. Shape: (n,)."""

    def _observation_labels(self) -> tuple[Label, ...]:
        return (*super()._observation_labels(), *self._waypoint_labels())

    def _waypoint_labels(self, bound: float = 1.0) -> tuple[Label, ...]:
        waits = Label("waits", "1 while the last waypoint of a segment waits for the arm", "1", low=0.0)
        return (*joint_labels("to_", "the waypoint", "rad", "/ joint limit", bound), waits)

    def sample_initial(
        self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """The first waypoint, and an obstacle on a path or at rest."""
        self._episodes[env_ids] += 1
        self.segment[env_ids] = self.step_in_segment[env_ids] = self.targets_reached[env_ids] = 0
        self.reference[env_ids], self.waits[env_ids] = self._waypoints[0, 0], False
        joints, place = self.begin(env_ids, options or {}, self._waypoints[0, 0])
        if place is not None:
            return self.initial(joints, rngs, obstacle_position=place)
        if self.fixed_paths:
            paths = [fixed_path(number) for number in self._path_numbers(env_ids, rngs)]
            samples = [FIXED_AROUND] * len(paths)
        else:
            samples = [int(rng.uniform(*AROUND)) for rng in rngs]
            paths = [draw_path(rng, around) for rng, around in zip(rngs, samples, strict=True)]
        around = np.array(samples, dtype=np.float64)
        return self.initial(joints, rngs, obstacle_path=np.stack(paths), obstacle_samples=around)

    def _path_numbers(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> list[int]:
        return [int(rng.integers(FIXED_PATHS)) for rng in rngs]

    def _columns(self, state: RobotState) -> list[Array]:
        waits = self.waits[:, None].astype(np.float64)
        return [*super()._columns(state), normalised(self.model, self.reference), waits]

    def command(self, action: Floats, state: RobotState) -> Array:
        """One period on the way to the next waypoint plus `action` [rad]. Shape: (n, 6)."""
        self.step_in_segment = self.step_in_segment + 1
        lengths = self._lengths[self.segment]
        self.reference = self._waypoints[self.segment, np.minimum(self.step_in_segment, lengths - 1)]
        self.waits = self.step_in_segment >= lengths
        return super().command(action, state)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward close following, small and smooth actions, and distance from the obstacle."""
        reward = self._following(state, self.offset(state), action) + BONUS * self._advance(state)
        return self.scored(state, reward, COLLISION, targets_reached=self.targets_reached.copy())

    def _following(self, state: RobotState, offset: Array, action: Floats) -> Array:
        """Reward without the bonus at the end of a segment. Shape: (n,)."""
        off = np.abs(offset)
        reward = np.where(off < CLOSE, 1 - off / CLOSE, 0.0).sum(axis=1) / 6000
        reward = reward - 0.002 * (self.sense(state).nearest < NEAREST)
        following: Array = reward + self.effort(action, weight=1.5, rapid=RAPID)
        return following

    def _advance(self, state: RobotState) -> Flags:
        """Begin the next segment if the arm is at the end of one; returns the mask of these arms. Shape: (n,)."""
        joints = state.signals["joint_position"]
        near = np.abs(self.reference - joints) <= ARRIVED + 1e-5 * np.abs(joints)  # as NumPy's isclose has it
        reached: Flags = self.waits & near.all(axis=1)
        self.segment = np.where(reached, (self.segment + 1) % len(self._lengths), self.segment)
        self.step_in_segment = np.where(reached, 0, self.step_in_segment)
        self.targets_reached = self.targets_reached + reached
        return reached


def load_trajectory(file: str | Path | None, limits: Array) -> tuple[Array, EnvIds]:
    """The trajectory in a JSON file of robo-gym's form, or the shipped one; `limits` (2, 6) are of the joints [rad].

    Returns:
        Joint positions [rad], short segments padded with their last waypoint, shape (segments, longest, 6), and the
        number of waypoints of each segment, shape (segments,).

    Raises:
        InvalidValue: There is no such file, or no trajectory of six joints inside their limits in it.
    """
    if not isinstance(file, (str, Path, type(None))):
        raise InvalidValue(f"The trajectory must be the path of a JSON file, not {file!r}.")
    path = Path(__file__).parent / "data" / RECORDED if file is None else Path(file).expanduser()
    try:
        found = path.stat()
        if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):  # reading a folder fails by itself
            raise InvalidValue(f"The trajectory {path} is no plain file; expected one in JSON.")
        if found.st_size > _MOST_BYTES:
            raise InvalidValue(f"The trajectory {path} has {found.st_size} bytes, expected at most {_MOST_BYTES}.")
        text = path.read_bytes()
    except OSError as error:
        raise InvalidValue(f"The trajectory {path} cannot be read: {error.strerror}.") from error
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidValue(f"The trajectory {path} is not JSON: {error}.") from error
    name = f"The trajectory {path}"
    segments = check(check(content, dict[str, Any], name).get("trajectory"), _Segments, f"{name}: trajectory")
    longest = max(len(segment) for segment in segments)
    waypoints = np.array([[*segment, *segment[-1:] * (longest - len(segment))] for segment in segments])
    outside = np.argwhere((waypoints < limits[0]) | (waypoints > limits[1]))
    if len(outside):
        number, step, joint = outside[0]
        raise InvalidValue(
            f"Segment {number} of the trajectory has joint {joint} at {waypoints[number, step, joint]:g} rad in "
            f"waypoint {step}; expected {limits[0, joint]:g} to {limits[1, joint]:g}."
        )
    return waypoints, np.array([len(segment) for segment in segments], dtype=np.int64)
