"""The Task protocol: what is asked of a robot. Pure: no I/O, no clock; its memory is rows of arrays it owns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.core.robot import Initial, RobotState, Rows

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Label:
    """What one number of an observation or action means."""

    name: str
    meaning: str
    unit: str
    """Of the quantity before scaling."""
    scale: str = "1"
    """How the quantity becomes the number."""
    low: float = -1.0
    high: float = 1.0


@dataclass
class Score:
    """How one step went, for n rows."""

    reward: Array
    """Shape: (n,)."""
    terminated: Flags
    """The task ended, well or badly. Shape: (n,)."""
    success: Flags
    """The task is done. Shape: (n,)."""
    info: dict[str, NDArray[Any]] = field(default_factory=dict)
    """Named distances and the like, numbers, text ("" for nothing to say) or objects. Shape: (n, ...) each."""


@runtime_checkable
class Task(Protocol):
    """Observation, command, reward and end for `num_rows` rows; the same code for one live robot and many simulated.

    A task may have two more attributes. ``reset_options`` names the options that an environment's `reset` takes; such a
    task's `sample_initial` has a third argument, ``options``, a mapping of those that were given. ``ends_by_itself`` is
    True for one that counts its own steps and terminates at its time limit; no time limit is put around it.
    """

    num_rows: int
    observation_space: spaces.Box
    """Of one row."""
    action_space: spaces.Box
    """Of one row."""
    observation_labels: tuple[Label, ...]
    action_labels: tuple[Label, ...]

    def sample_initial(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Initial:
        """Sample targets and start states for `rows`, each from its own generator."""

    def on_reset(self, rows: Rows, state: RobotState) -> None:
        """The robots of `rows` are at their start; note what was measured. `state` has all n rows."""

    def observe(self, state: RobotState) -> Floats:
        """What the policy sees. Shape: (n, ...)."""

    def command(self, action: Floats, state: RobotState) -> Array:
        """What the robot is sent, SI units. Shapes: (n, a) -> (n, m)."""

    def score(self, state: RobotState, action: Floats) -> Score:
        """How the step that led to `state` went."""

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """Spheres that a picture of row 0 shows: position (3,) [m] and colour."""

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned."""


def labelled_box(labels: Sequence[Label]) -> spaces.Box:
    """The float32 space whose numbers are `labels`."""
    low, high = ([getattr(label, side) for label in labels] for side in ("low", "high"))
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


def require_inside(observation: Floats, space: spaces.Box, labels: Sequence[Label]) -> Floats:
    """`observation` (n, k), if every row is in `space`; robo-gym has no observation outside, with ``parity=True``.

    Raises:
        ProtocolError: Names the first number that is not; robo-gym raises ``InvalidStateError``.
    """
    outside = ~((observation >= space.low) & (observation <= space.high))  # also what is not a number
    if outside.any():
        row, column = np.argwhere(outside)[0]
        label, value = labels[column], observation[row, column]
        raise ProtocolError(
            f"{label.name} is {value:.6g} {label.unit}, expected {label.low:.6g} to {label.high:.6g}, as in robo-gym: "
            "with parity=True there is no observation outside its space; leave parity out, or look at the sensor."
        )
    return observation
