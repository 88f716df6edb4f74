"""Every robot keeps the same promises."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bam_envs.arms.description import robot_model
from bam_envs.core.robot import EnvIds, Initial, Robot, RobotState
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


@pytest.mark.parametrize(("model", "randomize"), [("so101", False), ("fr3", True), ("ur10e", False)])
class TestAnyArm(RobotContract):
    @pytest.fixture(autouse=True)
    def chosen(self, model: str, randomize: bool) -> None:
        self.arm = robot_model(model)
        self.make = lambda n: SimulatedArm(n, robot_model=model, randomize=randomize)

    def initial(self, robot: Robot, env_ids: EnvIds) -> Initial:
        initial = super().initial(robot, env_ids)
        (x, y, _), _ = self.arm.workspace
        poses = np.tile([x, y, 0.3], (len(env_ids), 1))
        return Initial(
            {"joint_position": np.tile(self.arm.home, (len(env_ids), 1)), "object_pose": poses}, initial.seeds
        )


class TestGuardedFr3(TestGuardedArm):
    def make(self, num_robots: int) -> Robot:
        arm = SimulatedArm(num_robots, robot_model="fr3")
        return SafeRobot(arm, tool_position=arm.tool_position)

    def initial(self, robot: Robot, env_ids: EnvIds) -> Initial:
        home = np.array([robot_model("fr3").home])
        return Initial({"joint_position": home, "object_pose": np.array([[0.6, 0.1, 0.3]])}, np.zeros(1, np.int64))


class TestRandomizedArm(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return SimulatedArm(num_robots, randomize=True)
