"""Bandits: see a context, pull one arm, get a reward; one step an episode."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.task import Array, Label, Score
from bam_envs.core.validation import NonNegativeInt, PositiveInt, check
from bam_envs.local.local_task import LocalTask, one_step

MOST_PIXELS = 12
"""Pixels of the largest picture of an image bandit: every picture has its own row in the table."""
_BAR, _HEIGHT = 24, 120  # of the picture: width of an arm, height of a chance of 1 [pixels]


class Bandit(LocalTask):
    """Base class: what is expected of each arm in each context is a row of a table, drawn once from `table_seed`."""

    memory: Mapping[str, str] = {"context": "context", "luck": "luck"}
    draws = "random"
    """How a generator draws the luck of a step."""

    def __init__(self, num_envs: int, n_arms: int, n_state: int, table_seed: int) -> None:
        super().__init__(num_envs)
        self.n_arms, self.n_state = check(n_arms, PositiveInt, "n_arms"), check(n_state, PositiveInt, "n_state")
        self.table_rng = np.random.default_rng(check(table_seed, NonNegativeInt, "table_seed"))
        self.action_space: spaces.Space[Any] = spaces.Discrete(self.n_arms)
        self.action_labels = (Label("arm", "which arm to pull", "", low=0, high=self.n_arms - 1),)
        self.observation_space = spaces.Discrete(self.n_state)
        self.observation_labels = (Label("context", "which row of the table", "", low=0, high=self.n_state - 1),)
        self.expected: Array
        """What each arm is expected to give in each context, up to scale and offset. Shape: (n_state, n_arms)."""
        self.context = np.zeros(num_envs, np.int64)
        """Shape: (n,)."""
        self.luck = np.zeros(num_envs)
        """Shape: (n,)."""

    def begin(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> None:
        """Draw a context and the luck of the step."""
        self.own_memory()
        self.context[env_ids] = [int(rng.integers(self.n_state)) for rng in rngs]
        self.luck[env_ids] = [getattr(rng, self.draws)() for rng in rngs]

    def observe(self, state: RobotState) -> Any:
        """The contexts. Shape: (n,)."""
        return self.context.copy()

    def is_best(self, action: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether no arm is better in the context. Shape: (n,)."""
        expected = self.expected[self.context]
        return np.asarray(expected[np.arange(self.num_envs), action] == expected.max(axis=1))

    def picture(self) -> NDArray[np.uint8]:
        """What the arms are expected to give, as bars on white; the best one is red. Shape: (120, 24 n_arms, 3)."""
        image, row = np.full((_HEIGHT, _BAR * self.n_arms, 3), 255, np.uint8), self.expected[self.context[0]]
        for arm, share in enumerate((row - min(row.min(), 0)) / (row.max() - min(row.min(), 0))):
            colour = (200, 40, 40) if share == 1 else (40, 80, 200)
            image[_HEIGHT - 1 - int(share * (_HEIGHT - 1)) :, _BAR * arm + 2 : _BAR * (arm + 1) - 2] = colour
        return image


class ContextBandit(Bandit):
    """Pull the arm that wins most often in the context that is shown.

    A table drawn once from `table_seed` has the chance of every arm in every context: Pareto(2) draws, cut to at most
    5 and divided by the greatest of the context, so that one arm always wins.

    Action:
        Which arm to pull.

    Start:
        The context is one of `n_state`, uniformly.

    Reward:
        1 with the arm's chance, else -1.

    Success:
        No arm has a better chance.

    End:
        Terminated after one step.

    Info:
        `threshold`, the arm's chance, and `random_value`: it wins if that is smaller.

    Args:
        n_arms: Arms.
        n_state: Contexts.
        table_seed: Seed of the table of chances.
    """

    def __init__(self, num_envs: int = 1, *, n_arms: int = 5, n_state: int = 10, table_seed: int = 0) -> None:
        super().__init__(num_envs, n_arms, n_state, table_seed)
        drawn = self.table_rng.pareto(2.0, (self.n_state, self.n_arms)).clip(0, 5)
        self.expected = drawn / drawn.max(axis=1, keepdims=True)

    def score(self, state: RobotState, action: Any) -> Score:
        """Pull the arms."""
        chance = self.expected[self.context, action]
        reward = np.where(self.luck < chance, 1.0, -1.0)
        return one_step(self.is_best(action), reward, threshold=chance, random_value=self.luck.copy())


class ClassicBandit(ContextBandit):
    """Pull the arm that wins most often; nothing tells the episodes apart.

    The arms' chances are drawn once from `table_seed`: Pareto(2) draws, cut to at most 5 and divided by the greatest,
    so that one arm always wins.

    Start:
        The observation is always 0.

    Args:
        n_arms: Arms.
        table_seed: Seed of the chances.
    """

    def __init__(self, num_envs: int = 1, *, n_arms: int = 5, table_seed: int = 0) -> None:
        super().__init__(num_envs, n_arms=n_arms, n_state=1, table_seed=table_seed)


class ImageBandit(Bandit):
    """Pull the arm that gives most for the picture that is shown, which is the context.

    A table drawn once from `table_seed` has the mean, in [-1, 1], and the standard deviation, in [0.05, 0.2], of every
    arm for every picture.

    Action:
        Which arm to pull.

    Start:
        Each pixel is 0 or 255, by a coin.

    Reward:
        Normally distributed, with mean and standard deviation of the arm for the picture.

    Success:
        No arm has a greater mean.

    End:
        Terminated after one step.

    Info:
        `mean` and `std` of the arm.

    Args:
        n_arms: Arms.
        height: Pixels from top to bottom.
        width: Pixels from left to right; a picture has at most 12 pixels.
        table_seed: Seed of the table.
    """

    draws = "standard_normal"

    def __init__(
        self, num_envs: int = 1, *, n_arms: int = 5, height: int = 2, width: int = 2, table_seed: int = 0
    ) -> None:
        self.shape = (check(height, PositiveInt, "height"), check(width, PositiveInt, "width"), 1)
        pixels = self.shape[0] * self.shape[1]
        if pixels > MOST_PIXELS:
            raise InvalidValue(f"height * width: expected at most {MOST_PIXELS} pixels, found {pixels}")
        super().__init__(num_envs, n_arms, 2**pixels, table_seed)
        self.expected = self.table_rng.uniform(-1, 1, (self.n_state, self.n_arms))
        self.spread = self.table_rng.uniform(0.05, 0.2, (self.n_state, self.n_arms))
        self.observation_space: spaces.Space[Any] = spaces.Box(0, 255, self.shape, np.uint8)
        self.observation_labels = (Label("picture", "black and white pixels", "", low=0, high=255),)

    def observe(self, state: RobotState) -> NDArray[np.uint8]:
        """The pictures. Shape: (n, height, width, 1)."""
        bits = self.context[:, None] >> np.arange(self.shape[0] * self.shape[1]) & 1
        return (255 * bits).astype(np.uint8).reshape(-1, *self.shape)

    def score(self, state: RobotState, action: Any) -> Score:
        """Pull the arms."""
        mean, std = self.expected[self.context, action], self.spread[self.context, action]
        return one_step(self.is_best(action), mean + std * self.luck, mean=mean, std=std)
