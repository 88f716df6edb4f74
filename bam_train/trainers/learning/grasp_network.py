"""The success of a grasp, from the depth picture around it; and the frozen policy that looks at every grasp.

A grasp is seen in the gripper's frame: the picture is turned so that the gripper closes along its rows. So what is
learnt at one place and rotation holds for all. Training computes single patches; the frozen policy turns the whole
picture by every rotation, and the same convolutions slide over it.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import nn

from bam_train.errors import SettingsError
from bam_train.trainers.frozen_network import FrozenNetwork, Layer, to

EDGE = 33
"""Width of a patch [pixels]."""
HEIGHT_UNIT = 0.0005
"""Heights are kept as bytes, in this unit [m]."""
STRIDE = 2
"""Pixels between two places that the frozen policy looks at."""
_SCALE = 0.05  # heights of the network's inputs are divided by it [m]
_HALF = EDGE // 2
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Grid:
    """The pictures and actions of an environment of grasps."""

    rows: int
    columns: int
    bins: tuple[int, ...]
    """Columns, rows, rotations, and widths if there are any."""

    @classmethod
    def of(cls, observation: spaces.Space[Any], action: spaces.Space[Any]) -> Grid:
        """Read the spaces; raises SettingsError if they are not those of a grasp from a picture."""
        depth = observation.spaces.get("depth") if isinstance(observation, spaces.Dict) else None
        if not isinstance(depth, spaces.Box) or depth.shape[2:] not in ((), (1,)) or len(depth.shape) < 2:
            raise SettingsError(
                f"grasps: expected a Dict with a picture 'depth' (h, w) or (h, w, 1), found {observation}"
            )
        if not isinstance(action, spaces.MultiDiscrete) or action.shape not in ((3,), (4,)):
            raise SettingsError(f"grasps: expected one grasp as MultiDiscrete of 3 or 4 numbers, found {action}")
        return cls(depth.shape[0], depth.shape[1], tuple(action.nvec.tolist()))

    @property
    def rotations(self) -> int:
        """Number of rotations in half a turn."""
        return self.bins[2]

    @property
    def widths(self) -> int:
        """Number of widths; 1 if they are no part of an action."""
        return self.bins[3] if len(self.bins) > 3 else 1

    def actions(self, column: Any, row: Any, rotation: Any, width: Any) -> NDArray[np.int64]:
        """Actions (n, 3 or 4) of grasps at pixels, rotations and widths, (n,) each."""
        parts = [column * self.bins[0] // self.columns, row * self.bins[1] // self.rows, rotation, width]
        return np.stack(parts[: len(self.bins)], axis=1)

    def turned(self, column: Any, row: Any, rotation: Any, across: Any, down: Any) -> tuple[Any, Any, Any]:
        """Column and row of the pixel `across` and `down` of grasps, in their turned frames; whether it exists."""
        angle = np.asarray(rotation)[:, None, None] * math.pi / self.rotations
        x = np.floor(column + np.cos(angle) * across + np.sin(angle) * down + 0.5).astype(np.int64)
        y = np.floor(row - np.sin(angle) * across + np.cos(angle) * down + 0.5).astype(np.int64)
        return x, y, (x >= 0) & (x < self.columns) & (y >= 0) & (y < self.rows)

    def patches(self, heights: Bytes, column: Any, row: Any, rotation: Any) -> Bytes:
        """The patches around grasps, the table outside the picture. Shapes: (n, h, w), (n,) each -> (n, 33, 33)."""
        down, across = np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1]
        x, y, inside = self.turned(column[:, None, None], row[:, None, None], rotation, across, down)
        seen = heights[np.arange(len(x))[:, None, None], np.where(inside, y, 0), np.where(inside, x, 0)]
        return np.where(inside, seen, np.uint8(0))


class GraspNetwork(Layer):
    """Logits of success. Shape: (n, 1, 33 + 2 k, 33 + 2 l) heights -> (n, widths, 1 + k, 1 + l)."""

    def __init__(self, channels: int, widths: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(1, channels, 5, stride=STRIDE),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, dilation=2),
            nn.ReLU(),
            nn.Conv2d(channels, 2 * channels, 3, dilation=4),
            nn.ReLU(),
            nn.Conv2d(2 * channels, 2 * channels, 1),
            nn.ReLU(),
            nn.Conv2d(2 * channels, widths, 1),
        )

    def forward(self, heights: torch.Tensor) -> torch.Tensor:
        """See the class."""
        return self.layers(heights / _SCALE)


class GraspPolicy(FrozenNetwork):
    """The grasp with the highest success, of every other pixel and every rotation.

    Args:
        network: The learner's.
        grid: Pictures and actions.
        table: Depth of the table [m].
        space: The environment's observation space.
    """

    def __init__(self, network: GraspNetwork, grid: Grid, table: float, space: spaces.Dict) -> None:
        super().__init__(space)
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.grid, self.table = grid, table
        self.at = list(self.leaves).index("depth")
        column, row, index = self._turned()
        self.shape, self.index = index.shape[1:], [torch.as_tensor(one.astype(np.int32).ravel()) for one in index]
        places = np.ix_(np.arange(0, grid.rows, STRIDE) + _HALF, np.arange(0, grid.columns, STRIDE) + _HALF)
        columns, rows = (np.stack([one[places].ravel() for one in each]) for each in (column, row))
        self.places = columns.shape[1]
        chosen = np.broadcast_arrays(  # rotations, widths, places
            columns[:, None], rows[:, None], *np.ogrid[: grid.rotations, : grid.widths, :1][:2]
        )
        self.actions = torch.as_tensor(grid.actions(*(one.ravel() for one in chosen)).astype(np.int32))
        self.head = _Best(self.actions, spaces.MultiDiscrete(list(grid.bins)).dtype)

    def _turned(self) -> tuple[Any, Any, Any]:
        """Column, row and place in the flat picture of every pixel of the turned ones, with margins."""
        grid, (v, u) = self.grid, np.mgrid[-_HALF : self.grid.rows + _HALF, -_HALF : self.grid.columns + _HALF]
        middle = (grid.columns - 1) / 2, (grid.rows - 1) / 2
        x, y, inside = grid.turned(*middle, np.arange(grid.rotations), u - middle[0], v - middle[1])
        index = np.where(inside, y * grid.columns + x, grid.rows * grid.columns)  # the table, behind the last pixel
        return x.clip(0, grid.columns - 1), y.clip(0, grid.rows - 1), index

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """Logits of every grasp. Shape: (n, rotations * widths * places)."""
        heights = (self.table - observation[self.at].flatten(1)).clamp(0.0, 255 * HEIGHT_UNIT)
        # Zeros, of every input: one that is not used would not be an input of the graph.
        margin = sum(to(one.flatten(1)[:, :1], torch.float32) * 0.0 for one in observation)
        flat, each = torch.cat([heights, margin], 1), []
        for index in self.index:  # one rotation after the other takes little memory
            logits = self.network(flat.index_select(1, index).reshape(-1, 1, *self.shape))
            each.append(logits.reshape(-1, self.grid.widths * self.places))
        return torch.cat(each, 1)


class _Best(Layer):
    """The action with the highest score. Shape: (n, k) -> (n, 3 or 4)."""

    def __init__(self, actions: torch.Tensor, dtype: Any) -> None:
        super().__init__()
        self.actions, self.dtype = actions, torch.as_tensor(np.zeros((), dtype)).dtype

    def forward(self, scores: torch.Tensor) -> torch.Tensor:
        return to(self.actions.index_select(0, scores.argmax(1)), self.dtype)

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        """The difference between the best and the second score. Shape: (n,)."""
        best = scores.topk(2, dim=1)[0]
        return best[:, 0] - best[:, 1]
