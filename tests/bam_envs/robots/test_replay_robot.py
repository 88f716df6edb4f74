"""The robot that plays recorded states."""

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, ResetNeeded, RobotFault
from bam_envs.core.robot import Initial, Robot
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.replay_robot import ReplayRobot
from bam_envs.testing.assertions import assert_same_state, no_io

FIRST = np.zeros(1, np.int64)
START = Initial({"joint_position": np.zeros((1, 6))}, FIRST)


@pytest.fixture
def episodes():
    """Two episodes of a `FakeRobot`, of three states and of two."""
    robot = FakeRobot()
    robot.connect()
    return [
        [robot.reset(FIRST, START), *(robot.step(np.full((1, 7), 0.01 * k)) for k in range(1, steps + 1))]
        for steps in (2, 1)
    ]


def test_it_measures_what_was_recorded(episodes):
    with no_io():
        robot = ReplayRobot(FakeRobot().spec, episodes)
    assert isinstance(robot, Robot)
    robot.connect()
    for episode in (*episodes, episodes[0]):  # after the last one comes the first
        assert_same_state(robot.reset(FIRST, START), episode[0])
        for state in episode[1:]:
            found = robot.step(np.ones((1, 7)))
            assert_same_state(found, state)
            np.testing.assert_array_equal(found.command, state.command)
            found.signals["joint_position"][:] = 9.0  # of the caller alone
    robot.halt()
    robot.close()
    with pytest.raises(ResetNeeded):
        robot.step(np.ones((1, 7)))


def test_it_refuses_what_every_robot_refuses(episodes):
    robot = ReplayRobot(FakeRobot().spec, episodes)
    with pytest.raises(ResetNeeded, match=r"not connected. Call connect\(\) first"):
        robot.reset(FIRST, START)
    robot.connect()
    robot.reset(FIRST, START)
    with pytest.raises(InvalidValue, match=r"The command must have shape \(1, 7\), not \(1, 6\)"):
        robot.step(np.zeros((1, 6)))
    with pytest.raises(InvalidValue, match="must be finite"):
        robot.step(np.full((1, 7), np.nan))
    robot.step(np.zeros((1, 7)))
    robot.step(np.zeros((1, 7)))
    with pytest.raises(RobotFault, match=r"The recorded episode has 2 steps, and no more. Call reset\(\)"):
        robot.step(np.zeros((1, 7)))
    with pytest.raises(InvalidValue, match="has no picture"):
        robot.render("rgb_array", [])
    with pytest.raises(InvalidValue, match="at least one episode"):
        ReplayRobot(FakeRobot().spec, [])
