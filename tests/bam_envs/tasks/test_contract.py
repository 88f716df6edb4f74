"""Every task keeps the same promises, on a robot without physics and on the simulated one."""

from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot import Robot, RobotState
from bam_envs.core.task import Array, Task
from bam_envs.robots.ur import UR_MODELS
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.pick_place import PickPlaceTask
from bam_envs.tasks.reach import ReachTask
from bam_envs.testing import TaskContract

PARITY: dict[str, Any] = {"parity": True, "rs_state_to_info": True}


class TestReach(TaskContract):
    def make(self, num_envs: int) -> Task:
        return ReachTask(num_envs)


class TestPick(TaskContract):
    def make(self, num_envs: int) -> Task:
        return PickTask(num_envs)


class TestPickPlace(TaskContract):
    def make(self, num_envs: int) -> Task:
        return PickPlaceTask(num_envs)


class Simulated(TaskContract):
    id: str
    options: ClassVar[dict[str, Any]] = {}
    randomize = False

    def make(self, num_envs: int) -> Task:
        return ENVIRONMENTS[self.id].make_task(num_envs, self.options)

    def make_robot(self, num_robots: int) -> Robot:
        return ENVIRONMENTS[self.id].make_robot(num_robots, self.randomize, self.options)


class TestReachSimulated(Simulated):
    id = "bam/reach-v0"


class TestPickSimulated(Simulated):
    id = "bam/pick-v0"


class TestPickPlaceSimulated(Simulated):
    id = "bam/pick-place-v0"


class TestPickRandomized(Simulated):
    id = "bam/pick-v0"
    randomize = True


class Ur(Simulated):
    joint_step = 0.1 * np.pi * 0.1 * (1 + 1e-12)
    tool_step = 0.06

    def tool_position(self, joints: Array) -> Array:
        return UR_MODELS[self.options.get("ur_model", "ur5")].geometry.tool_position(joints)


class TestUrReach(Ur):
    id = "bam/ur-reach-v0"


class TestUrReachParity(TestUrReach):
    options = PARITY


class TestUrReachSmall(TestUrReach):
    options: ClassVar[dict[str, Any]] = {"ur_model": "ur3"}
    joint_step = 0.2 * np.pi * 0.1 * (1 + 1e-12)


class TestUrReachOnArmsThatDiffer(TestUrReach):
    randomize = True


class TestUrEmpty(Ur):
    id = "bam/ur-empty-v0"


class TestUrEmptyParity(TestUrEmpty):
    options: ClassVar[dict[str, Any]] = {**PARITY, "ur_model": "ur16e"}


class Drive(Simulated):
    def first_command(self, state: RobotState) -> Array:
        return state.command

    def check_pace(self, last: Array, command: Array) -> None:
        assert (np.abs(command) <= [0.5, 0.7]).all()


class TestNavigation(Drive):
    id = "bam/mir100-navigation-v0"


class TestNavigationInParity(TestNavigation):
    options = PARITY


class TestAvoidance(Drive):
    id = "bam/mir100-avoidance-v0"


class TestAvoidanceInParity(TestAvoidance):
    options = PARITY


class Broken(PickTask):
    """Breaks one promise after another."""

    def observe(self, state):  # type: ignore[no-untyped-def]
        state.signals["joint_position"] += 0.001
        return super().observe(state)


def test_the_contract_finds_a_task_that_changes_a_state() -> None:
    contract = TaskContract()
    contract.make = Broken  # type: ignore[method-assign]
    with pytest.raises(AssertionError):
        contract.test_nothing_given_is_changed()


VARIANTS = [(env_id, {flag: True}) for env_id, entry in ENVIRONMENTS.items() for flag in entry.variants]
SIZES = [("bam/ur-reach-v0", {"ur_model": model}) for model in UR_MODELS]


@pytest.mark.parametrize(("env_id", "options"), [*((env_id, {}) for env_id in ENVIRONMENTS), *VARIANTS, *SIZES])
@pytest.mark.filterwarnings("ignore:.*A Box observation space m(ini|axi)mum value is -?infinity")  # robo-gym's bounds
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")  # Isaac Lab's actions
@pytest.mark.filterwarnings("ignore:.*maximum and minimum values are equal")  # an elbow that sees nothing
def test_gymnasium_finds_nothing_wrong(make, env_id, options):  # type: ignore[no-untyped-def]
    check_env(make(env_id, **options).unwrapped, skip_render_check=True)
