"""The Task protocol: the problem that a robot solves. A task is pure: no I/O and no clock; its memory is arrays."""

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
    """Unit of the quantity before scaling."""
    scale: str = "1"
    """Scaling of the quantity."""
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
    """Named infos, such as distances: numbers, text ("" for none) or objects. Shape: (n, ...) each."""


def unscored(num_envs: int) -> Score:
    """The outcome of a step that nothing rewards and that ends nothing, for a task with ``says_success`` False."""
    return Score(np.zeros(num_envs), np.zeros(num_envs, dtype=bool), np.zeros(num_envs, dtype=bool))


@runtime_checkable
class Task(Protocol):
    """Observation, command, reward and end of `num_envs` environments: one live robot, or many simulated ones.

    A task may have one more attribute, ``reset_options``: the names of the options that `reset` of its environment
    takes. Its `sample_initial` then has a third argument, ``options``, a mapping of the options in use.

    A task that is the same with left and right exchanged may have ``mirrored``: the names of the labels of observation
    and action whose numbers change their sign then.

    A task that can begin near its goal, to train on, has ``near_starts``: the share of such starts, 0 at first.

    A task with a fixed number of different starts has it as ``num_starts``, and as ``drawn`` the number of the start of
    each environment, from 0 on. Shape: (n,).

    A task that does not know what success is has ``says_success``, False: no info of its environment has
    ``is_success``, and the `success` of its scores stays False.
    """

    num_envs: int
    observation_space: spaces.Space[Any]
    """Observation space of a single environment: arrays, or a Dict of them."""
    action_space: spaces.Space[Any]
    """Action space of a single environment: a Box, a Discrete or a MultiDiscrete."""
    observation_labels: tuple[Label, ...]
    """One for each number, in order; an image has one, with its name."""
    action_labels: tuple[Label, ...]

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """Sample targets and start states of these environments, each from its own generator."""

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Begin the memory of an episode in these environments, whose robots are at their start.

        `state` has all n environments.
        """

    def observe(self, state: RobotState) -> Any:
        """The observation for the policy: an array (n, ...), or a new dict of them."""

    def command(self, action: Floats, state: RobotState) -> Array:
        """The command to the robot, SI units. Shapes: (n, a) -> (n, m)."""

    def score(self, state: RobotState, action: Floats) -> Score:
        """The outcome of the step that led to `state`."""

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """Spheres to draw in an image of environment 0: position (3,) [m] and RGBA colour."""

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""


def limited(values: Any, low: Any, high: Any) -> NDArray[Any]:
    """`values`, none below `low` or above `high`: `np.clip` in a quarter of its time for the few numbers of a robot."""
    result: NDArray[Any] = np.minimum(np.maximum(values, low), high)
    return result


def labelled_box(labels: Sequence[Label]) -> spaces.Box:
    """The float32 space whose numbers are `labels`."""
    low, high = ([getattr(label, side) for label in labels] for side in ("low", "high"))
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


class Memory:
    """The memory of a task or of simulated robots, for `Task.state_dict`: the arrays that `memory` names."""

    memory: Mapping[str, str] = {}
    """Key in the saved memory -> attribute."""

    def state_dict(self) -> dict[str, Any]:
        """A copy of each array."""
        return {key: getattr(self, attribute).copy() for key, attribute in self.memory.items()}

    def load_state_dict(self, state: dict[str, Any]) -> Any:
        """Restore the result of `state_dict`; arrays that an earlier version did not save stay as they are."""
        for key, attribute in self.memory.items():
            if key in state:
                setattr(self, attribute, np.array(state[key], dtype=getattr(self, attribute).dtype))

    def own_memory(self) -> None:
        """Continue with copies, so that views of the arrays that a caller holds keep their numbers."""
        for attribute in self.memory.values():
            setattr(self, attribute, getattr(self, attribute).copy())


def draw_seeds(rngs: Sequence[np.random.Generator]) -> NDArray[np.int64]:
    """Seeds of the robots' own random numbers, one from each generator; for `Initial.seeds`. Shape: (k,)."""
    return np.array([rng.integers(2**63) for rng in rngs], dtype=np.int64)


def as_objects(values: Sequence[Any]) -> NDArray[Any]:
    """`values`, one for each environment, as an info: an array of objects. Shape: (n,)."""
    objects = np.empty(len(values), dtype=object)
    objects[:] = values
    return objects


def first_info(score: Score) -> dict[str, Any]:
    """The info of the first environment in plain Python values, without empty texts and without its success."""
    return {key: _plain(value[0]) for key, value in score.info.items() if present(value)[0]}


def present(value: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask of the environments that have this info; an empty text means none. Shape: (n,)."""
    if value.dtype.kind in "US":
        return np.asarray(value != "")
    if value.dtype.kind == "O":
        return np.array([not (isinstance(one, str) and one == "") for one in value], dtype=bool)
    return np.ones(len(value), dtype=bool)


def _plain(value: Any) -> Any:
    """Text as str, one number as float, several as a new array, objects unchanged."""
    if isinstance(value, str):
        return str(value)
    if isinstance(value, np.ndarray):
        return value.tolist() if value.dtype.kind in "US" else value.copy()
    return float(value) if isinstance(value, np.generic) else value
