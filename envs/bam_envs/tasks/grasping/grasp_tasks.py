"""Grasps from a picture: look down at a table with objects, say where to grasp, and the gripper does it.

An episode is one step: `bam/grasp-xyr`, `bam/grasp-xyrw` and `bam/grasp-6d` differ in what an action says of a grasp.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Label, Memory, Score, draw_seeds
from bam_envs.core.validation import PositiveInt, check
from bam_envs.robots.grasping import CAMERA_HEIGHT, HIGH, LOW, NUMBERS, REASONS, straight_down, to_metres
from bam_envs.robots.ur5e import GRIPPER_OPEN

DEEP = 0.022
"""How far below the surface at a pixel the middle of the pads goes [m]."""
LOWEST = 0.014
"""Least height of the middle of the pads above the table [m]: their ends are 2 mm above it."""
_MOST_PIXELS = 512


class GraspTask(Memory):
    """What the grasp tasks share: the pictures, and the reward for what was lifted.

    A subclass defines `numbers`, the labels of one grasp, `action_space`, and `poses`, which turns actions into grasps.

    Start:
        Boxes, cylinders and corners of random sizes, colours and poses, 2 mm apart or more, their middles within 9 cm
        of that of the picture along x and y. Some are too wide for the gripper in one direction or in all.

    Reward:
        The share of the grasps that lifted an object.

    Success:
        Every grasp lifted an object: at the end, 10 cm higher, the fingers hold it.

    End:
        Terminated after every step.

    Info:
        `lifted`: number of grasps that lifted an object; `object`: index of the lifted object, or -1, of each grasp;
        `rise` of the object that rose most [m]; `reason` of the first failure: "blocked" (the gripper did not get to
        its pose), "missed" (it closed on nothing) or "dropped".

    Args:
        objects: Number of objects on the table; one that finds no place in 40 tries is left out.
        grasps: Grasps of an action, executed one after the other; what one lifts is gone for the next.
        size: Width and height of the pictures [pixels].
    """

    numbers: tuple[Label, ...]
    action_space: spaces.Space[Any]

    def __init__(self, num_envs: int = 1, *, objects: int = 5, grasps: int = 1, size: int = 100) -> None:
        self.num_envs = num_envs
        for name, value in (("objects", objects), ("grasps", grasps), ("size", size)):
            check(value, PositiveInt, name)
        if size > _MOST_PIXELS:
            raise InvalidValue(f"size must be at most {_MOST_PIXELS} pixels, not {size}.")
        self.grasps, self.size = grasps, size
        images: dict[str, spaces.Space[Any]] = {
            "color": spaces.Box(0, 255, (size, size, 3), np.uint8),
            "depth": spaces.Box(0.0, 2 * CAMERA_HEIGHT, (size, size, 1), np.float32),
        }
        self.observation_space = spaces.Dict(images)
        self.observation_labels = (
            Label("color", "picture from above, RGB", "1", low=0, high=255),
            Label("depth", "distance from the camera's plane", "m", low=0, high=2 * CAMERA_HEIGHT),
        )

    @property
    def action_labels(self) -> tuple[Label, ...]:
        """The numbers of every grasp."""
        if self.grasps == 1:
            return self.numbers
        return tuple(
            Label(f"grasp{k}_{one.name}", one.meaning, one.unit, one.scale, one.low, one.high)
            for k in range(self.grasps)
            for one in self.numbers
        )

    def poses(self, grasps: NDArray[Any], depth: Array) -> Array:
        """Grasps (n, k, a) as commands: position [m], orientation, width [m]. Shape: (n, k, 8).

        `depth` is the picture's, (n, size, size) [m].
        """
        raise NotImplementedError

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """Draw the seeds of the objects."""
        return Initial({}, draw_seeds(rngs))

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Do nothing: there is no memory."""

    def observe(self, state: RobotState) -> dict[str, NDArray[Any]]:
        """The pictures. Shape: (n, size, size, 3 or 1)."""
        return {name: state.signals[name].copy() for name in ("color", "depth")}

    def command(self, action: NDArray[Any], state: RobotState) -> Array:
        """See `poses`; all grasps go by the same picture. Shape: (n, 8 grasps)."""
        depth = state.signals["depth"][..., 0].astype(np.float64)
        commands = self.poses(np.asarray(action).reshape(len(depth), self.grasps, -1), depth)
        return np.clip(commands, LOW, HIGH).reshape(len(depth), NUMBERS * self.grasps)

    def score(self, state: RobotState, action: NDArray[Any]) -> Score:
        """Reward the share of the grasps that lifted an object."""
        truth = state.truth
        lifted = truth["object"] >= 0
        failed = np.argmin(lifted, axis=1)  # the first, if there is one
        info = {
            "lifted": lifted.sum(axis=1),
            "object": truth["object"] if self.grasps > 1 else truth["object"][:, 0],
            "rise": truth["rise"].max(axis=1),
            "reason": REASONS[truth["reason"][np.arange(len(lifted)), failed]],
        }
        ended = np.ones(len(lifted), dtype=bool)
        return Score(lifted.mean(axis=1), ended, np.asarray(lifted.all(axis=1)), info)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """None beyond the scene."""
        return []


class GraspXYR(GraspTask):
    """Say at which place of the picture the open gripper goes down, and along which direction it closes.

    Action:
        Column, row and rotation, for each grasp. The rotation turns the direction in which the gripper closes
        anticlockwise in the picture, from along its rows, by half a turn in all. The depth at the place decides how
        deep the gripper goes.

    Args:
        bins: Numbers of columns, rows and rotations of an action.
    """

    labels: tuple[tuple[str, str], ...] = (
        ("column", "place from the left edge of the picture"),
        ("row", "place from the upper edge of the picture"),
        ("rotation", "direction in which the gripper closes, in steps of half a turn by the number of rotations"),
    )

    def __init__(self, num_envs: int = 1, *, bins: Sequence[int] = (100, 100, 16), **options: Any) -> None:
        super().__init__(num_envs, **options)
        self.bins = tuple(check(list(bins), list[PositiveInt], "bins"))
        if len(self.bins) != len(self.labels):
            raise InvalidValue(f"bins must be {len(self.labels)} numbers, not {len(self.bins)}.")
        self.action_space = spaces.MultiDiscrete(np.tile(self.bins, self.grasps))
        self.numbers = tuple(
            Label(name, meaning, "bins", low=0, high=count - 1)
            for (name, meaning), count in zip(self.labels, self.bins, strict=True)
        )

    def poses(self, grasps: NDArray[Any], depth: Array) -> Array:
        """See `GraspTask.poses`."""
        places = (grasps[..., :2] + 0.5) * self.size / np.array(self.bins[:2])  # column, row [pixels]
        column, row = np.moveaxis(places, -1, 0)
        envs = np.arange(len(depth))[:, None]
        distance = depth[envs, row.astype(np.int64), column.astype(np.int64)]
        point = to_metres(column, row, distance, (self.size, self.size))
        point[..., 2] = np.maximum(point[..., 2] - DEEP, LOWEST)
        turn = straight_down(grasps[..., 2] * math.pi / self.bins[2])
        return np.concatenate([point, turn, self.widths(grasps)[..., None]], axis=-1)

    def widths(self, grasps: NDArray[Any]) -> Array:
        """Width of the open gripper [m]. Shape: (n, k, a) -> (n, k)."""
        return np.full(grasps.shape[:2], GRIPPER_OPEN)


class GraspXYRW(GraspXYR):
    """As `bam/grasp-xyr`, and how wide the gripper is open: a narrow one fits between two objects.

    Action:
        Column, row, rotation and width, for each grasp. The last width is the open gripper, the others are equal steps
        below it.

    Args:
        bins: Numbers of columns, rows, rotations and widths of an action.
    """

    labels = (*GraspXYR.labels, ("width", "width of the gripper before it closes, from the smallest to fully open"))

    def __init__(self, num_envs: int = 1, *, bins: Sequence[int] = (100, 100, 16, 8), **options: Any) -> None:
        super().__init__(num_envs, bins=bins, **options)

    def widths(self, grasps: NDArray[Any]) -> Array:
        """Width of the gripper before it closes [m]. Shape: (n, k, 4) -> (n, k)."""
        widths: Array = GRIPPER_OPEN * (grasps[..., 3] + 1) / self.bins[3]
        return widths


class Grasp6D(GraspTask):
    """Say where the gripper goes, how it is turned and how wide it is open: any pose, such as from the side.

    Action:
        Position of the middle of the pads, orientation as a quaternion of any length, and width, for each grasp. The
        gripper comes along its fingers from 12 cm away. The quaternion (0, 1, 0, 0) points down and closes along x.
    """

    numbers = (
        *(Label(axis, f"middle of the pads, {axis}", "m", scale="limits of the command") for axis in "xyz"),
        *(Label(f"q{part}", f"orientation, {part}", "1") for part in "wxyz"),
        Label("width", "width of the gripper before it closes", "m", scale="limits of the command"),
    )

    def __init__(self, num_envs: int = 1, **options: Any) -> None:
        super().__init__(num_envs, **options)
        self.action_space = spaces.Box(-1.0, 1.0, (NUMBERS * self.grasps,), np.float32)

    def poses(self, grasps: NDArray[Any], depth: Array) -> Array:
        """See `GraspTask.poses`; -1 and 1 are the limits of the command."""
        commands: Array = LOW + (np.clip(grasps, -1.0, 1.0).astype(np.float64) + 1.0) / 2 * (HIGH - LOW)
        return commands
