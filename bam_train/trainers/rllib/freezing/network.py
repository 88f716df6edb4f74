"""RLlib's own networks, built again from their weights: what leads from an encoded observation to the action's scores.

Nothing is imported from ray: layers are known by the names of their weights, activations and strides by the model
config. A network that cannot be known in this way is refused, or traced where the live module is there. The file is
long because it has a part for each kind: dense, images, distributional, traced, and those of the old stack.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import nn

from bam_train.errors import PolicyError
from bam_train.trainers.freezing.layers import Layer
from bam_train.trainers.rllib.freezing.layers import outputs_of
from bam_train.trainers.rllib.freezing.parts import Array, PolicyParts, leaf_spaces

_EPSILON = 1e-3  # of RLlib's layer norms
# Where the actor's encoder and its head are: PPO and its relatives with separate and shared encoders; SAC, CQL and IQL;
# BC; DQN. The first whose names are there is taken.
_PLACES = (
    ("encoder.actor_encoder.", "pi."),
    ("encoder.encoder.", "pi."),
    ("pi_encoder.", "pi."),
    ("_encoder.", "_pi_head."),
    ("encoder.", "af."),
)
_ACTIVATIONS = {"swish": "SiLU", "silu": "SiLU", "relu": "ReLU", "tanh": "Tanh", "elu": "ELU"}


def network(parts: PolicyParts) -> nn.Module:
    """Return what leads from an encoded observation, (n, ...) float32, to scores: means, logits or values, (n, k).

    Raises:
        PolicyError: The weights are not those of one of RLlib's own networks.
    """
    if parts.module is not None:
        return _Traced(parts.module)
    if parts.old_stack:
        return _old_network(parts)
    names = list(parts.weights)
    for encoder, head in _PLACES:
        if any(name.startswith(encoder) for name in names) and any(name.startswith(head) for name in names):
            return _new_network(parts, encoder, head)
    raise PolicyError(f"the weights are not of a network of RLlib's own: {_few(names)}")


def _new_network(parts: PolicyParts, encoder: str, head: str) -> nn.Module:
    config, weights = parts.model_config, parts.weights
    if any(name.startswith((f"{encoder}lstm.", f"{encoder}gru.", f"{encoder}tokenizer.")) for name in weights):
        raise PolicyError("a recurrent network of RLlib cannot be frozen; train without use_lstm")
    if any(name.startswith(f"{encoder}net.0.cnn.") for name in weights):
        body = [_Images(parts, f"{encoder}net.0.cnn.")]
    else:
        body = [_dense(weights, f"{encoder}net.mlp.", config.get("fcnet_activation", "tanh"), output=False)]
    atoms = int(config.get("num_atoms") or 1) if head == "af." else 1
    if atoms > 1:
        return nn.Sequential(*body, _Atoms(parts, head, atoms))
    # Of a Gaussian the second half are log deviations; of a dueling network the value adds the same to every choice.
    activation = config.get("head_fcnet_activation", "relu")
    body.append(_dense(weights, f"{head}net.mlp.", activation, output=True, keep=outputs_of(parts)))
    return nn.Sequential(*body)


def _dense(
    weights: Mapping[str, Array], prefix: str, activation: Any, *, output: bool, keep: int | None = None
) -> nn.Sequential:
    """RLlib's `TorchMLP`: linear layers, each with its layer norm if it has one, then its activation.

    Args:
        weights: Of the whole module.
        prefix: Of the layers' names; a number follows.
        activation: The config's word for it.
        output: The last layer has no activation.
        keep: Outputs of the last layer that are wanted; the first ones.
    """
    numbers = sorted({int(name[len(prefix) :].split(".")[0]) for name in weights if name.startswith(prefix)})
    if not numbers:
        raise PolicyError(f"the weights lack {prefix}0.weight")
    layers: list[nn.Module] = []
    linear = [number for number in numbers if _weight(weights, f"{prefix}{number}.weight").ndim == 2]
    for number in numbers:
        weight, bias = _weight(weights, f"{prefix}{number}.weight"), weights.get(f"{prefix}{number}.bias")
        last = number == linear[-1]
        if weight.ndim == 1:
            layers.append(_norm(weight, bias))
        else:
            layers.append(_linear(weight, bias, keep if last else None))
        if number + 1 not in numbers and not (output and number >= linear[-1]):
            layers += _activation(activation)
    return nn.Sequential(*layers)


def _weight(weights: Mapping[str, Array], name: str) -> Array:
    if name not in weights:
        raise PolicyError(f"the weights lack {name}")
    return weights[name]


def _linear(weight: Array, bias: Array | None, keep: int | None = None) -> nn.Linear:
    if keep is not None and len(weight) < keep:
        raise PolicyError(f"the last layer has {len(weight)} outputs, expected {keep} or more for the action space")
    weight = weight[:keep]
    layer = nn.utils.skip_init(nn.Linear, weight.shape[1], weight.shape[0], bias=bias is not None)
    layer.weight.data = _tensor(weight)
    if bias is not None:
        layer.bias.data = _tensor(bias[:keep])
    return layer


def _norm(weight: Array, bias: Array | None) -> nn.LayerNorm:
    layer = nn.LayerNorm(len(weight), eps=_EPSILON, bias=bias is not None)
    layer.weight.data = _tensor(weight)
    if bias is not None:
        layer.bias.data = _tensor(bias)
    return layer


def _tensor(array: Array) -> torch.Tensor:
    return torch.from_numpy(np.array(array, np.float32))


def _activation(name: Any) -> list[nn.Module]:
    """The layer that RLlib's `get_activation_fn` makes of a name; none for linear."""
    if name is None or name == "linear":
        return []
    kind = getattr(nn, name if hasattr(nn, str(name)) else _ACTIVATIONS.get(str(name).lower(), ""), None)
    if not isinstance(name, str) or not isinstance(kind, type) or not issubclass(kind, nn.Module):
        known = "tanh, relu, elu, swish, silu, linear or the name of a torch activation"
        raise PolicyError(f"activation {name!r} is not known; expected {known}")
    try:
        layer: nn.Module = kind()
    except TypeError as error:
        raise PolicyError(f"activation {name!r} cannot be made without arguments") from error
    if any(True for _ in layer.parameters()):
        raise PolicyError(f"activation {name!r} has weights of its own and cannot be frozen")
    return [layer]


class _Images(Layer):
    """RLlib's `TorchCNN` and its flattening: padded as TensorFlow pads, channels last in and out."""

    def __init__(self, parts: PolicyParts, prefix: str) -> None:
        super().__init__()
        (space,) = leaf_spaces(parts.observation_space).values()
        config, weights, shape = parts.model_config, parts.weights, tuple(space.shape or ())
        filters = config.get("conv_filters") or default_filters(shape)
        numbers = sorted(
            int(match[1]) for name in weights if (match := re.fullmatch(re.escape(prefix) + r"(\d+)\.weight", name))
        )
        if len(numbers) != len(filters):
            raise PolicyError(f"conv_filters: expected {len(numbers)} layers as in the weights, found {len(filters)}")
        size, layers = list(shape[:2]), []
        for number, (_, kernel, stride, *padding) in zip(numbers, filters, strict=True):
            pad, size = _padding(size, _pair(kernel), _pair(stride), padding[0] if padding else "same")
            layers += [nn.ZeroPad2d(pad)] if any(pad) else []
            layers.append(_convolution(weights, f"{prefix}{number}.", _pair(stride)))
            layers += _activation(config.get("conv_activation", "relu"))
        self.layers = nn.Sequential(*layers)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1).flatten(1)


def _convolution(weights: Mapping[str, Array], prefix: str, stride: tuple[int, int]) -> nn.Conv2d:
    weight, bias = _weight(weights, f"{prefix}weight"), weights.get(f"{prefix}bias")
    if weight.ndim != 4:
        raise PolicyError(f"{prefix}weight: a layer norm among convolutions cannot be frozen")
    layer = nn.utils.skip_init(
        nn.Conv2d, weight.shape[1], weight.shape[0], weight.shape[2:], stride, bias=bias is not None
    )
    layer.weight.data = _tensor(weight)
    if bias is not None:
        layer.bias.data = _tensor(bias)
    return layer


def _pair(value: Any) -> tuple[int, int]:
    first, second = (value, value) if np.ndim(value) == 0 else value
    return int(first), int(second)


def _padding(
    size: list[int], kernel: tuple[int, int], stride: tuple[int, int], word: str
) -> tuple[tuple[int, int, int, int], list[int]]:
    """Left, right, top and bottom padding, and the size after the layer; ``same`` rounds up, ``valid`` does not pad."""
    if word != "same":
        return (0, 0, 0, 0), [-(-(s - k + 1) // step) for s, k, step in zip(size, kernel, stride, strict=True)]
    after = [-(-s // step) for s, step in zip(size, stride, strict=True)]
    whole = [(n - 1) * step + k - s for n, step, k, s in zip(after, stride, kernel, size, strict=True)]
    top, left = whole[0] // 2, whole[1] // 2
    return (left, whole[1] - left, top, whole[0] - top), after


def default_filters(shape: tuple[int, ...]) -> list[list[int]]:
    """Channels, kernel and stride of the layers that RLlib chooses for an image, ``get_filter_config``."""
    table = {
        96: [[16, 8, 4], [32, 4, 2], [256, 11, 2]],
        84: [[16, 8, 4], [32, 4, 2], [256, 11, 1]],
        64: [[16, 4, 2], [32, 4, 2], [64, 4, 2], [128, 4, 2]],
        42: [[16, 4, 2], [32, 4, 2], [256, 11, 1]],
        10: [[16, 5, 2], [32, 5, 2]],
    }
    for size, filters in table.items():
        if list(shape[:2]) == [size, size] or list(shape[1:]) == [size, size]:
            return filters
    raise PolicyError(f"conv_filters: RLlib has no default for images of shape {shape}, and the config names none")


class _Atoms(Layer):
    """Distributional DQN: the mean of each choice's distribution over equally spaced values."""

    def __init__(self, parts: PolicyParts, head: str, atoms: int) -> None:
        super().__init__()
        config, activation = parts.model_config, parts.model_config.get("head_fcnet_activation", "relu")
        self.shape = (outputs_of(parts), atoms)
        self.advantage = _dense(parts.weights, f"{head}net.mlp.", activation, output=True)
        dueling = bool(config.get("dueling", True)) and any(name.startswith("vf.") for name in parts.weights)
        self.value = _dense(parts.weights, "vf.net.mlp.", activation, output=True) if dueling else None
        low, high = float(config.get("v_min", -10.0)), float(config.get("v_max", 10.0))
        steps = torch.arange(0.0, atoms, dtype=torch.float32)
        self.support = low + steps * (high - low) / float(atoms - 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        logits = self.advantage(x).reshape(-1, *self.shape)
        if self.value is not None:
            logits = logits - logits.mean(dim=-1, keepdim=True) + self.value(x).unsqueeze(2)
        return (self.support * logits.softmax(-1)).sum(-1)


class _Traced(Layer):
    """A module that is not RLlib's own, as it acts: its means, logits or actions."""

    def __init__(self, module: Any) -> None:
        super().__init__()
        self.module = module

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        outputs = self.module._forward_inference({"obs": x})
        if "action_dist_inputs" not in outputs:
            raise PolicyError(f"{type(self.module).__name__} gives no action_dist_inputs and cannot be frozen")
        return outputs["action_dist_inputs"]


# The old stack: every layer is a `SlimFC`, a linear layer and its activation


def _old_network(parts: PolicyParts) -> nn.Module:
    """`FullyConnectedNetwork`, of SAC and CQL the actor's; of DQN with the layers of its advantages."""
    weights, config = parts.weights, parts.model_config
    at = "action_model." if any(name.startswith("action_model.") for name in weights) else ""
    _require_old(weights, config, at)
    activation = config.get("fcnet_activation" if config.get("fcnet_hiddens") else "post_fcnet_activation")
    layers = [*_slim(weights, rf"{at}_hidden_layers\.(\d+)\.", activation)]
    keep = outputs_of(parts)
    if "advantage_module.A._model.0.weight" in weights:
        layers += _slim(weights, r"advantage_module\.dueling_A_(\d+)\.", "relu")
        layers.append(_slim_linear(weights, "advantage_module.A.", keep))
    elif f"{at}_logits._model.0.weight" in weights:
        layers.append(_slim_linear(weights, f"{at}_logits.", keep))
    return nn.Sequential(*layers)


def _require_old(weights: Mapping[str, Array], config: Mapping[str, Any], at: str) -> None:
    """Refuse what is more than layers one after the other."""
    refused = {
        "custom_model": bool(config.get("custom_model")),
        "custom_action_dist": bool(config.get("custom_action_dist")),
        "use_lstm": bool(config.get("use_lstm")),
        "use_attention": bool(config.get("use_attention")),
        "noisy": bool(config.get("noisy")),
        "num_atoms > 1": int(config.get("num_atoms") or 1) > 1,
    }
    for name, found in refused.items():
        if found:
            raise PolicyError(f"a network of the old API stack with {name} cannot be frozen")
    if not any(name.startswith(f"{at}_hidden_layers.") for name in weights):
        text = "the weights are not of a FullyConnectedNetwork of the old API stack, and cannot be frozen"
        raise PolicyError(f"{text}: {_few(list(weights))}")


def _slim(weights: Mapping[str, Array], pattern: str, activation: Any) -> list[nn.Module]:
    """The layers whose names match, in the order of their numbers."""
    found = {int(match[1]): match[0] for name in weights if (match := re.match(pattern, name))}
    return [layer for _, at in sorted(found.items()) for layer in (_slim_linear(weights, at), *_activation(activation))]


def _slim_linear(weights: Mapping[str, Array], at: str, keep: int | None = None) -> nn.Linear:
    return _linear(_weight(weights, f"{at}_model.0.weight"), weights.get(f"{at}_model.0.bias"), keep)


def _few(names: list[str], most: int = 5) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")
