"""What remains of the chunks of actions that a policy gave for one environment, aligned by the steps executed."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bam_train.checkpoint.manifest import Chunk
from bam_train.errors import LateChunk, PolicyError

Array = NDArray[Any]
ONE_BY_ONE = "it gives one action at a time, and has no chunks to plan"
FADE = 8
"""Least number of steps in which one chunk takes over from another, 0.4 s at 20 Hz."""
LEFT, KNOWN = "chunk.left", "chunk.known"
"""Inputs of a policy with an `overlap`: what is left of the chunk before for the next steps, filled up with zeros,
(size, ...); and for how many steps, and how many of these pass until a new one comes, (2,)."""
TOO_SLOW = "The policy is too slow for this computer: end other programs, or compute its chunks on a policy server"
"""What to say of a late chunk that is computed here."""
STEEPEST = 1.5
"""Greatest slope of 3 w^2 - 2 w^3, by which a change-over fades."""


class _Answer(NamedTuple):
    begun: int
    """Steps executed before its observation."""
    tick: int
    """Ticks before its observation: steps that were executed or not."""
    actions: Array
    """Shape: (size, ...)."""
    fade: Array
    """What is added to the first of the actions that are taken, so that the change-over is smooth."""
    first: int
    """The step of the first of these."""


class Plan:
    """The actions of the next steps of one environment.

    Args:
        chunk: How the policy answers.
        shape: Of an action.
        fade: Greatest change of each number of an action in a step that a change-over may add, of this shape; None:
            change-overs do not fade.
        slow: What is too slow where a chunk is late.
    """

    def __init__(
        self,
        chunk: Chunk | None,
        shape: tuple[int, ...],
        fade: Array | None = None,
        slow: str = TOO_SLOW,
    ) -> None:
        if chunk is None:
            raise PolicyError(f"the policy: {ONE_BY_ONE}")
        self.chunk, self._shape, self._fade, self._slow = chunk, shape, fade, slow
        self.step = 0
        """Steps executed so far."""
        self.tick = 0
        """Steps so far, those among them in which a guard held the robot."""
        self.delay = 0
        """Steps that the next chunk may take to come."""
        self._answers: list[_Answer] = []
        self._seen: deque[Mapping[str, Array]] = deque(maxlen=chunk.history)

    def see(self, observation: Mapping[str, Array]) -> None:
        """Take the observation of this step; the first one counts for those before it."""
        self._seen.append(observation)
        while len(self._seen) < self.chunk.history:
            self._seen.append(observation)

    def seen(self) -> dict[str, Array]:
        """The graph's inputs for this step, without a batch axis."""
        last = self._seen[-1]
        seen = dict(last) if self.chunk.history == 1 else {k: np.stack([o[k] for o in self._seen]) for k in last}
        return seen if self.chunk.overlap is None else {**seen, **self._left()}

    def _left(self) -> dict[str, Array]:
        """The inputs of an `overlap`."""
        left, old = np.zeros((self.chunk.size, *self._shape), np.float32), self._answers[-1:]
        values = [self._value(one, k) for one in old for k in range(self.step, one.begun + self.chunk.size)]
        left[: len(values)] = np.reshape(values, (-1, *self._shape))
        return {LEFT: left, KNOWN: np.array([len(values), min(self.delay, len(values))], np.int64)}

    def is_due(self, lead: int = 0) -> bool:
        """Whether the next chunk should be asked for, which may take `lead` steps to come."""
        steps = 1 if self.chunk.ensemble is not None else self.chunk.steps
        return not self._answers or self.tick - self._answers[-1].tick >= max(1, steps - lead)

    def add(self, begun: int, actions: Array, tick: int | None = None) -> None:
        """Take the chunk for the observation after `begun` executed steps, and `tick` steps in all.

        Raises:
            PolicyError: It has another shape, came twice, or has a number that is not finite.
        """
        shape = (self.chunk.size, *self._shape)
        if actions.shape != shape:
            raise PolicyError(f"the chunk of step {begun}: expected shape {shape}, found {actions.shape}")
        tick = begun if tick is None else tick
        if self._answers and tick <= self._answers[-1].tick:
            raise PolicyError(f"the chunk of step {begun} came twice, or after that of step {self._answers[-1].begun}")
        finite = np.isfinite(actions).reshape(len(actions), -1).all(axis=1)
        if not finite.all():
            number = int(np.argmin(finite))
            found = actions[number].tolist()
            raise PolicyError(
                f"the chunk of step {begun}: action {number + 1} of {len(actions)} is not finite: {found}"
            )
        self._answers = [one for one in self._answers if self.tick - one.tick < self.chunk.size]
        new = _Answer(begun, tick, actions, np.zeros((0, *self._shape)), self.step)
        if self._fade is not None and self.chunk.ensemble is None and self.has_action and self._covers(new):
            new = new._replace(fade=self._faded(self._fade, self._answers[-1], new))
        self._answers = [*self._answers, new] if self.chunk.ensemble is not None else [new]

    def repeat(self) -> None:
        """The action before was not executed, as a guard held the robot: it is that of this step again."""
        self.step = max(0, self.step - 1)

    @property
    def has_action(self) -> bool:
        """Whether a chunk has an action for this step."""
        return any(map(self._covers, self._answers))

    def take(self) -> Array:
        """The action of this step.

        Raises:
            LateChunk: No chunk has one.
        """
        found = [one for one in self._answers if self._covers(one)]
        if not found:
            last = f"the last one was for step {self._answers[-1].begun}" if self._answers else "none came"
            raise LateChunk(
                f"no chunk has an action for step {self.step}: {last}, of {self.chunk.size} actions. {self._slow}"
            )
        values = np.stack([self._value(one, self.step) for one in found])
        self.step, self.tick = self.step + 1, self.tick + 1
        if len(found) == 1:
            action: Array = values[0]
            return action
        weights = np.exp(-float(self.chunk.ensemble or 0.0) * np.arange(len(found)))
        mean: Array = np.tensordot(weights / weights.sum(), values, 1).astype(values.dtype)
        return mean

    def _covers(self, one: _Answer) -> bool:
        """Whether a chunk has an action for this step that is not too old."""
        return self.step - one.begun < self.chunk.size and self.tick - one.tick < self.chunk.size

    @staticmethod
    def _value(one: _Answer, step: int) -> Array:
        value: Array = one.actions[step - one.begun]
        return value + one.fade[step - one.first].astype(value.dtype) if step - one.first < len(one.fade) else value

    def _faded(self, fade: Array, old: _Answer, new: _Answer) -> Array:
        """What is added to `new` from this step on: less and less of the way from it to `old`. Shape: (steps, ...)."""
        both = range(self.step, old.begun + self.chunk.size)  # the steps for which both have actions
        ways = np.array([self._value(old, k).astype(np.float64) - new.actions[k - new.begun] for k in both])
        far = float((np.abs(ways).max(axis=0) / np.maximum(fade, 1e-9)).max())
        count = min(max(FADE, math.ceil(STEEPEST * far)), self.chunk.size)
        ways = ways[np.minimum(np.arange(count), len(ways) - 1)]
        left = 1.0 - np.arange(1, count + 1) / (count + 1)
        left = left * left * (3.0 - 2.0 * left)
        faded: Array = left.reshape(-1, *[1] * len(self._shape)) * ways
        return faded
