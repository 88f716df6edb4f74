"""Any checkpoint directory of RLlib, of an algorithm or a policy, of the new or the old API stack, as `PolicyParts`.

Its files are pickles, and nothing in them is run: `pickles` says what they hold. What a file says only by running it
(a module class of the user's own) needs ``trust``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bam_train.compat.rllib.directory import ARGUMENTS, MODULE, Directory
from bam_train.compat.rllib.old_stack import read_old_policy
from bam_train.compat.rllib.parts import FAULTS, ForeignPolicy, read_filter, read_weights
from bam_train.compat.rllib.records import attributes, class_name, constructor, last_name, space_of
from bam_train.errors import AlteredCheckpoint, FormatError, PolicyError
from bam_train.trainers.rllib.freezing.parts import (
    AnySpace,
    PolicyParts,
    connector_parts,
    is_own,
    plain_config,
)

_AFTER = frozenset(  # connectors that only move actions about
    {
        "GetActions",
        "ListifyDataForVectorEnv",
        "ModuleToAgentUnmapping",
        "NormalizeAndClipActions",
        "RemoveSingleTsTimeRankFromBatch",
        "TensorToNumpy",
        "UnBatchToIndividualItems",
    }
)


def read_policy(directory: Directory) -> ForeignPolicy:
    """Read one policy.

    Raises:
        CheckpointError: A file is missing, damaged or cannot be read without running it.
        PolicyError: Something in it cannot be frozen.
    """
    return read_old_policy(directory) if directory.old_stack else _new_policy(directory)


def _new_policy(directory: Directory) -> ForeignPolicy:
    own_class, _, given = _arguments(directory, directory.policy / ARGUMENTS)
    name = class_name(own_class)
    weights = read_weights(directory, directory.policy / MODULE, directory.state(directory.policy / MODULE))
    config = _config(directory)
    pipelines = _pipelines(directory)
    seen = _spaces(directory, given)
    fields: dict[str, Any] = {"observation_space": seen[0], "action_space": seen[1], **(pipelines or {})}
    parts = PolicyParts(
        algorithm=config.algorithm or _algorithm_of(name),
        weights=weights,
        model_config=plain_config(attributes(given.get("model_config") or {})),
        module_class=name,
        module=None if is_own(name) else _foreign_module(directory, name),
        **fields,
    )
    known = bool(config.algorithm)
    env_kwargs, whole = dict(config.env_kwargs), pipelines is not None
    return ForeignPolicy(parts, config.env, env_kwargs, _steps(directory), whole, known, config.fields)


def _arguments(directory: Directory, path: Any) -> tuple[Any, tuple[Any, ...], dict[str, Any]]:
    return _constructor(directory, path, directory.record(path))


def _constructor(directory: Directory, path: Any, value: Any) -> tuple[Any, tuple[Any, ...], dict[str, Any]]:
    try:
        return constructor(value)
    except FormatError as error:
        raise directory.altered(path, str(error)) from error


def _spaces(directory: Directory, given: Mapping[str, Any]) -> tuple[AnySpace, AnySpace]:
    """The module's own spaces, which come after the connectors."""
    try:
        return space_of(given["observation_space"]), space_of(given["action_space"])
    except KeyError as error:
        raise directory.altered(directory.policy / ARGUMENTS, f"lacks the field {error}") from error
    except FormatError as error:
        raise directory.altered(directory.policy / ARGUMENTS, f"cannot be read: {error}") from error


def _foreign_module(directory: Directory, name: str) -> Any:
    """A module whose class is not RLlib's: only its own code can make it."""
    if not directory.trust:
        raise directory.altered(
            directory.policy / ARGUMENTS,
            f"names the module class {name}, which is not RLlib's own. If you trust its maker, add --trust-pickle, "
            "which imports and runs it",
        )
    from ray.rllib.core.rl_module.rl_module import RLModule

    directory.warn(f"making {name} runs its code (--trust-pickle)")
    try:
        return RLModule.from_checkpoint(str(directory.policy))
    except Exception as error:  # anything: it is a program
        reason = " ".join(str(error).split())
        text = f"cannot be made into a module: {type(error).__name__}: {reason:.160}"
        raise directory.altered(directory.policy / ARGUMENTS, text) from error


def _algorithm_of(name: str) -> str:
    """The algorithm whose module this is: some have that of another, such as IMPALA PPO's."""
    match = re.match(r"ray\.rllib\.algorithms\.(\w+)\.", name)
    return match[1] if match else ""


@dataclass(frozen=True)
class _Config:
    algorithm: str = ""
    env: str | None = None
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    fields: Mapping[str, Any] = field(default_factory=dict)


def _config(directory: Directory) -> _Config:
    """Algorithm and environment in the algorithm's own files; nothing if only the policy is there, or it says more."""
    root = directory.root
    path = None if root is None else root / ARGUMENTS
    if path is None or not path.is_file():
        return _Config()
    try:
        kind, args, kwargs = _constructor(directory, path, directory.outline(path))
    except AlteredCheckpoint as error:
        directory.warn(f"{error.member} says more than names and numbers, and is left out")
        return _Config()
    given = attributes(args[0]) if args else attributes(kwargs.get("config") or {})
    return _settings(last_name(kind).lower(), given)


def _settings(algorithm: str, given: Mapping[str, Any]) -> _Config:
    env, more = given.get("env"), given.get("env_config")
    kwargs = dict(more) if isinstance(more, Mapping) else {}
    return _Config(algorithm, env if isinstance(env, str) else None, kwargs, given)


def _pipelines(directory: Directory) -> dict[str, Any] | None:
    """What the env runner's connectors do, and the environment's own spaces."""
    runner = directory.root / "env_runner" if directory.root else directory.folder
    before, after = runner / "env_to_module_connector", runner / "module_to_env_connector"
    if not (before / ARGUMENTS).is_file():
        return None
    _, args, kwargs = _arguments(directory, before / ARGUMENTS)
    pieces = _pieces(directory, before / ARGUMENTS, kwargs)
    fields: dict[str, Any] = connector_parts([name for name, _ in pieces])
    if any(given.get("keys_to_remove") for _, given in pieces):
        raise PolicyError("FlattenObservations that removes keys cannot be frozen")
    if any(name == "AgentToModuleMapping" for name, _ in pieces):
        if fields["flatten"] or any(name == "MeanStdFilter" for name, _ in pieces):
            raise PolicyError("connectors of several agents cannot be frozen")
        return {**fields, **_after(directory, after / ARGUMENTS)}  # the spaces are those of all agents together
    try:
        fields["observation_space"], fields["action_space"] = (space_of(space) for space in args[:2])
    except (FormatError, ValueError) as error:
        raise directory.altered(before / ARGUMENTS, f"does not hold two spaces: {error}") from error
    if any(name == "MeanStdFilter" for name, _ in pieces):
        path = before / "MeanStdFilter" / "state.pkl"
        fields["filter"] = read_filter(directory, path, directory.state(path))
    return {**fields, **_after(directory, after / ARGUMENTS)}


def _pieces(directory: Directory, path: Any, kwargs: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Class name and keyword arguments of every connector of a pipeline."""
    try:
        return [(last_name(kind), dict(given)) for kind, _, given in kwargs["connectors"]]
    except FAULTS as error:
        raise directory.altered(path, "does not list its connectors") from error


def _after(directory: Directory, path: Any) -> dict[str, bool]:
    """What is done with actions on their way to the environment."""
    _, _, kwargs = _arguments(directory, path)
    found = {"normalize_actions": False, "clip_actions": False}
    for name, given in _pieces(directory, path, kwargs):
        if name not in _AFTER:
            raise PolicyError(f"connector {name} cannot be frozen; expected those that RLlib adds itself")
        if name == "NormalizeAndClipActions":
            found = {key: bool(given.get(key)) for key in found}
    return found


def _steps(directory: Directory) -> int:
    path = None if directory.root is None else directory.root / "env_runner" / "state.pkl"
    if path is None or not path.is_file():
        return 0
    state = directory.state(path)
    found = state.get("num_env_steps_sampled_lifetime", 0) if isinstance(state, Mapping) else 0
    return int(found) if isinstance(found, (int, float, np.number)) and found > 0 else 0
