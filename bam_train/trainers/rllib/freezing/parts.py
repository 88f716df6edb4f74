"""What a frozen policy is made of: weights, spaces, and what RLlib's connectors do before and after the network.

`parts_of` takes them from a live algorithm; `foreign` reads them from a checkpoint directory; `freeze` makes one ONNX
graph of them. Nothing here imports ray: a connector is known by the name of its class. The file is long because each
field of the parts has its sentence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_train.errors import PolicyError

Array = NDArray[Any]
AnySpace = spaces.Space[Any]

KINDS = "Box, Discrete, MultiDiscrete or MultiBinary"
POLICY_ID = "default_policy"
"""RLlib's name of the one policy of a run that did not name any."""

_EPSILON = 1e-6  # ray.rllib.utils.numpy.SMALL_NUMBER
# Connectors that only move data about: what RLlib itself adds to every env-to-module pipeline.
_PLAIN = frozenset(
    {
        "AddObservationsFromEpisodesToBatch",
        "AddStatesFromEpisodesToBatch",
        "AddTimeDimToBatchAndZeroPad",
        "AgentToModuleMapping",
        "BatchIndividualItems",
        "NumpyToTensor",
    }
)


_KNOWN = frozenset({"FlattenObservations", "MeanStdFilter"})


@dataclass(frozen=True)
class Filter:
    """A `MeanStdFilter` that has stopped learning: clip((x - offset) / divisor, -limit, limit), in float64."""

    count: int
    """Observations seen."""
    mean: Array
    """Of all of them, of the observation's shape."""
    squares: Array
    """Sum of squared differences from the mean."""
    limit: float | None
    """`clip_by_value`; 0 and None do not clip."""
    center: bool = True
    """`de_mean_to_zero`."""
    scale: bool = True
    """`de_std_to_one`."""

    @property
    def offset(self) -> Array:
        """What is subtracted, float64."""
        return np.asarray(self.mean, np.float64) if self.center else np.zeros(np.shape(self.mean))

    @property
    def divisor(self) -> Array:
        """The float32 deviation + 1e-6, as float64; of fewer than two observations RLlib's deviation is 0."""
        if not self.scale:
            return np.ones(np.shape(self.mean))
        variance = np.asarray(self.squares) / (self.count - 1.0) if self.count > 1 else np.zeros(np.shape(self.mean))
        deviation = np.sqrt(np.maximum(variance.astype(np.float32), 0)) + np.float32(_EPSILON)
        return np.asarray(deviation, np.float64)


@dataclass(frozen=True)
class PolicyParts:
    """One policy of RLlib, with everything that its deterministic action depends on."""

    algorithm: str
    """Such as ppo."""
    observation_space: AnySpace
    """The environment's own, before any connector."""
    action_space: AnySpace
    """The environment's own."""
    weights: dict[str, Array]
    """The module's state, by RLlib's names."""
    model_config: dict[str, Any]
    """RLlib's model config as plain values."""
    filter: Filter | None = None
    """What normalises observations."""
    flatten: bool = False
    """Observations become one vector: keys in alphabetical order, whole numbers one-hot."""
    filter_first: bool = False
    """The filter comes before the flattening."""
    normalize_actions: bool = True
    """Actions of -1 to 1 are stretched to the bounds of the action space."""
    clip_actions: bool = False
    """Actions that are not stretched are clipped to the bounds."""
    squash: bool = False
    """A tanh follows the mean: SAC of the old stack. The new stack's deterministic action (2.60) is without one."""
    old_stack: bool = False
    """The weights are named as before RLModules."""
    module_class: str = ""
    """Dotted name of the module's class; "" if it is not known."""
    module: Any = None
    """The live module, if its class is not RLlib's own: it is traced."""


def parts_of(
    module: Any,
    env_to_module: Any,
    config: Any,
    env_spaces: tuple[AnySpace, AnySpace],
    policy: str = POLICY_ID,
) -> PolicyParts:
    """Take the parts from a live algorithm of the current API; nothing is changed.

    Args:
        module: An RLModule, or the MultiRLModule that has it.
        env_to_module: The env runner's pipeline, or None without connectors.
        config: The AlgorithmConfig.
        env_spaces: Observation and action space of the environment, before any connector.
        policy: Which module, of several.

    Raises:
        PolicyError: A connector or space is of a kind that cannot be frozen.
    """
    if hasattr(module, "keys") and policy in module.keys():  # noqa: SIM118 - a MultiRLModule is no mapping
        module = module[policy]
    module = module.unwrapped() if hasattr(module, "unwrapped") else module
    name = f"{type(module).__module__}.{type(module).__qualname__}"
    return PolicyParts(
        algorithm=config.algo_class.__name__.lower() if config.algo_class else "",
        observation_space=env_spaces[0],
        action_space=env_spaces[1],
        weights={key: value.detach().cpu().numpy().copy() for key, value in module.state_dict().items()},
        model_config=plain_config(module.model_config),
        **_live_connectors(env_to_module),
        normalize_actions=bool(config.normalize_actions),
        clip_actions=bool(config.clip_actions),
        squash=is_own(name) and isinstance(env_spaces[1], spaces.Box) and _squashes(module),
        module_class=name,
        module=None if is_own(name) else module,
    )


def _squashes(module: Any) -> bool:
    """Whether the distribution's deterministic action is the tanh of the mean: what it makes of a mean of 0.5."""
    logits = next(module.parameters()).detach().cpu().new_full((1, 2), 0.5)
    value = module.get_inference_action_dist_cls().from_logits(logits).to_deterministic().sample()
    return abs(float(value[0, 0]) - float(np.tanh(0.5))) < 1e-3


def is_own(class_name: str) -> bool:
    """Whether a module's class is one of RLlib's, whose layers `freeze` knows."""
    return class_name.startswith("ray.rllib.algorithms.")


def plain_config(config: Any) -> dict[str, Any]:
    """A model config, which is a dataclass or a dict, as a dict of plain values; initialisers are left out."""
    if config is None:
        return {}
    values = config if isinstance(config, Mapping) else vars(config)
    return {str(key): value for key, value in values.items() if "initializer" not in str(key)}


def filter_of(state: Mapping[Any, Any]) -> Filter:
    """The filter in the state of a `MeanStdFilter` connector.

    Args:
        state: By agent, as `MeanStdFilter.get_state` gives it, with arrays in place of text.

    Raises:
        PolicyError: It is of several agents or several arrays.
    """
    if len(state) != 1:
        raise PolicyError(f"MeanStdFilter: expected one agent, found {len(state)}")
    (entry,) = state.values()
    stats = entry["running_stats"]
    if len(stats) != 1:
        raise PolicyError(f"MeanStdFilter: expected one array, found {len(stats)}; put FlattenObservations before it")
    return Filter(
        count=int(stats[0]["num_pushes"]),
        mean=np.asarray(stats[0]["mean_array"]),
        squares=np.asarray(stats[0]["sum_sq_diff_array"]),
        limit=entry["clip_by_value"],
        center=bool(entry["de_mean_to_zero"]),
        scale=bool(entry["de_std_to_one"]),
    )


def connector_parts(names: list[str]) -> dict[str, bool]:
    """Which of flattening and filtering there is, and in which order, from the class names of a pipeline.

    Raises:
        PolicyError: Another connector changes observations, and cannot be frozen.
    """
    steps = [name for name in names if name not in _PLAIN]
    for name in steps:
        if name not in _KNOWN:
            raise PolicyError(f"connector {name} cannot be frozen; expected FlattenObservations or MeanStdFilter")
    if len(set(steps)) != len(steps):
        raise PolicyError(f"connectors {', '.join(steps)} cannot be frozen: one is there twice")
    flatten = "FlattenObservations" in steps
    return {"flatten": flatten, "filter_first": steps[:1] == ["MeanStdFilter"]}


def leaf_spaces(space: AnySpace) -> dict[str, AnySpace]:
    """The spaces in a Dict by key, in alphabetical order as RLlib takes them; any other space just by ``""``.

    Raises:
        PolicyError: A Dict in a Dict, or a Tuple.
    """
    leaves = {key: space[key] for key in sorted(space.spaces)} if isinstance(space, spaces.Dict) else {"": space}
    for key, leaf in leaves.items():
        if not isinstance(leaf, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            kind = type(leaf).__name__
            raise PolicyError(f"observation {key!r}: a {kind} cannot be frozen; expected {KINDS} or a Dict of them")
    return leaves


def _live_connectors(pipeline: Any) -> dict[str, Any]:
    """Fields of `PolicyParts` from a live pipeline."""
    pieces = [] if pipeline is None else list(pipeline.connectors)
    names = [_kind(piece) for piece in pieces]
    order: dict[str, Any] = connector_parts(names)
    if any(getattr(piece, "_keys_to_remove", None) for piece in pieces):
        raise PolicyError("FlattenObservations that removes keys cannot be frozen")
    if "MeanStdFilter" in names:
        order["filter"] = filter_of(_live_statistics(pieces[names.index("MeanStdFilter")]))
    return order


def _kind(piece: Any) -> str:
    """A connector's class, or that of RLlib's which it is a special case of."""
    names = [base.__name__ for base in type(piece).__mro__ if base.__module__.startswith("ray.rllib.connectors.")]
    return next((name for name in names if name in _PLAIN | _KNOWN), type(piece).__name__)


def _live_statistics(piece: Any) -> dict[Any, Any]:
    """`get_state` without packing arrays into text and back."""
    if piece._filters is None:
        piece.get_state()  # makes them, as the first observation would
    return {
        agent: {
            "de_mean_to_zero": one.demean,
            "de_std_to_one": one.destd,
            "clip_by_value": one.clip,
            "running_stats": [
                {
                    "num_pushes": one.running_stats.num_pushes,
                    "mean_array": one.running_stats.mean_array.copy(),
                    "sum_sq_diff_array": one.running_stats.sum_sq_diff_array.copy(),
                }
            ],
        }
        for agent, one in piece._filters.items()
    }
