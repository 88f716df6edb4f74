"""Complete settings as RLlib's `AlgorithmConfig`."""

import contextlib
import functools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.connectors.env_to_module import FlattenObservations
from ray.rllib.utils.error import UnsupportedSpaceException

from bam_train.environments import is_batched
from bam_train.errors import BamTrainError, SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS
from bam_train.trainers.rllib import register_foreign
from bam_train.trainers.rllib.mean_std_filter import MeanStdFilter
from bam_train.trainers.rllib.ray_resources import learners
from bam_train.trainers.rllib.rllib_hyperparameters import training_arguments
from bam_train.trainers.rllib.robot_env_runner import RobotEnvRunner, log_end
from bam_train.trainers.rllib.runner_deaths import (
    PROBE_TIMEOUT,
    RESTART_DELAY,
    SAMPLE_TIMEOUT,
    ReportingEnvRunner,
    first_cause_of_death,
)

STEPS_AT_LEAST = 200
"""Steps of an iteration of an algorithm that updates after every few: its overhead is then small."""


def make_config(settings: TrainSettings, observation_space: Space[Any], action_space: Space[Any], seed: int) -> Any:
    """The configuration of a run of complete settings; the spaces are the environment's own."""
    algorithm, values = RLLIB_ALGORITHMS[settings.algo], settings.hyperparameters
    number, gpus_each = learners(settings)
    config = algorithm.load()()
    config.framework("torch").rl_module(model_config=dict(values["model_config"]))
    config.training(**training_arguments(values))
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
    if not batched:
        config.callbacks(NotesEnds)
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


def envs_each(settings: TrainSettings) -> int:
    """Environments of each runner: an equal share of `num_envs`, to the nearest whole number from 1."""
    return max(1, round(settings.num_envs / max(1, settings.num_env_runners)))


def connectors(
    observation_space: Space[Any], normalize: bool | Mapping[str, Any], env: Any, spaces: Any, device: Any
) -> list[Any]:
    """What lies between environment and module: several inputs become one vector, normalised if asked for."""
    pieces: list[Any] = [] if is_plain(observation_space) else [FlattenObservations()]
    if normalize:
        pieces.append(MeanStdFilter(**({} if normalize is True else normalize)))
    return pieces


def is_plain(space: Space[Any]) -> bool:
    """Whether RLlib's networks take it as it is: a vector or an image, of floats."""
    floats = isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)
    return floats and len(space.shape or ()) in (1, 3)


_REFUSALS = (
    *(AssertionError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, OSError),
    UnsupportedSpaceException,
)


@contextlib.contextmanager
def refusals(settings: TrainSettings) -> Iterator[None]:
    """RLlib's errors about settings that cannot work, as our own."""
    try:
        yield
    except BamTrainError:
        raise
    except _REFUSALS as error:
        said = " ".join(str(error).partition("To suppress all validation errors")[0].split()) or type(error).__name__
        text = first_cause_of_death(settings.num_env_runners) or said  # RLlib's is about runners that are not there
        raise SettingsError(f"{settings.algo} on {settings.env} cannot be set up: {text:.400}") from error


class NotesEnds(RLlibCallback):  # type: ignore[misc]
    """Notes how each episode of RLlib's own runner went, which keeps means alone and no success."""

    def on_episode_end(
        self, *, episode: Any, prev_episode_chunks: Any = (), metrics_logger: Any, **kwargs: Any
    ) -> None:
        """Note one."""
        success = episode.get_infos(-1).get("is_success")
        total = sum(piece.get_return() for piece in (*prev_episode_chunks, episode))
        # PPO's learner has lengthened the earlier pieces by a step without a reward: `t` counts the real ones.
        log_end(metrics_logger, episode.t, float(total), None if success is None else bool(success))
