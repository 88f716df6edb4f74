"""`RobotEnv` with the methods that robo-gym's environments have beside Gymnasium's, on ``env.unwrapped``."""

from __future__ import annotations

from typing import Any

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import Robot
from bam_envs.core.robot_env import RobotEnv
from bam_envs.core.task import Task


class RoboGymEnv(RobotEnv):
    """One robot and one task, under one of robo-gym's ids.

    Args:
        robot: A robot with ``num_robots == 1``.
        task: A task with ``num_rows == 1`` and a method ``rs_state``.
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
