"""Export a checkpoint directory of RLlib as a checkpoint.zip that can be evaluated and deployed, and resumed if whole.

A directory of RLlib's current API is restored by the installed RLlib, which runs the code in it, so only with
``trust``; a directory of the old layout is read without running code.
"""

import contextlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.core.errors import UnknownName
from bam_envs.core.registry import are_same, entry_of, resolve_id
from bam_envs.core.spaces import leaves, space_to_json
from bam_envs.robo_gym.making import PLACES
from bam_train.checkpoint import safetensors_file
from bam_train.compat.exported import Exported, exported
from bam_train.compat.rllib_directory import Directory, find_policy
from bam_train.compat.rllib_layouts import SavedPolicy, read_old_policy, restore, states, training_settings
from bam_train.environments import (
    described,
    first_difference,
    make_env,
    must_be_named,
    parity_if_needed,
    require_env_kwargs,
    short_json,
)
from bam_train.errors import CheckpointMismatch, PolicyError, SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS
from bam_train.trainers.rllib.rllib_freezing import AnySpace, FrozenModule, PolicyParts, RLlibPolicy
from bam_train.trainers.zero_based_spaces import space_from_zero


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
        env: The environment, if the directory does not name it or names another.
        env_kwargs: Arguments of the environment, which override the directory's.
        algo: The algorithm, if the directory does not name it.
        policy: The policy's name, if there are several.
        otherwise: The environment, if neither `env` nor the directory names it.
        trust: Whether to unpickle a directory of the current API, which runs the code in it.
        warn: Called with messages for the user, and before anything is unpickled.

    Raises:
        CheckpointError: The directory cannot be used.
        PolicyError: Its policy cannot be frozen.
        UnknownName: No environment is called `env`, or no algorithm `algo`.
        SettingsError: The environment cannot be made.
    """
    directory = find_policy(given, policy)
    saved = _read(directory, trust, warn)
    env_id, kwargs = _environment(saved, env or (otherwise if saved.env is None else None), trust, warn)
    require_env_kwargs(env_id, env_kwargs or {})
    fitted = partial(_in_environment, saved, env_id, warn)
    kwargs, (parts, signals, period) = parity_if_needed(env_id, {**kwargs, **(env_kwargs or {})}, fitted, warn)
    parts = replace(parts, algorithm=_algorithm(saved, algo))
    if saved.module is None:  # the network in PyTorch
        by, own = "PyTorch", None
    else:
        env_spaces = parts.observation_space, parts.action_space
        own = partial(RLlibPolicy, saved.module, saved.env_to_module, saved.config, env_spaces)
        by = f"RLlib {metadata.version('ray')}"
    graph, arrays = FrozenModule(parts, own).members()
    frozen = FrozenPolicy.from_graph(graph, *map(space_to_json, (parts.observation_space, parts.action_space)))
    source = {"directory": str(given.expanduser().absolute()), "policy": directory.name, "ray": directory.ray_version}
    facts = {"env": env_id, "env_kwargs": kwargs, "signals": signals, "period": period, "steps": saved.steps}
    facts |= {"algorithm": parts.algorithm, "trainer": "rllib"}
    made = exported(str(given), frozen, graph, safetensors_file.parse(arrays), source, by, **facts)
    try:
        run = training_settings(saved, parts, env_id, kwargs)
    except SettingsError as error:
        return replace(made, cannot_resume=str(error))
    settings = {**made.fields["settings"], **run.to_mapping()}
    versions = {**made.fields["versions"], "ray": directory.ray_version}  # of these states
    fields = {**made.fields, "settings": settings, "seed": run.seed, "versions": versions}
    return replace(made, fields=fields, members={**made.members, **states(directory)}, cannot_resume="")


def _read(directory: Directory, trust: bool, warn: Callable[[str], None]) -> SavedPolicy:
    if directory.old_layout:
        return read_old_policy(directory)
    if not trust:
        text = "is read by RLlib itself, which runs whatever code is in its pickles. If you trust its maker, add "
        raise CheckpointMismatch(directory.given, f"{text}--trust-pickle")
    if find_spec("ray") is None:
        text = 'is read by RLlib itself, which is not installed. Run: pip install "bam-train[rllib]"'
        raise CheckpointMismatch(directory.given, text)
    warn(f"reading {directory.given} runs whatever code is in it (--trust-pickle)")
    return restore(directory)


def _algorithm(saved: SavedPolicy, asked: str | None) -> str:
    """Name of the algorithm; the directory of a policy alone has only the algorithm of the network's class."""
    known = saved.parts.algorithm if re.fullmatch(r"\w{1,40}", saved.parts.algorithm, re.ASCII) else ""
    asked = None if asked is None else asked.lower()  # such as RLlib's name PPO
    if asked is not None and asked not in RLLIB_ALGORITHMS:
        raise UnknownName("algorithm", asked, RLLIB_ALGORITHMS)
    if asked is None and not known:
        raise CheckpointMismatch(saved.directory.given, "does not say which algorithm trained it; give --algo NAME")
    if asked is not None and known and asked != known and saved.configured:
        raise CheckpointMismatch(saved.directory.given, f"was trained by {known}, not by {asked}; leave --algo out")
    return asked or known


def _environment(
    saved: SavedPolicy, asked: str | None, trust: bool, warn: Callable[[str], None]
) -> tuple[str, dict[str, Any]]:
    """Id and keyword arguments of the environment `asked`, or else of the directory's."""
    trained, given = _trained_environment(saved, asked, trust), saved.directory.given
    if asked is None and trained is None:
        raise CheckpointMismatch(given, "does not say on which environment it was trained; give --env ID")
    env = resolve_id(asked) if asked is not None else str(trained)
    names = ", ".join(map(str, saved.env_kwargs))
    if trained is None or not are_same(env, trained):
        if names:
            warn(f"the env_config of its own environment ({names:.200}) is not given to {env}")
        return env, {}
    try:
        text = json.dumps(dict(saved.env_kwargs), allow_nan=False, default=lambda array: array.tolist())
    except (TypeError, ValueError, RecursionError, AttributeError) as error:
        text = f"its env_config holds more than plain values ({names}), which cannot be kept; train with plain ones"
        raise CheckpointMismatch(given, text) from error
    kept = json.loads(text).items()
    return env, {name: value for name, value in kept if entry_of(env) is None or name not in PLACES}


def _trained_environment(saved: SavedPolicy, asked: str | None, trust: bool) -> str | None:
    """The environment that the directory names, if it is known here; its module is imported only with consent."""
    name, given = saved.env, saved.directory.given
    module = (name or "").rpartition(":")[0]
    if name is None or (asked is not None and module and asked != name):
        return None
    if asked is None and not trust and must_be_named(name):
        text = f"was trained on {name!r}, and importing {module!r} runs its code. If you trust it, give --env {name!r}"
        raise CheckpointMismatch(given, text)
    try:
        return resolve_id(name)
    except UnknownName as error:
        if asked is not None:
            return None
        text = f"was trained on {name!r}, which is not known here; give --env ID, or --env module:ID"
        raise CheckpointMismatch(given, text) from error


def _in_environment(
    saved: SavedPolicy, env_id: str, warn: Callable[[str], None], env_kwargs: dict[str, Any]
) -> tuple[PolicyParts, dict[str, Any], float | None]:
    """The parts with the environment's spaces, its signals and its period; raises CheckpointMismatch if they differ."""
    with contextlib.closing(make_env(env_id, env_kwargs)) as env:
        signals, period = described(env)
        ours = env.observation_space, env.action_space
    parts = saved.parts if saved.whole else _guessed(saved, env_id, ours[0], warn)
    pairs = [("action_space", _from_zero(parts.action_space), _from_zero(ours[1]))]
    if saved.whole:
        pairs.append(("observation_space", _from_zero(parts.observation_space), _from_zero(ours[0])))
    if found := first_difference(*pairs):
        what, there, here = found
        text = f"{what} is {there} in the directory and {here} in {env_id}"
        raise CheckpointMismatch(saved.directory.given, f"{text}; {_GIVE_ENV}")
    if isinstance(parts.action_space, (spaces.Discrete, spaces.MultiDiscrete)) and np.any(parts.action_space.start):
        text = "RLlib counts actions from 0 whatever their start; it cannot be frozen"
        raise PolicyError(f"action space {parts.action_space}: {text}")
    return replace(parts, observation_space=ours[0], action_space=ours[1]), signals, period


def _from_zero(space: Any) -> dict[str, Any]:
    """A space as JSON; the trainer may have used whole numbers that count from 0."""
    return space_to_json(space_from_zero(space))


_GIVE_ENV = "give the environment it was trained on with --env"


def _guessed(saved: SavedPolicy, env_id: str, ours: AnySpace, warn: Callable[[str], None]) -> PolicyParts:
    """The parts of a policy whose directory lacks the connectors before and after the network."""
    parts, given = saved.parts, saved.directory.given
    theirs = parts.observation_space
    if space_to_json(theirs) == space_to_json(ours):
        return parts
    shape, width = theirs.shape or (), sum(spaces.flatdim(leaf) for leaf in leaves(ours).values())
    text = f"its network takes observations {_space(theirs)}, and {env_id} gives {_space(ours)}"
    if not isinstance(theirs, spaces.Box) or (theirs.shape != ours.shape and shape != (width,)):
        raise CheckpointMismatch(given, f"{text}; {_GIVE_ENV}")
    if np.isfinite(theirs.low).any() or np.isfinite(theirs.high).any():
        more = "what RLlib did to them in between (MeanStdFilter) is not in a policy's directory"
        raise CheckpointMismatch(given, f"{text}: {more}. Give that of the whole algorithm")
    warn("a policy's directory does not say how observations were flattened: taken as FlattenObservations does it")
    return replace(parts, flatten=True)


def _space(space: AnySpace) -> str:
    """A short text for a space."""
    return f"{type(space).__name__}{space.shape}" if isinstance(space, spaces.Box) else short_json(space_to_json(space))
