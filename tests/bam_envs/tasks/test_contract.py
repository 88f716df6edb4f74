"""Every task keeps the same promises, on a robot without physics and on the simulated one."""

import pytest

from bam_envs.core.registry import ENVIRONMENTS, resolve
from bam_envs.core.robot import Robot
from bam_envs.core.task import Task
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.pick_place import PickPlaceTask
from bam_envs.tasks.reach import ReachTask
from bam_envs.testing import TaskContract


class TestReach(TaskContract):
    def make(self, num_rows: int) -> Task:
        return ReachTask(num_rows)


class TestPick(TaskContract):
    def make(self, num_rows: int) -> Task:
        return PickTask(num_rows)


class TestPickPlace(TaskContract):
    def make(self, num_rows: int) -> Task:
        return PickPlaceTask(num_rows)


class Simulated(TaskContract):
    id: str
    randomize = False

    def make(self, num_rows: int) -> Task:
        return resolve(ENVIRONMENTS[self.id].task)(num_rows)

    def make_robot(self, num_robots: int) -> Robot:
        return resolve(ENVIRONMENTS[self.id].robot)(num_robots, randomize=self.randomize)


class TestReachSimulated(Simulated):
    id = "bam/reach-v0"


class TestPickSimulated(Simulated):
    id = "bam/pick-v0"


class TestPickPlaceSimulated(Simulated):
    id = "bam/pick-place-v0"


class TestPickRandomized(Simulated):
    id = "bam/pick-v0"
    randomize = True


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
