"""A hand-written policy for `bam/grasp-xyr`: grasp across the narrow side of a blob of the depth picture."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.task import Array
from bam_envs.robots.grasping import CAMERA_HEIGHT

ABOVE = 0.01
"""Least height of an object's pixels above the table [m]."""
FEWEST = 20
"""Pixels of the smallest blob."""


class ScriptedGrasps:
    """Grasps the blob that is narrowest, at the centre of its pixels and across its principal axis.

    Args:
        bins: Columns, rows and rotations of the actions.
    """

    def __init__(self, bins: Sequence[int] = (100, 100, 16)) -> None:
        self.bins = np.array(bins)

    def act_batch(self, observations: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
        """Actions (n, 3) for n observations; the middle of the picture where there is no blob."""
        depth = observations["depth"][..., 0]
        return np.array([self._act(one) for one in depth], np.int64).reshape(len(depth), 3)

    def _act(self, depth: NDArray[np.float32]) -> Array:
        best, narrowest = (np.array(depth.shape[::-1]) / 2, 0.0), math.inf
        for pixels in blobs(depth < CAMERA_HEIGHT - ABOVE):
            middle = pixels.mean(axis=0)
            _, axes = np.linalg.eigh(np.cov((pixels - middle).T))
            across = (pixels - middle) @ axes[:, 0]
            width = across.max() - across.min()
            if width < narrowest:
                best, narrowest = (middle, math.atan2(-axes[1, 0], axes[0, 0])), width  # rows go downwards
        (column, row), angle = best
        rows, columns = depth.shape
        turn = round(angle / math.pi * self.bins[2]) % self.bins[2]
        return np.array([column * self.bins[0] // columns, row * self.bins[1] // rows, turn])

    def reset(self, env_ids: Sequence[int] | None = None) -> None:
        """Do nothing: there is no memory."""


def blobs(mask: NDArray[np.bool_]) -> list[Array]:
    """The connected regions of a picture (h, w) with at least `FEWEST` pixels: column and row of each. (k, 2) each."""
    labels = np.where(mask, np.arange(1, mask.size + 1).reshape(mask.shape), 0)
    while True:  # every pixel takes the greatest label around it
        padded = np.pad(labels, 1)
        around = np.maximum.reduce([labels, padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
        spread = np.where(mask, around, 0)
        if (spread == labels).all():
            break
        labels = spread
    regions = (np.argwhere(labels == label)[:, ::-1].astype(np.float64) + 0.5 for label in np.unique(labels[mask]))
    return [pixels for pixels in regions if len(pixels) >= FEWEST]
