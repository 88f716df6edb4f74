"""What training goes on from, out of a whole algorithm's directory: its settings as ours, and its states."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from bam_train.compat.rllib.directory import Directory
from bam_train.compat.rllib.parts import ForeignPolicy
from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.rllib.freezing.parts import POLICY_ID, PolicyParts
from bam_train.trainers.rllib_algorithms import ALGORITHMS


def training_settings(
    directory: Directory, foreign: ForeignPolicy, parts: PolicyParts, env: str, env_kwargs: Mapping[str, Any]
) -> TrainSettings:
    """The settings of a run that goes on where the directory's algorithm stopped.

    Args:
        directory: Where it is.
        foreign: What it says.
        parts: Its policy, with the environment's own spaces.
        env: Versioned id.
        env_kwargs: The environment's arguments.

    Raises:
        SettingsError: There is no such run here; says why.
    """
    if directory.root is None or directory.old_stack or not foreign.config:
        raise SettingsError("it is not a whole algorithm of RLlib's present API")
    algorithm = ALGORITHMS.get(parts.algorithm)
    if algorithm is None or algorithm.offline or directory.name != POLICY_ID or parts.module is not None:
        raise SettingsError("it is more than one policy of RLlib's own that learns in an environment")
    try:
        from bam_train.trainers.rllib import hyperparameters
        from bam_train.trainers.rllib.config import is_plain
    except ModuleNotFoundError as error:
        raise SettingsError('its settings cannot be checked without RLlib: pip install "bam-train[rllib]"') from error
    as_here = parts.flatten != is_plain(parts.observation_space) and not (parts.flatten and parts.filter_first)
    if not as_here or not parts.normalize_actions:
        raise SettingsError("its connectors are others than those of a run here")
    config = foreign.config
    names = hyperparameters.complete(algorithm, {})
    own = json.loads(json.dumps({name: config[name] for name in names if name in config and _is_json(config[name])}))
    batch = config.get("_train_batch_size_per_learner") or config.get("train_batch_size")  # as RLlib's own property
    own |= {} if batch is None else {"train_batch_size_per_learner": batch}
    model = {name: value for name, value in parts.model_config.items() if name in names["model_config"]}
    values = hyperparameters.complete(algorithm, {**own, "model_config": model})
    runners = _count(config, "num_env_runners", 0)
    return TrainSettings.from_mapping(
        {
            "env": env,
            "env_kwargs": dict(env_kwargs),
            "algo": parts.algorithm,
            "trainer": "rllib",
            "steps": max(1, foreign.steps),
            "seed": _count(config, "seed", 0),
            "num_envs": _count(config, "num_envs_per_env_runner", 1) * max(1, runners),
            "num_env_runners": runners,
            "num_learners": _count(config, "num_learners", 0),
            "normalize": _normalize(parts),
            "hyperparameters": values,
        }
    )


def _normalize(parts: PolicyParts) -> bool | dict[str, Any]:
    """The arguments of its `MeanStdFilter`, if it has one."""
    if parts.filter is None:
        return False
    limit, center, scale = parts.filter.limit, parts.filter.center, parts.filter.scale
    return {"clip_by_value": limit, "de_mean_to_zero": center, "de_std_to_one": scale}


def _count(config: Mapping[str, Any], name: str, otherwise: int) -> int:
    value = config.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= otherwise else otherwise


def _is_json(value: Any) -> bool:
    """Whether JSON can hold it."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def states(directory: Directory) -> dict[str, bytes]:
    """The states of a whole algorithm as members of a checkpoint; how objects are made is left out.

    Raises:
        CheckpointError: One cannot be read.
    """
    from bam_train.trainers.rllib.state import FOLDER, NOTES, STATES

    root = directory.root or directory.folder
    files = sorted(path for path in root.rglob("*.pkl") if path.name in STATES)
    tree = {FOLDER + path.relative_to(root).as_posix(): directory.read_bytes(path) for path in files}
    return {NOTES: b"{}", **tree}
