"""From a checkpoint directory of RLlib to a checkpoint.zip that can be evaluated and deployed, and resumed if whole.

The file is long because every way in which directory and environment may differ has a refusal of its own.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from bam_envs.core.errors import UnknownName
from bam_envs.core.registry import are_same, entry_of, resolve_id
from bam_envs.core.spaces import space_to_json
from bam_envs.robo_gym.options import PLACES
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, safetensors_file, write_checkpoint
from bam_train.compat.rllib.directory import Directory, find_policy
from bam_train.compat.rllib.parts import ForeignPolicy
from bam_train.compat.rllib.reading import read_policy
from bam_train.compat.rllib.training import states, training_settings
from bam_train.environments import (
    control_period,
    first_difference,
    make_env,
    must_be_named,
    parity_if_needed,
    require_env_kwargs,
)
from bam_train.errors import CheckpointMismatch, PolicyError, SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.policy.array_specs import array_spec, observation_arrays
from bam_train.policy.golden_check import TOLERANCE, worst_difference
from bam_train.settings import TrainSettings
from bam_train.trainers.freezing.golden import pack
from bam_train.trainers.manifest import origin
from bam_train.trainers.rllib.freezing.by_hand import actions_by_hand
from bam_train.trainers.rllib.freezing.freeze import freeze
from bam_train.trainers.rllib.freezing.golden import clear_observations
from bam_train.trainers.rllib.freezing.parts import AnySpace, Array, PolicyParts, leaf_spaces
from bam_train.trainers.rllib_algorithms import ALGORITHMS

EXPORTED = "exported"
"""Setting of the manifest that says where an exported checkpoint comes from; a run's own has none of this name."""


@dataclass(frozen=True)
class Exported:
    """A policy out of a directory, frozen and checked."""

    directory: Directory
    parts: PolicyParts
    """Its spaces are the environment's own."""
    env: str
    """Versioned id."""
    env_kwargs: dict[str, Any]
    steps: int
    signals: dict[str, Any]
    period: float | None
    graph: bytes
    """ONNX."""
    golden: bytes
    """Observations and the actions that the graph was checked against."""
    checked_by: str
    """What computed those actions: RLlib with its version, or NumPy."""
    difference: float
    """The largest difference from them."""
    policy: FrozenPolicy
    training: TrainSettings | str
    """Settings of a run that goes on from it, or why there is none."""

    def write(self, path: Path) -> Checkpoint:
        """Write the checkpoint.zip.

        Raises:
            OutputError: It cannot be written there.
        """
        source = {
            "directory": str(self.directory.folder),
            "policy": self.directory.name,
            "ray": self.directory.ray_version,
            "golden": self.checked_by,
        }
        settings: dict[str, Any] = {EXPORTED: source}
        members = {POLICY: self.graph, GOLDEN: self.golden}
        made_by = origin()
        if isinstance(self.training, TrainSettings):
            settings |= self.training.to_mapping()
            members |= states(self.directory)
            made_by["versions"] = {**made_by["versions"], "ray": self.directory.ray_version}  # whose states they are
        fields = {
            "env": self.env,
            "env_kwargs": self.env_kwargs,
            "observation_space": self.policy.observation_space,
            "action_space": self.policy.action_space,
            "signals": self.signals,
            "period": self.period,
            "algorithm": self.parts.algorithm,
            "trainer": "rllib",
            "settings": settings,
            "steps": self.steps,
            "seed": settings.get("seed", 0),
            "scores": {},
            **made_by,
        }
        return write_checkpoint(path, fields, members)


def export(
    given: Path,
    *,
    env: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    algo: str | None = None,
    policy: str | None = None,
    otherwise: str | None = None,
    trust: bool = False,
    warn: Callable[[str], None] = lambda text: None,
) -> Exported:
    """Read, freeze and check one policy of a checkpoint directory of RLlib.

    Args:
        given: The directory, of an algorithm or of a policy.
        env: Its environment, where the directory does not say it or means another.
        env_kwargs: Arguments of the environment; they win over the directory's.
        algo: Its algorithm, where the directory does not say it.
        policy: Its name, where there are several.
        otherwise: Its environment, where neither `env` nor the directory says it.
        trust: Files that only their own code can read are unpickled, which runs it.
        warn: Told before that is done, and what else the user should know.

    Raises:
        CheckpointError: The directory cannot be used.
        PolicyError: Its policy cannot be frozen.
        UnknownName: No environment is called `env`, or no algorithm `algo`.
        SettingsError: The environment cannot be made.
    """
    directory = find_policy(given, policy, trust=trust, warn=warn)
    foreign = read_policy(directory)
    if env is None and foreign.env is None:
        env = otherwise
    env_id, kwargs = _environment(directory, foreign, env)
    require_env_kwargs(env_id, env_kwargs or {})
    kwargs, (parts, signals, period) = parity_if_needed(
        env_id, {**kwargs, **(env_kwargs or {})}, partial(_in_environment, directory, foreign, env_id, warn), warn
    )
    parts = replace(parts, algorithm=_algorithm(directory, foreign, algo))
    graph = freeze(parts)
    golden, by = _golden(parts)
    frozen = FrozenPolicy.from_graph(graph, *_spaces(parts))
    difference = _checked(directory, frozen, golden, by)
    try:
        training: TrainSettings | str = training_settings(directory, foreign, parts, env_id, kwargs)
    except SettingsError as error:
        training = str(error)
    made = directory, parts, env_id, kwargs, foreign.steps, signals, period
    return Exported(*made, graph, golden, by, difference, frozen, training)


def _spaces(parts: PolicyParts) -> tuple[dict[str, Any], dict[str, Any]]:
    return space_to_json(parts.observation_space), space_to_json(parts.action_space)


def _algorithm(directory: Directory, foreign: ForeignPolicy, asked: str | None) -> str:
    found = foreign.parts.algorithm if re.fullmatch(r"\w{1,40}", foreign.parts.algorithm, re.ASCII) else ""
    asked = None if asked is None else asked.lower()  # PPO, as RLlib says it
    if asked is not None and asked not in ALGORITHMS:
        raise UnknownName("algorithm", asked, ALGORITHMS)
    if asked is None and not found:
        raise CheckpointMismatch(directory.given, "does not say which algorithm trained it; give --algo NAME")
    if asked is not None and found and asked != found and foreign.algorithm_known:
        raise CheckpointMismatch(directory.given, f"was trained by {found}, not by {asked}; leave --algo out")
    return asked or found


def _environment(directory: Directory, foreign: ForeignPolicy, asked: str | None) -> tuple[str, dict[str, Any]]:
    """Id and keyword arguments of the environment: what was asked for, else what the directory says."""
    own = _own_environment(directory, foreign.env, asked)
    if asked is None and own is None:
        raise CheckpointMismatch(directory.given, "does not say on which environment it was trained; give --env ID")
    env = resolve_id(asked) if asked is not None else str(own)
    if own is not None and are_same(env, own):
        given = _plain(directory, foreign.env_kwargs)
        return env, {name: given[name] for name in given if entry_of(env) is None or name not in PLACES}
    if foreign.env_kwargs:
        names = ", ".join(map(str, foreign.env_kwargs))
        directory.warn(f"the env_config of its own environment ({names:.200}) is not given to {env}")
    return env, {}


def _own_environment(directory: Directory, name: str | None, asked: str | None) -> str | None:
    """The environment that the directory names, if it is known here; its module is imported only if the user says so.

    Raises:
        CheckpointMismatch: It is not known, and no other was asked for.
    """
    module = (name or "").rpartition(":")[0]
    if name is None or (asked is not None and module and asked != name):
        return None
    if asked is None and not directory.trust and must_be_named(name):
        text = f"was trained on {name!r}, and importing {module!r} runs its code. If you trust it, give --env {name!r}"
        raise CheckpointMismatch(directory.given, text)
    try:
        return resolve_id(name)
    except UnknownName as error:
        if asked is not None:
            return None
        text = f"was trained on {name!r}, which is not known here; give --env ID, or --env module:ID"
        raise CheckpointMismatch(directory.given, text) from error


def _plain(directory: Directory, kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments as JSON values; NumPy's numbers and arrays as Python's."""
    try:
        return dict(json.loads(json.dumps(dict(kwargs), allow_nan=False, default=_of_numpy)))
    except (TypeError, ValueError, RecursionError) as error:
        text = f"its env_config holds more than plain values ({', '.join(map(str, kwargs))}), which cannot be kept"
        raise CheckpointMismatch(directory.given, f"{text}; train with plain ones") from error


def _of_numpy(value: Any) -> Any:
    if not isinstance(value, (np.ndarray, np.generic)):
        raise TypeError(type(value).__name__)
    return value.tolist()


def _in_environment(
    directory: Directory,
    foreign: ForeignPolicy,
    env_id: str,
    warn: Callable[[str], None],
    env_kwargs: dict[str, Any],
) -> tuple[PolicyParts, dict[str, Any], float | None]:
    """The parts with the environment's own spaces, its signals and its period."""
    with contextlib.closing(make_env(env_id, env_kwargs)) as env:
        parts = _fitted(directory, foreign, env_id, env, warn)
        describe = getattr(env.unwrapped, "describe", None)
        return parts, {} if describe is None else describe(), control_period(env)


def _fitted(
    directory: Directory, foreign: ForeignPolicy, env_id: str, env: gym.Env[Any, Any], warn: Callable[[str], None]
) -> PolicyParts:
    """The parts with the environment's own spaces, which must be those that the policy was trained with.

    Raises:
        CheckpointMismatch: Names the first difference.
    """
    parts = foreign.parts
    pairs = [("action_space", parts.action_space, env.action_space)]
    if foreign.whole:
        pairs.append(("observation_space", parts.observation_space, env.observation_space))
    else:
        parts = _guessed(directory, parts, env_id, env.observation_space, warn)
    for name, theirs, ours in pairs:
        found = first_difference(_from_zero(space_to_json(theirs)), _from_zero(space_to_json(ours)), name)
        if found is not None:
            what, there, here = found
            text = f"{what} is {_short(there)} in the directory and {_short(here)} in {env_id}"
            raise CheckpointMismatch(directory.given, f"{text}; give the environment it was trained on with --env")
    _require_from_zero(parts.action_space)
    return replace(parts, observation_space=env.observation_space, action_space=env.action_space)


def _guessed(
    directory: Directory, parts: PolicyParts, env_id: str, ours: AnySpace, warn: Callable[[str], None]
) -> PolicyParts:
    """Parts of a policy alone, whose directory does not say what came before and after the network."""
    theirs = parts.observation_space
    if space_to_json(theirs) == space_to_json(ours):
        return parts
    shape, width = theirs.shape or (), sum(_width(leaf) for leaf in leaf_spaces(ours).values())
    if not isinstance(theirs, spaces.Box) or (theirs.shape != ours.shape and shape != (width,)):
        text = f"its network takes observations {_space(theirs)}, and {env_id} gives {_space(ours)}"
        raise CheckpointMismatch(directory.given, f"{text}; give the environment it was trained on with --env")
    if np.isfinite(theirs.low).any() or np.isfinite(theirs.high).any():
        text = f"its network takes observations {_space(theirs)}, and {env_id} gives {_space(ours)}: what RLlib did to "
        more = "them in between (MeanStdFilter) is not in a policy's directory. Give that of the whole algorithm"
        raise CheckpointMismatch(directory.given, text + more)
    warn("a policy's directory does not say how observations were flattened: taken as FlattenObservations does it")
    return replace(parts, flatten=True)


def _width(space: AnySpace) -> int:
    """Numbers of a flattened array."""
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    if isinstance(space, spaces.MultiDiscrete):
        return int(space.nvec.sum())
    return math.prod(space.shape or ())


def _from_zero(space: Any) -> Any:
    """A space's JSON form without ``start`` of whole numbers: the trainer may have seen them counted from 0."""
    if not isinstance(space, Mapping):
        return space
    if space.get("type") == "Dict":
        return {**space, "spaces": {key: _from_zero(inner) for key, inner in sorted(dict(space["spaces"]).items())}}
    return {key: value for key, value in space.items() if key != "start"}


def _require_from_zero(space: AnySpace) -> None:
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) and np.any(space.start):
        raise PolicyError(
            f"action space {space}: RLlib counts actions from 0 whatever their start; it cannot be frozen"
        )


def _space(space: AnySpace) -> str:
    """A space in short."""
    return f"{type(space).__name__}{space.shape}" if isinstance(space, spaces.Box) else _short(space_to_json(space))


def _short(value: Any, most: int = 60) -> str:
    text = json.dumps(value)
    return text if len(text) <= most else text[: most - 3] + "..."


def _golden(parts: PolicyParts) -> tuple[bytes, str]:
    """Observations and actions for them, and who computed those: RLlib's own code if it is there, else NumPy."""
    observations = clear_observations(parts)
    actions, by = _reference_actions(parts, observations)
    return pack(observations, actions), by


def _reference_actions(parts: PolicyParts, observations: dict[str, Array]) -> tuple[Array, str]:
    if parts.old_stack:
        return actions_by_hand(parts, observations), "NumPy"
    try:
        from bam_train.trainers.rllib.freezing.reference import remade, rllib_actions
    except ModuleNotFoundError:
        return actions_by_hand(parts, observations), "NumPy"
    return rllib_actions(parts, *remade(parts), observations), f"RLlib {metadata.version('ray')}"


def _checked(directory: Directory, policy: FrozenPolicy, golden: bytes, by: str) -> float:
    """Act on the golden observations; the largest difference."""
    parts, action = observation_arrays(policy.observation_space), array_spec("action", policy.action_space)
    worst, _ = worst_difference(policy, parts, action, safetensors_file.parse(golden))
    if not worst <= TOLERANCE:  # NaN too
        text = f"its frozen policy differs by {worst:.3g} from the actions of {by}"
        raise PolicyError(f"{directory.given}: {text}, expected at most {TOLERANCE}: this network cannot be exported")
    return worst
