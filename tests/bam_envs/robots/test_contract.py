"""Every robot keeps the same promises."""

from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.robot import Robot
from bam_envs.robots.simulated.arm import SimulatedArm
from bam_envs.testing import RobotContract


class TestFakeRobot(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return FakeRobot(num_robots)


class TestFakeRobotWithoutObject(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return FakeRobot(num_robots, with_object=False)


class TestSimulatedArm(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return SimulatedArm(num_robots)


class TestSimulatedArmWithoutObject(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return SimulatedArm(num_robots, with_object=False)


class TestRandomizedArm(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return SimulatedArm(num_robots, randomize=True)
