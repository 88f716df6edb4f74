"""Grid world: walk to a target on a square board."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.task import Label, Score
from bam_envs.core.validation import PositiveInt, check
from bam_envs.local.local_task import LocalTask

MOVES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
"""What each action adds to x and y: right, up, left, down."""
_CELL = 48  # width of a cell of the picture [pixels]


class GridWorld(LocalTask):
    """Walk to the target, one cell a step; a step into a wall stays where it is.

    Action:
        0 to 3: right (+x), up (+y), left (-x), down (-y).

    Start:
        Agent and target are in two different cells, uniformly.

    Reward:
        1 at the target, else 0.

    Success:
        The agent is at the target.

    End:
        Terminated at success.

    Info:
        `distance` to the target: the sum of the differences of x and y [cells].

    Args:
        size: Cells along each side, at least 2.
    """

    memory: Mapping[str, str] = {"agent": "agent", "target": "target"}
    action_labels = (Label("move", "0 right, 1 up, 2 left, 3 down", "", low=0, high=3),)

    def __init__(self, num_envs: int = 1, *, size: int = 5) -> None:
        super().__init__(num_envs)
        self.size = check(size, PositiveInt, "size")
        if size < 2:
            check(size - 1, PositiveInt, "size - 1")
        one = spaces.Box(0, size - 1, (2,), np.int64)
        self.observation_space = spaces.Dict(agent=one, target=one)
        self.action_space = spaces.Discrete(4)
        self.observation_labels = tuple(
            Label(f"{name}_{axis}", f"cell of the {name}, {axis}", "cells", low=0, high=size - 1)
            for name in ("agent", "target")
            for axis in "xy"
        )
        self.agent = np.zeros((num_envs, 2), np.int64)
        """Cells of the agents. Shape: (n, 2)."""
        self.target = np.ones((num_envs, 2), np.int64)
        """Cells of the targets. Shape: (n, 2)."""

    def begin(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> None:
        """Draw two different cells for each of these environments."""
        cells = np.array([rng.choice(self.size**2, 2, replace=False) for rng in rngs])
        self.own_memory()
        self.agent[env_ids] = np.stack(np.divmod(cells[:, 0], self.size), axis=1)
        self.target[env_ids] = np.stack(np.divmod(cells[:, 1], self.size), axis=1)

    def observe(self, state: RobotState) -> dict[str, NDArray[np.int64]]:
        """Cells of agent and target. Shape: (n, 2) each."""
        return {"agent": self.agent.copy(), "target": self.target.copy()}

    def score(self, state: RobotState, action: Any) -> Score:
        """Move the agents."""
        self.agent = np.clip(self.agent + MOVES[action], 0, self.size - 1)
        distance = np.abs(self.agent - self.target).sum(axis=1)
        arrived = distance == 0
        return Score(arrived.astype(np.float64), arrived, arrived, {"distance": distance.astype(np.float64)})

    def picture(self) -> NDArray[np.uint8]:
        """The board, y upwards: the target red, the agent blue. Shape: (48 size + 1, 48 size + 1, 3)."""
        image = np.full((_CELL * self.size + 1, _CELL * self.size + 1, 3), 255, np.uint8)
        for cell, colour, edge in ((self.target[0], (200, 40, 40), 1), (self.agent[0], (40, 80, 200), 12)):
            left, top = _CELL * int(cell[0]), _CELL * (self.size - 1 - int(cell[1]))
            image[top + edge : top + _CELL + 1 - edge, left + edge : left + _CELL + 1 - edge] = colour
        image[::_CELL] = image[:, ::_CELL] = 0
        return image
