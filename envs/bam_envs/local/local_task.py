"""What the local environments share: a task without a robot, and the `Robot` that stands in the place of one."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.core.robot import EnvIds, Initial, RobotSpec, RobotState, SignalSpec
from bam_envs.core.task import Array, Flags, Label, Memory, Score

PERIOD = 0.1
"""Time of a step where one is asked for, such as between two pictures of a video [s]."""


class NoRobot:
    """The robots of an environment that has none: no signals, an empty command, and a clock that counts periods."""

    def __init__(self, num_robots: int = 1, *, randomize: bool = False) -> None:
        self.num_robots = num_robots
        self.spec = RobotSpec("none", (), SignalSpec("command", (), (), (), (), ()), PERIOD)
        self._stamp = np.zeros(num_robots)

    def connect(self) -> None:
        """Do nothing."""

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """Set the clocks of these environments to zero."""
        self._stamp = self._stamp.copy()
        self._stamp[env_ids] = 0.0
        return self._state()

    def step(self, command: Array) -> RobotState:
        """Advance the clocks by a period."""
        self._stamp = self._stamp + PERIOD
        return self._state()

    def _state(self) -> RobotState:
        return RobotState({}, self._stamp, np.empty((self.num_robots, 0)))

    def halt(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def state_dict(self) -> dict[str, Any]:
        """The clocks."""
        return {"stamp": self._stamp.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> RobotState:
        """Restore the result of `state_dict`."""
        self._stamp = np.array(state["stamp"])
        return self._state()


class LocalTask(Memory):
    """A task without a robot: what happens is its own memory.

    A subclass defines the spaces, the labels and these:

    - ``begin(env_ids, rngs)``: a new episode in these environments, each drawn from its own generator.
    - ``observe(state)``: new arrays (n, ...), or a dict of them.
    - ``score(state, action)``: take the step, for actions (n, ...); returns its outcome.
    - ``picture()``, if it has one: an image (h, w, 3) uint8 of the first environment.
    """

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    observation_labels: tuple[Label, ...]
    action_labels: tuple[Label, ...]

    def __init__(self, num_envs: int = 1) -> None:
        self.num_envs = num_envs

    def begin(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> None:
        """Begin an episode in these environments."""
        raise NotImplementedError

    def observe(self, state: RobotState) -> Any:
        """The observations, new arrays. Shape: (n, ...)."""
        raise NotImplementedError

    def score(self, state: RobotState, action: Any) -> Score:
        """Take the step; returns its outcome."""
        raise NotImplementedError

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """Begin an episode in these environments."""
        self.begin(env_ids, rngs)
        return Initial({}, np.zeros(len(env_ids), np.int64))

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Do nothing: the episode has begun."""

    def command(self, action: Any, state: RobotState) -> Array:
        """The empty command. Shape: (n, 0)."""
        return np.empty((self.num_envs, 0))

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """Nothing to draw."""
        return []


def one_step(correct: Flags, reward: Array, **info: Any) -> Score:
    """The outcome of a step that ends every episode; `correct` (n,) bool tells where it was the best choice."""
    ended = np.ones(len(correct), dtype=bool)
    return Score(np.asarray(reward, np.float64), ended, correct, info)
