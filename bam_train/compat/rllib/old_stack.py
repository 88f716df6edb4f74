"""One policy of RLlib's old API stack, out of its ``policy_state.pkl``, as `PolicyParts`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium import spaces

from bam_train.compat.rllib.directory import STATE, Directory
from bam_train.compat.rllib.parts import FAULTS, ForeignPolicy, read_filter, read_weights
from bam_train.compat.rllib.records import attributes, old_space
from bam_train.errors import CheckpointMismatch, FormatError, PolicyError
from bam_train.trainers.rllib.freezing.parts import AnySpace, Filter, PolicyParts

_OLD_BEFORE = frozenset({"ObsPreprocessorConnector", "StateBufferConnector", "ViewRequirementAgentConnector"})
_OLD_FILTERS = ("MeanStdObservationFilterAgentConnector", "ConcurrentMeanStdObservationFilterAgentConnector")
_OLD_AFTER = frozenset({"ConvertToNumpyConnector", "ImmutableActionsConnector"})


def read_old_policy(directory: Directory) -> ForeignPolicy:
    """Read one policy of the old API stack.

    Raises:
        CheckpointError: Its file is missing, damaged or cannot be read without running it.
        PolicyError: Something in it cannot be frozen.
    """
    path = directory.policy / STATE
    state = directory.record(path)
    try:
        spec = state["policy_spec"]
        config = attributes(spec["config"])
        space, action_space = old_space(spec["observation_space"]), old_space(spec["action_space"])
        connectors = state.get("connector_configs") or {}
        before, after = (connectors.get(kind, ("", []))[1] for kind in ("agent", "action"))
        steps, name = int(state.get("global_timestep") or 0), str(spec["policy_class"])
        model = {**attributes(config["model"]), **_own_model(config)}
    except FormatError as error:
        raise directory.altered(path, f"cannot be read: {error}") from error
    except FAULTS as error:
        raise directory.altered(path, f"is not the state of a policy: {type(error).__name__} {error}") from error
    bounds: dict[str, Any] = _old_after(after, config)
    parts = PolicyParts(
        algorithm=name.removesuffix("Policy").removesuffix("Torch").lower(),
        observation_space=space,
        action_space=action_space,
        weights=read_weights(directory, path, state["weights"]),
        model_config={key: value for key, value in model.items() if "initializer" not in key},
        filter=_old_filter(directory, path, before),
        flatten=not (isinstance(space, spaces.Box) and len(space.shape) == 1),
        squash=name.startswith(("SAC", "CQL")) and isinstance(action_space, spaces.Box),
        old_stack=True,
        **bounds,
    )
    _require_old(directory, name, config, space)
    env, kwargs = config.get("env"), config.get("env_config")
    env = env if isinstance(env, str) else None
    return ForeignPolicy(
        parts, env, dict(kwargs) if isinstance(kwargs, Mapping) else {}, steps, whole=True, algorithm_known=True
    )


def _own_model(config: Mapping[str, Any]) -> dict[str, Any]:
    """What SAC and DQN say of their networks outside the model config."""
    own = {key: config[key] for key in ("noisy", "num_atoms", "dueling") if key in config}
    return {**own, **attributes(config.get("policy_model_config") or {})}


def _require_old(directory: Directory, name: str, config: Mapping[str, Any], space: AnySpace) -> None:
    if not name.removesuffix("Policy").endswith("Torch"):
        raise CheckpointMismatch(directory.given, f"has a policy of class {name}; expected one of RLlib's for torch")
    keys = list(space.spaces) if isinstance(space, spaces.Dict) else []
    if keys != sorted(keys):
        raise PolicyError(f"observation keys {keys} of the old API stack are not in alphabetical order: not frozen")
    if config.get("normalize_actions") is False and name.startswith(("SAC", "CQL")):
        raise PolicyError("SAC of the old API stack without normalize_actions has a Beta distribution: not frozen")


def _old_filter(directory: Directory, path: Any, connectors: Any) -> Filter | None:
    found = None
    for name, given in connectors:
        if name in _OLD_FILTERS:
            if not given.get("running_stats"):
                raise directory.altered(path, f"holds no statistics of {name}")
            names = {"demean": "de_mean_to_zero", "destd": "de_std_to_one", "clip": "clip_by_value"}
            entry = {names.get(key, key): value for key, value in given.items()}
            found = read_filter(directory, path, {None: entry})
        elif name not in _OLD_BEFORE and name != "ClipRewardAgentConnector":
            raise PolicyError(f"connector {name} cannot be frozen; expected those that RLlib adds itself")
    return found


def _old_after(connectors: Any, config: Mapping[str, Any]) -> dict[str, bool]:
    names = [name for name, _ in connectors]
    if not names:
        return {key: bool(config.get(key)) for key in ("normalize_actions", "clip_actions")}
    for name in names:
        if name not in _OLD_AFTER | {"NormalizeActionsConnector", "ClipActionsConnector"}:
            raise PolicyError(f"connector {name} cannot be frozen; expected those that RLlib adds itself")
    return {
        "normalize_actions": "NormalizeActionsConnector" in names,
        "clip_actions": "ClipActionsConnector" in names,
    }
