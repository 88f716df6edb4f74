"""What a learner has seen: transitions of whole episodes, with the last actions before each, and which to imitate."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_train.agent.transitions import LiveTransitions
from bam_train.trainers.learning.replay_memory import ActionCode, Batch, ReplayMemory

Floats = NDArray[np.float32]
_COLUMNS = ("seen", "action", "reward", "after", "discount", "person", "success")


class Experience:
    """The newest transitions; demonstrations are those of a person, and of episodes that succeeded.

    An episode is added when it ends, or when another one begins; without its first step it is left out, because the
    actions before it are unknown.

    Args:
        size: Most transitions that are kept.
        code: Of the actions, a Box.
        history: Last actions that are part of what a policy sees.
        gamma: Discount of a step.
        ahead: Steps whose rewards are added before the value of what follows, fewer at the end of an episode.
    """

    def __init__(self, size: int, code: ActionCode, *, history: int, gamma: float, ahead: int) -> None:
        self._memory, self._code, self._history = ReplayMemory(size), code, history
        self._gamma, self._ahead = gamma, ahead
        self.interventions = 0
        """How many of the transitions were a person's."""
        self.outcomes: list[tuple[bool, bool, str]] = []
        """Of each episode: whether it succeeded, whether a person drove, and the policy's digest at its end."""
        self._open: dict[bool, list[SimpleNamespace]] = {}

    @property
    def added(self) -> int:
        """Transitions added so far."""
        return self._memory.added

    def add(self, transitions: LiveTransitions) -> int:
        """Add what came; returns the number of transitions that can be learnt from now on."""
        before = self.added
        same = (np.diff(transitions.episode) == 0) & (np.diff(transitions.intervention) == 0)
        starts = np.flatnonzero(~same | (transitions.step[1:] == 0)) + 1  # an agent that reconnects counts from 0 again
        columns = {field.name: np.asarray(getattr(transitions, field.name)) for field in fields(transitions)}
        for start, end in pairwise([0, *starts.tolist(), len(transitions)]):
            if end > start:
                self._extend(SimpleNamespace(**{name: column[start:end] for name, column in columns.items()}))
        return self.added - before

    def _extend(self, piece: SimpleNamespace) -> None:
        """Add a piece of one episode, with the fields of `LiveTransitions`."""
        person = bool(piece.intervention[0])
        running = self._open.get(person)
        if running and (running[0].episode[0] != piece.episode[0] or piece.step[0] == 0):
            self._close(person)
        self._open.setdefault(person, []).append(piece)
        if piece.terminated[-1] or piece.truncated[-1]:
            self._close(person)

    def _close(self, person: bool) -> None:
        columns = zip(*(vars(piece).values() for piece in self._open[person]), strict=True)
        whole = SimpleNamespace(**dict(zip(vars(self._open.pop(person)[0]), map(np.concatenate, columns), strict=True)))
        count, success = len(whole.step), bool(whole.success[-1])
        if not np.array_equal(whole.step, np.arange(count)):
            return
        actions = self._code.encode(whole.action).numpy()
        before = self._before(actions)
        reward, last = self._returns(whole.reward)
        discount = self._gamma ** (last - np.arange(count) + 1.0) * ~whole.terminated[last]
        self._memory.add(
            seen=np.concatenate([whole.observation.reshape(count, -1), before[:-1]], 1),
            action=actions,
            reward=reward[:, None],
            after=np.concatenate([whole.next_observation.reshape(count, -1), before[1:]], 1)[last],
            discount=discount[:, None].astype(np.float32),
            person=np.full(count, person),
            success=np.full(count, success and not person),
        )
        self.interventions += count * person
        self.outcomes.append((success, person, str(whole.policy[-1])))

    def _returns(self, reward: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Discounted sum of the rewards of `ahead` steps from each one on, and the last of these steps. (n,) each."""
        count, total = len(reward), np.zeros(len(reward), np.float32)
        for k in range(min(self._ahead, count)):
            total[: count - k] += self._gamma**k * reward[k:]
        return total, np.minimum(np.arange(count) + self._ahead - 1, count - 1)

    def _before(self, actions: Floats) -> Floats:
        """The last actions before each step and after the last one, newest first. Shape: (n + 1, k)."""
        n, size = actions.shape
        padded = np.concatenate([np.zeros((self._history, size), np.float32), actions])
        newest = np.arange(n + 1)[:, None] + self._history - 1 - np.arange(self._history)
        return padded[newest].reshape(n + 1, -1)

    def __len__(self) -> int:
        return len(self._memory)

    def sample(self, count: int, share: float, rng: np.random.Generator) -> Batch:
        """Draw a batch; `share` of it are demonstrations, half of a person and half of successes, if there are both.

        Columns: seen and after (n, inputs), action (n, a), reward and discount (n,), all float32; and the number of
        `demonstrations`, which come last.
        """
        columns = self._memory.columns()
        kinds = [rows for kind in ("success", "person") if len(rows := np.flatnonzero(columns[kind]))]
        wanted = round(share * count) if kinds else 0
        parts = [rng.integers(len(self), size=count - wanted)]
        for k, rows in enumerate(kinds):
            parts.append(rows[rng.integers(len(rows), size=wanted // len(kinds) + (k < wanted % len(kinds)))])
        batch = self._memory.rows(np.concatenate(parts))
        batch.reward, batch.discount, batch.demonstrations = batch.reward[:, 0], batch.discount[:, 0], wanted
        return batch

    def state_dict(self) -> dict[str, Any]:
        """The complete episodes, as arrays."""
        arrays = {name: column.numpy() for name, column in self._memory.columns().items()}
        counts: dict[str, Any] = {"added": self.added, "interventions": self.interventions}
        return {**arrays, **counts, "outcomes": [list(outcome) for outcome in self.outcomes]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict` of a buffer of the same size."""
        self._memory.load({name: state[name] for name in _COLUMNS if name in state}, int(state["added"]))
        self.interventions = int(state["interventions"])
        self.outcomes = [(bool(success), bool(person), str(policy)) for success, person, policy in state["outcomes"]]
