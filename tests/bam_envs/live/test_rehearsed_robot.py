"""A simulated robot behind a link and the guards of a live one."""

import math

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, StaleState
from bam_envs.core.robot import Initial
from bam_envs.live.building import live_robot
from bam_envs.live.rehearsed_robot import RehearsedRobot, rehearsed_robot, time_to_stop
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.linked import PROFILES, LinkedRobot, LinkProfile
from bam_envs.robots.physics.kinematic_base import open_floor
from bam_envs.testing import RobotContract
from bam_envs.testing.assertions import assert_same_state
from bam_envs.testing.robots import ARM_HOME

AT_ONCE, NOT_AT_ALL = [0.0, 0.0], [60.0, 60.0]
START = Initial({"joint_position": ARM_HOME[None]}, np.zeros(1, np.int64))


def driving(profile, steps=5):
    """A base behind a link that was sent 0.5 m/s for some periods of 0.1 s."""
    robot = LinkedRobot(open_floor(1), profile)
    robot.connect()
    robot.reset(np.arange(1), START)
    for _ in range(steps):
        robot.step(np.array([[0.5, 0.0]]))
    return robot


class TestContract(RobotContract):
    sizes = (1,)
    holds_what_is_not_finite = True

    def make(self, num_robots):
        return rehearsed_robot(LinkedRobot(FakeRobot(num_robots), LinkProfile(AT_ONCE, AT_ONCE)))

    def move(self, robot, state):
        return self.stay(state) - 0.005


def test_it_takes_cleared_commands_only():
    robot = RehearsedRobot(LinkedRobot(FakeRobot(), PROFILES["wifi"]), FakeRobot().spec)
    robot.connect()
    state = robot.reset(np.arange(1), START)
    with pytest.raises(InvalidValue, match=r"^Commands to fake must be cleared by a SafeRobot: use rehearsed_robot"):
        robot.step(state.command)


def test_its_limits_are_those_of_a_profile(tmp_path):
    linked = LinkedRobot(FakeRobot(), PROFILES["wifi"])
    assert rehearsed_robot(linked).limits.joint_speed == 1.0
    assert linked.spec.lag == 0.0  # the simulated arm follows better than a live one
    assert rehearsed_robot(linked).spec.lag == live_robot("ws://robot", linked.spec).spec.lag == 0.125
    assert rehearsed_robot(LinkedRobot(open_floor(1), PROFILES["wifi"])).spec.lag == 0.3
    path = tmp_path / "cell.toml"
    path.write_text('extends = "ur5e"\n[limits]\njoint_speed = 0.5\n')
    assert rehearsed_robot(linked, profile=str(path)).limits.joint_speed == 0.5
    assert rehearsed_robot(linked, guards={"lag": 0.2}).limits.lag == 0.2
    with pytest.raises(InvalidValue, match=r"^A SafeRobot guards one robot, not 2 stepped together\.$"):
        rehearsed_robot(LinkedRobot(FakeRobot(2), PROFILES["wifi"]))


def stopped(robot, command):
    """Step until a guard stops the robot."""
    for _ in range(20):
        robot.step(command)


def test_a_link_without_states_stops_it_by_their_age():
    robot = rehearsed_robot(LinkedRobot(FakeRobot(), LinkProfile(AT_ONCE, NOT_AT_ALL)))
    robot.connect()
    state = robot.reset(np.arange(1), START)
    with pytest.raises(
        StaleState, match=r"^The robot was stopped by state age \(G3\): the newest state is 0\.\d+ s old"
    ):
        stopped(robot, state.command)
    report = robot.report()["state age"]
    assert (report["held"], report["stopped"]) == (10, 1)  # 0.5 s of 0.05 s
    robot.resume()
    robot.reset(np.arange(1), START)
    robot.step(state.command)


@pytest.mark.parametrize(
    ("profile", "seconds"),
    [
        (LinkProfile(AT_ONCE, AT_ONCE), 0.5),  # 0.5 m/s, less 0.1 m/s each 0.1 s
        (LinkProfile([0.2, 0.2], AT_ONCE), 0.7),
    ],
)
def test_time_to_stop(profile, seconds):
    robot = driving(profile, steps=8)
    deceleration = robot.spec.command.max_rate[0] * robot.spec.period
    braking = math.ceil(round(0.5 / deceleration, 6)) * robot.spec.period
    before, memory = robot.newest, robot.state_dict()
    assert time_to_stop(robot) == pytest.approx(seconds - 0.5 + braking)
    assert_same_state(robot.newest, before)
    for name, value in robot.state_dict().items():
        np.testing.assert_equal(value, memory[name])


def test_a_base_whose_halt_is_lost_stops_by_its_watchdog():
    robot = driving(LinkProfile(AT_ONCE, AT_ONCE), steps=8)
    at_once = time_to_stop(robot)
    robot.profile = LinkProfile(NOT_AT_ALL, AT_ONCE)
    assert time_to_stop(robot) == pytest.approx(0.5 + at_once)
