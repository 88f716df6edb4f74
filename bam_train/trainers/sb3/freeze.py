"""Turn a trained stable-baselines3 model into one ONNX graph: raw observation in, deterministic action out.

The graph holds the whole path of ``model.predict(..., deterministic=True)``, with what lies around it: `VecNormalize`,
`VecTransposeImage`, one-hot codes, the network, squashing, and the action space's bounds. It is traced from a copy on
the CPU: the model is not touched and no random number is drawn.

Inputs are ``observation`` (``observation.<key>`` of a Dict) in the environment's own dtype and layout, and for
recurrent policies ``state.<name>``; outputs are ``action`` and ``next_state.<name>``; the first axis is the batch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from bam_train.errors import PolicyError
from bam_train.trainers.freezing.layers import Layer, zeros
from bam_train.trainers.freezing.onnx_export import onnx_file
from bam_train.trainers.sb3.frozen_layers import encoder, head, leaves, network

__all__ = ["FrozenModule", "freeze"]


def freeze(
    model: BaseAlgorithm,
    normaliser: VecNormalize | None,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
) -> bytes:
    """Write the model's deterministic policy as an ONNX file.

    Args:
        model: Of any algorithm of stable-baselines3 or sb3-contrib but ARS.
        normaliser: What the observations were normalised with, if anything.
        observation_space: The environment's own, before any wrapper of SB3.
        action_space: The environment's own; its ``start`` is added to what SB3 counts from 0.

    Raises:
        PolicyError: The policy or a space is of a kind that cannot be frozen.
    """
    module = FrozenModule(model, normaliser, observation_space, action_space)
    inputs = module.example_inputs()
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
        self.raw = leaves(observation_space)
        seen = leaves(policy.observation_space)
        if set(seen) != set(self.raw):
            raise PolicyError(f"observation: the policy takes {sorted(seen)}, the environment gives {sorted(self.raw)}")
        owner, extractor, layers, self.lstm = network(policy)
        scale = owner.normalize_images
        self.encoders = nn.ModuleList(
            encoder(key, space, seen[key], _statistics(normaliser, key), scale) for key, space in self.raw.items()
        )
        self.is_dict = isinstance(observation_space, spaces.Dict)
        self.extractor, self.layers = extractor, layers
        self.head = head(action_space, policy)
        self.eval()

    def example_inputs(self) -> dict[str, torch.Tensor]:
        """Two rows of zeros for every input, by name."""
        inputs = zeros(self.raw, self.is_dict)
        for layer, size in enumerate(self.lstm.sizes if self.lstm is not None else []):
            inputs |= {f"state.{name}_{layer}": torch.zeros(2, size) for name in ("hidden", "cell")}
        return inputs

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


def _statistics(normaliser: VecNormalize | None, key: str) -> Any:
    """Return mean, standard deviation (float64) and limit of one leaf; None if it is not normalised."""
    if normaliser is None or not normaliser.norm_obs:
        return None
    if key and key not in normaliser.norm_obs_keys:
        return None
    rms = normaliser.obs_rms[key] if key else normaliser.obs_rms
    deviation = np.sqrt(rms.var + normaliser.epsilon)
    return torch.as_tensor(rms.mean), torch.as_tensor(deviation), float(normaliser.clip_obs)
