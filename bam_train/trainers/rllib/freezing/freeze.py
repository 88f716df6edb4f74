"""Turn one policy of RLlib into one ONNX graph: raw observation in, deterministic action out.

The graph holds what RLlib does with ``explore=False``: its connectors (one-hot codes, flattening, `MeanStdFilter`), the
actor's network, the distribution's deterministic action, and the stretching or clipping to the action space. Its input
is ``observation`` (``observation.<key>`` of a Dict) in the environment's own dtype and layout, its output ``action``;
the first axis is the batch.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from gymnasium import spaces

from bam_train.errors import PolicyError
from bam_train.trainers.freezing.layers import Layer, zeros
from bam_train.trainers.freezing.onnx_export import onnx_file
from bam_train.trainers.rllib.freezing.layers import encoder, head, outputs_of
from bam_train.trainers.rllib.freezing.network import network
from bam_train.trainers.rllib.freezing.parts import PolicyParts, leaf_spaces

__all__ = ["FrozenModule", "freeze"]

_SAYS_NOTHING = {
    "Constant folding - Only steps=1 can be constant folded": UserWarning,  # of the padding of images
    "": torch.jit.TracerWarning,  # whether outputs are cut off never changes
}


def freeze(parts: PolicyParts) -> bytes:
    """Write a policy as an ONNX file.

    Raises:
        PolicyError: The network, a connector or a space is of a kind that cannot be frozen.
    """
    module = FrozenModule(parts)
    return onnx_file(module, module.example_inputs(), ["action"], _SAYS_NOTHING)


class FrozenModule(Layer):
    """A policy on the CPU, from raw observations to actions; a copy that shares nothing with the live one."""

    def __init__(self, parts: PolicyParts) -> None:
        super().__init__()
        self.raw = leaf_spaces(parts.observation_space)
        self.is_dict = isinstance(parts.observation_space, spaces.Dict)
        self.observation = encoder(parts)
        self.network = copy.deepcopy(network(parts)).cpu()
        self.head = head(parts)
        self.outputs, self.more = outputs_of(parts), parts.module is not None
        self.eval().requires_grad_(False)
        self._require_fit()

    def example_inputs(self) -> dict[str, torch.Tensor]:
        """Two rows of zeros for every input, by name."""
        return zeros(self.raw, self.is_dict)

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """Return what the action is made of, (n, k) float32: means, logits or values."""
        scores = self.network(self.observation(observation))
        return scores[:, : self.outputs] if self.more else scores

    def forward(self, *observation: torch.Tensor) -> Any:
        """Return the action, (n, ...)."""
        return self.head(self.scores(*observation))

    def _require_fit(self) -> None:
        """Run once: weights, observation and action space must belong together."""
        try:
            with torch.no_grad():
                self(*self.example_inputs().values())
        except PolicyError:
            raise
        except (RuntimeError, ValueError, TypeError, IndexError, KeyError) as error:
            reason = " ".join(str(error).split())
            raise PolicyError(f"the weights do not fit the spaces: {reason:.200}") from error
