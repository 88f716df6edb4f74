"""What a learner has seen: transitions of whole episodes, with the last actions before each, and which to imitate."""

from dataclasses import fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bam_train.agent.transitions import LiveTransitions
from bam_train.trainers.live.rlpd import Batch

Floats = NDArray[np.float32]
_COLUMNS = ("seen", "action", "reward", "after", "discount")


class Experience:
    """A ring buffer of transitions; demonstrations are those of a person, and of episodes that succeeded.

    An episode is added when it ends, or when another one begins; without its first step it is left out, because the
    actions before it are unknown.

    Args:
        size: Most transitions that are kept.
        observation: Numbers of an observation.
        low: Least values of an action. Shape: (a,).
        high: Greatest values of an action. Shape: (a,).
        history: Last actions that are part of what a policy sees.
        gamma: Discount of a step.
        ahead: Steps whose rewards are added before the value of what follows, fewer at the end of an episode.
    """

    def __init__(
        self, size: int, observation: int, low: Floats, high: Floats, *, history: int, gamma: float, ahead: int
    ) -> None:
        self._size, self._low, self._high, self._history = size, low, high, history
        self._gamma, self._ahead = gamma, ahead
        inputs, actions = observation + history * len(low), len(low)
        widths = dict(zip(_COLUMNS, (inputs, actions, 1, inputs, 1), strict=True))
        self._columns = {name: np.zeros((size, width), np.float32) for name, width in widths.items()}
        self._person, self._success = np.zeros(size, np.bool_), np.zeros(size, np.bool_)
        self.added = 0
        """Transitions added so far."""
        self.interventions = 0
        """How many of them were a person's."""
        self.outcomes: list[tuple[bool, bool, str]] = []
        """Of each episode: whether it succeeded, whether a person drove, and the policy's digest at its end."""
        self._open: dict[bool, list[LiveTransitions]] = {}

    def add(self, transitions: LiveTransitions) -> int:
        """Add what came; returns the number of transitions that can be learnt from now on."""
        before = self.added
        same = (np.diff(transitions.episode) == 0) & (np.diff(transitions.intervention) == 0)
        starts = np.flatnonzero(~same | (transitions.step[1:] == 0)) + 1  # an agent that reconnects counts from 0 again
        for rows in np.split(np.arange(len(transitions)), starts):
            if len(rows):
                self._extend(_some(transitions, rows))
        return self.added - before

    def _extend(self, piece: LiveTransitions) -> None:
        """Add a piece of one episode."""
        person = bool(piece.intervention[0])
        running = self._open.get(person)
        if running and (running[0].episode[0] != piece.episode[0] or piece.step[0] == 0):
            self._close(person)
        self._open.setdefault(person, []).append(piece)
        if piece.ends[-1]:
            self._close(person)

    def _close(self, person: bool) -> None:
        whole = _joined(self._open.pop(person))
        if not np.array_equal(whole.step, np.arange(len(whole))):
            return
        success, count, actions = bool(whole.success[-1]), len(whole), self.normalised(whole.action)
        seen = np.concatenate([whole.observation.reshape(count, -1), self._before(actions)[:-1]], 1)
        after = np.concatenate([whole.next_observation.reshape(count, -1), self._before(actions)[1:]], 1)
        reward, last = self._returns(whole.reward)
        discount = self._gamma ** (last - np.arange(count) + 1.0) * ~whole.terminated[last]
        rows = (np.arange(count) + self.added) % self._size
        values = (seen, actions, reward[:, None], after[last], discount[:, None])
        for name, value in zip(_COLUMNS, values, strict=True):
            self._columns[name][rows] = value
        self._person[rows], self._success[rows] = person, success and not person
        self.added, self.interventions = self.added + count, self.interventions + count * person
        self.outcomes.append((success, person, whole.policy[-1]))

    def _returns(self, reward: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Discounted sum of the rewards of `ahead` steps from each one on, and the last of these steps. (n,) each."""
        count, total = len(reward), np.zeros(len(reward), np.float32)
        for k in range(min(self._ahead, count)):
            total[: count - k] += self._gamma**k * reward[k:]
        return total, np.minimum(np.arange(count) + self._ahead - 1, count - 1)

    def normalised(self, action: Floats) -> Floats:
        """Actions of the space as numbers from -1 to 1. Shape: (n, ...) -> (n, a)."""
        flat = action.reshape(len(action), -1)
        scaled: Floats = np.clip(2 * (flat - self._low) / (self._high - self._low) - 1, -1, 1).astype(np.float32)
        return scaled

    def _before(self, actions: Floats) -> Floats:
        """The last actions before each step and after the last one, newest first. Shape: (n + 1, k)."""
        n, size = actions.shape
        padded = np.concatenate([np.zeros((self._history, size), np.float32), actions])
        newest = np.arange(n + 1)[:, None] + self._history - 1 - np.arange(self._history)
        return padded[newest].reshape(n + 1, -1)

    def __len__(self) -> int:
        return min(self.added, self._size)

    def sample(self, count: int, share: float, rng: np.random.Generator) -> Batch:
        """Draw a batch; `share` of it are demonstrations, half of a person and half of successes, if there are both."""
        valid = len(self)
        kinds = [np.flatnonzero(kind[:valid]) for kind in (self._success, self._person)]
        kinds = [rows for rows in kinds if len(rows)]
        wanted = round(share * count) if kinds else 0
        parts = [rng.integers(valid, size=count - wanted)]
        for k, rows in enumerate(kinds):
            parts.append(rows[rng.integers(len(rows), size=wanted // len(kinds) + (k < wanted % len(kinds)))])
        chosen = np.concatenate(parts)
        seen, action, reward, after, discount = (torch.from_numpy(self._columns[name][chosen]) for name in _COLUMNS)
        return Batch(seen, action, reward[:, 0], after, discount[:, 0], wanted)

    def state_dict(self) -> dict[str, Any]:
        """The complete episodes, as arrays."""
        valid = len(self)
        arrays = {name: column[:valid] for name, column in self._columns.items()}
        counts: dict[str, Any] = {"added": self.added, "interventions": self.interventions}
        kinds = {"person": self._person[:valid], "success": self._success[:valid]}
        return {**arrays, **kinds, **counts, "outcomes": [list(outcome) for outcome in self.outcomes]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict` of a buffer of the same size."""
        self.added, self.interventions = int(state["added"]), int(state["interventions"])
        valid = len(self)
        for name, column in self._columns.items():
            column[:valid] = state[name]
        self._person[:valid], self._success[:valid] = state["person"], state["success"]
        self.outcomes = [(bool(success), bool(person), str(policy)) for success, person, policy in state["outcomes"]]


def _some(transitions: LiveTransitions, rows: NDArray[np.int64]) -> LiveTransitions:
    columns: dict[str, Any] = {field.name: getattr(transitions, field.name) for field in fields(LiveTransitions)}
    policy: list[str] = columns.pop("policy")
    return LiveTransitions(
        **{name: column[rows] for name, column in columns.items()}, policy=[policy[row] for row in rows.tolist()]
    )


def _joined(pieces: list[LiveTransitions]) -> LiveTransitions:
    columns: dict[str, Any] = {
        field.name: np.concatenate([getattr(piece, field.name) for piece in pieces])
        for field in fields(LiveTransitions)
        if field.name != "policy"
    }
    return LiveTransitions(**columns, policy=[one for piece in pieces for one in piece.policy])
