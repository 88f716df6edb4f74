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
import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from msgspec import Meta
from torch import nn
from torch.nn import functional

from bam_train.errors import TrainingFailed
from bam_train.trainers.frozen_network import Layer
from bam_train.trainers.offline.training_data import ActionCode, TrainingBatch

_Count = Annotated[int, Meta(ge=1, le=100_000)]
_Positive = Annotated[float, Meta(gt=0, le=1e6)]
_NotNegative = Annotated[float, Meta(ge=0, le=1e6)]
_Share = Annotated[float, Meta(ge=0, le=1)]
_MOST = 100.0  # greatest weight of an action


@dataclass(frozen=True)
class Cloning:
    """Hyperparameters of behaviour cloning."""

    learning_rate: _Positive = 1e-3
    """At the beginning; it falls to 0 along a cosine."""
    batch_size: _Count = 256
    width: _Count = 256
    """Units of each of the actor's two hidden layers."""
    weight_decay: _NotNegative = 0.0
    """Share of the actor's weights that each gradient pulls them back by; few episodes are cloned better with some."""
    loss: Annotated[str, Meta(pattern="^(absolute|squared)$")] = "squared"
    """Error of a Box action: squared (the mean of what was done; default of bc) or absolute (the median)."""


@dataclass(frozen=True)
class ImplicitQ(Cloning):
    """Hyperparameters of implicit Q-learning."""

    loss: Annotated[str, Meta(pattern="^(absolute|squared)$")] = "absolute"
    """As of cloning; among actions of which many are bad, the median is the better guess."""
    gamma: _Share = 0.98
    """Discount of a step."""
    expectile: _Share = 0.7
    """0.5: the value of what was done; 1: of the best that was done."""
    advantage_scale: _Positive = 1.0
    """Exponent of an action's weight for an advantage of one standard deviation."""
    tau: _Share = 0.005
    """Share of the critics that the target critics take over at each update."""
    critic_width: _Count = 128
    critic_share: _Share = 0.7
    """Share of the updates that go to the critics, before the actor's."""
    update_ratio: _Positive = 0.5
    """Online: updates for each step of the environments."""
    exploration: _Positive = 0.1
    """Online: deviation of the noise of Box actions, whose range is 2; share of random Discrete actions."""
    online_from: Annotated[int, Meta(ge=0)] | None = None
    """Step at which --resume went online; bam-train sets it."""


class Ensemble(Layer):
    """`count` networks with two hidden layers, computed together. Shapes: (n, inputs) -> (count, n)."""

    def __init__(self, count: int, inputs: int, width: int) -> None:
        super().__init__()
        sizes = ((inputs, width), (width, width), (width, 1))
        draws = [(2 * torch.rand(count, i, o) - 1) / math.sqrt(i) for i, o in sizes]
        self.weights = nn.ParameterList(map(nn.Parameter, draws))
        self.biases = nn.ParameterList(nn.Parameter(torch.zeros(count, 1, o)) for _, o in sizes)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """A value of each network."""
        x = x.expand(len(self.weights[0]), -1, -1)
        for layer in range(3):
            x = torch.baddbmm(self.biases[layer], x, self.weights[layer])
            x = functional.relu(x) if layer < 2 else x
        return x.squeeze(-1)


class ImplicitQLearner:
    """Updates of one of the two algorithms; `iql` is None for cloning."""

    tanh = True
    """Whether scores of a Box are squashed."""

    def __init__(self, settings: Cloning, inputs: int, code: ActionCode, data: TrainingBatch) -> None:
        self.settings, self._code, self.data = settings, code, data
        self.iql = settings if isinstance(settings, ImplicitQ) else None
        width = settings.width
        layers = (nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, code.size))
        self.actor = nn.Sequential(*layers)
        self._optimisers = {"actor": self._adam(self.actor, settings.weight_decay)}
        self.modules: dict[str, Any] = {"actor": self.actor}
        if self.iql is not None:
            self._q = Ensemble(2, inputs + code.size, self.iql.critic_width)
            self._target, self._v = copy.deepcopy(self._q), Ensemble(1, inputs, self.iql.critic_width)
            self.modules |= {"q": self._q, "target": self._target, "v": self._v}
            self._optimisers["critics"] = self._adam(nn.ModuleList([self._q, self._v]))
        self._chances: torch.Tensor | None = None  # sums of the chances of transitions to be drawn for the actor
        self.metrics: dict[str, float] = {}
        """Numbers of the last update."""

    def _adam(self, module: nn.Module, decay: float = 0.0) -> Any:
        rate = self.settings.learning_rate
        return torch.optim.Adam(module.parameters(), lr=rate, weight_decay=decay, fused=True)

    def update(self, step: int, total: int) -> None:
        """Update number `step` of `total` on the data set.

        Raises:
            TrainingFailed: A loss is not finite.
        """
        turn = 0 if self.iql is None else round(self.iql.critic_share * total)
        size = self.settings.batch_size
        if step < turn:
            self._chances = None
            self.update_critics(self.data.rows(torch.randint(len(self.data), (size,))), step / turn)
            return
        if self._chances is None:
            chances = torch.ones(len(self.data)) if self.iql is None else self._weights(self.data)
            self._chances = chances.double().cumsum(0)
        drawn = torch.rand(size, dtype=torch.float64) * self._chances[-1]
        rows = torch.searchsorted(self._chances, drawn).clamp(max=len(self.data) - 1)
        self.update_actor(self.data.rows(rows), None, (step - turn) / (total - turn))

    def update_critics(self, batch: TrainingBatch, done: float) -> None:
        """Update Q and V on a batch; `done` is the share of the updates before this one."""
        iql = self._of_iql()
        with torch.no_grad():
            tried = self._target(torch.cat([batch.seen, batch.action], 1)).amin(0)
            goal = batch.reward + iql.gamma * (1 - batch.terminal) * self._v(batch.after)[0]
        ahead = tried - self._v(batch.seen)[0]
        value_loss = ((iql.expectile - (ahead < 0).float()).abs() * ahead**2).mean()
        q_loss = ((self._q(torch.cat([batch.seen, batch.action], 1)) - goal) ** 2).mean(1).sum()
        self._descend("critics", value_loss + q_loss, done)
        with torch.no_grad():
            torch._foreach_lerp_([*self._target.parameters()], [*self._q.parameters()], iql.tau)
        self.metrics["value"] = float(goal.mean())

    def update_actor(self, batch: TrainingBatch, weights: torch.Tensor | None, done: float) -> None:
        """Update the actor on a batch; `weights` (n,) of its transitions have the mean 1."""
        scores = self.actor(batch.seen)
        if self._code.is_discrete:
            errors = functional.cross_entropy(scores, batch.action, reduction="none")
        else:
            difference = torch.tanh(scores) - batch.action
            errors = (difference.abs() if self.settings.loss == "absolute" else difference**2).mean(1)
        self._descend("actor", (errors if weights is None else weights * errors).mean(), done)

    @torch.no_grad()  # type: ignore[untyped-decorator] # torch is not typed here
    def _weights(self, batch: TrainingBatch) -> torch.Tensor:
        """Weight of every action by its advantage; their mean is 1. Shape: (n,)."""
        iql = self._of_iql()
        pieces = zip(*(column.split(4096) for column in (batch.seen, batch.action)), strict=True)
        advantage = torch.cat([self._target(torch.cat(pair, 1)).amin(0) - self._v(pair[0])[0] for pair in pieces])
        weights = (iql.advantage_scale * advantage / advantage.std().clamp(min=1e-6)).exp().clamp(max=_MOST)
        return weights / weights.mean()

    def update_online(self, batch: TrainingBatch, done: float) -> None:
        """Update critics and actor on a batch."""
        self.update_critics(batch, done)
        self.update_actor(batch, self._weights(batch), done)

    def _of_iql(self) -> ImplicitQ:
        if self.iql is None:
            raise TrainingFailed("behaviour cloning has no critics; train with --algo iql")
        return self.iql

    def _descend(self, name: str, loss: torch.Tensor, done: float) -> None:
        if not torch.isfinite(loss):
            raise TrainingFailed(f"the loss of the {name} is {loss.item()}: try a smaller learning_rate")
        optimiser = self._optimisers[name]
        optimiser.param_groups[0]["lr"] = self.settings.learning_rate * 0.5 * (1 + math.cos(math.pi * done))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        self.metrics[f"loss/{name}"] = loss.item()

    def network(self) -> nn.Module:
        """From normalised observations to scores of actions, before squashing or choosing: (n, inputs) -> (n, k)."""
        return self.actor

    def state_dict(self) -> dict[str, Any]:
        """Weights and optimisers."""
        state = {name: module.state_dict() for name, module in self.modules.items()}
        return {**state, "optimisers": {name: one.state_dict() for name, one in self._optimisers.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        for name, module in self.modules.items():
            module.load_state_dict(state[name])
        for name, optimiser in self._optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
