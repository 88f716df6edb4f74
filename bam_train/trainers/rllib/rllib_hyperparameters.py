"""Hyperparameters, checked against the arguments of RLlib's ``training()`` and completed; a run's `AlgorithmConfig`.

Additional ones are ``model_config`` (RLlib's `DefaultModelConfig`; initialisers by their name in ``torch.nn.init``),
``rollout_fragment_length``, the steps of each environment before a runner delivers its samples, ``log_std_init`` of a
free standard deviation (``model_config.free_log_std``), ``noise_steps``, the steps that share the noise of such
actions (as with ``use_sde`` of stable-baselines3), and ``action_init_scale``, which multiplies the weights of the last
layer: with 0.01 the first actions are about 0. A schedule is a list: ``lr=[[0, 3e-4], [1000000, 0.0]]``.
"""

import contextlib
import dataclasses
import functools
import inspect
import json
import typing
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.connectors.env_to_module import FlattenObservations
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.utils.error import UnsupportedSpaceException
from ray.rllib.utils.replay_buffers import EpisodeReplayBuffer, PrioritizedEpisodeReplayBuffer

from bam_envs.core.validation import PositiveInt, check
from bam_train.environments import is_batched
from bam_train.errors import BamTrainError, SettingsError
from bam_train.settings import RLlibSettings
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS, Algorithm
from bam_train.trainers.library_arguments import fits, require_known, take
from bam_train.trainers.rllib import register_foreign
from bam_train.trainers.rllib.mean_std_filter import MeanStdFilter
from bam_train.trainers.rllib.ray_cluster import learners
from bam_train.trainers.rllib.robot_env_runner import (
    CAUSES,
    PROBE_TIMEOUT,
    RESTART_DELAY,
    SAMPLE_TIMEOUT,
    ReportingEnvRunner,
    RobotEnvRunner,
    log_end,
)
from bam_train.trainers.rllib_arguments import ELSEWHERE, OURS, hyperparameters_of, take_hyperparameters

_OF_CONNECTORS = frozenset({"self", "kwargs", "multi_agent", "update_stats"})


_CLONING = {"lr": 1e-3, "train_batch_size_per_learner": 256}
"""Defaults of bc and marwil. With RLlib's, 1e-4 and 2,000, 100,000 recorded steps are 50 small updates."""


def complete(algorithm: Algorithm, given: Mapping[str, Any], *, is_continuous: bool = False) -> dict[str, Any]:
    """Check hyperparameters by name, type and range, and add defaults for missing ones.

    Those of bc and marwil are `_CLONING`, and for numbers as actions (`is_continuous`) a free standard deviation: one
    that depends on the observation excuses every error of the mean, which is the action that is deployed.

    Raises:
        SettingsError: An unknown name (with the closest match), a wrong type or a number out of range.
    """
    given, kinds = take_hyperparameters(algorithm, given), hyperparameters_of(algorithm)[0]
    config, clones = algorithm.load()(), algorithm.name in ("bc", "marwil")
    if clones:
        config.training(**_CLONING)
    defaults = {name: _plain(getattr(config, name, OURS.get(name))) for name in kinds}
    if "actor_lr" in kinds:  # RLlib refuses any other value, although its CQL has one
        defaults["lr"] = None
    for name, value in given.items():
        if value is None and defaults[name] is not None and not fits(None, kinds[name]):
            check(value, kinds[name], name, SettingsError)
    values = {**defaults, **given}
    if "replay_buffer_config" in given:
        values["replay_buffer_config"] = _complete_buffer(
            defaults["replay_buffer_config"], given["replay_buffer_config"]
        )
    free = {"free_log_std": True} if clones and is_continuous else {}
    values["model_config"] = _complete_model(config, {**free, **given.get("model_config", {})})
    if values["log_std_init"] is not None and not values["model_config"]["free_log_std"]:
        raise SettingsError("log_std_init: only a free standard deviation has one; add model_config.free_log_std=true")
    if values["noise_steps"] > 1 and not (is_continuous and values["model_config"]["free_log_std"]):
        raise SettingsError("noise_steps: only numbers with a free standard deviation keep their noise; leave it out")
    return values


def complete_normalize(given: bool | Mapping[str, Any]) -> bool | dict[str, Any]:
    """Check the arguments of `MeanStdFilter`."""
    if isinstance(given, bool):
        return given
    known = inspect.signature(MeanStdFilter).parameters.keys() - _OF_CONNECTORS
    hints = {name: float if name == "clip_by_value" else bool for name in known}
    return take(given, hints, "normalize argument", ELSEWHERE, prefix="normalize.")


def _plain(value: Any) -> Any:
    """The value in JSON, with lists for tuples."""
    return json.loads(json.dumps(value, default=str))


_BUFFERS = {buffer.__name__: buffer for buffer in (EpisodeReplayBuffer, PrioritizedEpisodeReplayBuffer)}


def _complete_buffer(default: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Check the names in ``replay_buffer_config``, as RLlib does not, and add the defaults."""
    values = {**default, **given}
    if default["type"] not in _BUFFERS:  # CQL does not use it
        return values
    buffer = _BUFFERS.get(values["type"])
    if buffer is None:
        raise SettingsError(f"replay_buffer_config.type: expected {' or '.join(_BUFFERS)}, found {values['type']!r}")
    known = {*inspect.signature(buffer).parameters, *default} - _OF_CONNECTORS
    require_known(given, known, "replay_buffer_config argument", ELSEWHERE)
    name = "replay_buffer_config.capacity"
    return {**values, "capacity": check(values["capacity"], PositiveInt, name, SettingsError)}


def _complete_model(config: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Check ``model_config`` and add RLlib's defaults."""
    hints = typing.get_type_hints(DefaultModelConfig)
    hints |= {name: typing.Optional[str] for name in hints if name.endswith("_initializer")}  # noqa: UP045 - no function
    defaults = dataclasses.asdict(DefaultModelConfig()) | config._model_config_auto_includes
    taken = take(given, hints, "model_config argument", ELSEWHERE, prefix="model_config.")
    for name, sizes in taken.items():
        if not name.endswith("_hiddens"):
            continue
        if any(size < 1 for size in sizes) or (name == "fcnet_hiddens" and not sizes):
            wanted = "one size of a layer or more, each" if name == "fcnet_hiddens" else "sizes of layers of"
            raise SettingsError(f"model_config.{name}: expected {wanted} at least 1, found {sizes!r}")
    return {name: _plain(defaults[name]) for name in hints} | taken


# The configuration of a run

STEPS_AT_LEAST = 200
"""Minimum steps of an iteration of an algorithm that updates after a few steps, for a small overhead."""


def make_config(settings: RLlibSettings, observation_space: Space[Any], action_space: Space[Any], seed: int) -> Any:
    """The configuration of a run with complete settings; the spaces are the environment's."""
    algorithm, values = RLLIB_ALGORITHMS[settings.algo], settings.hyperparameters
    number, gpus_each = learners(settings)
    config = algorithm.load()()
    config.framework("torch").rl_module(model_config=dict(values["model_config"]))
    arguments = {name: _plain(value) for name, value in values.items() if name not in OURS}
    if isinstance(n_step := arguments.get("n_step"), list):
        arguments["n_step"] = tuple(n_step)  # a range to draw from
    config.training(**arguments)
    config.learners(num_learners=number, num_gpus_per_learner=gpus_each)
    config.debugging(seed=seed, log_level="ERROR")
    own_length = algorithm.on_policy or algorithm.offline
    least = 0 if own_length else min(STEPS_AT_LEAST, settings.eval_every or STEPS_AT_LEAST)
    config.reporting(min_time_s_per_iteration=0, min_sample_timesteps_per_iteration=least)
    if algorithm.offline:
        from bam_train.trainers.rllib.recorded_episodes import add_data  # and with it pyarrow

        return add_data(config, settings, observation_space, action_space)
    name = register_foreign(settings.env)
    config.environment(name, env_config=dict(settings.env_kwargs), disable_env_checking=True)
    recurrent = values["model_config"]["use_lstm"]
    batched = is_batched(settings.env) and isinstance(observation_space, spaces.Box) and not recurrent
    if not batched and values.get("noise_steps", 1) > 1:
        raise SettingsError(f"noise_steps: the noise is kept in vector environments of bam_envs, found {settings.env}")
    if not batched:
        config.callbacks(NotesEnds)
    config.noise_steps = values.get("noise_steps", 1)  # RobotEnvRunner's; older checkpoints have none
    config.env_runners(
        env_runner_cls=RobotEnvRunner if batched else ReportingEnvRunner,
        num_env_runners=settings.num_env_runners,
        num_envs_per_env_runner=envs_each(settings),
        rollout_fragment_length=values["rollout_fragment_length"],
        env_to_module_connector=functools.partial(connectors, observation_space, settings.normalize),
        sample_timeout_s=SAMPLE_TIMEOUT,
    )
    return config.fault_tolerance(
        restart_failed_env_runners=True,
        delay_between_env_runner_restarts_s=RESTART_DELAY,
        env_runner_health_probe_timeout_s=PROBE_TIMEOUT,
    )


def envs_each(settings: RLlibSettings) -> int:
    """Environments of each runner: an equal share of `num_envs`, to the nearest whole number from 1."""
    return max(1, round(settings.num_envs / max(1, settings.num_env_runners)))


def connectors(
    observation_space: Space[Any], normalize: bool | Mapping[str, Any], env: Any, spaces: Any, device: Any
) -> list[Any]:
    """Connectors between environment and module: several inputs become one vector, normalised if `normalize` is set."""
    pieces: list[Any] = [] if is_plain(observation_space) else [FlattenObservations()]
    if normalize:
        pieces.append(MeanStdFilter(**({} if normalize is True else normalize)))
    return pieces


def is_plain(space: Space[Any]) -> bool:
    """Whether RLlib's networks take the space without a connector: a vector or an image of floats."""
    floats = isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)
    return floats and len(space.shape or ()) in (1, 3)


_REFUSALS = (
    *(AssertionError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, OSError),
    UnsupportedSpaceException,
)


@contextlib.contextmanager
def refusals(settings: RLlibSettings) -> Iterator[None]:
    """Turn RLlib's errors about settings that cannot work into SettingsError."""
    try:
        yield
    except BamTrainError:
        raise
    except _REFUSALS as error:
        why = " ".join(str(error).partition("To suppress all validation errors")[0].split()) or type(error).__name__
        if CAUSES.known:  # RLlib's message is only that runners are missing
            index, cause = min(CAUSES.known.items())
            why = f"env runner {index} died ({cause})"
            CAUSES.known.clear()
        raise SettingsError(f"{settings.algo} on {settings.env} cannot be set up: {why:.400}") from error


class NotesEnds(RLlibCallback):  # type: ignore[misc]
    """Logs the end of each episode of RLlib's own runner, which keeps only means, without success."""

    def on_episode_end(
        self, *, episode: Any, prev_episode_chunks: Any = (), metrics_logger: Any, **kwargs: Any
    ) -> None:
        """Log one episode."""
        success = episode.get_infos(-1).get("is_success")
        total = sum(piece.get_return() for piece in (*prev_episode_chunks, episode))
        # PPO's learner adds a step without a reward to earlier pieces; `t` does not count it.
        log_end(metrics_logger, episode.t, float(total), None if success is None else bool(success))
