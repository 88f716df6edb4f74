"""RLPD: soft actor-critic that learns from demonstrations and from a robot's experience at the same time.

P. J. Ball, L. Smith, I. Kostrikov, S. Levine: Efficient Online Reinforcement Learning with Offline Data (2023),
https://arxiv.org/abs/2302.02948: half of each batch are demonstrations, the critics are an ensemble with layer
normalisation, whose target is the least of a random subset, and there are several updates for each step of the robot.

What differs, because a robot must stay useful while it learns: the actor imitates, instead of climbing the critics'
slope, which in the first thousands of steps leads away from all that was ever tried. It imitates a person, and the
robot's own successful episodes (Oh et al., Self-Imitation Learning, https://arxiv.org/abs/1806.05635), with noise on
what it sees, without which a dozen demonstrations are learnt by heart; and the average of its weights drives. The
critics count only where a setting says so: ``advantage_weight`` for what they value more than the usual actions
(Nair et al., AWAC, https://arxiv.org/abs/2006.09359), ``value_weight`` for SAC's own loss.
"""

import copy
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from bam_train.trainers.frozen_network import Layer
from bam_train.trainers.learner_hyperparameters import RlpdHyperparameters
from bam_train.trainers.learning.networks import Descent, Ensemble, follow, two_layers
from bam_train.trainers.learning.replay_memory import Batch
from bam_train.trainers.learning.torch_trainer import restore, state_of

_DRAWS = 2  # actions that the usual value of an observation is the mean of
_MOST = 3.0  # greatest exponent of the weight of an action


class Actor(Layer):
    """Observation and last actions to mean and logarithm of the deviation of the next action, before squashing."""

    def __init__(self, inputs: int, actions: int, width: int, deviation: float) -> None:
        super().__init__()
        self.layers, self.mean = two_layers(inputs, width), nn.Linear(width, actions)
        self.log_deviation = nn.Linear(width, actions)
        nn.init.zeros_(self.log_deviation.weight)
        nn.init.constant_(self.log_deviation.bias, math.log(deviation))

    def forward(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Shapes: (n, inputs) -> (n, a), (n, a)."""
        x = self.layers(seen)
        return self.mean(x), self.log_deviation(x).clamp(-5.0, 0.0)

    def draw(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Drawn actions in [-1, 1] (n, a), the logarithm of their density (n,), and the means in [-1, 1] (n, a)."""
        mean, log_deviation = self(seen)
        noise = torch.randn_like(mean)
        raw = mean + noise * log_deviation.exp()
        # log of the derivative of tanh: 2 (log 2 - x - softplus(-2 x))
        slope = 2 * (math.log(2) - raw - functional.softplus(-2 * raw))
        density = -0.5 * noise**2 - log_deviation - 0.5 * math.log(2 * math.pi) - slope
        return torch.tanh(raw), density.sum(-1), torch.tanh(mean)


class Rlpd:
    """Actor, critics and their optimisers.

    Args:
        inputs: Numbers of an observation and of the last actions.
        actions: Numbers of an action.
        settings: The hyperparameters.
    """

    def __init__(self, inputs: int, actions: int, settings: RlpdHyperparameters) -> None:
        self.settings, self.updates = settings, 0
        self.actor = Actor(inputs, actions, settings.actor_width, settings.deviation)
        self.average = copy.deepcopy(self.actor).requires_grad_(False)
        """The actor's weights, averaged over its last updates: it drives."""
        shape = settings.critics, inputs + actions, settings.critic_width
        self.critics, self._target = (Ensemble(*shape, normalises=True) for _ in range(2))
        self._target.load_state_dict(self.critics.state_dict())
        self._log_temperature = torch.tensor(math.log(settings.temperature), requires_grad=True)
        learnt = {
            "critics": self.critics.parameters(),
            "actor": self.actor.parameters(),
            "temperature": [self._log_temperature],
        }
        self._optimisers = {name: Descent(name, some, settings.learning_rate) for name, some in learnt.items()}
        self._parts = {
            "actor": self.actor,
            "average": self.average,
            "critics": self.critics,
            "target": self._target,
            "temperature": self._log_temperature,
            "optimisers": self._optimisers,
        }
        self.metrics: dict[str, float] = {}
        """Numbers of the last updates."""

    @property
    def has_critics(self) -> bool:
        """Whether critics are learnt."""
        return bool(self.settings.advantage_weight or self.settings.value_weight)

    def update(self, draw: Callable[[], Batch], *, actor: bool = True) -> None:
        """Update the critics, and every so often the actor, unless it is to stay as it is.

        Args:
            draw: Gives a batch; not called if nothing is to be updated.
            actor: Whether the actor may change.

        Raises:
            TrainingFailed: A loss is not finite.
        """
        self.updates += 1
        actor = actor and self.updates % self.settings.actor_every == 0
        if not actor and not self.has_critics:
            return
        batch = draw()
        if self.has_critics:
            self._update_critics(batch)
        if actor:
            self._update_actor(batch)

    def _update_critics(self, batch: Batch) -> None:
        settings = self.settings
        with torch.no_grad():
            action, density, _ = self.actor.draw(batch.after)
            chosen = torch.randperm(settings.critics)[: settings.subset]
            value = self._target(batch.after, action, chosen=chosen).amin(0) - self._log_temperature.exp() * density
            target = settings.reward_scale * batch.reward + batch.discount * value
        loss = ((self.critics(batch.seen, batch.action) - target) ** 2).sum(0).mean()
        self._optimisers["critics"].descend(loss)
        follow(self._target, self.critics, settings.tau)
        self.metrics |= {"loss/critics": loss.item(), "value": target.mean().item()}

    def _update_actor(self, batch: Batch) -> None:
        settings, own = self.settings, len(batch.seen) - batch.demonstrations
        blurred = batch.seen + settings.blur * batch.seen.std(0, correction=0) * torch.randn_like(batch.seen)
        drawn, density, mean = self.actor.draw(blurred)
        errors, losses = ((mean - batch.action) ** 2).mean(1), {}
        if batch.demonstrations and settings.imitation_weight:
            losses["imitation"] = settings.imitation_weight * errors[own:].mean()
        if self.updates > settings.warmup and settings.advantage_weight:
            weights = self._weights(batch.seen[:own], batch.action[:own])
            losses["advantage"] = settings.advantage_weight * (weights * errors[:own]).mean()
        temperature = self._log_temperature.exp()
        if self.updates > settings.warmup and settings.value_weight:
            value = self.critics(batch.seen, drawn).mean(0)
            gain = (temperature.detach() * density - value).mean() / value.detach().abs().mean().clamp(min=1e-3)
            losses["value"] = settings.value_weight * gain
            excess = density.detach().mean() + settings.target_entropy
            self._optimisers["temperature"].descend(-temperature * excess)
        if losses:
            self._optimisers["actor"].descend(torch.stack([*losses.values()]).sum())
            follow(self.average, self.actor, settings.average)
        self.metrics |= {f"loss/{name}": loss.item() for name, loss in losses.items()}

    @torch.no_grad()  # type: ignore[untyped-decorator] # torch is not typed here
    def _weights(self, seen: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Weights of the actions that were tried, by their advantage over drawn ones; their mean is 1. Shape: (n,)."""
        usual = [self.critics(seen, self.actor.draw(seen)[0]).mean(0) for _ in range(_DRAWS)]
        advantage = self.critics(seen, action).mean(0) - torch.stack(usual).mean(0)
        exponent = self.settings.advantage_scale * advantage / advantage.std().clamp(min=1e-6)
        weights = exponent.clamp(max=_MOST).exp()
        return weights / weights.mean()

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next updates depend on, except torch's random numbers."""
        return {**state_of(self._parts), "updates": self.updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; early ones have no average."""
        restore(self._parts, {"average": state["actor"], **state})
        self.updates = int(state["updates"])
