"""Training with RLlib on its new API stack.

Importing this package registers every environment of `bam_envs` with RLlib, so that a script needs no more than::

    import bam_train.trainers.rllib
    from ray.rllib.algorithms.ppo import PPOConfig

    PPOConfig().environment("bam/pick", env_config={"randomize": True})

RLlib's own runner makes n separate environments. `RobotEnvRunner`, which ``bam-train`` uses, steps all environments of
a runner in one batched simulation: ``.env_runners(env_runner_cls=RobotEnvRunner)``. Ray is not started.
"""

import functools
import importlib.util
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym

import bam_envs  # noqa: F401 - registers our environments with Gymnasium
from bam_envs.core.registry import ENVIRONMENTS
from bam_train.env_faults import FiniteEnv, ForeignEnv
from bam_train.environments import is_batched
from bam_train.trainers.zero_based_spaces import from_zero

if TYPE_CHECKING:
    from bam_train.trainers.rllib.robot_env_runner import RobotEnvRunner

__all__ = ["RobotEnvRunner"]

# Ray prints every death of a process on standard output, whatever its log level; it reads this when it is imported.
os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "A worker died or was killed while executing a task")


def register() -> None:
    """Register every environment of `bam_envs` with RLlib, under its id and under its id without a version."""
    for env_id in own_ids():
        for name in {env_id, env_id.rpartition("-v")[0]}:
            _register(name, env_id)


def register_foreign(env_id: str) -> str:
    """Register with RLlib, as `env_id`, an environment that this process has registered with Gymnasium."""
    if env_id not in own_ids():
        module, _, name = env_id.rpartition(":")
        if module:
            importlib.import_module(module)  # which registers it
        _register(env_id, gym.spec(name))  # a runner elsewhere may not know the id
    return env_id


def own_ids() -> list[str]:
    """Ids of the environments of `bam_envs`: those of its table, and others that it registers."""
    made_here = (spec.id for spec in gym.registry.values() if str(spec.entry_point).startswith("bam_envs."))
    return sorted({*ENVIRONMENTS, *made_here})


def _register(name: str, env: str | gym.envs.registration.EnvSpec) -> None:
    """Register a function with RLlib; its runners on other computers import this module, and with it `bam_envs`."""
    from ray.tune.registry import register_env

    register_env(name, functools.partial(create, env))


def create(env: str | gym.envs.registration.EnvSpec, context: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """Make one environment for RLlib's own runner; `context` holds the keyword arguments of ``env_config``."""
    name = env if isinstance(env, str) else env.id
    made: gym.Env[Any, Any] = gym.make(env, disable_env_checker=True, **dict(context))
    return from_zero(FiniteEnv(made if is_batched(name) else ForeignEnv(made, name), name))


if importlib.util.find_spec("ray") is not None:  # checkpoints of the old API stack are read without Ray
    register()


def __getattr__(name: str) -> Any:
    """`RobotEnvRunner`, imported on use: it imports all of RLlib."""
    if name == "RobotEnvRunner":
        from bam_train.trainers.rllib.robot_env_runner import RobotEnvRunner

        return RobotEnvRunner
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
