"""Avoidance: stay at a pose, and out of the way of an obstacle that goes up and down beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from bam_envs.core.robot import Initial, RobotState, Rows
from bam_envs.core.task import Array, Floats, Score
from bam_envs.robots.physics.obstacles import wave_signals
from bam_envs.robots.ur import DEFAULT_MODEL, START
from bam_envs.tasks.ur_obstacle import UrObstacleTask

POSE = (-1.57, -1.31, -1.31, -2.18, 1.57, 0.0)
"""Joint positions to stay at [rad]; the obstacle's way goes past the flange."""
NEAREST = 0.30
"""Distance of the obstacle from flange and elbow that costs [m]."""
RAPID = 0.5
"""Change of an action that costs, in a joint [rad]."""
SPREAD = 0.6
"""Sum of the shares of their limits that the joints may be off while it is worth something."""
COLLISION = -0.1
"""Reward of a collision; robo-gym's own has none, and charges this in its other task with an obstacle."""


class UrAvoidanceTask(UrObstacleTask):
    """Stay at the pose and 30 cm away from the obstacle.

    Start:
        The arm is at [-1.57, -1.31, -1.31, -2.18, 1.57, 0] rad, or at the reset option ``joint_positions`` (6) [rad]:
        the pose to keep. The obstacle, a sphere of 5 cm, is at x 0.12 and y 0.34 m, at the bottom of a triangle wave
        of 0.125 Hz whose middle is 0.2 to 0.6 m above the base, and which goes 0.09 to 0.35 m up and down; or it
        stays at the reset option ``fixed_object_position`` (3) [m].

    Action:
        Where the joints are to be, beside the pose [rad]. They go there at a fifth of their fastest speed, and slower
        when they are near.

    Reward:
        Each step, in thousandths: 1 - s / 0.6 while the sum s of the joints' offsets from the pose, in shares of their
        limits, is below 0.6; 1 - the mean square of the action; -0.2 for each joint whose action changed by more than
        0.5; -2 while the obstacle is within 0.30 m of flange or elbow. At a collision -0.1 and nothing else.

    Success:
        No collision in 1000 steps.

    End:
        Terminated at a collision, of the arm with itself, the table or the obstacle; a live arm does not notice any.

    Info:
        `target_coord` of the obstacle [m], its `distance` from flange or elbow, the nearer one [m], `rs_state` where it
        is asked for, and at the end `final_status`: "success" or "collision".

    With ``parity=True`` the pose is robo-gym's [0, -2.5, 1.5, 0, -1.4, 0], the first reward depends on the sum over
    the observation's last six numbers, as robo-gym's does, a collision costs nothing, and 1000 steps terminate.

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
        include_polar_to_elbow: bool = False,
        fixed_object_position: Sequence[float] | None = None,
        rs_state_to_info: bool = False,
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

    def sample_initial(
        self, rows: Rows, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] = MappingProxyType({})
    ) -> Initial:
        """The pose, and an obstacle that goes up and down or stays."""
        draws = np.stack([rng.random(2) for rng in rngs])
        seeds = np.array([rng.integers(2**63) for rng in rngs], dtype=np.int64)
        joints, place = self.begin_rows(rows, options, np.array(START if self.parity else POSE))
        self.reference[rows] = joints
        obstacle = wave_signals(draws) if place is None else {"obstacle_position": place}
        return Initial({"joint_position": joints, **obstacle}, seeds)

    def on_reset(self, rows: Rows, state: RobotState) -> None:
        """The reference is the pose that was asked for, wherever exactly the arm is."""

    def score(self, state: RobotState, action: Floats) -> Score:
        """Staying at the pose, acting little and smoothly, away from the obstacle."""
        sense = self.sense(state)
        reward = self._staying(state) + self.effort(action, weight=1.0, rapid=RAPID)
        reward = reward - 0.002 * (np.minimum(sense.tool[:, 0], sense.elbow[:, 0]) < NEAREST)
        collision, arrived = self.ends(state)
        if not self.parity:
            reward = np.where(collision, COLLISION, reward)
        terminated = collision | arrived if self.parity else collision
        return Score(reward, terminated, arrived, self.info(state, collision, arrived))

    def _staying(self, state: RobotState) -> Array:
        """Worth of being at the pose. Shape: (n,)."""
        if self.parity:
            seen = np.abs(self.observe(state).astype(np.float64))
            off, gate = seen[:, 9:15].sum(axis=1), seen[:, 12:18].sum(axis=1)
        else:
            off = gate = np.abs(self.offset(self.sense(state))).sum(axis=1)
        staying: Array = np.where(gate < SPREAD, (1 - off / SPREAD) / 1000, 0.0)
        return staying
