"""Freezing a policy of any library: the common layers and ONNX export, and golden observations.

A frozen policy has the inputs ``observation`` (``observation.<key>`` for a Dict) in the environment's dtype and layout,
and ``state.<name>`` if it is recurrent; its outputs are ``action`` and ``next_state.<name>``. The first axis is the
batch. Golden actions are the trainer's own for some observations; the graph is checked against them.
"""

import io
import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import nn

from bam_envs.core.spaces import leaves
from bam_train.checkpoint import safetensors_file
from bam_train.errors import PolicyError

Array = NDArray[Any]

KINDS = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_BUDGET = 200_000  # bytes of golden observations; images are random and cannot be compressed
_FAR = 1e6  # bounds beyond this are far from the values that occur
_HARMLESS_WARNINGS = {
    # The TorchScript exporter is deprecated, but 20 times as fast as its successor, and works without onnxscript.
    "You are using the legacy TorchScript-based ONNX export": DeprecationWarning,
    "The feature will be removed": DeprecationWarning,
    "Constant folding - Only steps=1 can be constant folded": UserWarning,  # about the padding of images
    "": torch.jit.TracerWarning,  # about branches on shapes, which are the same for every observation
}


def to(x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Cast to a dtype, without a node in the graph if the tensor has it already."""
    return x if x.dtype == dtype else x.to(dtype)


class Layer(nn.Module):  # type: ignore[misc]
    """Base class of layers, for the type checker, which has no types of torch."""


class OneHot(Layer):
    """One-hot codes of a Discrete, (n,), or MultiDiscrete, (n, k), concatenated for each observation."""

    def __init__(self, space: spaces.Discrete[Any] | spaces.MultiDiscrete) -> None:
        super().__init__()
        counts = np.ravel(space.n if isinstance(space, spaces.Discrete) else space.nvec)
        starts = np.ravel(space.start)
        columns = np.repeat(np.arange(len(counts)), counts)
        values = np.concatenate([np.arange(count) + start for count, start in zip(counts, starts, strict=True)])
        self.columns, self.values = torch.as_tensor(columns), torch.as_tensor(values)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Encode whole numbers; returns (n, number of choices) float32."""
        x = x.long()
        x = x.unsqueeze(1) if x.ndim == 1 else x.flatten(1)
        return (x.index_select(1, self.columns) == self.values).float()


class Normalised(Layer):
    """clip((x - mean) / deviation, -limit, limit) in float64, or without clipping if there is no limit."""

    def __init__(self, mean: Array, deviation: Array, limit: float | None) -> None:
        super().__init__()
        self.mean, self.deviation, self.limit = torch.as_tensor(mean), torch.as_tensor(deviation), limit

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalise numbers."""
        x = (to(x, torch.float64) - self.mean) / self.deviation
        return x.clamp(-self.limit, self.limit) if self.limit else x


def action_head(space: spaces.Space[Any], *, tanh: bool, scale: bool, clip: bool) -> nn.Module:
    """The layer that turns scores, (n, k), into actions of a space; `tanh`, `scale` and `clip` apply to a Box.

    Raises:
        PolicyError: The space is of another kind.
    """
    if isinstance(space, spaces.Box):
        return _Continuous(space, tanh, scale, clip)
    if isinstance(space, spaces.MultiBinary):
        return _Switches()
    if isinstance(space, spaces.Discrete) or (isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1):
        return _Choice(space)
    raise PolicyError(f"action space {space} cannot be frozen; expected {_KINDS_TEXT}")


class _Continuous(Layer):
    """Actions of a Box: tanh, scaling from [-1, 1] to the bounds, clipping; float64 if the space is."""

    def __init__(self, space: spaces.Box, tanh: bool, scale: bool, clip: bool) -> None:
        super().__init__()
        self.dtype = torch.float64 if space.dtype == np.float64 else torch.float32
        self.low, self.high = (torch.as_tensor(bound).to(self.dtype) for bound in (space.low, space.high))
        self.shape, self.tanh, self.scale, self.clip = space.shape, tanh, scale, clip

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = torch.tanh(x) if self.tanh else x
        x = x if len(self.shape) == 1 else x.reshape(-1, *self.shape)
        x = self.low + to(0.5 * (x + 1.0), self.dtype) * (self.high - self.low) if self.scale else to(x, self.dtype)
        return torch.maximum(torch.minimum(x, self.high), self.low) if self.clip else x


class _Choice(Layer):
    """The index of the best of each group of scores plus ``start``: (n,) for Discrete, (n, k) for MultiDiscrete."""

    def __init__(self, space: spaces.Discrete[Any] | spaces.MultiDiscrete) -> None:
        super().__init__()
        self.single = isinstance(space, spaces.Discrete)
        self.counts: list[int] = [int(space.n)] if isinstance(space, spaces.Discrete) else space.nvec.tolist()
        self.dtype = torch.int64 if self.single else torch.as_tensor(np.zeros((), space.dtype)).dtype
        self.starts, self.shifted = torch.as_tensor(np.asarray(space.start)), bool(np.any(space.start))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.single:
            best = x.argmax(1)
        else:
            best = torch.cat([group.argmax(1, keepdim=True) for group in x.split(self.counts, dim=1)], 1)
        return to(best + self.starts if self.shifted else best, self.dtype)

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        """The smallest difference between a best and a second score, (n,)."""
        gaps = [group.topk(2)[0] for group in scores.split(self.counts, dim=1) if group.shape[1] > 1]
        return torch.stack([gap[:, 0] - gap[:, 1] for gap in gaps]).amin(0) if gaps else torch.ones(len(scores))


class _Switches(Layer):
    """Actions of a MultiBinary: 1 where the logit is positive, that is where the probability rounds to 1."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x > 0).to(torch.int8)

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        return scores.abs().amin(1)


class FrozenNetwork(Layer):
    """A copy of a policy, on the CPU and in evaluation mode, from raw observations to actions.

    A subclass defines `head` and `scores`, and the `moments` of inputs that the policy normalises.
    """

    head: nn.Module

    def __init__(self, observation_space: spaces.Space[Any]) -> None:
        super().__init__()
        self.is_dict, self.leaves = isinstance(observation_space, spaces.Dict), leaves(observation_space)
        self.moments: dict[str, tuple[Array, Array]] = {}
        """Mean and deviation of the values of an observation, by key."""
        self.state: dict[str, torch.Tensor] = {}
        """Zeros (2, ...) for every array of a recurrent policy's state, by name."""
        for key, leaf in self.leaves.items():
            if not isinstance(leaf, KINDS):
                found = type(leaf).__name__
                raise PolicyError(f"observation {key!r}: a {found} cannot be frozen; expected {_KINDS_TEXT}")

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """The scores that the action is computed from, (n, k) float32: means, logits or values."""
        raise NotImplementedError

    def forward(self, *inputs: torch.Tensor) -> Any:
        """The action, (n, ...)."""
        return self.head(self.scores(*inputs))

    def example(self) -> tuple[torch.Tensor, ...]:
        """Two observations of zeros."""
        arrays = (np.zeros((2, *leaf.shape), leaf.dtype) for leaf in self.leaves.values())
        return tuple(map(torch.as_tensor, arrays))

    def onnx_file(self) -> bytes:
        """Trace the policy into an ONNX file."""
        names = [_input_name(key) for key in self.leaves] + [f"state.{name}" for name in self.state]
        outputs = ["action", *(f"next_state.{name}" for name in self.state)]
        return trace(self, (*self.example(), *self.state.values()), names, outputs)

    def draw(self, n: int, rng: np.random.Generator) -> dict[str, Array]:
        """Draw n observations by key, (n, ...) each."""
        return {key: draw_array(leaf, n, rng, self.moments.get(key)) for key, leaf in self.leaves.items()}

    def golden_observations(self, n: int = 256, given: Mapping[str, Array] | None = None) -> dict[str, Array]:
        """Draw n observations by key, (n, ...) each, with a fixed seed; fewer if they are large.

        For discrete actions, those with the clearest choice are taken, as rounding would decide a tie; of the `given`
        ones if there are any.
        """
        size = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in self.leaves.values())
        n, rng = min(n, max(4, _BUDGET // (size or 1))), np.random.default_rng(0)
        if self.state or isinstance(self.head, _Continuous):
            return self.draw(n, rng)
        drawn = self.draw(2 * n, rng) if given is None else {key: given[key] for key in self.leaves}
        with torch.no_grad():
            margin = self.head.margin(self.scores(*map(torch.as_tensor, drawn.values()))).numpy()
        keep = np.sort(np.argsort(-margin, kind="stable")[:n])
        return {key: value[keep] for key, value in drawn.items()}

    def members(self, n: int = 256, given: Mapping[str, Array] | None = None) -> tuple[bytes, bytes]:
        """The ONNX file, and `golden_observations` with `own_actions` for them, as safetensors."""
        observations = self.golden_observations(n, given)
        return self.onnx_file(), pack(observations, self.own_actions(observations))

    def own_actions(self, observations: Mapping[str, Array]) -> Array:
        """The actions of the library that trained the policy, here those that torch computes. Shape: (n, ...).

        If the policy is recurrent, the observations by key, (n, ...), are the steps of one episode.
        """
        batch = tuple(map(torch.as_tensor, observations.values()))
        state, actions = [one[:1] for one in self.state.values()], []
        with torch.no_grad():
            for one in zip(*(x.split(1) for x in batch), strict=True) if state else (batch,):
                outputs = self(*one, *state)
                action, *state = outputs if isinstance(outputs, tuple) else (outputs,)
                actions.append(action.numpy())
        return np.concatenate(actions)


def trace(
    module: nn.Module,
    example: tuple[torch.Tensor, ...],
    names: list[str],
    outputs: list[str],
    *,
    any_number: bool = True,
) -> bytes:
    """The ONNX file of a module, for `any_number` of observations at once, or for as many as the example has."""
    file = io.BytesIO()
    with torch.no_grad(), warnings.catch_warnings():
        for text, category in _HARMLESS_WARNINGS.items():
            warnings.filterwarnings("ignore", text, category)
        torch.onnx.export(
            module,
            example,
            file,
            dynamo=False,
            opset_version=17,
            input_names=names,
            output_names=outputs,
            dynamic_axes={name: {0: "n"} for name in [*names, *outputs]} if any_number else None,
        )
    return file.getvalue()


_KINDS_TEXT = "Box, Discrete, MultiDiscrete or MultiBinary"


def draw_array(space: Any, n: int, rng: np.random.Generator, moments: tuple[Array, Array] | None) -> Array:
    """Draw n values of a space other than a Dict, (n, ...).

    `moments` are the mean and deviation of numbers that the policy normalises; few values then exceed its limits.
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


def _input_name(key: str) -> str:
    return f"observation.{key}" if key else "observation"


def pack(observations: Mapping[str, Array], actions: Array) -> bytes:
    """Write golden observations by key and their actions, (n, ...) each, as safetensors."""
    named = {_input_name(key): value for key, value in observations.items()}
    return safetensors_file.dump({**named, "action": actions})
