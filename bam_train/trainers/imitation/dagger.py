"""DAgger: the learner acts, a teacher says what it should have done, and all of it is learnt from.

S. Ross, G. Gordon, D. Bagnell: A reduction of imitation learning and structured prediction to no-regret online learning
(AISTATS 2011).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from gymnasium import spaces
from msgspec import Meta
from torch.nn import functional

from bam_envs.core.spaces import leaves
from bam_train.rollout import PlayedEpisode, play
from bam_train.trainers.base import Statistics
from bam_train.trainers.imitation.imitation_network import ImitationNetwork
from bam_train.trainers.imitation.teacher import Teacher
from bam_train.trainers.offline.training_data import ActionCode

_Count = Annotated[int, Meta(ge=1, le=10_000_000)]
_Positive = Annotated[float, Meta(gt=0, le=1e6)]
_Share = Annotated[float, Meta(ge=0, le=1)]
_RECENT = 100  # episodes of the statistics
_KNEE = 0.1  # errors above are punished in proportion, below by their square
_LAST_RATE = 0.02  # of the learning rate, at the end of the run


@dataclass(frozen=True)
class Dagger:
    """Hyperparameters of DAgger."""

    learning_rate: _Positive = 1e-3
    """At the beginning; it falls to a fiftieth over the run."""
    batch_size: _Count = 128
    """Steps that one update learns from."""
    passes: _Positive = 16.0
    """How many times each step is learnt from, on average."""
    teacher_share: _Share = 0.25
    """Share of the run over which the teacher acts in fewer and fewer episodes, from all of them to none."""
    memory: _Count = 50_000
    """Newest steps that are learnt from."""
    guess_weight: Annotated[float, Meta(ge=0, le=1e6)] = 1.0
    """Weight of guessing the state that the teacher sees, where the learner sees images instead."""
    channels: _Count = 16
    """Channels of the first convolution; the others have twice as many."""
    width: _Count = 256
    """Units of each of the two hidden layers."""


class TaughtSteps:
    """The newest steps: observations, codes of the teacher's actions, and the states that it saw."""

    def __init__(self, space: spaces.Space[Any], size: int, codes: int, states: int) -> None:
        self._keys, self._size, self.added = list(leaves(space)), size, 0
        arrays = [np.zeros((size, *leaf.shape), leaf.dtype) for leaf in leaves(space).values()]  # pages come with use
        self._observed = [torch.from_numpy(array) for array in arrays]
        self._codes, self._states = torch.zeros(size, codes), torch.zeros(size, states)

    def __len__(self) -> int:
        return min(self.added, self._size)

    def add(self, observed: list[torch.Tensor], codes: torch.Tensor, states: Any) -> None:
        """Add n steps in place of the oldest."""
        rows = (torch.arange(len(codes)) + self.added) % self._size
        for column, new in zip(self._observed, observed, strict=True):
            column[rows] = new
        self._codes[rows] = codes
        if states is not None:
            self._states[rows] = torch.as_tensor(states)
        self.added += len(codes)

    def drawn(self, count: int) -> tuple[list[torch.Tensor], torch.Tensor, torch.Tensor]:
        """Random steps: observations by key, codes, states."""
        rows = torch.randint(len(self), (count,))
        return [column[rows] for column in self._observed], self._codes[rows], self._states[rows]


class DaggerLearner:
    """The learner, its teacher, and the environments that both act in: the policy that is played there."""

    def __init__(self, values: Dagger, seed: int, envs: Any, teacher: Teacher) -> None:
        self.values, self.envs, self.teacher = values, envs, teacher
        seen, acts = envs.single_observation_space, envs.single_action_space
        self._keys, self._code = list(leaves(seen)), ActionCode(acts)
        sizes = self._code.size, teacher.state_size
        self.network = ImitationNetwork(seen, *sizes, values.channels, values.width)
        self._optimiser = torch.optim.Adam(self.network.parameters(), lr=values.learning_rate)
        self._experience = TaughtSteps(seen, values.memory, *sizes)
        self._rng = np.random.default_rng(seed)
        self._playing = play(envs, self, seed=seed)
        self._taught = self._draw_taught(envs.num_envs, 0.0)  # where the teacher acts in this episode
        self._ended: deque[PlayedEpisode] = deque(maxlen=_RECENT)
        self._due, self._refill = 0.0, 0
        self.metrics: dict[str, float] = {}

    def _tensors(self, observation: Any) -> list[torch.Tensor]:
        each = [observation[key] if key else observation for key in self._keys]
        return [torch.as_tensor(np.ascontiguousarray(one)) for one in each]

    def step(self, done: float) -> int:
        """Step every environment once, when a share `done` of the run is over; returns the number of steps.

        The learner's own episodes count; who acts in an episode is drawn when it begins.
        """
        step = next(self._playing)
        self._ended += [one for one in step.ended if not self._taught[one.env_id]]
        if step.ended:
            self._taught[[one.env_id for one in step.ended]] = self._draw_taught(len(step.ended), done)
        self._due += len(step.rewards) * self.values.passes / self.values.batch_size
        return len(step.rewards)

    def reset(self, env_ids: Any = None) -> None:
        """Let the teacher forget these environments, or all."""
        self.teacher.reset(env_ids)

    def act_batch(self, observations: Any) -> Any:
        """Actions for all environments, once the teacher's are remembered."""
        observed = self._tensors(observations)
        wanted, states = self.teacher(observations)
        codes = self._code.encode(wanted)
        self.network.learn_moments(dict(zip(self._keys, observed, strict=True)))
        if states is not None:
            self.network.seen.learn(torch.as_tensor(states))
        self._experience.add(observed, codes, states)
        return wanted if self._taught.all() else self._mixed(wanted, observed)

    def _mixed(self, wanted: Any, observed: list[torch.Tensor]) -> Any:
        """The learner's actions, and the teacher's in the episodes that it acts in."""
        with torch.no_grad():
            scores = self.network.actor(self.network.features(*observed))
        scores = scores if self._code.is_discrete else scores.clamp(-1, 1)
        own = self._code.decode(scores, self.envs.single_action_space)
        return np.where(self._taught.reshape(-1, *[1] * (own.ndim - 1)), wanted, own).astype(own.dtype)

    def _draw_taught(self, episodes: int, done: float) -> Any:
        """In which of these new episodes the teacher acts: in all at first, in none after its share of the run."""
        share = max(0.0, 1 - done / self.values.teacher_share) if self.values.teacher_share else 0.0
        return self._rng.random(episodes) < share

    def learn(self, done: float) -> None:
        """Do the updates that are due."""
        if len(self._experience) < max(2 * self.values.batch_size, self._refill):
            self._due = 0.0
        for group in self._optimiser.param_groups:
            group["lr"] = self.values.learning_rate * max(_LAST_RATE, 1 - done)
        while self._due >= 1:
            self._due -= 1
            self._update()

    def _update(self) -> None:
        observed, codes, states = self._experience.drawn(self.values.batch_size)
        features = self.network.features(*observed)
        scores = self.network.actor(features)
        if self._code.is_discrete:
            loss = functional.cross_entropy(scores, codes.argmax(1))
        else:
            loss = functional.smooth_l1_loss(scores, codes, beta=_KNEE)
        self.metrics = {"train/loss": loss.item()}
        if states.shape[1] and self.values.guess_weight:
            guess = functional.smooth_l1_loss(self.network.guess(features), self.network.seen(states), beta=_KNEE)
            self.metrics["train/guess_loss"] = guess.item()
            loss = loss + self.values.guess_weight * guess
        self._optimiser.zero_grad()
        loss.backward()
        self._optimiser.step()

    def statistics(self) -> Statistics:
        """Means over the learner's last episodes."""
        return Statistics.of(self._ended, self.metrics)

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimiser and random numbers; the experience is collected anew."""
        return {
            "network": self.network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "rng": dict(self._rng.bit_generator.state),
            "steps": len(self._experience),
        }

    def load_state_dict(self, state: dict[str, Any], done: float) -> None:
        """Restore the result of `state_dict`; new episodes begin, and some of them end before the first update."""
        self.network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._rng.bit_generator.state = state["rng"]
        self._playing = play(self.envs, self, seed=int(self._rng.integers(2**31)))
        self._refill = min(int(state["steps"]), 100 * self.envs.num_envs)
        self._taught = self._draw_taught(self.envs.num_envs, done)
