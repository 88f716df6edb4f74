"""The Task protocol: what a robot is asked to do. A task is pure: no I/O and no clock; its memory is arrays it owns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.robot import EnvIds, Initial, RobotState

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Label:
    """The meaning of one number of an observation or action."""

    name: str
    meaning: str
    unit: str
    """Of the quantity before scaling."""
    scale: str = "1"
    """How the quantity is scaled."""
    low: float = -1.0
    high: float = 1.0


@dataclass
class Score:
    """The outcome of one step in each of n environments."""

    reward: Array
    """Shape: (n,)."""
    terminated: Flags
    """The task ended, well or badly. Shape: (n,)."""
    success: Flags
    """The task is done. Shape: (n,)."""
    info: dict[str, NDArray[Any]] = field(default_factory=dict)
    """Named distances and the like, numbers, text ("" for none) or objects. Shape: (n, ...) each."""


@runtime_checkable
class Task(Protocol):
    """Observation, command, reward and end of `num_envs` environments: one live robot, or many simulated ones.

    A task may have one more attribute, ``reset_options``: the names of the options that `reset` of its environment
    takes. Its `sample_initial` has a third argument then, ``options``, a mapping of those that were given.
    """

    num_envs: int
    observation_space: spaces.Box
    """Of a single environment."""
    action_space: spaces.Box
    """Of a single environment."""
    observation_labels: tuple[Label, ...]
    action_labels: tuple[Label, ...]

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """Sample targets and start states of these environments, each from its own generator."""

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """The robots of these environments are at their start: begin the memory of the episode with what was measured.

        `state` has all n environments.
        """

    def observe(self, state: RobotState) -> Floats:
        """What the policy sees. Shape: (n, ...)."""

    def command(self, action: Floats, state: RobotState) -> Array:
        """What the robot is sent, SI units. Shapes: (n, a) -> (n, m)."""

    def score(self, state: RobotState, action: Floats) -> Score:
        """The outcome of the step that led to `state`."""

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """Spheres that a picture of environment 0 shows: position (3,) [m] and colour."""

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned."""


def labelled_box(labels: Sequence[Label]) -> spaces.Box:
    """The float32 space whose numbers are `labels`."""
    low, high = ([getattr(label, side) for label in labels] for side in ("low", "high"))
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


class Memory:
    """The memory of a task or of simulated robots, as `Task.state_dict` has it: the arrays that `memory` names."""

    memory: Mapping[str, str] = {}
    """Key in the saved memory -> attribute."""

    def state_dict(self) -> dict[str, Any]:
        """A copy of each array."""
        return {key: getattr(self, attribute).copy() for key, attribute in self.memory.items()}

    def load_state_dict(self, state: dict[str, Any]) -> Any:
        """Go to what `state_dict` returned."""
        for key, attribute in self.memory.items():
            setattr(self, attribute, np.array(state[key], dtype=getattr(self, attribute).dtype))

    def own_memory(self) -> None:
        """Go on with copies: what was handed out of the arrays keeps its numbers."""
        for attribute in self.memory.values():
            setattr(self, attribute, getattr(self, attribute).copy())


def draw_seeds(rngs: Sequence[np.random.Generator]) -> NDArray[np.int64]:
    """A seed for what the robot itself draws, one from each generator; for `Initial.seeds`. Shape: (k,)."""
    return np.array([rng.integers(2**63) for rng in rngs], dtype=np.int64)


def as_objects(values: Sequence[Any]) -> NDArray[Any]:
    """`values` as an info: an array of objects, one for each environment. Shape: (n,)."""
    objects = np.empty(len(values), dtype=object)
    objects[:] = values
    return objects
