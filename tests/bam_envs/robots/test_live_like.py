"""Robots as live ones are: slower, held now and then, and measured late."""

import numpy as np
import pytest

from bam_envs.core.robot import Initial
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.live_like import SLOWEST, LiveLike
from bam_envs.robots.physics.kinematic_base import open_floor
from bam_envs.testing import RobotContract
from bam_envs.testing.robots import ARM_HOME

PERIOD = 0.05


class TestContract(RobotContract):
    def make(self, num_robots):
        return LiveLike(FakeRobot(num_robots))

    def test_state_has_the_command_that_was_sent(self):
        with self.running(3) as (robot, state):
            command = self.move(robot, state)
            sent = robot.step(command).command
            assert (sent >= command).all()
            assert (sent < state.command).all()  # limits leave a part of the way
            np.testing.assert_array_equal(robot.robot.step(sent).command, sent)


def started(robot, seed=0):
    robot.connect()
    n = robot.num_robots
    signals = {"joint_position": np.tile(ARM_HOME, (n, 1)), "base_pose": np.zeros((n, 3))}
    return robot.reset(np.arange(n), Initial(signals, np.arange(n, dtype=np.int64) + seed))


@pytest.fixture(scope="module")
def arms():
    """400 arms that are sent a first joint 0.04 rad ahead of the last command: states and commands of 40 steps."""
    robot = LiveLike(FakeRobot(400))
    state = started(robot)
    states = [state]
    for _ in range(40):
        command = states[-1].command.copy()
        command[:, 0] += 0.04
        states.append(robot.step(command))
    return robot, states


def test_half_of_the_episodes_are_at_full_speed_and_the_others_slower(arms):
    robot, states = arms
    assert np.mean(robot.pace == 1.0) == pytest.approx(0.5, abs=0.08)
    assert SLOWEST <= robot.pace.min() < 0.2
    speed = np.diff([state.command[:, 0] for state in states], axis=0)[-10:].max(axis=0) / PERIOD
    np.testing.assert_allclose(speed, robot.pace * 0.8, rtol=1e-9)


def test_speed_grows_gradually_and_a_hold_is_a_rest(arms):
    _, states = arms
    speed = np.diff([state.command[:, 0] for state in states], axis=0) / PERIOD
    assert 0.25 <= speed[0].max() <= 1.0  # of 10 rad/s^2, half to twice
    held = (speed[1:] == 0.0).mean()
    assert 0.01 < held < 0.06  # one in a hundred steps begins a hold of three on average


def test_a_state_is_between_the_newest_two_and_the_command_is_the_one_sent(arms):
    _, states = arms
    sent = np.array([state.command[:, 0] for state in states])  # a fake arm is where it was sent
    seen = np.array([state.signals["joint_position"][:, 0] for state in states])
    late = (sent[1:] - seen[1:]) / np.maximum(np.diff(sent, axis=0), 1e-12)
    moving = np.diff(sent, axis=0) > 1e-4
    assert 0.0 <= late[moving].min() < 0.01
    assert 0.9 < late[moving].max() <= 1.0 + 1e-9


def test_an_episode_depends_on_its_seed_alone(arms):
    _, states = arms
    alone = LiveLike(FakeRobot(1))
    found = [started(alone, seed=7)]
    for _ in range(40):
        command = found[-1].command.copy()
        command[:, 0] += 0.04
        found.append(alone.step(command))
    for one, many in zip(found, states, strict=True):
        np.testing.assert_array_equal(one.command[0], many.command[7])
        np.testing.assert_array_equal(one.signals["joint_position"][0], many.signals["joint_position"][7])


def test_a_base_keeps_its_share_of_the_speed_limit_and_rests_when_it_is_held():
    robot = LiveLike(open_floor(100))
    state = started(robot)
    sent = []
    for _ in range(60):
        state = robot.step(np.tile([1.0, 0.0], (100, 1)))
        sent.append(state.command[:, 0])
    np.testing.assert_allclose(np.max(sent, axis=0), 0.5 * robot.pace)
    assert (np.array(sent)[30:] == 0.0).any()
