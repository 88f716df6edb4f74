"""Hand-written policies that solve the tasks from their observations: they show that a task can be done, and give demonstrations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.pick_place import PickPlaceTask
from bam_envs.tasks.task import Label
from bam_envs.tasks.tool_control import LEASH, TOOL_STEP, YAW_STEP

Floats = NDArray[np.float32]
HOVER = 0.08
"""How far above the object the tool comes in [m]."""


class Columns:
    """Reads an observation (n, k) by the names of its labels."""

    def __init__(self, labels: Sequence[Label]) -> None:
        self._index = {label.name: column for column, label in enumerate(labels)}

    def take(self, observation: Floats, *names: str) -> NDArray[np.float64]:
        """The named numbers, side by side. Shape: (n, len(names))."""
        return observation[:, [self._index[name] for name in names]].astype(np.float64)


class ScriptedPick:
    """Hover above the cube with the gripper turned to it, go down, close, lift. No memory: it acts on the observation alone."""

    labels = PickTask.observation_labels

    def __init__(self) -> None:
        self._columns = Columns(self.labels)

    def act_batch(self, observations: Floats) -> Floats:
        """Actions for n observations. Shapes: (n, k) -> (n, 5)."""
        take = self._columns.take
        offset = 0.1 * take(observations, "object_dx", "object_dy", "object_dz")
        lead = LEASH * take(observations, "target_dx", "target_dy", "target_dz")
        cosine, sine = take(observations, "object_yaw_cos", "object_yaw_sin").T
        turn = np.arctan2(sine, cosine) / 4
        holding = self._holding(observations, offset)
        aligned = (np.hypot(offset[:, 0], offset[:, 1]) < 0.008) & (np.abs(turn) < 0.08)
        low = aligned & (np.abs(offset[:, 2]) < 0.008)
        height = np.where(aligned | holding, 0.0, HOVER)
        travel = offset - lead
        travel[:, 2] += height
        travel[holding] = (0.0, 0.0, 1.0)
        closed = (take(observations, "grip")[:, 0] > 0) & (np.linalg.norm(offset, axis=1) < 0.02)
        waiting = closed & ~holding
        travel[waiting] = 0.0
        grip = np.where(low | closed, 1.0, -1.0)
        turn = np.where(closed, 0.0, turn)
        actions = np.concatenate([travel / TOOL_STEP, turn[:, None] / YAW_STEP, grip[:, None]], axis=1)
        return np.clip(actions, -1.0, 1.0).astype(np.float32)

    def _holding(self, observations: Floats, offset: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the closed gripper has stopped at the width of a cube, which is between the pads. Shape: (n,)."""
        grip, width = self._columns.take(observations, "grip", "gripper_width").T
        held: NDArray[np.bool_] = (grip > 0) & (width < 0.1) & (np.linalg.norm(offset, axis=1) < 0.03)
        return held

    def reset(self, rows: Sequence[int] | None = None) -> None:
        """Nothing to forget."""
