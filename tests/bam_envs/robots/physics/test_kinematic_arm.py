"""Universal Robots arms without dynamics."""

import numpy as np
import pytest

from bam_envs.core.robot import Initial, Robot
from bam_envs.robots.physics.kinematic_arm import empty_arm, isaac_arm, obstacle_arm, reach_arm
from bam_envs.robots.ur import START, UR_MODELS
from bam_envs.testing import RobotContract
from bam_envs.testing.assertions import assert_same_state

ROWS = np.arange(2)
DOWN = np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])


class TestReachArm(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return reach_arm(num_robots)


class TestSmallArm(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return empty_arm(num_robots, ur_model="ur3e")


class TestArmWithObstacle(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return obstacle_arm(num_robots, ur_model="ur16e")


class TestRandomizedArm(RobotContract):
    def make(self, num_robots: int) -> Robot:
        return isaac_arm(num_robots, randomize=True)


def started(robot, joints=START):
    robot.connect()
    rows = np.arange(robot.num_robots)
    return robot.reset(rows, Initial({"joint_position": np.tile(joints, (len(rows), 1))}, rows + 5))


def test_it_is_at_its_set_point_one_period_later():
    robot = reach_arm(2)
    state = started(robot)
    command = state.command + np.array([[0.1, -0.2, 0.3, 0.01, 0.0, -0.3]])
    state = robot.step(command)
    np.testing.assert_array_equal(state.signals["joint_position"], command)
    np.testing.assert_allclose(state.signals["joint_velocity"], [[1, -2, 3, 0.1, 0, -3]] * 2, atol=1e-12)
    np.testing.assert_array_equal(state.stamp, [0.1, 0.1])
    np.testing.assert_array_equal(robot.setpoint, command)


def test_no_faster_than_it_can_and_never_beyond_its_limits():
    robot = reach_arm(2, ur_model="ur10")
    state = started(robot)
    state = robot.step(state.command + np.array([[1.0, -1.0, 1.0, 1.0, 0.0, 0.0]]))
    way = state.signals["joint_position"] - START
    np.testing.assert_allclose(way, [[0.2 * np.pi / 3, -0.2 * np.pi / 3, 0.1 * np.pi, 0.1 * np.pi, 0, 0]] * 2)
    for _ in range(60):
        state = robot.step(np.full((2, 6), 9.0))
    np.testing.assert_array_equal(state.signals["joint_position"], [UR_MODELS["ur10"].joint_limits[1]] * 2)


def test_parts_of_a_period_end_where_the_whole_does():
    whole, parts = reach_arm(2), reach_arm(2)
    state = started(whole)
    started(parts)
    command = state.command + 0.05
    states = list(parts.slices(command, 5))
    np.testing.assert_allclose(states[1].signals["joint_position"], START + np.full((2, 6), 0.02))
    np.testing.assert_allclose([one.stamp[0] for one in states], [0.02, 0.04, 0.06, 0.08, 0.1])
    assert_same_state(states[-1], whole.step(command))


def test_a_halt_holds_for_the_rest_of_the_period():
    robot = reach_arm(2)
    state = started(robot)
    states = robot.slices(state.command + 0.05, 5)
    first = next(states)
    robot.halt()
    rest = list(states)
    np.testing.assert_array_equal(rest[-1].signals["joint_position"], first.signals["joint_position"])
    np.testing.assert_array_equal(rest[-1].signals["joint_velocity"], np.zeros((2, 6)))
    assert rest[-1].stamp[0] == pytest.approx(0.1)


def test_a_collision_is_told_until_the_next_reset():
    robot = reach_arm(2)
    state = started(robot)
    assert state.truth["collision"].tolist() == [False, False]
    command = state.command.copy()
    seen = []
    for goal in (DOWN, START):
        for _ in range(15):
            command[1] += np.clip(goal - command[1], -0.3, 0.3)
            seen.append(robot.step(command).truth["collision"])
    assert not np.array(seen)[:, 0].any()
    told = np.array(seen)[:, 1].tolist()
    assert told == sorted(told)
    assert told[0] is False
    assert told[-1] is True
    state = robot.reset(np.array([1]), Initial({"joint_position": np.array([START])}, np.zeros(1, np.int64)))
    assert state.truth["collision"].tolist() == [False, False]


def test_arms_that_differ_lag_by_a_share_of_the_way():
    robot = reach_arm(2, randomize=True)
    state = started(robot)
    state = robot.step(state.command + 0.1)
    way = state.signals["joint_position"] - START
    shares = 1 - 0.3 * np.array([np.random.default_rng(seed).random() for seed in (5, 6)])
    np.testing.assert_allclose(way, np.tile(0.1 * shares[:, None], 6))
    assert (way < 0.1).all()
    assert way[0, 0] != way[1, 0]


def test_the_tool_is_at_the_pads_of_a_gripper():
    robot, joints = reach_arm(1, ur_model="ur3"), np.array([START])
    position, axes = UR_MODELS["ur3"].geometry.flange_pose(joints)
    np.testing.assert_allclose(robot.tool_position(joints), position + 0.15 * axes[:, :, 2], atol=1e-12)


def test_it_sees_its_obstacle():
    robot = obstacle_arm(2)
    robot.connect()
    signals = {"joint_position": np.tile(START, (2, 1)), "obstacle_position": np.array([[0.3, 0.2, 0.5], [1, 1, 1.0]])}
    state = robot.reset(ROWS, Initial(signals, ROWS))
    np.testing.assert_array_equal(state.signals["object_position"], signals["obstacle_position"])
    np.testing.assert_array_equal(state.signals["object_quaternion"], [[1.0, 0, 0, 0]] * 2)
    flange = UR_MODELS["ur5"].geometry.tool_position(signals["joint_position"])
    signals["obstacle_position"][1] = flange[1]
    assert robot.reset(ROWS, Initial(signals, ROWS)).truth["collision"].tolist() == [False, True]
