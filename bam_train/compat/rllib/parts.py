"""What is read alike of both API stacks: weights, filters, and what a directory says in all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bam_train.compat.rllib.directory import Directory
from bam_train.compat.rllib.pickles import unpacked_array
from bam_train.errors import PolicyError
from bam_train.trainers.rllib.freezing.parts import Array, Filter, PolicyParts, filter_of

FAULTS = (AttributeError, IndexError, KeyError, TypeError, ValueError)
"""What taking a structure apart raises that is not as it should be."""


@dataclass(frozen=True)
class ForeignPolicy:
    """What a directory says of one policy."""

    parts: PolicyParts
    """Its spaces are the environment's own if the directory has them, else the network's."""
    env: str | None
    """Name of the environment; None if the directory does not say it, or only by running something."""
    env_kwargs: dict[str, Any]
    """The environment's keyword arguments; {} if unknown."""
    steps: int
    """Environment steps trained; 0 if unknown."""
    whole: bool
    """Whether the directory says what RLlib's connectors do before and after the network."""
    algorithm_known: bool
    """Whether the directory names the algorithm; else it is that whose network this is, if any."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the algorithm's configuration; {} if unknown, as of the old API stack."""


def read_weights(directory: Directory, path: Path, state: Any) -> dict[str, Array]:
    """The arrays of a module's state, by name.

    Raises:
        AlteredCheckpoint: It holds something else.
    """
    if not isinstance(state, Mapping) or not state:
        raise directory.altered(path, "holds no weights")
    for name, array in state.items():
        if not isinstance(name, str) or not isinstance(array, (np.ndarray, np.generic, float, int)):
            raise directory.altered(path, f"holds a {type(array).__name__} under {name!r}, expected an array")
    return {name: np.asarray(array) for name, array in state.items()}


def read_filter(directory: Directory, path: Path, state: Any) -> Filter:
    """The filter in the state of a `MeanStdFilter` whose arrays are packed into text.

    Raises:
        AlteredCheckpoint: It holds something else.
    """
    try:
        return filter_of({agent: _with_arrays(entry) for agent, entry in state.items()})
    except PolicyError:
        raise
    except FAULTS as error:
        raise directory.altered(path, f"is not the state of a MeanStdFilter: {error}") from error


def _with_arrays(entry: Mapping[str, Any]) -> dict[str, Any]:
    """An agent's filter with arrays in place of text."""
    stats = [
        {
            "num_pushes": stat["num_pushes"],
            **{name: unpacked_array(stat[name]) for name in ("mean_array", "sum_sq_diff_array")},
        }
        for stat in entry["running_stats"]
    ]
    return {**entry, "running_stats": stats}
