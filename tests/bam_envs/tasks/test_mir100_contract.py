"""The MiR100's tasks keep the promises of every task, in both modes, on the simulated base."""

from typing import Any, ClassVar

import numpy as np

from bam_envs.core.registry import ENVIRONMENTS, resolve
from bam_envs.core.robot import Robot, RobotState
from bam_envs.core.task import Array, Task
from bam_envs.testing import TaskContract


class DriveContract(TaskContract):
    id: str
    options: ClassVar[dict[str, Any]] = {}

    def make(self, num_rows: int) -> Task:
        return resolve(ENVIRONMENTS[self.id].task)(num_rows, **self.options)

    def make_robot(self, num_robots: int) -> Robot:
        return resolve(ENVIRONMENTS[self.id].robot)(num_robots)

    def first_command(self, state: RobotState) -> Array:
        return state.command

    def check_pace(self, last: Array, command: Array) -> None:
        assert (np.abs(command) <= [0.5, 0.7]).all()


class TestNavigation(DriveContract):
    id = "bam/mir100-navigation-v0"


class TestNavigationInParity(TestNavigation):
    options: ClassVar[dict[str, Any]] = {"parity": True, "rs_state_to_info": True}


class TestAvoidance(DriveContract):
    id = "bam/mir100-avoidance-v0"


class TestAvoidanceInParity(TestAvoidance):
    options: ClassVar[dict[str, Any]] = {"parity": True, "rs_state_to_info": True}
