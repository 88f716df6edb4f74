"""The tasks of UR arms keep the promises of every task."""

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from bam_envs.core.robot import Robot
from bam_envs.core.task import Task
from bam_envs.robots.physics.ur import empty_arm, reach_arm
from bam_envs.robots.ur import UR_MODELS
from bam_envs.tasks.ur_empty import UrEmptyTask
from bam_envs.tasks.ur_reach import UrReachTask
from bam_envs.testing import TaskContract


class UrContract(TaskContract):
    joint_step = 0.1 * np.pi * 0.1 * (1 + 1e-12)
    tool_step = 0.06
    model = "ur5"
    parity = False

    def tool_position(self, joints):
        return UR_MODELS[self.model].geometry.tool_position(joints)


class TestReach(UrContract):
    def make(self, num_rows: int) -> Task:
        return UrReachTask(num_rows, ur_model=self.model, parity=self.parity, rs_state_to_info=self.parity)

    def make_robot(self, num_robots: int) -> Robot:
        return reach_arm(num_robots, ur_model=self.model)


class TestReachParity(TestReach):
    parity = True


class TestReachSmall(TestReach):
    model, joint_step = "ur3", 0.2 * np.pi * 0.1 * (1 + 1e-12)


class TestReachOnArmsThatDiffer(TestReach):
    def make_robot(self, num_robots: int) -> Robot:
        return reach_arm(num_robots, randomize=True)


class TestEmpty(UrContract):
    def make(self, num_rows: int) -> Task:
        return UrEmptyTask(num_rows, ur_model=self.model, parity=self.parity, rs_state_to_info=self.parity)

    def make_robot(self, num_robots: int) -> Robot:
        return empty_arm(num_robots, ur_model=self.model)


class TestEmptyParity(TestEmpty):
    parity, model = True, "ur16e"


@pytest.mark.parametrize("model", UR_MODELS)
@pytest.mark.parametrize("env_id", ["bam/ur-reach-v0", "bam/ur-empty-v0"])
def test_gymnasium_finds_nothing_wrong(make, env_id, model):
    check_env(make(env_id, ur_model=model).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", ["bam/ur-reach-v0", "bam/ur-empty-v0"])
@pytest.mark.filterwarnings("ignore:.*A Box observation space m(ini|axi)mum value is -?infinity")  # robo-gym's bounds
def test_gymnasium_finds_nothing_wrong_with_parity(make, env_id):
    check_env(make(env_id, parity=True).unwrapped, skip_render_check=True)
