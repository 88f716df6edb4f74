"""One policy of RLlib's present API, restored by the installed RLlib itself, which runs what is in the directory."""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bam_train.compat.rllib_directory import ARGUMENTS, Directory
from bam_train.errors import AlteredCheckpoint, SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS
from bam_train.trainers.rllib.rllib_freezing import (
    POLICY_ID,
    PolicyParts,
    RLlibPolicy,
    parts_of,
    require_layout_only,
)


@dataclass(frozen=True)
class Restored:
    """What RLlib made of a directory."""

    module: Any
    """The RLModule."""
    env_to_module: Any
    """The env runner's pipeline; None if the directory has none."""
    config: Any
    """The AlgorithmConfig; RLlib's default if the directory has none."""
    whole: bool
    """Whether the directory is of a whole algorithm, with its configuration."""
    steps: int
    """Environment steps trained; 0 if unknown."""

    @property
    def env_spaces(self) -> tuple[Any, Any]:
        """Observation and action space of the environment; the module's own without a pipeline."""
        if self.env_to_module is None:
            return self.module.observation_space, self.module.action_space
        return self.env_to_module.input_observation_space, self.env_to_module.input_action_space

    @property
    def parts(self) -> PolicyParts:
        """What a frozen policy is made of."""
        return parts_of(self.module, self.env_to_module, self.config, self.env_spaces)

    def policy(self, env_spaces: tuple[Any, Any]) -> RLlibPolicy:
        """The same policy, run by RLlib."""
        return RLlibPolicy(self.module, self.env_to_module, self.config, env_spaces)


def restore(directory: Directory) -> Restored:
    """Let RLlib read the directory.

    Raises:
        AlteredCheckpoint: RLlib cannot.
        PolicyError: It has a connector that cannot be frozen.
    """
    from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
    from ray.rllib.connectors.env_to_module import EnvToModulePipeline
    from ray.rllib.connectors.module_to_env import ModuleToEnvPipeline
    from ray.rllib.core.rl_module.rl_module import RLModule

    root = directory.root or directory.policy.parent
    runner = root / "env_runner" if (root / "env_runner").is_dir() else root
    module = _made(directory, directory.policy, RLModule)
    before = _made(directory, runner / "env_to_module_connector", EnvToModulePipeline)
    after = _made(directory, runner / "module_to_env_connector", ModuleToEnvPipeline)
    if module is None:
        raise directory.altered(directory.policy / ARGUMENTS, "is missing. Copy it again from its source, whole")
    for piece in [] if after is None else after.connectors:
        require_layout_only(piece, ["NormalizeAndClipActions"])
    config = _config(directory)
    steps = 0
    if (runner / "state.pkl").is_file():
        state = _unpickled(directory, runner / "state.pkl")
        steps = int(state.get("num_env_steps_sampled_lifetime", 0)) if isinstance(state, Mapping) else 0
    return Restored(module, before, config or AlgorithmConfig(), config is not None, steps)


def _made(directory: Directory, folder: Any, kind: Any) -> Any:
    """The object that RLlib restores of a folder; None if there is no such folder."""
    if not (folder / ARGUMENTS).is_file():
        return None
    try:
        return kind.from_checkpoint(str(folder))
    except Exception as error:  # anything: it is a program
        reason = " ".join(str(error).split())
        text = f"cannot be restored by RLlib: {type(error).__name__}: {reason:.160}"
        raise directory.altered(folder / ARGUMENTS, text) from error


def _unpickled(directory: Directory, path: Any) -> Any:
    try:
        return pickle.loads(directory.read_bytes(path))
    except AlteredCheckpoint:
        raise
    except Exception as error:  # anything: it is a program
        reason = " ".join(str(error).split())
        text = f"cannot be unpickled: {type(error).__name__}: {reason:.160}"
        raise directory.altered(path, text) from error


def _config(directory: Directory) -> Any:
    """The AlgorithmConfig that the algorithm was made with; None if only the policy is there."""
    path = None if directory.root is None else directory.root / ARGUMENTS
    if path is None or not path.is_file():
        return None
    from ray.rllib.algorithms.algorithm_config import AlgorithmConfig

    args, kwargs = _unpickled(directory, path)["ctor_args_and_kwargs"]
    config = args[0] if args else kwargs["config"]
    return AlgorithmConfig.from_state(config) if isinstance(config, Mapping) else config


def algorithm_of(restored: Restored) -> str:
    """The algorithm whose module this is; some have that of another, such as IMPALA PPO's. "" if unknown."""
    match = re.match(r"ray\.rllib\.algorithms\.(\w+)\.", type(restored.module).__module__)
    return match[1] if match else ""


def training_settings(
    directory: Directory, restored: Restored, parts: PolicyParts, env: str, env_kwargs: Mapping[str, Any]
) -> TrainSettings:
    """The settings of a run that goes on where the directory's algorithm stopped.

    Args:
        directory: Where it is.
        restored: What RLlib made of it.
        parts: Its policy, with the environment's own spaces.
        env: Versioned id.
        env_kwargs: The environment's arguments.

    Raises:
        SettingsError: There is no such run here; says why.
    """
    from bam_train.trainers.rllib.algorithm_config import is_plain
    from bam_train.trainers.rllib.rllib_hyperparameters import complete

    algorithm = RLLIB_ALGORITHMS.get(parts.algorithm)
    own_module = type(restored.module).__module__.startswith("ray.rllib.algorithms.")
    if not restored.whole or algorithm is None or algorithm.offline or directory.name != POLICY_ID or not own_module:
        raise SettingsError("it is no whole algorithm with one policy of RLlib's own that learns in an environment")
    as_here = parts.flatten != is_plain(parts.observation_space) and not (parts.flatten and parts.filter_first)
    if not as_here or not parts.normalize_actions:
        raise SettingsError("its connectors are others than those of a run here")
    config, model = restored.config, restored.module.model_config
    model = model if isinstance(model, Mapping) else vars(model)
    names = complete(algorithm, {})
    own = {name: getattr(config, name) for name in names if _is_json(getattr(config, name, object()))}
    own["train_batch_size_per_learner"] = config.train_batch_size_per_learner
    own["model_config"] = {name: model[name] for name in names["model_config"] if name in model}
    given = parts.filter
    return TrainSettings.from_mapping(
        {
            "env": env,
            "env_kwargs": dict(env_kwargs),
            "algo": parts.algorithm,
            "trainer": "rllib",
            "steps": max(1, restored.steps),
            "seed": config.seed or 0,
            "num_envs": config.num_envs_per_env_runner * max(1, config.num_env_runners),
            "num_env_runners": config.num_env_runners,
            "num_learners": config.num_learners,
            "normalize": given is not None
            and {"clip_by_value": given.limit, "de_mean_to_zero": given.center, "de_std_to_one": given.scale},
            "hyperparameters": complete(algorithm, json.loads(json.dumps(own))),
        }
    )


def _is_json(value: Any) -> bool:
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
    from bam_train.trainers.rllib.rllib_state import FOLDER, NOTES, STATES

    root = directory.root or directory.policy
    files = sorted(path for path in root.rglob("*.pkl") if path.name in STATES)
    tree = {FOLDER + path.relative_to(root).as_posix(): directory.read_bytes(path) for path in files}
    return {NOTES: b"{}", **tree}
