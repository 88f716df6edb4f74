"""PPO whose network is computed with NumPy, if it is of dense layers: in half the CPU time that torch takes.

For layers this small most of torch's time is its overhead and its tanh. The update is that of stable-baselines3, in
float32, on the same minibatches: weights, the state of Adam and the log are where it has them.
"""

import contextlib
import functools
import inspect
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution, StateDependentNoiseDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import explained_variance
from threadpoolctl import ThreadpoolController
from torch import nn

Array = NDArray[np.float32]
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_threads = functools.cache(ThreadpoolController)


@contextlib.contextmanager
def _without_compiler() -> Iterator[None]:
    """Use optimisers without the import of torch's compiler, which their wrapped methods do: a second of CPU time."""
    names = ("add_param_group", "state_dict", "load_state_dict")
    wrapped = {name: getattr(torch.optim.Optimizer, name) for name in names}
    for name, method in wrapped.items():
        setattr(torch.optim.Optimizer, name, inspect.unwrap(method))
    try:
        yield
    finally:
        for name, method in wrapped.items():
            setattr(torch.optim.Optimizer, name, method)


class NumpyPPO(PPO):  # type: ignore[misc]
    """As `PPO`, which computes a policy, optimiser or setting that `fits` does not know."""

    @_without_compiler()
    def _setup_model(self) -> None:
        super()._setup_model()

    @_without_compiler()
    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """The weights of the policy and the state of its optimiser."""
        found: dict[str, dict[str, Any]] = super().get_parameters()
        return found

    @_without_compiler()
    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """Set what `get_parameters` returned; see `PPO`."""
        super().set_parameters(*args, **kwargs)

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
        """Fill the rollout buffer, see `PPO`; the weights stay as they are meanwhile."""
        if not fits(self):
            return bool(super().collect_rollouts(*args, **kwargs))
        self.policy.forward = _Network(self.policy).act
        try:
            return bool(super().collect_rollouts(*args, **kwargs))
        finally:
            del self.policy.forward

    def train(self) -> None:
        """Update the policy with the rollout buffer."""
        if not fits(self):
            super().train()
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip = self.clip_range(self._current_progress_remaining)
        update, figures = _Update(self, clip), list[tuple[float, ...]]()
        with _threads().limit(limits=1, user_api="blas"):  # two take longer for such small layers
            for _ in range(self.n_epochs):
                epoch = [update.step(batch) for batch in self.rollout_buffer.get(self.batch_size)]
                figures += epoch
                self._n_updates += 1
        update.write()
        names = ("entropy_loss", "policy_gradient_loss", "value_loss", "clip_fraction")
        for name, value in zip(names, np.mean(figures, axis=0), strict=False):
            self.logger.record(f"train/{name}", value)
        values, returns = self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten()
        self.logger.record("train/approx_kl", np.mean([row[4] for row in epoch]))  # of the last epoch, as in PPO
        self.logger.record("train/loss", epoch[-1][5])
        self.logger.record("train/explained_variance", explained_variance(values, returns))
        self.logger.record("train/std", self.policy.log_std.exp().mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip)


def fits(model: PPO) -> bool:
    """Whether the update of a model can be computed here."""
    policy, noise = model.policy, model.policy.action_dist
    if type(policy) is not ActorCriticPolicy or type(policy.features_extractor) is not FlattenExtractor:
        return False
    layers = {type(layer) for branch in _branches(policy) for layer in branch}
    group, *others = policy.optimizer.param_groups
    is_adam = type(policy.optimizer) is torch.optim.Adam and not others
    box = model.observation_space
    return (
        layers <= {nn.Linear, nn.Tanh, nn.ReLU}
        and is_adam
        and not (group["weight_decay"] or group["amsgrad"] or group["maximize"])
        and isinstance(box, spaces.Box)
        and box.dtype == np.float32
        and model.clip_range_vf is None
        and model.target_kl is None
        and model.device.type == "cpu"
        and (type(noise) is DiagGaussianDistribution or _is_plain_sde(noise))
    )


def _is_plain_sde(noise: Any) -> bool:
    is_sde = type(noise) is StateDependentNoiseDistribution and noise.bijector is None
    return is_sde and noise.full_std and not noise.use_expln and not noise.learn_features


def _branches(policy: ActorCriticPolicy) -> tuple[list[nn.Module], list[nn.Module]]:
    """The layers of actor and critic."""
    hidden = policy.mlp_extractor
    return [*hidden.policy_net, policy.action_net], [*hidden.value_net, policy.value_net]


class _Branch:
    """Dense layers; weights and gradients are views of vectors of all parameters."""

    def __init__(self, layers: list[nn.Module], weights: dict[int, Array], gradients: dict[int, Array]) -> None:
        dense = [layer for layer in layers if isinstance(layer, nn.Linear)]
        self.tanh = any(isinstance(layer, nn.Tanh) for layer in layers)
        self.weights = [(weights[id(layer.weight)], weights[id(layer.bias)]) for layer in dense]
        self.gradients = [(gradients[id(layer.weight)], gradients[id(layer.bias)]) for layer in dense]
        self.inputs: list[Array] = []
        """Inputs of the layers in the last `forward`. Shape: (n, k) each."""

    def forward(self, x: Array) -> Array:
        """The output (n, outputs) for the input (n, inputs)."""
        self.inputs = [x]
        for weight, bias in self.weights[:-1]:
            x = x @ weight.T
            x += bias
            self.inputs.append(np.tanh(x, out=x) if self.tanh else np.maximum(x, 0.0, out=x))
        weight, bias = self.weights[-1]
        output: Array = self.inputs[-1] @ weight.T + bias
        return output

    def backward(self, slope: Array) -> None:
        """Set the gradients, for the slope of the loss by the output (n, outputs)."""
        for k in reversed(range(len(self.weights))):
            x, (weight, bias) = self.inputs[k], self.gradients[k]
            np.matmul(slope.T, x, out=weight)
            slope.sum(axis=0, out=bias)
            if k:
                slope = slope @ self.weights[k][0]
                slope *= 1.0 - x * x if self.tanh else x > 0.0


class _Network:
    """The weights of a policy, and what it computes from them."""

    def __init__(self, policy: ActorCriticPolicy) -> None:
        self.parameters: list[nn.Parameter] = list(policy.parameters())
        self.noise, self.weights = policy.action_dist, _joined(self.parameters)
        self.gradient = np.empty_like(self.weights)
        views, slopes = self._views(self.weights), self._views(self.gradient)
        self.actor, self.critic = (_Branch(layers, views, slopes) for layers in _branches(policy))
        self.log_std, self.log_std_slope = (each[id(policy.log_std)] for each in (views, slopes))
        self.std2 = np.exp(2 * self.log_std)
        self.is_sde = self.log_std.ndim == 2

    def _views(self, vector: Array) -> dict[int, Array]:
        """Views of a vector by the id of the parameter, each in its shape."""
        ends = np.cumsum([one.numel() for one in self.parameters])[:-1]
        parts = np.split(vector, ends)
        return {id(one): part.reshape(one.shape) for one, part in zip(self.parameters, parts, strict=True)}

    def variance(self) -> Array:
        """Variance of the actions after `forward` of the actor. Shape: (n, a) or (a,)."""
        np.exp(2 * self.log_std, out=self.std2)
        return self.actor.inputs[-1] ** 2 @ self.std2 + self.noise.epsilon if self.is_sde else self.std2

    def act(self, observations: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """As the policy's `forward`: random actions (n, a), their values (n, 1) and the log of their density (n,)."""
        seen = observations.numpy().reshape(len(observations), -1)
        mean, values, variance = self.actor.forward(seen), self.critic.forward(seen), self.variance()
        if self.is_sde:
            latent, each = self.actor.inputs[-1], self.noise.exploration_matrices.detach().numpy()
            is_single = len(seen) == 1 or len(seen) != len(each)
            used = self.noise.exploration_mat.detach().numpy() if is_single else each
            error = latent @ used if is_single else (latent[:, None] @ used)[:, 0]
        else:
            error = np.sqrt(variance) * torch.normal(torch.zeros(mean.shape), 1.0).numpy()
        density = -_surprise(error, variance, error / variance)
        return torch.from_numpy(mean + error), torch.from_numpy(values), torch.from_numpy(density)


def _surprise(error: Array, variance: Array, scaled: Array) -> Array:
    """Minus the log of the density of a normal distribution; `scaled` is the error by the variance. Shape: (n,)."""
    surprise: Array = (0.5 * (error * scaled + np.log(variance)) + np.float32(_LOG_SQRT_2PI)).sum(axis=1)
    return surprise


def _joined(tensors: list[Any]) -> Array:
    joined: Array = np.concatenate([tensor.detach().numpy().ravel() for tensor in tensors])
    return joined


class _Update(_Network):
    """An update of a model's policy, with the state of its Adam."""

    def __init__(self, model: NumpyPPO, clip: float) -> None:
        super().__init__(model.policy)
        self.model, self.clip, self.optimizer = model, clip, model.policy.optimizer
        states = [(one, self.optimizer.state[one]) for one in self.parameters]
        self.count = int(states[0][1].get("step", 0))
        self.mean, self.square = (
            _joined([state.get(name, torch.zeros_like(one)) for one, state in states])
            for name in ("exp_avg", "exp_avg_sq")
        )

    def step(self, batch: Any) -> tuple[float, ...]:
        """Learn from a minibatch; returns losses of entropy, policy and value, clipped share, divergence, and loss."""
        seen, acted, _, before, advantages, returns, *_ = (one.numpy() for one in batch)
        seen, count = seen.reshape(len(seen), -1), len(seen)
        error = acted - self.actor.forward(seen)
        variance = self.variance()
        scaled = error / variance
        log_ratio = -_surprise(error, variance, scaled) - before
        if self.model.normalize_advantage and count > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std(ddof=1) + np.float32(1e-8))
        ratio = np.exp(log_ratio)
        gained, limited = advantages * ratio, advantages * np.clip(ratio, 1 - self.clip, 1 + self.clip)
        is_clipped = np.abs(ratio - 1) > self.clip
        # The minimum of both has a slope where nothing is clipped, or the first is smaller.
        slope = np.where(~is_clipped | (gained < limited), gained, np.float32(0.0))[:, None] / np.float32(-count)
        self.actor.backward(slope * scaled)
        entropy_slope = np.float32(self.model.ent_coef / count)
        by_variance = 0.5 * (slope * (error * scaled - 1) - entropy_slope) / variance
        by_std2 = (self.actor.inputs[-1] ** 2).T @ by_variance if self.is_sde else by_variance.sum(axis=0)
        np.multiply(2 * self.std2, by_std2, out=self.log_std_slope)
        missed = self.critic.forward(seen)[:, 0] - returns
        self.critic.backward(np.float32(2 * self.model.vf_coef / count) * missed[:, None])
        entropy = -float((0.5 * np.log(variance) + 0.5 + _LOG_SQRT_2PI).sum(axis=-1).mean())
        self._descend()
        policy, value = -float(np.minimum(gained, limited).mean()), float((missed * missed).mean())
        loss = policy + self.model.ent_coef * entropy + self.model.vf_coef * value
        return entropy, policy, value, float(is_clipped.mean()), float((ratio - 1 - log_ratio).mean()), loss

    def _descend(self) -> None:
        """Adam with a clipped gradient, as torch computes them."""
        group, gradient = self.optimizer.param_groups[0], self.gradient
        first, second = group["betas"]
        self.count += 1
        gradient *= min(1.0, self.model.max_grad_norm / (float(np.linalg.norm(gradient)) + 1e-6))
        self.mean += (1 - first) * (gradient - self.mean)
        self.square *= second
        self.square += (1 - second) * gradient * gradient
        deviation = np.sqrt(self.square) / math.sqrt(1 - second**self.count) + group["eps"]
        self.weights -= group["lr"] / (1 - first**self.count) * self.mean / deviation

    def write(self) -> None:
        """Write weights and state back to torch."""
        weights, mean, square = (self._views(vector) for vector in (self.weights, self.mean, self.square))
        for one in self.parameters:
            one.data.copy_(torch.from_numpy(weights[id(one)]))
            moments = {"exp_avg": mean[id(one)], "exp_avg_sq": square[id(one)]}
            state = {name: torch.from_numpy(moment.copy()) for name, moment in moments.items()}
            self.optimizer.state[one] = {"step": torch.tensor(float(self.count)), **state}
