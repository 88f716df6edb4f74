"""One policy in a checkpoint directory of RLlib, of its current API or of its old API stack.

A directory of the current API is restored by the installed RLlib itself, which runs the code in it. Today's Ray cannot
read directories of the old API stack (robo-gym's scripts used Ray 2.10), so ``policy_state.pkl`` is read here, without
running its code, and the network is built from the names of its weights: dense layers, for SAC and CQL the actor's.
"""

import json
import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from bam_train.compat.rllib_directory import AGAIN, ARGUMENTS, OLD_STATE, Directory
from bam_train.errors import CheckpointMismatch, FormatError, PolicyError, SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS
from bam_train.trainers.rllib.rllib_freezing import (
    POLICY_ID,
    AnySpace,
    Filter,
    PolicyParts,
    parts_of,
    require_layout_only,
)
from bam_train.trainers.rllib.rllib_state import read_state, unpacked_array


@dataclass(frozen=True)
class SavedPolicy:
    """One policy in a directory."""

    directory: Directory
    parts: PolicyParts
    """The parts, with the environment's spaces if the directory has them, else the network's."""
    env: str | None
    """Name of the environment; None if the directory does not have it."""
    env_kwargs: Mapping[str, Any]
    steps: int
    """Environment steps trained; 0 if unknown."""
    whole: bool
    """Whether the directory has RLlib's connectors before and after the network."""
    configured: bool = True
    """Whether the directory has the configuration of its algorithm."""
    module: Any = field(default=None, repr=False)
    """The RLModule; None for the old layout."""
    env_to_module: Any = field(default=None, repr=False)
    """The env runner's pipeline; None if the directory has none."""
    config: Any = field(default=None, repr=False)
    """The AlgorithmConfig; RLlib's default if the directory has none."""


def _named(env: Any, env_kwargs: Any) -> tuple[str | None, dict[str, Any]]:
    """Environment and arguments of a configuration, if they are a name and a mapping."""
    return env if isinstance(env, str) else None, dict(env_kwargs) if isinstance(env_kwargs, Mapping) else {}


# The current API


def restore(directory: Directory) -> SavedPolicy:
    """Restore a directory with RLlib, which runs the code in it.

    Raises:
        CheckpointError: RLlib cannot read the directory.
        PolicyError: A connector or the network cannot be frozen.
    """
    from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
    from ray.rllib.connectors.env_to_module import EnvToModulePipeline
    from ray.rllib.connectors.module_to_env import ModuleToEnvPipeline
    from ray.rllib.core.rl_module.rl_module import RLModule

    root = directory.root or directory.policy.parent
    runner = root / "env_runner" if (root / "env_runner").is_dir() else root
    module = _restored(directory, directory.policy, RLModule)
    before = _restored(directory, runner / "env_to_module_connector", EnvToModulePipeline)
    after = _restored(directory, runner / "module_to_env_connector", ModuleToEnvPipeline)
    if module is None:
        raise directory.altered(directory.policy / ARGUMENTS, f"is missing. {AGAIN}, whole")
    for piece in [] if after is None else after.connectors:
        require_layout_only(piece, ["NormalizeAndClipActions"])
    arguments = None if directory.root is None else directory.root / ARGUMENTS
    configured, config = arguments is not None and arguments.is_file(), AlgorithmConfig()
    if arguments is not None and configured:
        args, kwargs = _unpickled(directory, arguments)["ctor_args_and_kwargs"]
        config = args[0] if args else kwargs["config"]
        config = AlgorithmConfig.from_state(config) if isinstance(config, Mapping) else config
    state = _unpickled(directory, runner / "state.pkl") if (runner / "state.pkl").is_file() else None
    steps = int(state.get("num_env_steps_sampled_lifetime", 0)) if isinstance(state, Mapping) else 0
    env_spaces = module.observation_space, module.action_space
    if before is not None:
        env_spaces = before.input_observation_space, before.input_action_space
    parts = parts_of(module, before, config, env_spaces)
    if not parts.algorithm:  # that of the module's class, although IMPALA, for example, uses PPO's
        match = re.match(r"ray\.rllib\.algorithms\.(\w+)\.", type(module).__module__)
        parts = replace(parts, algorithm=match[1] if match else "")
    env, env_kwargs = _named(config.env, config.env_config)
    whole = before is not None
    return SavedPolicy(directory, parts, env, env_kwargs, steps, whole, configured, module, before, config)


def _restored(directory: Directory, folder: Path, kind: Any) -> Any:
    """The object that RLlib restores from a folder; None if there is no such folder."""
    path = folder / ARGUMENTS
    return _ran(directory, path, lambda: kind.from_checkpoint(str(folder))) if path.is_file() else None


def _unpickled(directory: Directory, path: Path) -> Any:
    data = directory.read_bytes(path)
    return _ran(directory, path, lambda: pickle.loads(data))


def _ran(directory: Directory, path: Path, read: Callable[[], Any]) -> Any:
    """The result of reading a file, a program that may raise any exception."""
    try:
        return read()
    except Exception as error:
        reason = " ".join(str(error).split())
        text = f"cannot be restored by RLlib: {type(error).__name__}: {reason:.160}"
        raise directory.altered(path, text) from error


def training_settings(saved: SavedPolicy, parts: PolicyParts, env: str, env_kwargs: Mapping[str, Any]) -> TrainSettings:
    """The settings of a run that continues the directory's algorithm.

    `parts` are those of `saved` with the environment's spaces; `env` is a versioned id.

    Raises:
        SettingsError: No run of bam-train corresponds to it; the message has the reason.
    """
    if saved.module is None:
        raise SettingsError("it is not of RLlib's present API")
    from bam_train.trainers.rllib.rllib_hyperparameters import complete, is_plain

    algorithm, name = RLLIB_ALGORITHMS.get(parts.algorithm), saved.directory.name
    is_rllibs = type(saved.module).__module__.startswith("ray.rllib.algorithms.")
    if not saved.configured or algorithm is None or algorithm.offline or name != POLICY_ID or not is_rllibs:
        raise SettingsError("it is no whole algorithm with one policy of RLlib's own that learns in an environment")
    as_here = parts.flatten != is_plain(parts.observation_space) and not (parts.flatten and parts.filter_first)
    if not as_here or not parts.normalize_actions:
        raise SettingsError("its connectors are others than those of a run here")
    config, model = saved.config, saved.module.model_config
    model = model if isinstance(model, Mapping) else vars(model)
    names = complete(algorithm, {})
    values = {name: getattr(config, name) for name in names if _is_json(getattr(config, name, object()))}
    values["train_batch_size_per_learner"] = config.train_batch_size_per_learner
    values["model_config"] = {name: model[name] for name in names["model_config"] if name in model}
    filter_ = parts.filter
    return TrainSettings.from_mapping(
        {
            "env": env,
            "env_kwargs": dict(env_kwargs),
            "algo": parts.algorithm,
            "trainer": "rllib",
            "steps": max(1, saved.steps),
            "seed": config.seed or 0,
            "num_envs": config.num_envs_per_env_runner * max(1, config.num_env_runners),
            "num_env_runners": config.num_env_runners,
            "num_learners": config.num_learners,
            "normalize": filter_ is not None
            and {"clip_by_value": filter_.limit, "de_mean_to_zero": filter_.center, "de_std_to_one": filter_.scale},
            "hyperparameters": complete(algorithm, json.loads(json.dumps(values))),
        }
    )


def _is_json(value: Any) -> bool:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def states(directory: Directory) -> dict[str, bytes]:
    """The states of a whole algorithm as members of a checkpoint, without the pickles that construct objects.

    Raises:
        CheckpointError: A state cannot be read.
    """
    from bam_train.trainers.rllib.rllib_state import FOLDER, NOTES, STATES

    root = directory.root or directory.policy
    files = sorted(path for path in root.rglob("*.pkl") if path.name in STATES)
    tree = {FOLDER + path.relative_to(root).as_posix(): directory.read_bytes(path) for path in files}
    return {NOTES: b"{}", **tree}


# The old API stack

_BEFORE = ("ObsPreprocessorConnector", "StateBufferConnector", "ViewRequirementAgentConnector")
_FILTERS = ("MeanStdObservationFilterAgentConnector", "ConcurrentMeanStdObservationFilterAgentConnector")
_AFTER = ("ConvertToNumpyConnector", "ImmutableActionsConnector", "NormalizeActionsConnector", "ClipActionsConnector")
_ACTIVATIONS: dict[Any, Any] = {"tanh": nn.Tanh, "relu": nn.ReLU, "swish": nn.SiLU, "silu": nn.SiLU, "elu": nn.ELU}
_MALFORMED = (AttributeError, LookupError, TypeError, ValueError, AssertionError, OverflowError, RuntimeError)


def read_old_policy(directory: Directory) -> SavedPolicy:
    """Read a policy of the old API stack, without running code.

    Raises:
        CheckpointError: Its file is missing or damaged.
        PolicyError: A part of it cannot be frozen.
    """
    path = directory.policy / OLD_STATE
    try:
        state = read_state(directory.read_bytes(path), skip_objects=True)
        return _old_policy(directory, state)
    except FormatError as error:
        raise directory.altered(path, f"{error}. {AGAIN}") from error
    except _MALFORMED as error:
        reason = " ".join(str(error).split())
        raise directory.altered(path, f"is not the state of a policy: {type(error).__name__} {reason:.160}") from error


def _old_policy(directory: Directory, state: Mapping[str, Any]) -> SavedPolicy:
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
    after_names = [kind for kind, _ in after]
    strange = [kind for kind, _ in before if kind not in (*_BEFORE, *_FILTERS, "ClipRewardAgentConnector")]
    for kind in strange + [kind for kind in after_names if kind not in _AFTER]:
        raise PolicyError(f"connector {kind} cannot be frozen; expected those that RLlib adds itself")
    actions = config
    if after_names:
        actions = {f"{do}_actions": f"{do.title()}ActionsConnector" in after_names for do in ("normalize", "clip")}
    filters = [
        Filter.of(state["running_stats"][0], state["clip"], state["demean"], state["destd"])
        for kind, state in before
        if kind in _FILTERS
    ]
    model = {**config["model"], **(config.get("policy_model_config") or {})}
    parts = PolicyParts(
        algorithm=algorithm,
        observation_space=space,
        action_space=action_space,
        network=_network(state["weights"], model, squashed),
        filter=filters[0] if filters else None,
        flatten=not (isinstance(space, spaces.Box) and len(space.shape) == 1),
        normalize_actions=bool(actions.get("normalize_actions")),
        clip_actions=bool(actions.get("clip_actions")),
    )
    env, env_kwargs = _named(config.get("env"), config.get("env_config"))
    return SavedPolicy(directory, parts, env, env_kwargs, int(state.get("global_timestep") or 0), whole=True)


def _space(value: Mapping[str, Any]) -> AnySpace:
    """The space before any preprocessor, from `space_to_dict` of the old stack."""
    value = value.get("original_space", value)
    fields = value["space"] if isinstance(value["space"], Mapping) else value
    kind = fields["space"]
    if kind == "box":
        low, high, shape = unpacked_array(fields["low"]), unpacked_array(fields["high"]), tuple(fields["shape"])
        if not low.shape == high.shape == shape:  # a number would be broadcast to a shape of any size
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


def _network(weights: Mapping[str, Any], model: Mapping[str, Any], squashed: bool) -> nn.Module:
    """Build RLlib's `FullyConnectedNetwork`, whose layers are `SlimFC`, a linear layer and its activation."""
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
