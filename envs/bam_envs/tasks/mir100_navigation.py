"""Drive a MiR100 to a place on an open floor."""

from __future__ import annotations

import math

import numpy as np

from bam_envs.core.robot import RobotState
from bam_envs.core.task import Array, Flags
from bam_envs.tasks.mir100_drive import BOUNDARY, MIN_DISTANCE, DriveTask
from bam_envs.tasks.poses import spread

START, TARGET = 2.0, 1.0
"""Starts and targets are drawn at most this far from the origin, along x and along y [m]."""
CANDIDATES = 64
"""Targets that are drawn; the first is taken that is far enough from the start."""


class Mir100NavigationTask(DriveTask):
    """Drive to within 20 cm of a target, nothing in the way.

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

    With ``parity=True`` observation, reward and end are those of robo-gym's `NoObstacleNavigationMir100`: metres and
    radians, the way at a hundred times this reward but none for that of the first step, 200 at success, -200 outside,
    y below -10 m is not noticed, and the episode is terminated after 500 steps as "max_steps_exceeded".

    Args:
        num_rows: How many robots are scored together.
        parity: Robo-gym's arithmetic.
        rs_state_to_info: ``info["rs_state"]`` is the state as robo-gym's robot server would send it.
    """

    parity_success, failure = 200.0, "out of boundary"
    draws = 3 + 2 * CANDIDATES

    def starts(self, draws: Array) -> Array:
        """Anywhere near the origin. Shape: (k, 3)."""
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
        x, y = state.signals["base_pose"][:, 0], state.signals["base_pose"][:, 1]
        outside: Flags = (np.abs(x) > BOUNDARY) | ((y > BOUNDARY) if self.parity else (np.abs(y) > BOUNDARY))
        return outside
