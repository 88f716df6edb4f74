"""The guard of unusual observations: it warns, holds the robot until the episode ends, or stops it."""

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, SafetyStop
from bam_envs.core.robot import Initial
from bam_envs.robots.fake import FakeRobot
from bam_envs.safety.gate import SafeRobot
from bam_envs.testing import ARM_HOME

HOME = np.array([[*ARM_HOME, 0.085]])
START = Initial({"joint_position": np.array([ARM_HOME]), "object_pose": np.array([[0.5, 0.0, 0.0]])}, np.zeros(1))


@pytest.fixture
def robot():
    robot = SafeRobot(FakeRobot())
    robot.connect()
    robot.reset(np.array([0]), START)
    return robot


def test_by_default_it_warns_until_the_next_episode(robot):
    robot.tell_unusual("another place")
    robot.tell_unusual("the robot answers otherwise")
    robot.step(HOME)
    assert (robot.status, robot.warnings) == ("", ("unusual observations (G19): another place",))
    robot.tell_unusual("")
    assert robot.warnings == ()
    robot.tell_unusual("another place")
    robot.reset(np.array([0]), START)
    assert robot.warnings == ()


def test_it_holds_until_the_next_episode(robot):
    robot.react("hold")
    moved = HOME + 0.01
    robot.tell_unusual("another place")
    for _ in range(30):
        state = robot.step(moved)
        robot.tell_unusual("")  # another policy acts: the robot is held on
    assert (robot.status, robot.code, robot.stopped) == ("unusual observations (G19)", 19, None)
    np.testing.assert_array_equal(state.command[0, :6], ARM_HOME)
    assert robot.report()["unusual observations"]["held"] == 30
    robot.reset(np.array([0]), START)
    assert robot.step(moved).command[0, 0] > ARM_HOME[0]


def test_it_stops_until_a_person_resumes(robot):
    robot.react("stop")
    robot.step(HOME)
    robot.tell_unusual("another place")
    text = r"The robot was stopped by unusual observations \(G19\): another place. When it is safe, call resume\(\)."
    with pytest.raises(SafetyStop, match=text):
        robot.step(HOME)
    robot.resume()
    robot.step(HOME)
    assert robot.status == ""


def test_another_reaction_is_refused(robot):
    with pytest.raises(InvalidValue, match=r"unusual observations \(G19\) can warn, hold, stop, not 'ignore'"):
        robot.react("ignore")
