"""robo-gym's environments: what `gymnasium.make` and `gymnasium.make_vec` call for its ids."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bam_envs import make_env as ours
from bam_envs.core.errors import InvalidValue
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot import Robot
from bam_envs.core.robot_env import RobotEnv, RobotVectorEnv
from bam_envs.core.task import Task
from bam_envs.robo_gym.options import translate
from bam_envs.robo_gym.table import ROBO_GYM

if TYPE_CHECKING:
    from bam_envs.remote.remote_env import RemoteVectorEnv


def make_env(env_id: str, **options: Any) -> gym.Env[Any, Any]:
    """One robot and its task, with robo-gym's constructor options beside our own.

    Args:
        env_id: Key of `ROBO_GYM`.
        options: Those of robo-gym's class of that id, and those of `bam_envs.make_env.make_env`.

    Raises:
        UnknownName: An option that neither has.
        InvalidValue: An option that cannot be had.
    """
    entry = ROBO_GYM[env_id]
    arguments = translate(entry, options)
    if arguments.get("transport") is not None:
        return ours.make_env(env_id, **arguments)
    made = ours.make_env(entry.env_id, **arguments).unwrapped
    if not isinstance(made, RobotEnv):
        raise TypeError(f"{entry.env_id} is a {type(made).__name__}, and a RobotEnv was expected.")
    env = RoboGymEnv(made.robot, made.task, made.render_mode, is_live=arguments.get("robot") is not None)
    # robo-gym's ids have no limit at Gymnasium: with parity the task itself terminates at the last step.
    return env if options.get("parity") else gym.wrappers.TimeLimit(env, ENVIRONMENTS[entry.env_id].max_episode_steps)


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
        return ours.make_vector_env(env_id, num_envs, **arguments)
    if "rs_state_to_info" not in options:
        arguments.pop("rs_state_to_info", None)
    if not options.get("parity"):
        arguments.setdefault("max_episode_steps", ENVIRONMENTS[entry.env_id].max_episode_steps)
    return ours.make_vector_env(entry.env_id, num_envs, **arguments)


class RoboGymEnv(RobotEnv):
    """One robot and one task under one of robo-gym's ids, with the methods that robo-gym's environments add.

    Args:
        robot: A robot with ``num_robots == 1``.
        task: A task with ``num_envs == 1`` and a method ``rs_state``.
        render_mode: ``"rgb_array"``, ``"human"`` or None.
        is_live: Whether there is a robot behind `robot`, and no simulation.
    """

    def __init__(self, robot: Robot, task: Task, render_mode: str | None = None, *, is_live: bool = False) -> None:
        super().__init__(robot, task, render_mode)
        self.is_live = is_live

    def get_rs_state(self) -> dict[str, float] | list[float] | None:
        """The newest state as robo-gym's robot servers send it: of an arm by key, of a base as a list of 1030 numbers.

        None before the first `reset`.
        """
        task: Any = self.task
        if self.last_state is None:
            return None
        state: dict[str, float] | list[float] = task.rs_state(self.last_state)[0]
        return state

    def kill_sim(self) -> None:
        """End the simulation: its memory is free, and no step is taken until the next `reset`, which begins it anew.

        Raises:
            InvalidValue: The robot is live.
        """
        if self.is_live:
            raise InvalidValue(
                "kill_sim(): the robot is live, and there is no simulation to end; close() drops the link."
            )
        self.close()

    def restart_sim(self) -> None:
        """End the simulation and begin it anew; `reset` comes next.

        Raises:
            InvalidValue: The robot is live.
        """
        self.kill_sim()
        self.robot.connect()
