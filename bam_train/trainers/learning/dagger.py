"""DAgger: the learner acts, a teacher says what it should have done, and all of it is learnt from.

S. Ross, G. Gordon, D. Bagnell: A reduction of imitation learning and structured prediction to no-regret online learning
(AISTATS 2011).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from bam_train.env_faults import FiniteVectorEnv
from bam_train.environments import make_vector_env
from bam_train.errors import SettingsError
from bam_train.settings import ImitationSettings
from bam_train.trainers.learning.networks import Descent, Encoders, LearntPolicy, Numbers, two_layers
from bam_train.trainers.learning.replay_memory import ActionCode, ReplayMemory
from bam_train.trainers.learning.teacher import Teacher
from bam_train.trainers.learning.torch_trainer import TorchTrainer, state_of

_KNEE = 0.1  # errors above are punished in proportion, below by their square
_LAST_RATE = 0.02  # of the learning rate, at the end of the run
_LEAST = 1e-2  # standard deviation of numbers that hardly change
_NO_MEMORY = (
    "the steps that were learnt from are not saved: new ones are collected, so the rest differs from an unbroken run"
)


class DaggerTrainer(TorchTrainer[ImitationSettings]):
    """Made by `create` or `load`; the policy that is played acts as the learner or, in some episodes, the teacher."""

    def __init__(self, settings: ImitationSettings) -> None:
        super().__init__(settings)
        envs = make_vector_env(settings.env, settings.env_kwargs, settings.num_envs, settings.place)
        self.envs = FiniteVectorEnv(envs, settings.env)
        self.spaces = envs.single_observation_space, envs.single_action_space
        try:
            self.teacher, self.code = Teacher(settings, envs), ActionCode(self.spaces[1])
            encoders = Encoders(self.spaces[0], _LEAST, self.options.channels)
        except BaseException:
            envs.close()
            raise
        width, states = self.options.width, self.teacher.state_size
        self.network = nn.ModuleDict(
            {
                "encoders": encoders,
                "body": two_layers(encoders.outputs, width),
                "actor": nn.Linear(width, self.code.size),
                "guess": nn.Linear(width, max(1, states)),
                "seen": Numbers((states,), _LEAST),  # moments of what the teacher sees
            }
        )
        self.optimiser = Descent("network", self.network.parameters(), self.options.learning_rate)
        self.parts = {"learner": {"network": self.network, "optimiser": self.optimiser, "rng": self._rng}}
        self.memory, self._refill = ReplayMemory(self.options.memory), 0
        self._names = [f"seen {key}" for key in encoders.keys]  # columns of the memory
        self.play(seed=settings.seed)
        self._taught = self._draw_taught(envs.num_envs, 0.0)  # where the teacher acts in this episode

    @classmethod
    def complete(cls, settings: ImitationSettings) -> ImitationSettings:
        """Check the settings, and add the defaults of the algorithm."""
        if settings.teacher is None:
            raise SettingsError(
                "teacher: dagger imitates a teacher, found none. Give --teacher CHECKPOINT or --teacher scripted"
            )
        if settings.transport:
            raise SettingsError("transport: dagger needs the environment here, with its teacher; leave it out")
        settings, values = super().complete(settings), cls.read_options(settings)
        least = 2 * values.batch_size
        for name, steps in (("steps", settings.steps), ("memory", values.memory)):
            if steps < least:
                raise SettingsError(f"{name}: dagger learns from {least} steps on, twice batch_size, found {steps}")
        return dataclasses.replace(settings, eval_every=settings.eval_every or max(1000, settings.steps // 5))

    def advance(self, total: int) -> None:
        """Step every environment once, then do the updates that are due.

        The learner's own episodes count; who acts in an episode is drawn when it begins.
        """
        step, values = next(self.playing), self.options
        self.ended += [one for one in step.ended if not self._taught[one.env_id]]
        if step.ended:
            self._taught[[one.env_id for one in step.ended]] = self._draw_taught(len(step.ended), self.done(total))
        self._steps += len(step.rewards)
        due = self.take_due(len(step.rewards) * values.passes / values.batch_size)
        if len(self.memory) < max(2 * values.batch_size, self._refill):
            self._due = 0.0
            return
        for _ in due:
            self._update(max(_LAST_RATE, 1 - self.done(total)))

    def _update(self, rate: float) -> None:
        batch = self.memory.draw(self.options.batch_size)
        features = self._features(vars(batch)[name] for name in self._names)
        scores = self.network["actor"](features)
        if self.code.is_discrete:
            loss = functional.cross_entropy(scores, batch.code.argmax(1))
        else:
            loss = functional.smooth_l1_loss(scores, batch.code, beta=_KNEE)
        self.metrics = {"train/loss": loss.item()}
        if self.teacher.state_size and self.options.guess_weight:
            wanted = self.network["seen"](batch.state)
            guess = functional.smooth_l1_loss(self.network["guess"](features), wanted, beta=_KNEE)
            self.metrics["train/guess_loss"] = guess.item()
            loss = loss + self.options.guess_weight * guess
        self.optimiser.descend(loss, rate)

    def act_batch(self, observations: Any) -> Any:
        """Actions for all environments, once the teacher's are remembered."""
        observed = self.network["encoders"].tensors(observations)
        wanted, states = self.teacher(observations)
        self.network["encoders"].learn(observed)
        columns = {"code": self.code.encode(wanted)}
        if states is not None:
            columns["state"] = torch.as_tensor(states)
            self.network["seen"].learn(columns["state"])
        self.memory.add(**columns, **dict(zip(self._names, observed, strict=True)))
        if self._taught.all():
            return wanted
        with torch.no_grad():
            scores = self.network["actor"](self._features(observed))
        own = self.code.decode(scores if self.code.is_discrete else scores.clamp(-1, 1))
        return np.where(self._taught.reshape(-1, *[1] * (own.ndim - 1)), wanted, own).astype(own.dtype)

    def reset(self, env_ids: Any = None) -> None:
        """Let the teacher forget these environments, or all."""
        self.teacher.reset(env_ids)

    def _features(self, observed: Iterable[torch.Tensor]) -> torch.Tensor:
        """The last hidden layer. Shape: (n, width)."""
        return self.network["body"](self.network["encoders"](*observed))

    def _draw_taught(self, episodes: int, done: float) -> Any:
        """In which of these new episodes the teacher acts: in all at first, in none after its share of the run."""
        share = max(0.0, 1 - done / self.options.teacher_share) if self.options.teacher_share else 0.0
        return self._rng.random(episodes) < share

    def policy(self) -> LearntPolicy:
        """A copy of the network."""
        network = nn.Sequential(self.network["body"], self.network["actor"])
        return LearntPolicy(self.network["encoders"], network, *self.spaces, tanh=False)

    def state(self) -> dict[str, Any]:
        """Weights, optimiser and random numbers, without the steps that were learnt from."""
        return {"learner": {**state_of(self.parts["learner"]), "steps": len(self.memory)}}

    def load_state(self, state: Any) -> None:
        """Restore the result of `state`; new episodes begin, and some of them end before the first update."""
        super().load_state(state)
        self.play()
        self._refill = min(int(state["learner"]["steps"]), 100 * self.envs.num_envs)
        self._taught = self._draw_taught(self.envs.num_envs, self.done(self.settings.steps))
        self.notices.append(_NO_MEMORY)
