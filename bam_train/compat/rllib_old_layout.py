"""One policy of RLlib's old API stack, out of its ``policy_state.pkl``: what robo-gym's own scripts left.

Today's Ray cannot read what Ray 2.10 wrote, so the file is read here, without running what is in it, and its network is
built from the names of its weights: dense layers, of SAC and CQL the actor's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from bam_train.compat.rllib_directory import AGAIN, OLD_STATE, Directory
from bam_train.errors import CheckpointMismatch, FormatError, PolicyError
from bam_train.trainers.rllib.rllib_freezing import AnySpace, Filter, PolicyParts
from bam_train.trainers.rllib.state_pickles import read_state, unpacked_array

_BEFORE = ("ObsPreprocessorConnector", "StateBufferConnector", "ViewRequirementAgentConnector")
_FILTERS = ("MeanStdObservationFilterAgentConnector", "ConcurrentMeanStdObservationFilterAgentConnector")
_AFTER = ("ConvertToNumpyConnector", "ImmutableActionsConnector", "NormalizeActionsConnector", "ClipActionsConnector")
_ACTIVATIONS: dict[Any, Any] = {"tanh": nn.Tanh, "relu": nn.ReLU, "swish": nn.SiLU, "silu": nn.SiLU, "elu": nn.ELU}
_MALFORMED = (AttributeError, LookupError, TypeError, ValueError, AssertionError, OverflowError, RuntimeError)


def read_old_policy(directory: Directory) -> tuple[PolicyParts, Mapping[str, Any], int]:
    """The parts of the policy, the fields of its algorithm's configuration, and how many steps it was trained.

    Raises:
        CheckpointError: Its file is missing or damaged.
        PolicyError: Something in it cannot be frozen.
    """
    path = directory.policy / OLD_STATE
    try:
        state = read_state(directory.read_bytes(path), skip_objects=True)
        return _parts(directory, state)
    except FormatError as error:
        raise directory.altered(path, f"{error}. {AGAIN}") from error
    except _MALFORMED as error:
        reason = " ".join(str(error).split())
        raise directory.altered(path, f"is not the state of a policy: {type(error).__name__} {reason:.160}") from error


def _parts(directory: Directory, state: Mapping[str, Any]) -> tuple[PolicyParts, Mapping[str, Any], int]:
    spec = state["policy_spec"]
    config, name = spec["config"], str(spec["policy_class"]).removesuffix("Policy")
    if not name.endswith("Torch"):
        raise CheckpointMismatch(directory.given, f"has a policy of class {name}Policy; expected one for torch")
    algorithm = name.removesuffix("Torch").lower()
    space, action_space = _space(spec["observation_space"]), _space(spec["action_space"])
    keys = list(space.spaces) if isinstance(space, spaces.Dict) else []
    if keys != sorted(keys):
        raise PolicyError(f"observation keys {keys} of the old API stack are not in alphabetical order: not frozen")
    squashed = algorithm in ("sac", "cql") and isinstance(action_space, spaces.Box)
    if squashed and config.get("normalize_actions") is False:
        raise PolicyError("SAC of the old API stack without normalize_actions has a Beta distribution: not frozen")
    connectors = state.get("connector_configs") or {}
    before, after = (connectors.get(kind, ("", []))[1] for kind in ("agent", "action"))
    after_names = [one for one, _ in after]
    for one in [one for one, _ in before if one not in (*_BEFORE, *_FILTERS, "ClipRewardAgentConnector")] + [
        one for one in after_names if one not in _AFTER
    ]:
        raise PolicyError(f"connector {one} cannot be frozen; expected those that RLlib adds itself")
    does = config
    if after_names:
        does = {f"{one}_actions": f"{one.title()}ActionsConnector" in after_names for one in ("normalize", "clip")}
    filters = [_filter(given) for one, given in before if one in _FILTERS]
    parts = PolicyParts(
        algorithm=algorithm,
        observation_space=space,
        action_space=action_space,
        network=_network(state["weights"], {**config["model"], **(config.get("policy_model_config") or {})}, squashed),
        filter=filters[0] if filters else None,
        flatten=not (isinstance(space, spaces.Box) and len(space.shape) == 1),
        normalize_actions=bool(does.get("normalize_actions")),
        clip_actions=bool(does.get("clip_actions")),
    )
    return parts, config, int(state.get("global_timestep") or 0)


def _space(value: Mapping[str, Any]) -> AnySpace:
    """The space that `space_to_dict` of the old stack describes, before any preprocessor."""
    value = value.get("original_space", value)
    fields = value["space"] if isinstance(value["space"], Mapping) else value
    kind = fields["space"]
    if kind == "box":
        low, high, shape = unpacked_array(fields["low"]), unpacked_array(fields["high"]), tuple(fields["shape"])
        if not low.shape == high.shape == shape:  # a number would be spread over a shape of any size
            raise FormatError(f"has bounds of shapes {low.shape} and {high.shape} for shape {shape}")
        return spaces.Box(low, high, shape=shape, dtype=np.dtype(fields["dtype"]).type)
    if kind == "discrete":
        return spaces.Discrete(int(fields["n"]), start=int(fields.get("start", 0)))
    if kind == "multi-discrete":
        dtype: Any = np.dtype(fields["dtype"]).type
        return spaces.MultiDiscrete(unpacked_array(fields["nvec"]), dtype=dtype)
    if kind == "dict":
        return spaces.Dict({str(key): _space(space) for key, space in fields["spaces"].items()})
    raise FormatError(f"a space of kind {kind!r} is not known")


def _filter(given: Mapping[str, Any]) -> Filter:
    (stats,) = given["running_stats"]
    mean, squares = (unpacked_array(stats[name]) for name in ("mean_array", "sum_sq_diff_array"))
    return Filter(int(stats["num_pushes"]), mean, squares, given["clip"], bool(given["demean"]), bool(given["destd"]))


def _network(weights: Mapping[str, Any], model: Mapping[str, Any], squashed: bool) -> nn.Module:
    """`FullyConnectedNetwork`: every layer is a `SlimFC`, a linear layer and its activation."""
    for name in ("custom_model", "custom_action_dist", "use_lstm", "use_attention"):
        if model.get(name):
            raise PolicyError(f"a network of the old API stack with {name} cannot be frozen")
    at = "action_model." if any(name.startswith("action_model.") for name in weights) else ""
    hidden = [name for name in weights if re.fullmatch(rf"{at}_hidden_layers\.\d+\._model\.0\.weight", name)]
    if not hidden or any(name.startswith("advantage_module.") for name in weights):
        names = ", ".join(list(weights)[:5])
        text = "the weights are not of a FullyConnectedNetwork of PPO or SAC of the old API stack, and cannot be frozen"
        raise PolicyError(f"{text}: {names}, ...")
    activation = model.get("fcnet_activation" if model.get("fcnet_hiddens") else "post_fcnet_activation")
    if activation not in (None, "linear", *_ACTIVATIONS):
        raise PolicyError(f"activation {activation!r} is not known; expected {', '.join(_ACTIVATIONS)} or linear")
    layers: list[nn.Module] = []
    for name in sorted(hidden, key=lambda name: int(name.split(".")[-4])):
        layers += [_linear(weights, name), _ACTIVATIONS.get(activation, nn.Identity)()]
    if f"{at}_logits._model.0.weight" in weights:
        layers.append(_linear(weights, f"{at}_logits._model.0.weight"))
    return nn.Sequential(*layers, nn.Tanh() if squashed else nn.Identity())


def _linear(weights: Mapping[str, Any], name: str) -> nn.Linear:
    weight, bias = np.array(weights[name], np.float32), weights.get(name.removesuffix("weight") + "bias")
    layer = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None)
    layer.weight.data = torch.from_numpy(weight)
    if bias is not None:
        layer.bias.data = torch.from_numpy(np.array(bias, np.float32))
    return layer
