"""Behaviour cloning and implicit Q-learning, small and quick.

IQL (Kostrikov, Nair, Levine: Offline Reinforcement Learning with Implicit Q-Learning, 2021,
https://arxiv.org/abs/2110.06169) never asks for the value of an action that nobody tried:

    V: minimise |expectile - 1[Q < V]| (Q(s, a) - V(s))²      Q: minimise (r + gamma V(s') - Q(s, a))²
    actor: imitate a with the weight exp(scale (Q(s, a) - V(s)) / deviation)

Q and V do not depend on the actor. So offline they are learnt first, and the actor then clones the data by the weights
of the final values.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch.nn import functional

from bam_train.trainers.learner_hyperparameters import Cloning, ImplicitQ
from bam_train.trainers.learning.networks import Descent, Ensemble, cosine, follow, two_layers
from bam_train.trainers.learning.replay_memory import ActionCode, Batch, ReplayMemory

_MOST = 100.0  # greatest weight of an action


class ImplicitQLearner:
    """Updates of one of the two algorithms.

    Args:
        options: The hyperparameters.
        inputs: Numbers of an observation.
        code: Of the actions.
        data: Recorded transitions, with the columns of `offline_trainer.transitions`.
    """

    tanh = True
    """Whether scores of a Box are squashed."""

    def __init__(self, options: Cloning, inputs: int, code: ActionCode, data: ReplayMemory) -> None:
        self.options: Any = options
        self._code, self.data = code, data
        self.network = two_layers(inputs, options.width, code.size)
        """From normalised observations to scores of actions, before squashing or choosing: (n, inputs) -> (n, k)."""
        adam = {"learning_rate": options.learning_rate, "fused": True}
        self._actor = Descent("actor", self.network.parameters(), weight_decay=options.weight_decay, **adam)
        optimisers = {"actor": self._actor}
        self.parts: dict[str, Any] = {"actor": self.network, "optimisers": optimisers}
        if isinstance(options, ImplicitQ):
            self._q = Ensemble(2, inputs + code.size, options.critic_width)
            self._target, self._v = copy.deepcopy(self._q), Ensemble(1, inputs, options.critic_width)
            self._critics = Descent("critics", [*self._q.parameters(), *self._v.parameters()], **adam)
            optimisers["critics"] = self._critics
            self.parts |= {"q": self._q, "target": self._target, "v": self._v}
        self._chances: torch.Tensor | None = None  # sums of the chances of transitions to be drawn for the actor
        self.metrics: dict[str, float] = {}
        """Numbers of the last update."""

    def update(self, step: int, total: int) -> None:
        """Update number `step` of `total` on the recorded data: of the critics first, then of the actor.

        Raises:
            TrainingFailed: A loss is not finite.
        """
        options = self.options
        is_cloning = not isinstance(options, ImplicitQ)
        turn = 0 if is_cloning else round(options.critic_share * total)
        if step < turn:
            self._chances = None
            self._update_critics(self.data.draw(options.batch_size), step / turn)
            return
        if self._chances is None:
            count = len(self.data)
            chances = torch.ones(count) if is_cloning else self._weights(self.data.rows(slice(count)))
            self._chances = chances.double().cumsum(0)
        drawn = torch.rand(options.batch_size, dtype=torch.float64) * self._chances[-1]
        rows = torch.searchsorted(self._chances, drawn).clamp(max=len(self.data) - 1)
        self._update_actor(self.data.rows(rows), None, (step - turn) / (total - turn))

    def update_online(self, batch: Batch, done: float) -> None:
        """Update critics and actor of `ImplicitQ` on a batch, when a share `done` of all updates is over."""
        self._update_critics(batch, done)
        self._update_actor(batch, self._weights(batch), done)

    def _update_critics(self, batch: Batch, done: float) -> None:
        options = self.options
        with torch.no_grad():
            tried = self._target(batch.seen, batch.action).amin(0)
            goal = batch.reward + options.gamma * (1 - batch.terminal) * self._v(batch.after)[0]
        ahead = tried - self._v(batch.seen)[0]
        value_loss = ((options.expectile - (ahead < 0).float()).abs() * ahead**2).mean()
        q_loss = ((self._q(batch.seen, batch.action) - goal) ** 2).mean(1).sum()
        self.metrics["loss/critics"] = self._critics.descend(value_loss + q_loss, cosine(done))
        follow(self._target, self._q, options.tau)
        self.metrics["value"] = float(goal.mean())

    def _update_actor(self, batch: Batch, weights: torch.Tensor | None, done: float) -> None:
        scores = self.network(batch.seen)
        if self._code.is_discrete:
            errors = functional.cross_entropy(scores, batch.action, reduction="none")
        else:
            difference = torch.tanh(scores) - batch.action
            errors = (difference.abs() if self.options.loss == "absolute" else difference**2).mean(1)
        loss = (errors if weights is None else weights * errors).mean()
        self.metrics["loss/actor"] = self._actor.descend(loss, cosine(done))

    @torch.no_grad()  # type: ignore[untyped-decorator] # torch is not typed here
    def _weights(self, batch: Batch) -> torch.Tensor:
        """Weight of every action by its advantage; their mean is 1. Shape: (n,)."""
        options = self.options
        pieces = zip(batch.seen.split(4096), batch.action.split(4096), strict=True)
        advantage = torch.cat([self._target(*pair).amin(0) - self._v(pair[0])[0] for pair in pieces])
        weights = (options.advantage_scale * advantage / advantage.std().clamp(min=1e-6)).exp().clamp(max=_MOST)
        return weights / weights.mean()
