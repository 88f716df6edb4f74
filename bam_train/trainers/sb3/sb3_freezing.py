"""Turn a trained stable-baselines3 model into one ONNX graph: raw observation in, deterministic action out.

The graph holds the whole path of ``model.predict(..., deterministic=True)``, with what lies around it: `VecNormalize`,
`VecTransposeImage`, one-hot codes, the network, squashing, and the action space's bounds. It is traced from a copy on
the CPU: the model is not touched and no random number is drawn.

Inputs are ``observation`` (``observation.<key>`` of a Dict) in the environment's own dtype and layout, and for
recurrent policies ``state.<name>``; outputs are ``action`` and ``next_state.<name>``; the first axis is the batch.

Golden actions are what the trainer itself does on some observations; the graph is checked against them.
"""

import copy
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

from bam_train.errors import PolicyError
from bam_train.trainers.frozen_network import (
    Choice,
    Layer,
    OneHot,
    affordable,
    clearest,
    draw_array,
    onnx_file,
    pack,
    to,
    zeros,
)
from bam_train.trainers.zero_based_spaces import less_start, plus_start

_GOLDEN = 256  # golden actions, fewer if observations are large
_KINDS = "Box, Discrete, MultiDiscrete or MultiBinary"


def leaves(space: spaces.Space[Any]) -> dict[str, Any]:
    """The spaces in a Dict by key; any other space just by ``""``."""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {"": space}


class _Numbers(Layer):
    """A Box or MultiBinary: channels first, normalise in float64 as VecNormalize does, pixels to [0, 1], float32."""

    def __init__(self, statistics: Any, channels_last: bool, pixels: bool) -> None:
        super().__init__()
        self.statistics, self.channels_last, self.pixels = statistics, channels_last, pixels

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.channels_last:
            x = x.permute(0, 3, 1, 2)
        if self.statistics is not None:
            mean, deviation, limit = self.statistics
            x = ((to(x, torch.float64) - mean) / deviation).clamp(-limit, limit)
        x = to(x, torch.float32)
        return x / 255.0 if self.pixels else x


def _encoder(key: str, raw: spaces.Space[Any], seen: spaces.Space[Any], statistics: Any, scale: bool) -> nn.Module:
    """Return what turns an array of the environment's space `raw` into what the policy's feature extractor takes.

    The policy was built for the space `seen`: channels of an image may have been moved to the front.
    """
    if isinstance(raw, (spaces.Discrete, spaces.MultiDiscrete)):
        return OneHot(raw)
    if not isinstance(raw, (spaces.Box, spaces.MultiBinary)):
        raise PolicyError(f"observation {key!r}: a {type(raw).__name__} cannot be frozen; expected {_KINDS}")
    channels_last = raw.shape != seen.shape
    if channels_last and (len(raw.shape) != 3 or (raw.shape[2], *raw.shape[:2]) != seen.shape):
        raise PolicyError(
            f"observation {key!r}: the policy takes shape {seen.shape}, the environment gives {raw.shape}"
        )
    return _Numbers(statistics, channels_last, scale and is_image_space(seen))


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
        self.gates = nn.ModuleList()  # of each layer, one linear layer from (input, hidden) to the four gates
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
    """Return the module that owns the network, and copies of its feature extractor, its layers and its LSTM if any."""
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
    extractor, layers = (copy.deepcopy(one).cpu().eval().requires_grad_(False) for one in (extractor, layers))
    return owner, extractor, layers, None if lstm is None else _Lstm(copy.deepcopy(lstm).cpu())


def _mean_of_quantiles(layers: nn.Sequential, quantiles: int) -> nn.Sequential:
    """Fold the mean over quantiles into the last layer: the mean of linear functions is linear."""
    *hidden, last = copy.deepcopy(layers).cpu()
    mean = nn.utils.skip_init(nn.Linear, last.in_features, last.out_features // quantiles)
    weight = last.weight.detach().double().reshape(quantiles, mean.out_features, last.in_features).mean(0)
    mean.weight.data = weight.float()
    mean.bias.data = last.bias.detach().double().reshape(quantiles, mean.out_features).mean(0).float()
    return nn.Sequential(*hidden, mean)


class _Continuous(Layer):
    """Squash and scale, or only clip, as ``predict`` does; float64 where the space is."""

    def __init__(self, space: spaces.Box, tanh: bool, scale: bool) -> None:
        super().__init__()
        self.dtype = torch.float64 if space.dtype == np.float64 else torch.float32
        self.low, self.high = (torch.as_tensor(bound).to(self.dtype) for bound in (space.low, space.high))
        self.bounded = bool(np.isfinite(space.low).any()), bool(np.isfinite(space.high).any())
        self.shape, self.tanh, self.scale = space.shape, tanh, scale

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = torch.tanh(x) if self.tanh else x
        if len(self.shape) != 1:
            x = x.reshape(-1, *self.shape)
        x = to(x, self.dtype)
        if self.scale:
            x = self.low + (0.5 * (x + 1.0) * (self.high - self.low))
        x = torch.minimum(x, self.high) if self.bounded[1] else x  # scaled ones too: they can round past a bound
        return torch.maximum(x, self.low) if self.bounded[0] else x

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        return torch.ones(len(scores))


class _Switches(Layer):
    """A MultiBinary: on where the logit is positive, which is where the probability rounds to 1."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x > 0).to(torch.int8)

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        return scores.abs().amin(1)


def _head(space: spaces.Space[Any], policy: BasePolicy) -> nn.Module:
    """Return what turns the network's output into an action of the environment's space."""
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return Choice(space)
    if isinstance(space, spaces.MultiBinary):
        return _Switches()
    if not isinstance(space, spaces.Box):
        raise PolicyError(f"action space {space}: expected {_KINDS}")
    if isinstance(policy, ActorCriticPolicy):
        distribution = policy.action_dist
        tanh = isinstance(distribution, StateDependentNoiseDistribution) and distribution.bijector is not None
    else:  # TD3 and DDPG have theirs among the layers of `_network`
        tanh = hasattr(policy.actor, "latent_pi")
    return _Continuous(space, tanh, policy.squash_output)


def freeze(
    model: BaseAlgorithm,
    normaliser: VecNormalize | None,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
) -> bytes:
    """Write the model's deterministic policy as an ONNX file.

    Args:
        model: Of any algorithm of stable-baselines3 or sb3-contrib but ARS.
        normaliser: Normaliser of the observations, if any.
        observation_space: The environment's own, before any wrapper of SB3.
        action_space: The environment's own; its ``start`` is added to what SB3 counts from 0.

    Raises:
        PolicyError: The policy or a space is of a kind that cannot be frozen.
    """
    module = FrozenModule(model, normaliser, observation_space, action_space)
    inputs = zeros(module.raw, module.is_dict)
    for layer, size in enumerate(module.lstm.sizes if module.lstm is not None else []):
        inputs |= {f"state.{name}_{layer}": torch.zeros(2, size) for name in ("hidden", "cell")}
    outputs = ["action", *(f"next_{name}" for name in inputs if name.startswith("state."))]
    return onnx_file(module, inputs, outputs)


class FrozenModule(Layer):
    """A copy of a policy, on the CPU and in evaluation mode, from raw observations to actions."""

    def __init__(
        self,
        model: BaseAlgorithm,
        normaliser: VecNormalize | None,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
    ) -> None:
        super().__init__()
        policy = model.policy
        self.is_dict = isinstance(observation_space, spaces.Dict)
        self.raw, seen = leaves(observation_space), leaves(policy.observation_space)
        if set(seen) != set(self.raw):
            raise PolicyError(f"observation: the policy takes {sorted(seen)}, the environment gives {sorted(self.raw)}")
        owner, self.extractor, self.layers, self.lstm = _network(policy)
        self.encoders = nn.ModuleList()
        for key, space in self.raw.items():
            moments, statistics = _moments(normaliser, key), None
            if normaliser is not None and moments is not None:
                statistics = *map(torch.as_tensor, moments), float(normaliser.clip_obs)
            self.encoders.append(_encoder(key, space, seen[key], statistics, owner.normalize_images))
        self.head = _head(action_space, policy)
        self.eval()

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """Return what the action is made of, (n, outputs) float32: means, logits or values; not if recurrent."""
        return self.layers(self._features(observation))

    def forward(self, *inputs: torch.Tensor) -> Any:
        """Return the action, and of a recurrent policy the next state."""
        if self.lstm is None:
            return self.head(self.scores(*inputs))
        count = len(self.raw)
        output, state = self.lstm(self._features(inputs[:count]), inputs[count:])
        return self.head(self.layers(output)), *state

    def _features(self, observation: Any) -> torch.Tensor:
        encoded = [encoder(tensor) for encoder, tensor in zip(self.encoders, observation, strict=True)]
        return self.extractor(dict(zip(self.raw, encoded, strict=True)) if self.is_dict else encoded[0])


def _moments(normaliser: VecNormalize | None, key: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean and standard deviation (float64) that one leaf is normalised with; None if it is not."""
    if normaliser is None or not normaliser.norm_obs or (key and key not in normaliser.norm_obs_keys):
        return None
    rms = normaliser.obs_rms[key] if key else normaliser.obs_rms
    return rms.mean, np.sqrt(rms.var + normaliser.epsilon)


def golden(
    model: BaseAlgorithm,
    normaliser: VecNormalize | None,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
) -> bytes:
    """Draw observations, always the same, and record ``model.predict(..., deterministic=True)``.

    The arguments are those of `freeze`. The model is left as it was, and no random number of torch, NumPy or SB3 is
    drawn.

    Returns:
        A safetensors file with ``observation`` (or ``observation.<key>``), (n, ...), and ``action``, (n, ...); of a
        recurrent policy the steps of one episode.
    """
    recurrent = hasattr(model.policy, "lstm_actor")
    n = affordable(leaves(observation_space).values(), _GOLDEN)
    observations = draw(observation_space, n if recurrent else 2 * n, np.random.default_rng(0), normaliser)
    if not recurrent:
        observations = clearest(FrozenModule(model, normaliser, observation_space, action_space), observations, n)
    actions = trainer_actions(model, normaliser, observation_space, action_space, observations)
    return pack(observations, actions)


def draw(
    space: spaces.Space[Any], n: int, rng: np.random.Generator, normaliser: VecNormalize | None = None
) -> dict[str, np.ndarray]:
    """Draw n observations; the keys are those of a Dict, or just ``""``.

    Normalised numbers are drawn about their running mean, so that few of them end at the normaliser's limits.
    """
    return {key: draw_array(leaf, n, rng, _moments(normaliser, key)) for key, leaf in leaves(space).items()}


def trainer_actions(
    model: BaseAlgorithm,
    normaliser: VecNormalize | None,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    observations: dict[str, np.ndarray],
) -> np.ndarray:
    """Return the trainer's own actions for raw observations, in the environment's action space."""
    is_dict = isinstance(observation_space, spaces.Dict)
    seen = less_start(observation_space, observations if is_dict else observations[""])
    if normaliser is not None:
        transpose = unwrap_vec_wrapper(normaliser, VecTransposeImage)
        seen = normaliser.normalize_obs(seen if transpose is None else transpose.transpose_observations(seen))
    modes = [(module, module.training) for module in model.policy.modules()]
    try:
        if hasattr(model.policy, "lstm_actor"):  # one episode, an observation a step
            state, each = None, []
            for t in range(len(next(iter(observations.values())))):
                one = {key: array[t : t + 1] for key, array in seen.items()} if is_dict else seen[t : t + 1]
                action, state = model.predict(one, state, episode_start=np.array([t == 0]), deterministic=True)
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
