"""Turn a trained stable-baselines3 model into one ONNX graph: raw observation in, deterministic action out.

The graph computes all of ``model.predict(..., deterministic=True)`` and of the wrappers around it: `VecNormalize`,
`VecTransposeImage`, one-hot codes, the network, squashing, and the action space's bounds. It is traced from a copy on
the CPU: the model is not changed and no random number is drawn.
"""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecNormalize, VecTransposeImage, unwrap_vec_wrapper
from torch import nn

from bam_envs.core.spaces import leaves
from bam_train.errors import PolicyError
from bam_train.trainers.frozen_network import (
    FrozenNetwork,
    Layer,
    Normalised,
    OneHot,
    action_head,
    to,
)
from bam_train.trainers.zero_based_spaces import less_start, plus_start

AnySpace = spaces.Space[Any]


class _Numbers(Layer):
    """A Box or MultiBinary: channels first, normalise in float64 as VecNormalize does, pixels to [0, 1], float32."""

    def __init__(self, normalise: nn.Module, channels_last: bool, pixels: bool) -> None:
        super().__init__()
        self.normalise, self.channels_last, self.pixels = normalise, channels_last, pixels

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = to(self.normalise(x.permute(0, 3, 1, 2) if self.channels_last else x), torch.float32)
        return x / 255.0 if self.pixels else x


def _encoder(key: str, raw: Any, seen: AnySpace, normalise: nn.Module, scale: bool) -> nn.Module:
    """The layer that turns an array of the environment's space `raw` into the input of the policy's feature extractor.

    The policy was built for the space `seen`, in which an image's channels may come first.
    """
    if isinstance(raw, (spaces.Discrete, spaces.MultiDiscrete)):
        return OneHot(raw)
    channels_last = raw.shape != seen.shape
    if channels_last and (len(raw.shape) != 3 or (raw.shape[2], *raw.shape[:2]) != seen.shape):
        raise PolicyError(
            f"observation {key!r}: the policy takes shape {seen.shape}, the environment gives {raw.shape}"
        )
    return _Numbers(normalise, channels_last, scale and is_image_space(seen))


class _Chain(Layer):
    """The actor's part of an `MlpExtractor`, then the output layer."""

    def __init__(self, extractor: nn.Module, output: nn.Module) -> None:
        super().__init__()
        self.extractor, self.output = extractor, output

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.output(self.extractor.forward_actor(x))


class _Lstm(Layer):
    """One step of an `nn.LSTM`, written out as dense layers; its state is a hidden and a cell array for each layer."""

    def __init__(self, lstm: nn.LSTM) -> None:
        super().__init__()
        if lstm.bidirectional or lstm.proj_size or not lstm.bias:
            raise PolicyError("an LSTM that is bidirectional, projects or has no bias cannot be frozen")
        self.sizes = [lstm.hidden_size] * lstm.num_layers
        self.gates = nn.ModuleList()  # for each layer, a linear layer from (input, hidden) to the four gates
        for weights in lstm.all_weights:
            w_input, w_hidden, b_input, b_hidden = (weight.detach() for weight in weights)
            weight = torch.cat([w_input, w_hidden], 1)
            gates = nn.utils.skip_init(nn.Linear, weight.shape[1], weight.shape[0])
            gates.weight.data, gates.bias.data = weight, b_input + b_hidden
            self.gates.append(gates)

    def forward(self, x: torch.Tensor, state: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        following = []
        for layer, gates in enumerate(self.gates):
            hidden, cell = state[2 * layer : 2 * layer + 2]
            take, keep, new, give = gates(torch.cat([x, hidden], 1)).split(self.sizes[layer], dim=1)
            cell = keep.sigmoid() * cell + take.sigmoid() * new.tanh()
            x = give.sigmoid() * cell.tanh()
            following += [x, cell]
        return x, following


def _network(policy: BasePolicy) -> tuple[Any, nn.Module, nn.Module, nn.Module | None]:
    """The module that owns the network, and copies of its feature extractor, layers and LSTM (or None)."""
    lstm = None
    if isinstance(policy, ActorCriticPolicy):
        owner, extractor = policy, policy.pi_features_extractor
        layers: nn.Module = _Chain(policy.mlp_extractor, policy.action_net)
        lstm = getattr(policy, "lstm_actor", None)
    elif hasattr(policy, "quantile_net"):  # QR-DQN
        owner, extractor = policy.quantile_net, policy.quantile_net.features_extractor
        layers = _mean_of_quantiles(owner.quantile_net, owner.n_quantiles)
    elif hasattr(policy, "q_net"):  # DQN
        owner, extractor, layers = policy.q_net, policy.q_net.features_extractor, policy.q_net.q_net
    elif hasattr(policy, "actor"):  # SAC, TQC and CrossQ have latent_pi and mu; TD3 and DDPG only mu
        owner, extractor = policy.actor, policy.actor.features_extractor
        layers = nn.Sequential(getattr(owner, "latent_pi", nn.Identity()), owner.mu)
    else:
        raise PolicyError(f"policy {type(policy).__name__} cannot be frozen; expected one of stable-baselines3's own")
    extractor, layers = (copy.deepcopy(part).cpu().eval().requires_grad_(False) for part in (extractor, layers))
    return owner, extractor, layers, None if lstm is None else _Lstm(copy.deepcopy(lstm).cpu())


def _mean_of_quantiles(layers: nn.Sequential, quantiles: int) -> nn.Sequential:
    """Fold the mean over quantiles into the last layer: the mean of linear functions is linear."""
    *hidden, last = copy.deepcopy(layers).cpu()
    mean = nn.utils.skip_init(nn.Linear, last.in_features, last.out_features // quantiles)
    weight = last.weight.detach().double().reshape(quantiles, mean.out_features, last.in_features).mean(0)
    mean.weight.data = weight.float()
    mean.bias.data = last.bias.detach().double().reshape(quantiles, mean.out_features).mean(0).float()
    return nn.Sequential(*hidden, mean)


def _head(space: AnySpace, policy: BasePolicy) -> nn.Module:
    """The layer that turns the network's output into an action of the environment's space."""
    if not isinstance(space, spaces.Box):
        return action_head(space, tanh=False, scale=False, clip=False)
    if isinstance(policy, ActorCriticPolicy):
        distribution = policy.action_dist
        tanh = isinstance(distribution, StateDependentNoiseDistribution) and distribution.bijector is not None
    else:  # TD3 and DDPG have a tanh among the layers of `_network`
        tanh = hasattr(policy.actor, "latent_pi")
    return action_head(space, tanh=tanh, scale=policy.squash_output, clip=True)  # scaled actions can round past a bound


class FrozenModel(FrozenNetwork):
    """The policy of a model of any algorithm of stable-baselines3 or sb3-contrib, except ARS.

    Args:
        model: The model.
        normaliser: Normaliser of the observations, if any.
        observation_space: The environment's observation space, before any wrapper of SB3.
        action_space: The environment's action space; its ``start`` is added to SB3's actions, which count from 0.

    Raises:
        PolicyError: The policy or a space is of a kind that cannot be frozen.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        normaliser: VecNormalize | None,
        observation_space: AnySpace,
        action_space: AnySpace,
    ) -> None:
        super().__init__(observation_space)
        self.model, self.normaliser, self.spaces = model, normaliser, (observation_space, action_space)
        policy = model.policy
        seen = leaves(policy.observation_space)
        if set(seen) != set(self.leaves):
            found = f"the policy takes {sorted(seen)}, the environment gives {sorted(self.leaves)}"
            raise PolicyError(f"observation: {found}")
        owner, self.extractor, self.layers, self.lstm = _network(policy)
        self.encoders = nn.ModuleList()
        for key, space in self.leaves.items():
            normalise: nn.Module = nn.Identity()
            if normaliser is not None and normaliser.norm_obs and (not key or key in normaliser.norm_obs_keys):
                rms = normaliser.obs_rms[key] if key else normaliser.obs_rms
                self.moments[key] = rms.mean, np.sqrt(rms.var + normaliser.epsilon)
                normalise = Normalised(*self.moments[key], float(normaliser.clip_obs))
            self.encoders.append(_encoder(key, space, seen[key], normalise, owner.normalize_images))
        for layer, size in enumerate(self.lstm.sizes if self.lstm is not None else []):
            self.state |= {f"{name}_{layer}": torch.zeros(2, size) for name in ("hidden", "cell")}
        self.head = _head(action_space, policy)
        self.eval()

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """The scores of a policy that is not recurrent, (n, outputs) float32: means, logits or values."""
        return self.layers(self._features(observation))

    def forward(self, *inputs: torch.Tensor) -> Any:
        """The action, and the next state of a recurrent policy."""
        if self.lstm is None:
            return self.head(self.scores(*inputs))
        count = len(self.leaves)
        output, state = self.lstm(self._features(inputs[:count]), inputs[count:])
        return self.head(self.layers(output)), *state

    def _features(self, observation: Any) -> torch.Tensor:
        encoded = [encoder(tensor) for encoder, tensor in zip(self.encoders, observation, strict=True)]
        return self.extractor(dict(zip(self.leaves, encoded, strict=True)) if self.is_dict else encoded[0])

    def own_actions(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """What ``model.predict(..., deterministic=True)`` says, in the environment's action space."""
        model, normaliser, (observation_space, action_space) = self.model, self.normaliser, self.spaces
        seen = less_start(observation_space, observations if self.is_dict else observations[""])
        if normaliser is not None:
            transpose = unwrap_vec_wrapper(normaliser, VecTransposeImage)
            seen = normaliser.normalize_obs(seen if transpose is None else transpose.transpose_observations(seen))
        modes = [(module, module.training) for module in model.policy.modules()]
        try:
            if hasattr(model.policy, "lstm_actor"):  # one episode, an observation a step
                state, each = None, []
                for t in range(len(next(iter(observations.values())))):
                    now = {key: array[t : t + 1] for key, array in seen.items()} if self.is_dict else seen[t : t + 1]
                    action, state = model.predict(now, state, episode_start=np.array([t == 0]), deterministic=True)
                    each.append(action[0])
                actions = np.stack(each)
            else:
                actions = model.predict(seen, deterministic=True)[0]
        finally:  # `predict` switches to evaluation mode
            for module, training in modes:
                module.training = training
        if isinstance(action_space, spaces.MultiBinary):
            return actions.astype(np.int8)
        return np.asarray(plus_start(action_space, actions))
