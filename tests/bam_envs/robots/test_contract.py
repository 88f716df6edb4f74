"""Every robot keeps the same promises."""

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import Robot, RobotState
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.safety.gate import SafeRobot
from bam_envs.testing import RobotContract


class TestFakeRobot(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return FakeRobot(num_robots)


class TestSimulatedArm(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return SimulatedArm(num_robots)


class TestSimulatedArmWithoutObject(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return SimulatedArm(num_robots, with_object=False)


class TestGuardedArm(RobotContract):
    sizes = (1,)
    holds_what_is_not_finite = True

    def make(self, num_robots: int) -> Robot:
        return SafeRobot(SimulatedArm(num_robots))

    def move(self, robot: Robot, state: RobotState) -> NDArray[np.float64]:
        return self.stay(state) - 0.005


class TestRandomizedArm(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return SimulatedArm(num_robots, randomize=True)
