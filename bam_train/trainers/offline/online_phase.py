"""Offline to online: the learner goes on with its own experience, half of every batch, beside the data set."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from bam_train.environments import make_vector_env
from bam_train.errors import SettingsError
from bam_train.rollout import PlayedEpisode, PlayedStep, play
from bam_train.settings import TrainSettings
from bam_train.trainers.offline.implicit_q import ImplicitQLearner
from bam_train.trainers.offline.training_data import ActionCode, Normaliser, TrainingBatch

_LARGEST = 200_000  # own transitions that are kept
_RECENT = 100  # episodes of the statistics
_DONE = 0.5  # the learning rate stays at half of the first one


class OnlinePhase:
    """The environments of a run that went online, what was seen in them, and the policy that explores there."""

    def __init__(self, settings: TrainSettings, normaliser: Normaliser, code: ActionCode, reward_scale: float) -> None:
        self.envs: Any = make_vector_env(settings.env, settings.env_kwargs, settings.num_envs, settings.place)
        self._normaliser, self._code, self._reward_scale = normaliser, code, reward_scale
        self._rng = np.random.default_rng(settings.seed)
        self._playing: Iterator[PlayedStep] | None = None
        self._learner: Any = None
        self._acted: Any = None  # observations and codes of the last step
        self._own: TrainingBatch | None = None  # a ring buffer
        self._added, self._due = 0, 0.0
        self.ended: deque[PlayedEpisode] = deque(maxlen=_RECENT)
        """The last episodes."""

    def step(self, learner: ImplicitQLearner) -> int:
        """Step all environments once, then do the updates that are due; returns the number of steps."""
        if learner.iql is None:
            raise SettingsError("online: behaviour cloning has no critics to go on with; train with --algo iql first")
        self._learner = learner
        self._playing = self._playing or play(self.envs, self, seed=int(self._rng.integers(2**31)))
        step = next(self._playing)
        seen, codes = self._acted
        reward = torch.as_tensor(step.rewards / self._reward_scale, dtype=torch.float32)
        terminated = torch.as_tensor(step.terminated).float()
        self._keep(TrainingBatch(seen, codes, reward, self._normaliser(step.following), terminated))
        self.ended += step.ended
        self._due += len(reward) * learner.iql.update_ratio
        size = learner.settings.batch_size
        while self._due >= 1:
            self._due -= 1
            recorded = learner.data.rows(torch.randint(len(learner.data), (size - size // 2,)))
            learner.update_online(self._drawn(size // 2).joined(recorded), _DONE)
        return len(reward)

    def reset(self, env_ids: Any = None) -> None:
        """Nothing: it has no memory."""

    def act_batch(self, observations: Any) -> Any:
        """Actions of the learner, with noise."""
        seen = self._normaliser(observations)
        self._acted = seen, self._explore(self._learner, seen, self._learner.iql.exploration)
        return self._code.decode(self._acted[1], self.envs.single_action_space)

    def _explore(self, learner: ImplicitQLearner, seen: torch.Tensor, exploration: float) -> torch.Tensor:
        """Codes of the policy's actions with noise. Shape: (n, k)."""
        with torch.no_grad():
            scores = learner.actor(seen)
        if self._code.is_discrete:
            choice = scores.argmax(1)
            tried = torch.rand(len(choice)) < exploration
            choice = torch.where(tried, torch.randint(self._code.size, choice.shape), choice)
            return torch.nn.functional.one_hot(choice, self._code.size).float()
        return (torch.tanh(scores) + exploration * torch.randn_like(scores)).clamp(-1, 1)

    def _keep(self, batch: TrainingBatch) -> None:
        """Write transitions into the ring buffer."""
        if self._own is None:
            self._own = TrainingBatch(*(torch.zeros(_LARGEST, *column.shape[1:]) for column in batch.columns()))
        rows = (torch.arange(len(batch)) + self._added) % _LARGEST
        for column, new in zip(self._own.columns(), batch.columns(), strict=True):
            column[rows] = new
        self._added += len(batch)

    def _drawn(self, count: int) -> TrainingBatch:
        """Random transitions of the own ones, of which there are some."""
        own: Any = self._own
        return own.rows(torch.randint(min(self._added, _LARGEST), (count,)))  # type: ignore[no-any-return]

    def state_dict(self) -> dict[str, Any]:
        """The own transitions and the random numbers; running episodes begin anew."""
        kept = min(self._added, _LARGEST)
        own = None if self._own is None else [column[:kept] for column in self._own.columns()]
        return {"own": own, "added": self._added, "due": self._due, "rng": dict(self._rng.bit_generator.state)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        if state["own"] is not None:
            self._keep(TrainingBatch(*state["own"]))
        self._added, self._due = int(state["added"]), float(state["due"])
        self._rng.bit_generator.state = state["rng"]
