"""What `gymnasium.make` and `gymnasium.make_vec` call for robo-gym's ids."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bam_envs.core import registry
from bam_envs.core.errors import InvalidValue
from bam_envs.robo_gym.options import translate
from bam_envs.robo_gym.table import ROBO_GYM

if TYPE_CHECKING:
    from bam_envs.core.robot_env import RobotVectorEnv
    from bam_envs.remote.remote_env import RemoteVectorEnv


def make_env(env_id: str, **options: Any) -> gym.Env[Any, Any]:
    """One robot and its task, with robo-gym's constructor options beside our own.

    Args:
        env_id: Key of `ROBO_GYM`.
        options: Those of robo-gym's class of that id, and those of `bam_envs.core.registry.make_env`.

    Raises:
        UnknownName: An option that neither has.
        InvalidValue: An option that cannot be had.
    """
    from bam_envs.core.robot_env import RobotEnv
    from bam_envs.robo_gym.robo_gym_env import RoboGymEnv

    entry = ROBO_GYM[env_id]
    arguments = translate(entry, options)
    if arguments.get("transport") is not None:
        return registry.make_env(env_id, **arguments)
    made = registry.make_env(entry.env_id, **arguments).unwrapped
    if not isinstance(made, RobotEnv):
        raise TypeError(f"{entry.env_id} is a {type(made).__name__}, and a RobotEnv was expected.")
    env = RoboGymEnv(made.robot, made.task, made.render_mode, is_live=arguments.get("robot") is not None)
    return registry.limited(env, registry.ENVIRONMENTS[entry.env_id])


def make_vector_env(env_id: str, num_envs: int = 1, **options: Any) -> RobotVectorEnv | RemoteVectorEnv:
    """Simulated robots and their task, stepped together; of ``rs_state`` in the infos only where it is asked for.

    robo-gym has no such thing. Raises what `make_env` does.
    """
    entry = ROBO_GYM[env_id]
    if entry.is_live and options.get("transport") is None:
        raise InvalidValue(
            f"{env_id}: a live robot is one environment, which nothing may reset unasked; use gymnasium.make."
        )
    arguments = translate(entry, options)
    if arguments.get("transport") is not None:
        return registry.make_vector_env(env_id, num_envs, **arguments)
    if "rs_state_to_info" not in options:
        arguments.pop("rs_state_to_info", None)
    return registry.make_vector_env(entry.env_id, num_envs, **arguments)
