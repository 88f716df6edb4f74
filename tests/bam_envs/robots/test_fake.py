"""The robot without physics."""

import numpy as np
import pytest

from bam_envs.core.errors import ResetNeeded
from bam_envs.core.robot import Initial
from bam_envs.robots.fake import FakeRobot
from bam_envs.testing import ARM_HOME


def started(n=1):
    robot = FakeRobot(n)
    robot.connect()
    signals = {"joint_position": np.tile(ARM_HOME, (n, 1)), "object_pose": np.tile([0.5, 0.1, 0.3], (n, 1))}
    return robot, robot.reset(np.arange(n), Initial(signals, np.zeros(n, np.int64)))


def test_joints_are_exactly_where_they_were_told_to_be():
    robot, before = started()
    command = before.command + 0.1
    state = robot.step(command)
    np.testing.assert_array_equal(state.signals["joint_position"], command[:, :6])
    np.testing.assert_array_equal(state.signals["gripper_width"], [[0.085]])  # cut to its limit
    np.testing.assert_allclose(state.signals["joint_velocity"], 2.0)
    np.testing.assert_array_equal(state.stamp, [0.05])
    np.testing.assert_allclose(state.signals["object_position"], [[0.5, 0.1, 0.02]])
    np.testing.assert_allclose(state.signals["object_quaternion"], [[np.cos(0.15), 0, 0, np.sin(0.15)]])
    np.testing.assert_array_equal(robot.sent, [command])
    robot.halt()
    robot.close()
    assert robot.halts == 2
    with pytest.raises(ResetNeeded) as caught:
        robot.step(command)
    assert str(caught.value) == "The fake robot is not connected. Call connect() first."


def test_no_joint_is_faster_than_its_max_rate():
    robot, state = started()
    after = robot.step(state.command + 1.0)
    np.testing.assert_allclose(after.signals["joint_position"], ARM_HOME[None] + np.pi * 0.05)
    np.testing.assert_allclose(robot.step(np.zeros((1, 7))).signals["gripper_width"], 0.085 - 0.15 * 0.05)


def test_saved_and_restored():
    robot, state = started(2)
    robot.step(state.command + 0.01)
    other = FakeRobot(2)
    here = other.load_state_dict(robot.state_dict())
    there = robot.load_state_dict(robot.state_dict())
    for name, array in there.signals.items():
        np.testing.assert_array_equal(here.signals[name], array)
    np.testing.assert_array_equal(here.stamp, there.stamp)
    np.testing.assert_array_equal(here.command, there.command)


def test_the_parts_of_a_period_end_where_the_period_does():
    whole, state = started()
    parted, _ = started()
    command = state.command - 0.01
    expected = whole.step(command)
    states = list(parted.slices(command, 5))
    np.testing.assert_allclose([one.stamp[0] for one in states], [0.01, 0.02, 0.03, 0.04, 0.05])
    way = [one.signals["joint_position"][0, 0] - ARM_HOME[0] for one in states]
    np.testing.assert_allclose(way, [-0.002, -0.004, -0.006, -0.008, -0.01])
    np.testing.assert_array_equal(states[-1].signals["joint_position"], expected.signals["joint_position"])
    np.testing.assert_array_equal(parted.sent, whole.sent)


def test_a_halt_between_two_parts_holds():
    robot, state = started()
    parts = robot.slices(state.command - 0.01, 5)
    before = next(parts)
    robot.halt()
    after = next(parts)
    np.testing.assert_array_equal(after.signals["joint_position"], before.signals["joint_position"])
    np.testing.assert_array_equal(after.signals["joint_velocity"], np.zeros((1, 6)))


def test_the_object_is_placed_elsewhere():
    robot, before = started()
    state = robot.place_object(np.array([[0.4, -0.1, 0.0]]), np.zeros(1, np.int64))
    np.testing.assert_allclose(state.signals["object_position"], [[0.4, -0.1, 0.02]])
    np.testing.assert_allclose(before.signals["object_position"], [[0.5, 0.1, 0.02]])
    same = robot.place_object(None, np.zeros(1, np.int64))
    np.testing.assert_array_equal(same.signals["object_position"], state.signals["object_position"])
