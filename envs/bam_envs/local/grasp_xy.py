"""The simplest grasp: touch a circle in a picture."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from gymnasium import spaces
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.task import Label, Score
from bam_envs.core.validation import check
from bam_envs.local.local_task import LocalTask, one_step

CIRCLES = 5
RADII = (5, 20)
"""Least and greatest radius in a picture of 256 x 256 pixels [pixels]."""


class GraspXY(LocalTask):
    """Touch one of five red circles on black; the picture is what a camera above a table might see.

    Action:
        The pixel: x from the left, y from the top.

    Start:
        Radii are 5 to 20 pixels, in proportion where the picture is smaller. Every circle is anywhere in the picture,
        whole; circles may overlap.

    Reward:
        1 on a circle, else -1.

    Success:
        The pixel is on a circle.

    End:
        Terminated after one step.

    Info:
        Nothing else.

    Args:
        size: Pixels along each side of the picture, 16 to 1024.
    """

    memory: Mapping[str, str] = {"circles": "circles"}

    def __init__(self, num_envs: int = 1, *, size: int = 256) -> None:
        super().__init__(num_envs)
        self.size = check(size, Annotated[int, Meta(ge=16, le=1024)], "size")
        self.radii = [max(1, round(radius * self.size / 256)) for radius in RADII]
        self.observation_space = spaces.Box(0, 255, (self.size, self.size, 3), np.uint8)
        self.observation_labels = (Label("picture", "red circles on black", "", low=0, high=255),)
        self.action_space = spaces.MultiDiscrete([self.size, self.size])
        last = self.size - 1
        self.action_labels = (
            Label("x", "pixels from the left", "pixels", low=0, high=last),
            Label("y", "pixels from the top", "pixels", low=0, high=last),
        )
        self.circles = np.ones((num_envs, CIRCLES, 3), np.int64)
        """x, y and radius of each circle [pixels]. Shape: (n, 5, 3)."""

    def begin(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> None:
        """Draw the circles."""
        drawn = np.array([rng.random((CIRCLES, 3)) for rng in rngs])
        least, greatest = self.radii
        radius = least + (drawn[..., 2:] * (greatest - least + 1)).astype(np.int64)
        centre = radius + (drawn[..., :2] * (self.size - 2 * radius)).astype(np.int64)
        self.own_memory()
        self.circles[env_ids] = np.concatenate([centre, radius], axis=2)

    def observe(self, state: RobotState) -> NDArray[np.uint8]:
        """The pictures. Shape: (n, size, size, 3)."""
        images = np.zeros((self.num_envs, self.size, self.size, 3), np.uint8)
        reach = np.arange(-self.radii[1], self.radii[1] + 1)
        x, y, radius = (self.circles[..., i, None, None] for i in range(3))
        inside = reach**2 + reach[:, None] ** 2 <= radius**2
        env, _, _, _ = np.nonzero(inside)
        columns, rows = (np.broadcast_to(one, inside.shape)[inside] for one in (x + reach, y + reach[:, None]))
        images[env, rows, columns, 0] = 255
        return images

    def score(self, state: RobotState, action: Any) -> Score:
        """Touch the pixels."""
        away = ((self.circles[..., :2] - action[:, None]) ** 2).sum(axis=2)
        touched = (away <= self.circles[..., 2] ** 2).any(axis=1)
        return one_step(touched, np.where(touched, 1.0, -1.0))

    def picture(self) -> NDArray[np.uint8]:
        """What is observed. Shape: (size, size, 3)."""
        image: NDArray[np.uint8] = self.observe(RobotState({}, np.zeros(1), np.zeros((1, 0))))[0]
        return image
