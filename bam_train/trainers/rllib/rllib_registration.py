"""Our environments under their names in RLlib, in every process of a cluster.

RLlib hands a registered name to its runners together with the function that makes the environment. Ours is a function
of this module, so a runner elsewhere imports this package, and with it the table of environments.
"""

import functools
import importlib
from collections.abc import Mapping
from typing import Any

import gymnasium as gym

import bam_envs  # noqa: F401 - registers our environments with Gymnasium
from bam_envs.core.registry import ENVIRONMENTS
from bam_train.finite_envs import FiniteEnv
from bam_train.trainers.zero_based_spaces import from_zero

try:
    from ray.tune.registry import register_env
except ModuleNotFoundError as error:  # also where only ray's core is installed
    raise ModuleNotFoundError('RLlib is not installed. Run: pip install "bam-train[rllib]"', name="ray") from error


def register() -> None:
    """Give RLlib every environment of ours, under its id and under its id without a version."""
    for env_id in own_ids():
        for name in {env_id, env_id.rpartition("-v")[0]}:
            register_env(name, functools.partial(create, env_id))


def register_foreign(env_id: str) -> str:
    """Give RLlib an environment that this process has registered with Gymnasium, and a runner elsewhere may not have.

    Returns:
        The name that RLlib knows it by.
    """
    if env_id not in own_ids():
        module, _, name = env_id.rpartition(":")
        if module:
            importlib.import_module(module)  # which registers it
        register_env(env_id, functools.partial(create, gym.spec(name)))
    return env_id


def own_ids() -> list[str]:
    """Ids of our environments: those of the table, and what else `bam_envs` registers."""
    made_here = (spec.id for spec in gym.registry.values() if str(spec.entry_point).startswith("bam_envs."))
    return sorted({*ENVIRONMENTS, *made_here})


def create(env: str | gym.envs.registration.EnvSpec, context: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """One environment, as RLlib's own runner takes it.

    Args:
        env: Its full id, or where a runner elsewhere does not know that, its specification.
        context: What ``.environment(env_config=...)`` was given: keyword arguments.
    """
    name = env if isinstance(env, str) else env.id
    return from_zero(FiniteEnv(gym.make(env, disable_env_checker=True, **dict(context)), name))
