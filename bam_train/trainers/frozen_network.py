"""Freezing a policy of any library: common layers, the ONNX file, golden observations."""

import io
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import nn

from bam_train.checkpoint import safetensors_file


class Layer(nn.Module):  # type: ignore[misc]
    """A torch module; torch has no types here."""


class OneHot(Layer):
    """A Discrete, (n,), or MultiDiscrete, (n, k): a one-hot code of each number, side by side."""

    def __init__(self, space: spaces.Discrete[Any] | spaces.MultiDiscrete) -> None:
        super().__init__()
        counts = np.ravel(space.n if isinstance(space, spaces.Discrete) else space.nvec)
        starts = np.ravel(space.start)
        columns = np.repeat(np.arange(len(counts)), counts)
        values = np.concatenate([np.arange(count) + start for count, start in zip(counts, starts, strict=True)])
        self.columns, self.values = torch.as_tensor(columns), torch.as_tensor(values)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Encode whole numbers."""
        x = x.long()
        x = x.unsqueeze(1) if x.ndim == 1 else x.flatten(1)
        return (x.index_select(1, self.columns) == self.values).float()


class Choice(Layer):
    """The best of each group of scores, counted from ``start``: Discrete gives (n,), MultiDiscrete (n, k)."""

    def __init__(self, space: spaces.Discrete[Any] | spaces.MultiDiscrete) -> None:
        super().__init__()
        self.single = isinstance(space, spaces.Discrete)
        self.counts: list[int] = [int(space.n)] if isinstance(space, spaces.Discrete) else space.nvec.tolist()
        self.dtype = torch.int64 if self.single else torch.as_tensor(np.zeros((), space.dtype)).dtype
        self.starts, self.shifted = torch.as_tensor(np.asarray(space.start)), bool(np.any(space.start))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Choose."""
        if self.single:
            best = x.argmax(1)
        else:
            best = torch.cat([group.argmax(1, keepdim=True) for group in x.split(self.counts, dim=1)], 1)
        return to(best + self.starts if self.shifted else best, self.dtype)

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        """How clear the choice is: the least distance of a best score from the second."""
        gaps = [group.topk(2)[0] for group in scores.split(self.counts, dim=1) if group.shape[1] > 1]
        return torch.stack([gap[:, 0] - gap[:, 1] for gap in gaps]).amin(0) if gaps else torch.ones(len(scores))


def zeros(observation: Mapping[str, Any], is_dict: bool) -> dict[str, torch.Tensor]:
    """Two observations of zeros: an array for every input of the frozen policy, by name."""
    arrays = {key: np.zeros((2, *space.shape), space.dtype) for key, space in observation.items()}
    return {f"observation.{key}" if is_dict else "observation": torch.as_tensor(one) for key, one in arrays.items()}


def to(x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Cast, without leaving a node in the graph where there is nothing to do."""
    return x if x.dtype == dtype else x.to(dtype)


# The TorchScript exporter says that it will go; it is 20 times as fast as its successor and needs no onnxscript.
_NOTICES = ("You are using the legacy TorchScript-based ONNX export", "The feature will be removed")


def onnx_file(
    module: nn.Module,
    inputs: Mapping[str, torch.Tensor],
    outputs: Sequence[str],
    quiet: Mapping[str, Any] | None = None,
) -> bytes:
    """Trace a module on the CPU into an ONNX file; the first axis of every input and output is the batch.

    Args:
        module: The module.
        inputs: An example of each, in the order of ``forward``, by name.
        outputs: Their names.
        quiet: Beginnings of warnings that say nothing here, with their categories.
    """
    file = io.BytesIO()
    with torch.no_grad(), warnings.catch_warnings():
        for text, category in (dict.fromkeys(_NOTICES, DeprecationWarning) | dict(quiet or {})).items():
            warnings.filterwarnings("ignore", text, category)
        torch.onnx.export(
            module,
            tuple(inputs.values()),
            file,
            dynamo=False,
            opset_version=17,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes={name: {0: "n"} for name in [*inputs, *outputs]},
        )
    return file.getvalue()


_BUDGET = 200_000  # bytes of observations; images are random and do not pack
_FAR = 1e6  # a bound beyond this says nothing about the values that occur

Array = NDArray[Any]


def affordable(observation: Iterable[Any], n: int) -> int:
    """How many of `n` observations to record, of arrays in these spaces: fewer if they are large."""
    size = sum(math.prod(leaf.shape or ()) * np.dtype(leaf.dtype).itemsize for leaf in observation)
    return min(n, max(4, _BUDGET // (size or 1)))


def draw_array(space: Any, n: int, rng: np.random.Generator, moments: tuple[Array, Array] | None) -> Array:
    """Draw n values of a space that is no Dict, (n, ...).

    Numbers that the policy normalises have `moments`, mean and deviation, so that few of them end at its limits.
    """
    shape = (n, *space.shape)
    if isinstance(space, spaces.MultiBinary):
        return rng.integers(2, size=shape, dtype=np.int8)
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
        return np.asarray(space.start + rng.integers(counts, size=shape), space.dtype)
    if np.issubdtype(space.dtype, np.integer):
        return np.asarray(rng.integers(space.low, space.high, size=shape, dtype=space.dtype, endpoint=True))
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    values = rng.normal(size=shape)
    if moments is not None:
        values = moments[0] + 2.0 * moments[1] * values
    else:
        near = (low > -_FAR) & (high < _FAR)
        start, stop = np.where(near, low, 0.0), np.where(near, high, 1.0)
        values = np.where(near, start + (stop - start) * rng.random(shape), values)
    return np.asarray(np.clip(values, low, high).astype(space.dtype))


def clearest(module: Any, observations: Mapping[str, Array], n: int) -> dict[str, Array]:
    """The n observations whose choice is clearest: where two choices tie, rounding decides, and that proves nothing.

    The module is a frozen policy with ``scores`` and ``head.margin``; the observations are (m, ...) each, by key.
    """
    with torch.no_grad():
        margin = module.head.margin(module.scores(*map(torch.as_tensor, observations.values()))).numpy()
    keep = np.sort(np.argsort(-margin, kind="stable")[:n])
    return {key: value[keep] for key, value in observations.items()}


def pack(observations: Mapping[str, Array], actions: Array) -> bytes:
    """Write golden observations, by key of a Dict or just ``""``, and their actions, (n, ...) each, as safetensors."""
    named = {f"observation.{key}" if key else "observation": value for key, value in observations.items()}
    return safetensors_file.dump({**named, "action": actions})
