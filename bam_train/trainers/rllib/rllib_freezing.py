"""One policy of RLlib as one ONNX graph: raw observation in, deterministic action out; and RLlib's own actions.

The graph computes RLlib's actions with ``explore=False``: its connectors (one-hot codes, flattening, `MeanStdFilter`),
the module's forward pass, which is traced, the distribution's deterministic action, and the scaling or clipping to the
action space. `RLlibPolicy` computes the same with RLlib's own code.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import nn

from bam_train.errors import PolicyError, SettingsError
from bam_train.trainers.frozen_network import FrozenNetwork, Layer, Normalised, OneHot, action_head, to
from bam_train.trainers.rllib.rllib_state import unpacked_array
from bam_train.trainers.zero_based_spaces import less_start, plus_start

Array = NDArray[Any]
AnySpace = spaces.Space[Any]

POLICY_ID = "default_policy"
"""RLlib's default name of a single policy."""

_SMALL_NUMBER = 1e-6  # ray.rllib.utils.numpy.SMALL_NUMBER, which MeanStdFilter adds to the deviation
LAYOUT_CONNECTORS = frozenset(
    {
        *("AddObservationsFromEpisodesToBatch", "AddStatesFromEpisodesToBatch", "AddTimeDimToBatchAndZeroPad"),
        *("BatchIndividualItems", "NumpyToTensor", "GetActions", "ListifyDataForVectorEnv", "ModuleToAgentUnmapping"),
        *("RemoveSingleTsTimeRankFromBatch", "TensorToNumpy", "UnBatchToIndividualItems"),
    }
)
"""Connectors of every RLlib pipeline, which change the layout of observations and actions, but not their values."""


# The parts of a policy


@dataclass(frozen=True)
class Filter:
    """A fixed `MeanStdFilter`: clip((x - offset) / divisor, -limit, limit), in float64.

    The arrays have the observation's shape.
    """

    offset: Array
    """Mean of the observations seen, or zeros."""
    divisor: Array
    """Their deviation + 1e-6, or ones."""
    limit: float | None
    """`clip_by_value`; 0 and None do not clip."""
    center: bool
    """`de_mean_to_zero`."""
    scale: bool
    """`de_std_to_one`."""

    @classmethod
    def of(cls, stats: Mapping[str, Any], limit: float | None, center: bool, scale: bool) -> Filter:
        """Make the filter from a state of RLlib's `RunningStat`, which computes the deviation in float32."""
        count = int(stats["num_pushes"])
        mean, squares = (unpacked_array(stats[name]).astype(np.float64) for name in ("mean_array", "sum_sq_diff_array"))
        variance = squares / (count - 1.0) if count > 1 else np.zeros(squares.shape)
        deviation = np.sqrt(np.maximum(variance.astype(np.float32), 0)) + np.float32(_SMALL_NUMBER)
        offset = mean if center else np.zeros(mean.shape)
        divisor = deviation.astype(np.float64) if scale else np.ones(mean.shape)
        return cls(offset, divisor, limit, bool(center), bool(scale))


@dataclass(frozen=True)
class PolicyParts:
    """Everything on which the deterministic action of a policy of RLlib depends."""

    algorithm: str
    """Name of the algorithm, such as ppo; "" if unknown."""
    observation_space: AnySpace
    """The environment's observation space, before any connector."""
    action_space: AnySpace
    """The environment's action space."""
    network: Any
    """Torch module from encoded observations (n, ...) float32 to means, logits or values (n, k)."""
    filter: Filter | None = None
    """The filter that normalises observations."""
    flatten: bool = False
    """Whether observations become one vector: keys in alphabetical order, whole numbers one-hot."""
    filter_first: bool = False
    """Whether the filter comes before the flattening."""
    normalize_actions: bool = True
    """Whether actions from -1 to 1 are scaled to the bounds of the action space."""
    clip_actions: bool = False
    """Whether actions that are not scaled are clipped to the bounds."""


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
    """The fields of `PolicyParts` for the connectors before the network."""
    found: dict[str, Any] = {}
    for piece in connectors:
        kinds = [base.__name__ for base in type(piece).__mro__]  # bam_train's filter is a subclass of RLlib's
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
    """Raise PolicyError for a connector that changes values, except the `known` ones."""
    name = type(piece).__name__
    if name not in LAYOUT_CONNECTORS and name not in known:
        raise PolicyError(f"connector {name} cannot be frozen; expected FlattenObservations or MeanStdFilter")


def _filter_of(connector: Any) -> Filter:
    agents = list(connector.get_state().values())
    if len(agents) != 1:
        raise PolicyError(f"MeanStdFilter: expected one agent, found {len(agents)}")
    state, stats = agents[0], agents[0]["running_stats"]
    if len(stats) != 1:
        raise PolicyError(f"MeanStdFilter: expected one array, found {len(stats)}; put FlattenObservations before it")
    return Filter.of(stats[0], state["clip_by_value"], state["de_mean_to_zero"], state["de_std_to_one"])


# The graph


class FrozenModule(FrozenNetwork):
    """A copy of a policy of RLlib, from raw observations to actions.

    Args:
        parts: What the actions depend on.
        make_policy: Makes RLlib's own policy, where it is there.

    Raises:
        PolicyError: The network or a space is of a kind that cannot be frozen.
    """

    def __init__(self, parts: PolicyParts, make_policy: Callable[[], RLlibPolicy] | None = None) -> None:
        super().__init__(parts.observation_space)
        self._make_policy = make_policy
        space, actions, given = parts.observation_space, parts.action_space, parts.filter
        floats = isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)
        if not parts.flatten and not isinstance(space, spaces.Box):
            raise PolicyError(f"observation: a {type(space).__name__} without FlattenObservations cannot be frozen")
        if given is not None and (parts.filter_first or not parts.flatten) and not floats:  # would round whole numbers
            raise PolicyError("observation: MeanStdFilter of anything but a Box of floats cannot be frozen")
        if isinstance(actions, spaces.Box) and not (
            len(actions.shape) == 1 and np.issubdtype(actions.dtype, np.floating)
        ):
            raise PolicyError(f"action space {actions} cannot be frozen; expected a Box of floats with one axis")
        dtype = torch.float64 if parts.filter_first else torch.float32
        self.encoders = nn.ModuleList(
            _encoder(leaf, dtype) if parts.flatten else nn.Identity() for leaf in self.leaves.values()
        )
        self.normalise: nn.Module = nn.Identity()
        if given is not None:
            shape = (-1,) if parts.flatten else space.shape or ()
            self.normalise = Normalised(given.offset.reshape(shape), given.divisor.reshape(shape), given.limit)
        self.network = copy.deepcopy(parts.network).cpu()
        bounded = isinstance(actions, spaces.Box) and actions.is_bounded()
        scale = parts.normalize_actions and bounded
        clip = scale or (parts.clip_actions and not parts.normalize_actions)
        self.head = action_head(actions, tanh=False, scale=scale, clip=clip)
        self.outputs = spaces.flatdim(actions)
        self.eval().requires_grad_(False)
        self._require_fit()
        at = 0
        for key, leaf in self.leaves.items():
            part = slice(at, at := at + spaces.flatdim(leaf))
            if given is not None and isinstance(leaf, spaces.Box):
                mean, spread = (numbers.ravel()[part] for numbers in (given.offset, given.divisor))
                self.moments[key] = mean.reshape(leaf.shape), spread.reshape(leaf.shape)

    def own_actions(self, observations: Mapping[str, Array]) -> Array:
        """RLlib's own, or torch's where there is no RLlib; see `FrozenNetwork`."""
        if self._make_policy is None:
            return super().own_actions(observations)
        return self._make_policy().actions(one_by_one(observations))

    def _require_fit(self) -> None:
        """Raise PolicyError unless the weights fit the observation and action space."""
        try:
            with torch.no_grad():
                found = self.scores(*self.example()).shape[1]
                self(*self.example())
        except PolicyError:
            raise
        except (RuntimeError, ValueError, TypeError, IndexError, KeyError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise PolicyError(f"the weights do not fit the spaces: {reason:.200}") from error
        if found < self.outputs:
            raise PolicyError(f"the network has {found} outputs, expected {self.outputs} or more for the action space")

    def scores(self, *observation: torch.Tensor) -> torch.Tensor:
        """The scores that the action is computed from, (n, k) float32: means, logits or values.

        The log deviations that follow the means of a Gaussian are left out.
        """
        encoded = [encoder(tensor) for encoder, tensor in zip(self.encoders, observation, strict=True)]
        joined = encoded[0] if len(encoded) == 1 else torch.cat(encoded, 1)
        scores = self.network(to(self.normalise(joined), torch.float32))
        return scores[:, : self.outputs] if scores.shape[1] > self.outputs else scores


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
                setattr(module, name, head.net)  # without its treatment of log deviations, which are not needed
        return _Network(module)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        module = self.module
        if not hasattr(module, "af"):
            outputs = module.forward_inference({"obs": x})
            if "action_dist_inputs" not in outputs:
                raise PolicyError(f"{type(module).__name__} gives no action_dist_inputs and cannot be frozen")
            found = outputs["action_dist_inputs"]
            return torch.tanh(found) if self.squash else found
        # DQN: the value of each choice, without the term that a dueling network adds to all values.
        advantages = module.af(module.encoder({"obs": x})["encoder_out"])
        if module.num_atoms == 1:
            return advantages
        # A distributional DQN returns logits of each choice over equally spaced values, whose mean is the value; the
        # term that a dueling network adds to all logits of a choice does not change this mean.
        steps = torch.arange(0.0, module.num_atoms, dtype=torch.float32)
        support = module.v_min + steps * (module.v_max - module.v_min) / float(module.num_atoms - 1)
        logits = advantages.reshape(-1, int(module.action_space.n), module.num_atoms)
        return (support * logits.softmax(-1)).sum(-1)


def _encoder(space: Any, dtype: torch.dtype) -> nn.Module:
    return OneHot(space) if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) else _Flat(dtype)


class _Flat(Layer):
    """A Box or MultiBinary as one vector."""

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        self.dtype = dtype

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return to(x.unsqueeze(1) if x.ndim == 1 else x.flatten(1) if x.ndim > 2 else x, self.dtype)


# RLlib's own actions


def input_spaces(env_spaces: tuple[AnySpace, AnySpace]) -> dict[str, Any]:
    """The spaces of an environment as RLlib's pipelines of connectors take them."""
    from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES

    return {INPUT_ENV_SPACES: env_spaces, INPUT_ENV_SINGLE_SPACES: env_spaces}


class RLlibPolicy:
    """RLlib's own actions for raw observations; holds copies, independent of the trainer.

    Args:
        module: The RLModule.
        env_to_module: The env runner's pipeline, or None; its statistics do not change.
        config: The AlgorithmConfig, which determines the treatment of actions.
        env_spaces: Observation and action space of the environment.
        explore: Whether actions are drawn as in training, or deterministic.

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
        if module.is_stateful():
            raise SettingsError("a recurrent policy cannot explore here; let it take its best actions")
        given = input_spaces(env_spaces)
        self._module, self._spaces, self._explore = copy.deepcopy(module), env_spaces, explore
        self._before = copy.deepcopy(env_to_module) or config.build_env_to_module_connector(env=None, spaces=given)
        for connector in self._before.connectors:
            if hasattr(connector, "_update_stats"):
                connector._update_stats = False
        self._after = config.build_module_to_env_connector(env=None, spaces=given)

    def reset(self, rows: Any = None) -> None:
        """Do nothing: the policy is not recurrent."""

    def act(self, observation: Any) -> Any:
        """The action for one observation, in the environment's action space."""
        return self.actions([observation])[0]

    def actions(self, observations: Sequence[Any]) -> Array:
        """The actions for n observations, (n, ...), in the environment's action space."""
        from ray.rllib.env.single_agent_episode import SingleAgentEpisode

        space, action_space = self._spaces
        episodes = [
            SingleAgentEpisode(observations=[value], observation_space=space, action_space=action_space)
            for value in (less_start(space, observation) for observation in observations)  # RLlib counts from 0
        ]
        given = {"rl_module": self._module, "episodes": episodes, "explore": self._explore, "shared_data": {}}
        forward = self._module.forward_exploration if self._explore else self._module.forward_inference
        with torch.no_grad():
            batch = self._after(batch=forward(self._before(batch={}, **given)), **given)
        actions = np.stack([np.asarray(action) for action in batch.get("actions_for_env", batch["actions"])])
        dtype = np.int64 if isinstance(action_space, spaces.Discrete) else action_space.dtype
        return np.asarray(plus_start(action_space, actions), dtype)


def one_by_one(observations: Mapping[str, Array]) -> list[Any]:
    """Split a batch, (n, ...) by key, into the n observations of an environment."""
    if "" in observations:
        return list(observations[""])
    return [dict(zip(observations, values, strict=True)) for values in zip(*observations.values(), strict=True)]
