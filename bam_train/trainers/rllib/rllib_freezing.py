"""One policy of RLlib as one ONNX graph: raw observation in, deterministic action out; and RLlib's own actions.

The graph holds what RLlib does with ``explore=False``: its connectors (one-hot codes, flattening, `MeanStdFilter`), the
module's forward pass, which is traced, the distribution's deterministic action, and the scaling or clipping to the
action space. Its input is ``observation`` (``observation.<key>`` of a Dict) in the environment's own dtype and layout,
its output ``action``; the first axis is the batch. `RLlibPolicy` computes the same with RLlib's own code, and the
actions that it gives for random observations (`golden`) are what every frozen policy is checked against.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import nn

from bam_train.errors import PolicyError, SettingsError
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
from bam_train.trainers.rllib.state_pickles import unpacked_array
from bam_train.trainers.zero_based_spaces import less_start, plus_start

Array = NDArray[Any]
AnySpace = spaces.Space[Any]

POLICY_ID = "default_policy"
"""RLlib's name of the one policy of a run that did not name any."""

_SMALL_NUMBER = 1e-6  # ray.rllib.utils.numpy.SMALL_NUMBER, which MeanStdFilter adds to the deviation
# What RLlib adds to every pipeline: these connectors change the layout of observations and actions, not their values.
_LAYOUT = frozenset(
    {
        *("AddObservationsFromEpisodesToBatch", "AddStatesFromEpisodesToBatch", "AddTimeDimToBatchAndZeroPad"),
        *("BatchIndividualItems", "NumpyToTensor", "GetActions", "ListifyDataForVectorEnv", "ModuleToAgentUnmapping"),
        *("RemoveSingleTsTimeRankFromBatch", "TensorToNumpy", "UnBatchToIndividualItems"),
    }
)
_HARMLESS_WARNINGS = {
    "Constant folding - Only steps=1 can be constant folded": UserWarning,  # about the padding of images
    "": torch.jit.TracerWarning,  # about branches on shapes, which are the same for every observation
}


# What a policy is made of


@dataclass(frozen=True)
class Filter:
    """A `MeanStdFilter` that has stopped learning: clip((x - offset) / divisor, -limit, limit), in float64."""

    offset: Array
    """Mean of the observations seen, or zeros, float64. Shape: the observation's."""
    divisor: Array
    """Their deviation + 1e-6, or ones, float64. Shape: the observation's."""
    limit: float | None
    """`clip_by_value`; 0 and None do not clip."""
    center: bool
    """`de_mean_to_zero`."""
    scale: bool
    """`de_std_to_one`."""

    @classmethod
    def of(cls, stats: Mapping[str, Any], limit: float | None, center: bool, scale: bool) -> Filter:
        """The filter with these statistics, RLlib's `RunningStat` as a state; it computes the deviation in float32."""
        count = int(stats["num_pushes"])
        mean, squares = (unpacked_array(stats[name]) for name in ("mean_array", "sum_sq_diff_array"))
        variance = squares / (count - 1.0) if count > 1 else np.zeros(squares.shape)
        deviation = np.sqrt(np.maximum(variance.astype(np.float32), 0)) + np.float32(_SMALL_NUMBER)
        offset = mean if center else np.zeros(mean.shape)
        divisor = deviation if scale else np.ones(mean.shape)
        return cls(offset.astype(np.float64), divisor.astype(np.float64), limit, bool(center), bool(scale))


@dataclass(frozen=True)
class PolicyParts:
    """One policy of RLlib, with everything that its deterministic action depends on."""

    algorithm: str
    """Name of the algorithm, such as ppo; "" if unknown."""
    observation_space: AnySpace
    """The environment's own, before any connector."""
    action_space: AnySpace
    """The environment's own."""
    network: Any
    """Torch module from encoded observations (n, ...) float32 to means, logits or values (n, k)."""
    filter: Filter | None = None
    """What normalises observations."""
    flatten: bool = False
    """Observations become one vector: keys in alphabetical order, whole numbers one-hot."""
    filter_first: bool = False
    """The filter comes before the flattening."""
    normalize_actions: bool = True
    """Actions from -1 to 1 are scaled to the bounds of the action space."""
    clip_actions: bool = False
    """Actions that are not scaled are clipped to the bounds."""


def parts_of(module: Any, env_to_module: Any, config: Any, env_spaces: tuple[AnySpace, AnySpace]) -> PolicyParts:
    """The parts of a live policy; arguments as of `RLlibPolicy`.

    Raises:
        PolicyError: The network, a connector or a space is of a kind that cannot be frozen.
    """
    module = module.unwrapped() if hasattr(module, "unwrapped") else module
    if module.is_stateful():
        raise PolicyError("a recurrent network of RLlib cannot be frozen; train without use_lstm")
    return PolicyParts(
        algorithm=config.algo_class.__name__.lower() if config.algo_class else "",
        observation_space=env_spaces[0],
        action_space=env_spaces[1],
        network=_Network(module),
        normalize_actions=bool(config.normalize_actions),
        clip_actions=bool(config.clip_actions),
        **_preprocessing([] if env_to_module is None else list(env_to_module.connectors)),
    )


def _preprocessing(connectors: list[Any]) -> dict[str, Any]:
    """The fields of `PolicyParts` about what comes before the network."""
    found: dict[str, Any] = {}
    for piece in connectors:
        kinds = [base.__name__ for base in type(piece).__mro__]  # ours is a subclass of RLlib's filter
        name, field = ("MeanStdFilter", "filter") if "MeanStdFilter" in kinds else ("FlattenObservations", "flatten")
        if name not in kinds:
            require_layout_only(piece)
            continue
        if field in found:
            raise PolicyError(f"connectors {name}, {name} cannot be frozen: expected one of them")
        if field == "filter":
            found["filter"] = _filter_of(piece)
            continue
        if getattr(piece, "_keys_to_remove", None):
            raise PolicyError("FlattenObservations that removes keys cannot be frozen")
        found |= {"flatten": True, "filter_first": "filter" in found}
    return found


def require_layout_only(piece: Any, known: Sequence[str] = ()) -> None:
    """Refuse a connector that changes values in another way than the `known` ones."""
    name = type(piece).__name__
    if name not in _LAYOUT and name not in known:
        raise PolicyError(f"connector {name} cannot be frozen; expected FlattenObservations or MeanStdFilter")


def _filter_of(connector: Any) -> Filter:
    agents = list(connector.get_state().values())
    if len(agents) != 1:
        raise PolicyError(f"MeanStdFilter: expected one agent, found {len(agents)}")
    own, stats = agents[0], agents[0]["running_stats"]
    if len(stats) != 1:
        raise PolicyError(f"MeanStdFilter: expected one array, found {len(stats)}; put FlattenObservations before it")
    return Filter.of(stats[0], own["clip_by_value"], own["de_mean_to_zero"], own["de_std_to_one"])


def leaf_spaces(space: AnySpace) -> dict[str, AnySpace]:
    """The spaces in a Dict by key, in alphabetical order as RLlib takes them; any other space as ``""`` alone.

    Raises:
        PolicyError: A Dict in a Dict, or a Tuple.
    """
    leaves = {key: space[key] for key in sorted(space.spaces)} if isinstance(space, spaces.Dict) else {"": space}
    for key, leaf in leaves.items():
        if not isinstance(leaf, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            text = "expected Box, Discrete, MultiDiscrete or MultiBinary or a Dict of them"
            raise PolicyError(f"observation {key!r}: a {type(leaf).__name__} cannot be frozen; {text}")
    return leaves


# The graph


def freeze(parts: PolicyParts) -> bytes:
    """Write a policy as an ONNX file.

    Raises:
        PolicyError: The network or a space is of a kind that cannot be frozen.
    """
    module = FrozenModule(parts)
    return onnx_file(module, module.inputs, ["action"], _HARMLESS_WARNINGS)


class FrozenModule(Layer):
    """A policy on the CPU, from raw observations to actions; a copy that shares nothing with the live one.

    Attributes:
        inputs: A batch of two zeros for every input, by name.
    """

    def __init__(self, parts: PolicyParts) -> None:
        super().__init__()
        leaves = leaf_spaces(parts.observation_space)
        self.inputs = zeros(leaves, isinstance(parts.observation_space, spaces.Dict))
        self.observation = _Observation(parts, leaves)
        self.network = copy.deepcopy(parts.network).cpu()
        self.head = _head(parts)
        self.outputs = spaces.flatdim(parts.action_space)
        self.eval().requires_grad_(False)
        try:  # once: weights, observation and action space must belong together
            with torch.no_grad():
                found = self.scores(*self.inputs.values()).shape[1]
                self(*self.inputs.values())
        except PolicyError:
            raise
        except (RuntimeError, ValueError, TypeError, IndexError, KeyError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise PolicyError(f"the weights do not fit the spaces: {reason:.200}") from error
        if found < self.outputs:
            raise PolicyError(f"the network has {found} outputs, expected {self.outputs} or more for the action space")

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """Return what the action is made of, (n, k) float32: means, logits or values.

        The network of a Gaussian gives log deviations after the means: these are left out.
        """
        scores = self.network(self.observation(observation))
        return scores[:, : self.outputs] if scores.shape[1] > self.outputs else scores

    def forward(self, *observation: torch.Tensor) -> Any:
        """Return the action, (n, ...)."""
        return self.head(self.scores(*observation))


class _Network(Layer):
    """The forward pass of an RLModule, up to the input of its action distribution or DQN's values."""

    def __init__(self, module: Any) -> None:
        super().__init__()
        self.module, self.squash = module, False
        if isinstance(module.action_space, spaces.Box):
            # Whether the deterministic action is the tanh of the mean depends on Ray's version: try a mean of 0.5.
            logits = next(module.parameters()).detach().cpu().new_full((1, 2), 0.5)
            value = module.get_inference_action_dist_cls().from_logits(logits).to_deterministic().sample()
            self.squash = abs(float(value[0, 0]) - math.tanh(0.5)) < 1e-3

    def __deepcopy__(self, memo: dict[int, Any]) -> _Network:
        from ray.rllib.core.models.torch.heads import TorchFreeLogStdMLPHead, TorchMLPHead

        module = copy.deepcopy(self.module, memo)
        for name in ("pi", "_pi_head"):
            if isinstance(head := getattr(module, name, None), (TorchMLPHead, TorchFreeLogStdMLPHead)):
                setattr(module, name, head.net)  # without what it does to log deviations, which are not needed
        return _Network(module)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        module = self.module
        if not hasattr(module, "af"):
            outputs = module._forward_inference({"obs": x})
            if "action_dist_inputs" not in outputs:
                raise PolicyError(f"{type(module).__name__} gives no action_dist_inputs and cannot be frozen")
            found = outputs["action_dist_inputs"]
            return torch.tanh(found) if self.squash else found
        # DQN: the value of each choice, up to what a dueling network adds to all of them alike.
        advantages = module.af(module.encoder({"obs": x})["encoder_out"])
        if module.num_atoms == 1:
            return advantages
        # A distributional one gives logits of each choice over equally spaced values; the mean of these counts, and
        # what a dueling network adds to all logits of a choice changes nothing about it.
        steps = torch.arange(0.0, module.num_atoms, dtype=torch.float32)
        support = module.v_min + steps * (module.v_max - module.v_min) / float(module.num_atoms - 1)
        logits = advantages.reshape(-1, int(module.action_space.n), module.num_atoms)
        return (support * logits.softmax(-1)).sum(-1)


class _Observation(Layer):
    """What RLlib's connectors do: one-hot, flatten, normalise in float64, float32."""

    def __init__(self, parts: PolicyParts, leaves: Mapping[str, Any]) -> None:
        super().__init__()
        space, flatten, shape = parts.observation_space, parts.flatten, next(iter(leaves.values())).shape or ()
        if not flatten and not isinstance(space, spaces.Box):
            raise PolicyError(f"observation: a {type(space).__name__} without FlattenObservations cannot be frozen")
        early_filter = parts.filter is not None and (parts.filter_first or not flatten)  # would round whole numbers
        if early_filter and not (isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)):
            raise PolicyError("observation: MeanStdFilter of anything but a Box of floats cannot be frozen")
        self.leaves = nn.ModuleList(_encoder(leaf) if flatten else nn.Identity() for leaf in leaves.values())
        early, late = (parts.filter, None) if parts.filter_first else (None, parts.filter)
        self.early = nn.Identity() if early is None else _Normalised(early, shape)
        self.late = nn.Identity() if late is None else _Normalised(late, (-1,) if flatten else shape)

    def forward(self, tensors: tuple[torch.Tensor, ...]) -> torch.Tensor:
        encoded = [leaf(self.early(tensor)) for leaf, tensor in zip(self.leaves, tensors, strict=True)]
        return to(self.late(encoded[0] if len(encoded) == 1 else torch.cat(encoded, 1)), torch.float32)


def _encoder(space: Any) -> nn.Module:
    """Of a Box or MultiBinary: one vector, float32."""
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return OneHot(space)
    return _Numbers(len(space.shape))


class _Numbers(Layer):
    def __init__(self, dimensions: int) -> None:
        super().__init__()
        self.dimensions = dimensions

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x.unsqueeze(1) if self.dimensions == 0 else x.flatten(1) if self.dimensions > 1 else x
        return to(x, torch.float32)


class _Normalised(Layer):
    """clip((x - offset) / divisor, -limit, limit) in float64, then back to the type of x."""

    def __init__(self, given: Filter, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.offset, self.divisor = (torch.as_tensor(part.reshape(shape)) for part in (given.offset, given.divisor))
        self.limit = given.limit or None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = (to(x, torch.float64) - self.offset) / self.divisor
        return to(y if self.limit is None else y.clamp(-self.limit, self.limit), x.dtype)


def _head(parts: PolicyParts) -> nn.Module:
    """What turns the network's output into an action of the environment's space."""
    space = parts.action_space
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        return _Continuous(space, parts)
    if isinstance(space, spaces.Discrete) or (isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1):
        return Choice(space)
    expected = "a Box of floats with one axis, a Discrete or a MultiDiscrete"
    raise PolicyError(f"action space {space} cannot be frozen; expected {expected}")


class _Continuous(Layer):
    """The mean, scaled from [-1, 1] to the bounds or clipped to them, as RLlib's connector does."""

    def __init__(self, space: spaces.Box, parts: PolicyParts) -> None:
        super().__init__()
        self.dtype = torch.float64 if space.dtype == np.float64 else torch.float32
        self.low, self.high = (torch.as_tensor(bound).to(self.dtype) for bound in (space.low, space.high))
        self.half = (self.high - self.low) / 2.0
        bounded = bool(np.isfinite(space.low).all() and np.isfinite(space.high).all())
        self.stretch = parts.normalize_actions and bounded
        self.clip = self.stretch or (parts.clip_actions and not parts.normalize_actions)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.stretch:
            x = self.low + to(x + 1.0, self.dtype) * self.half
        x = to(x, self.dtype)
        return torch.maximum(torch.minimum(x, self.high), self.low) if self.clip else x

    def margin(self, scores: torch.Tensor) -> torch.Tensor:
        return torch.ones(len(scores))


# RLlib's own actions


class RLlibPolicy:
    """What RLlib's own code does on raw observations; copies, so that the trainer may go on or be closed.

    Args:
        module: The RLModule.
        env_to_module: The env runner's pipeline, or None; its statistics do not change.
        config: The AlgorithmConfig; says what is done with actions.
        env_spaces: Observation and action space of the environment.
        explore: Actions are drawn as in training; else they are the deterministic ones.

    Raises:
        SettingsError: The policy is recurrent.
    """

    def __init__(
        self,
        module: Any,
        env_to_module: Any,
        config: Any,
        env_spaces: tuple[AnySpace, AnySpace],
        *,
        explore: bool = False,
    ) -> None:
        from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES

        if module.is_stateful():
            raise SettingsError("a recurrent policy cannot explore here; let it take its best actions")
        given = {INPUT_ENV_SPACES: env_spaces, INPUT_ENV_SINGLE_SPACES: env_spaces}
        self._module, self._spaces, self._explore = copy.deepcopy(module), env_spaces, explore
        self._before = copy.deepcopy(env_to_module) or config.build_env_to_module_connector(env=None, spaces=given)
        for connector in self._before.connectors:
            if hasattr(connector, "_update_stats"):
                connector._update_stats = False
        self._after = config.build_module_to_env_connector(env=None, spaces=given)

    def reset(self, rows: Any = None) -> None:
        """Nothing: it has no memory."""

    def act(self, observation: Any) -> Any:
        """The action for one observation, in the environment's action space."""
        return self.actions([observation])[0]

    def actions(self, observations: Sequence[Any]) -> Array:
        """The actions for n observations, (n, ...), in the environment's action space."""
        from ray.rllib.env.single_agent_episode import SingleAgentEpisode

        space, action_space = self._spaces
        episodes = [
            SingleAgentEpisode(observations=[one], observation_space=space, action_space=action_space)
            for one in (less_start(space, observation) for observation in observations)  # RLlib counts from 0
        ]
        given = {"rl_module": self._module, "episodes": episodes, "explore": self._explore, "shared_data": {}}
        forward = self._module.forward_exploration if self._explore else self._module.forward_inference
        with torch.no_grad():
            batch = self._after(batch=forward(self._before(batch={}, **given)), **given)
        actions = np.stack([np.asarray(one) for one in batch.get("actions_for_env", batch["actions"])])
        dtype = np.int64 if isinstance(action_space, spaces.Discrete) else action_space.dtype
        return np.asarray(plus_start(action_space, actions), dtype)


def golden(parts: PolicyParts, policy: RLlibPolicy, n: int = 256, seed: int = 0) -> bytes:
    """Draw n observations, fewer if they are large, and record RLlib's deterministic actions for them.

    Returns:
        A safetensors file with ``observation`` (or ``observation.<key>``), (n, ...), and ``action``, (n, ...).
    """
    observations = clear_observations(parts, n, seed)
    return pack(observations, policy.actions(one_by_one(observations)))


def clear_observations(parts: PolicyParts, n: int = 256, seed: int = 0) -> dict[str, Array]:
    """Draw observations; of discrete actions those whose choice is clear: ties are decided by rounding alone."""
    n = affordable(leaf_spaces(parts.observation_space).values(), n)
    return clearest(FrozenModule(parts), draw(parts, 2 * n, np.random.default_rng(seed)), n)


def one_by_one(observations: Mapping[str, Array]) -> list[Any]:
    """The observations of a batch, as an environment gives them."""
    if "" in observations:
        return list(observations[""])
    return [dict(zip(observations, one, strict=True)) for one in zip(*observations.values(), strict=True)]


def draw(parts: PolicyParts, n: int, rng: np.random.Generator) -> dict[str, Array]:
    """Draw n observations; the keys are those of a Dict, or ``""`` alone.

    Normalised numbers are drawn about their running mean, so that few of them end at the filter's limits.
    """
    drawn, at = {}, 0
    for key, leaf in leaf_spaces(parts.observation_space).items():
        moments, part = None, slice(at, at := at + spaces.flatdim(leaf))
        if parts.filter is not None and isinstance(leaf, spaces.Box):
            mean, spread = (numbers.ravel()[part] for numbers in (parts.filter.offset, parts.filter.divisor))
            moments = mean.reshape(leaf.shape), spread.reshape(leaf.shape)
        drawn[key] = draw_array(leaf, n, rng, moments)
    return drawn
