"""Conventions of BBRL's agents: those that take a time, a seed, or can be saved. They are inherited together."""

from __future__ import annotations

import pickle
from abc import ABC
from pathlib import Path
from typing import Any

from bam_train.errors import LoopError, OutputError
from bam_train.loop.agent import Agent


class TimeAgent(Agent, ABC):
    """An agent whose ``forward`` takes the time t."""

    def forward(self, t: int, *args: Any, **kwargs: Any) -> Any:
        """What it does at time t; to be overridden."""
        raise NotImplementedError(f"{type(self).__name__} must override forward(self, t, **kwargs).")


class SeedableAgent(Agent, ABC):
    """An agent that is seeded once.

    Args:
        seed: The seed, if it is known already.
    """

    def __init__(self, seed: int | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._seed = seed
        self._seeds: list[int] = []

    def seed(self, seed: int) -> Any:
        """Take the seed; the agent itself is returned.

        Raises:
            LoopError: It has one already.
        """
        if self._seed is not None:
            raise LoopError(
                f"{type(self).__name__} is seeded with {self._seed} already and cannot be seeded with {seed}; "
                f"SeedableAgentLast, SeedableAgentSum and SeedableAgentMean take several seeds."
            )
        self._seed = seed
        return self


class SeedableAgentLast(SeedableAgent, ABC):
    """An agent that has the last seed it was given."""

    def seed(self, seed: int) -> Any:
        """Take the seed; the agent itself is returned."""
        self._seeds.append(seed)
        self._seed = self._combined(self._seeds)
        return self

    def _combined(self, seeds: list[int]) -> int:
        return seeds[-1]


class SeedableAgentSum(SeedableAgentLast, ABC):
    """An agent that has the sum of the seeds it was given."""

    def _combined(self, seeds: list[int]) -> int:
        return sum(seeds)


class SeedableAgentMean(SeedableAgentLast, ABC):
    """An agent that has the mean of the seeds it was given, rounded down to a whole number."""

    def _combined(self, seeds: list[int]) -> int:
        return int(sum(seeds) / len(seeds))


class SerializableAgent(Agent, ABC):
    """An agent that can be saved; override `serialize` to leave out what cannot."""

    def serialize(self) -> Any:
        """What is saved: the agent without what cannot be pickled."""
        return self

    def save(self, filename: str | Path) -> None:
        """Pickle `serialize` into a file.

        Raises:
            LoopError: Something in it cannot be pickled.
            OutputError: The file cannot be written.
        """
        try:
            data = pickle.dumps(self.serialize())
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise LoopError(f"{type(self).__name__} cannot be saved: {error}; override serialize().") from error
        try:
            Path(filename).expanduser().write_bytes(data)
        except OSError as error:
            raise OutputError(f"{filename}: cannot be written: {error.strerror or error}") from error


def load(filename: str | Path) -> Any:
    """The agent in a file of `SerializableAgent.save`. It is a pickle and runs what is in it: trust its maker.

    Raises:
        LoopError: No such file, or not a pickle.
    """
    try:
        return pickle.loads(Path(filename).expanduser().read_bytes())
    except (OSError, pickle.UnpicklingError, EOFError) as error:
        raise LoopError(f"{filename}: no agent can be loaded: {error}") from error
