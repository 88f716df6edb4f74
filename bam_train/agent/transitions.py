"""Transitions of a live agent, for a learner on another computer: collected in the loop, carried as JSON.

An event has a column for each field of `LiveTransitions`. Arrays are ``{"shape": [...], "data": base64}`` of little
endian float32, flags and counts lists, so that no number is rounded and a thousand transitions need a few milliseconds.
"""

import base64
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.wording import brief
from bam_train.deploy.episode import EpisodeStep
from bam_train.errors import FormatError

EVENT = "transitions"
"""Value of ``event`` in a message with transitions."""
MOST = 10_000
"""Maximum number of transitions in a message, and of those that wait to be sent."""
_LONGEST = 64 * 2**20  # bytes of one array
_ENDS = ("terminated", "truncated")
_FLAGS = (*_ENDS, "success", "intervention")
_COUNTS = ("episode", "step")

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Counts = NDArray[np.int64]


@dataclass(frozen=True)
class LiveTransitions:
    """n transitions in the order in which they happened; step k of an episode leads from time k to time k + 1."""

    observation: Floats
    """Shape: (n, ...)."""
    action: Floats
    """The action that the environment got, of the policy or of a person. Shape: (n, ...)."""
    reward: Floats
    """Shape: (n,)."""
    next_observation: Floats
    """Shape: (n, ...)."""
    terminated: Flags
    """Shape: (n,)."""
    truncated: Flags
    """Shape: (n,)."""
    success: Flags
    """Whether the task was done after the step. Shape: (n,)."""
    intervention: Flags
    """Whether a person drove. Shape: (n,)."""
    episode: Counts
    """Number of the episode since the agent started. Shape: (n,)."""
    step: Counts
    """Number of the step in its episode, from 0. Shape: (n,)."""
    policy: list[str]
    """Digest of the policy that drove; empty for a person. Length: n."""

    def __len__(self) -> int:
        return len(self.reward)

    @property
    def ends(self) -> Flags:
        """Whether an episode ended with the step. Shape: (n,)."""
        return self.terminated | self.truncated


def encode(transitions: LiveTransitions) -> dict[str, Any]:
    """The event with `transitions`, as plain JSON values."""
    event: dict[str, Any] = {"event": EVENT, "count": len(transitions), "policy": list(transitions.policy)}
    for field in fields(LiveTransitions):
        column = getattr(transitions, field.name)
        if field.name in (*_FLAGS, *_COUNTS):
            event[field.name] = column.tolist()
        elif field.name != "policy":
            data = base64.b64encode(np.ascontiguousarray(column, "<f4").tobytes()).decode("ascii")
            event[field.name] = {"shape": list(column.shape), "data": data}
    return event


def decode(event: Mapping[str, Any]) -> LiveTransitions:
    """The transitions of an event.

    Raises:
        FormatError: A column is missing, of another length or kind, or has a number that is not finite.
    """
    count: Any = event.get("count")
    if not _is_count(count) or count > MOST:
        raise FormatError(f"transitions: count: expected a whole number up to {MOST}, found {brief(count)}")
    columns: dict[str, Any] = {name: _listed(event, name, count, bool, np.bool_) for name in _FLAGS}
    columns |= {name: _listed(event, name, count, int, np.int64) for name in _COUNTS}
    columns |= {name: _array(event, name, count) for name in ("observation", "action", "reward", "next_observation")}
    shapes = columns["observation"].shape, columns["next_observation"].shape
    if shapes[0] != shapes[1]:
        raise FormatError(f"transitions: next_observation: expected shape {shapes[0]}, found {shapes[1]}")
    if columns["reward"].ndim != 1:
        raise FormatError(f"transitions: reward: expected shape ({count},), found {columns['reward'].shape}")
    return LiveTransitions(**columns, policy=_listed(event, "policy", count, str))


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _listed(event: Mapping[str, Any], name: str, count: int, kind: type, dtype: Any = None) -> Any:
    """A column that is a list of `kind`."""
    values = event.get(name)
    fits = _is_count if kind is int else lambda value: isinstance(value, kind)
    if not isinstance(values, list) or len(values) != count or not all(map(fits, values)):
        raise FormatError(
            f"transitions: {name}: expected {count} values of type {kind.__name__}, found {brief(values)}"
        )
    return values if dtype is None else np.array(values, dtype)


def _array(event: Mapping[str, Any], name: str, count: int) -> Floats:
    """A column that is an array, (count, ...)."""
    column = event.get(name)
    shape, data = (column.get("shape"), column.get("data")) if isinstance(column, dict) else (None, None)
    if not isinstance(shape, list) or not all(map(_is_count, shape)) or shape[:1] != [count]:
        raise FormatError(f"transitions: {name}: expected an array of {count} rows, found {brief(column)}")
    size = 4 * math.prod(shape)
    try:
        raw = base64.b64decode(data if isinstance(data, str) and len(data) <= 2 * _LONGEST else "!", validate=True)
    except ValueError as error:
        raise FormatError(f"transitions: {name}: expected base64, found {brief(data)}") from error
    if len(raw) != size:
        raise FormatError(f"transitions: {name}: expected {size} bytes for shape {shape}, found {len(raw)}")
    array = np.frombuffer(raw, "<f4").reshape(shape).astype(np.float32)
    if not np.isfinite(array).all():
        raise FormatError(f"transitions: {name}: expected finite numbers")
    return array


class TransitionLog:
    """The newest transitions until they are sent, at most `most`; used by one thread."""

    def __init__(self, most: int = MOST) -> None:
        self.wanted = True
        """Whether there is anybody who takes them; else nothing is kept."""
        self._rows: deque[tuple[Any, ...]] = deque(maxlen=most)
        self.lost = 0
        """Number of transitions that were dropped because nobody took them in time."""

    def add(self, *row: Any) -> None:
        """Add one transition: the fields of `LiveTransitions` in their order, without the axis n."""
        self.lost += len(self._rows) == self._rows.maxlen
        self._rows.append(row)

    def take(self) -> LiveTransitions | None:
        """Remove and return all; None if there are none."""
        if not self._rows:
            return None
        columns: dict[str, Any] = {}
        for field, column in zip(fields(LiveTransitions), zip(*self._rows, strict=True), strict=True):
            kind = np.bool_ if field.name in _FLAGS else np.int64 if field.name in _COUNTS else np.float32
            columns[field.name] = list(column) if field.name == "policy" else np.array(column, kind)
        self._rows.clear()
        return LiveTransitions(**columns)


class TransitionCollector:
    """Adds each complete step of a deployment to a `TransitionLog`; one of the observers of its loop.

    Args:
        log: Where they go.
        policy: Returns the digest of the policy that acts now.
        cut_short: Returns whether a request ended the last step before its time; such a step is left out.
    """

    def __init__(
        self, log: TransitionLog, policy: Callable[[], str], cut_short: Callable[[], bool] = lambda: False
    ) -> None:
        self._log, self._policy, self._cut_short, self._episode = log, policy, cut_short, -1
        self._before: tuple[Any, Any, str] | None = None

    def __call__(self, step: EpisodeStep) -> None:
        """Add the step that led to `step`."""
        if step.number == 0:
            self._episode += 1
        if not self._log.wanted:
            self._before = None
            return
        [array] = step.arrays.values()
        observation = array[0].copy()
        if step.number > 0 and self._before is not None and not self._cut_short():
            flags = (step.terminated, step.truncated, bool(step.success), False)
            seen, action, policy = self._before
            self._log.add(seen, action, step.reward, observation, *flags, self._episode, step.number - 1, policy)
        self._before = observation, step.action.copy(), self._policy()
