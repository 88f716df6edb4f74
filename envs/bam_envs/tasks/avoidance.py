"""Drive a wheeled base to the other side of a room, around three boxes that only its lasers detect."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.task import Array, Flags, Floats, Label
from bam_envs.robots.room import room_for, touches
from bam_envs.tasks.navigation import DriveTask, spread

SIDE = (2.1, 3.1)
"""Range of starts along y from the middle of the room, and of targets on the other side [m]."""
WIDTH = 2.0  # they are drawn at most this far from the middle along x [m]
BOXES = np.array([[-2.4, -1.5], [-0.5, 0.5], [1.5, 2.4]])
"""Lowest and highest x of the middle of each box [m]."""
BOX_DEPTH = 1.0  # boxes are drawn at most this far from the middle along y [m]
SECTORS = 16
"""Number of sectors, of all lasers together, whose shortest ray is observed."""
SIGHT = 3.0  # greatest range in observations [m]
_OF_BOXES = slice(6, 15)  # the drawn numbers for the boxes
_TRIES = 1000


class AvoidanceTask(DriveTask):
    """Drive to within 20 cm of a target on the other side of three boxes.

    Start:
        The base is at rest at x -2 to 2 m, 2.1 to 3.1 m from the middle of the room to either side along y, with any
        yaw; a live one where it is. The target is as far on the other side, at x -2 to 2 m. The boxes, cubes of 0.5 m,
        are about x -2, 0 and 2 m, y -1 to 1 m, with any yaw. The reset options ``start_pose`` and ``target_pose``
        (x, y [m], yaw [rad]) choose the former two; no box is at a chosen start. For a base that is larger than a
        MiR100 the room and these distances are larger in proportion (Husky: 1.05 times).

    Reward:
        Each step 0.5 for each metre nearer, less 0.005 for the time, 0.003 |forward| and 0.0003 |turn|. At success 2
        instead, and -2 instead at a collision.

    Success:
        The base is nearer than 20 cm to the target. Its heading does not matter.

    End:
        Terminated at success and at a collision: a ray that ends within 2 cm of the base, or is shorter than 15 cm on a
        MiR100, or, in simulation, a touch.

    Info:
        `distance` of the target [m], `target_coord` (x, y [m], yaw [rad]), at the end `final_status`: "success",
        "collision" or "max_steps_exceeded".
    """

    failure = "collision"
    draws = 15
    memory: Mapping[str, str] = {**DriveTask.memory, "obstacles": "obstacles"}

    def __init__(self, num_envs: int = 1, **options: Any) -> None:
        super().__init__(num_envs, **options)
        self._scale = room_for(self.body)
        self.obstacles = np.zeros((num_envs, len(BOXES), 3))
        """Boxes of a simulated room: x, y [m] and yaw [rad]. Shape: (n, 3, 3)."""

    def _observation_labels(self) -> tuple[Label, ...]:
        scanners = self.body.scanners
        if not scanners:
            raise InvalidValue(f"{self.base.name} has no laser, and this task needs one to see the boxes.")
        each = SECTORS // len(scanners)
        self._sectors = [np.linspace(0, len(one.bearings), each + 1).astype(np.int64)[:-1] for one in scanners]
        ranges = [
            Label(
                f"{one.name}_{sector}",
                f"shortest ray of sector {sector} of the {one.name} scanner, clockwise end first",
                "m",
                f"1 - range / {SIGHT:g}, clipped",
                0.0,
            )
            for one in scanners
            for sector in range(each)
        ]
        return (*super()._observation_labels(), *ranges)

    def starts(self, draws: Array) -> Array:
        """Start poses on either side. Shape: (k, 3)."""
        side = np.where(draws[:, 3] < 0.5, -1.0, 1.0)
        x, y = self._scale * np.array([spread(draws[:, 0], -WIDTH, WIDTH), side * spread(draws[:, 1], *SIDE)])
        return np.stack([x, y, spread(draws[:, 2], -math.pi, math.pi)], axis=1)

    def targets(self, draws: Array, start: Array) -> Array:
        """Targets on the other side, which are always far enough. Shape: (k, 3)."""
        side = np.where(start[:, 1] > 0, -1.0, 1.0)
        x, y = self._scale * np.array([spread(draws[:, 4], -WIDTH, WIDTH), side * spread(draws[:, 5], *SIDE)])
        return np.stack([x, y, np.zeros(len(start))], axis=1)

    def scene(
        self, env_ids: EnvIds, draws: Array, start: Array, rngs: Sequence[np.random.Generator]
    ) -> dict[str, Array]:
        """The boxes, drawn until none is at a chosen start; the robot refuses a start in a wall."""
        for k, rng in enumerate(rngs):
            for _ in range(0 if np.isnan(start[k, 0]) else _TRIES):
                if not touches(self.body, start[k : k + 1], None, self._boxes(draws[k : k + 1]))[0]:
                    break
                draws[k, _OF_BOXES] = rng.random(9)
        self.obstacles[env_ids] = self._boxes(draws)
        return {"obstacle_pose": self.obstacles[env_ids]}

    def sectors(self, state: RobotState) -> Array:
        """The shortest ray of each sector [m]; NaN counts as 0. Shape: (n, k)."""
        rays = zip(self.body.scanners, self._sectors, strict=True)
        shortest = [np.minimum.reduceat(state.signals[one.signal], starts, axis=1) for one, starts in rays]
        sectors: Array = np.nan_to_num(np.concatenate(shortest, axis=1), nan=0.0)
        return sectors

    def seen(self, state: RobotState) -> list[Floats]:
        """The shortest rays of sectors. Shape: (n, k)."""
        return [(1.0 - self.sectors(state) / SIGHT).astype(np.float32)]

    def failed(self, state: RobotState) -> Flags:
        """Whether the base touches something, or nearly does. Shape: (n,)."""
        touching: Any = state.truth.get("collision", False)
        near = [~(state.signals[one.signal] >= one.contact).all(axis=1) for one in self.body.scanners]  # NaN is near
        failed: Flags = np.any(near, axis=0) | touching
        return failed

    def _boxes(self, draws: Array) -> Array:
        """Poses of the boxes: x, y [m] and yaw [rad]. Shape: (k, draws) -> (k, 3, 3)."""
        of_x, of_y, of_yaw = np.moveaxis(draws[:, _OF_BOXES].reshape(-1, 3, len(BOXES)), 1, 0)
        x = self._scale * (BOXES[:, 0] + of_x * (BOXES[:, 1] - BOXES[:, 0]))
        y = self._scale * spread(of_y, -BOX_DEPTH, BOX_DEPTH)
        return np.stack([x, y, spread(of_yaw, -math.pi, math.pi)], axis=2)
