"""Simulated bases: arcs, limits, walls, boxes, scans."""

import math

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import Initial
from bam_envs.robots.physics.kinematic_base import SimulatedBase, lab, open_floor
from bam_envs.testing import RobotContract
from tests.bam_envs.making import CART

BOXES = np.array([[-2.0, 0.0, 0.3], [0.0, 2.0, 1.0], [2.0, -1.5, 0.0]])


class BaseContract(RobotContract):
    def measured(self, state):
        return state.signals["base_velocity"]

    def stay(self, state):
        return np.zeros_like(state.command)


class TestLab(BaseContract):
    def make(self, num_robots):
        return lab(num_robots)

    def initial(self, robot, rows):
        signals = {"base_pose": np.zeros((len(rows), 3)), "obstacle_pose": np.tile(BOXES, (len(rows), 1, 1))}
        return Initial(signals, np.arange(len(rows), dtype=np.int64))


class TestRandomizedLab(TestLab):
    def make(self, num_robots):
        return lab(num_robots, randomize=True)


class TestHusky(TestLab):
    def make(self, num_robots):
        return lab(num_robots, robot_model="husky")


class TestOmnidirectional(TestLab):
    def make(self, num_robots):
        return lab(num_robots, robot_model=CART, randomize=True)


class TestOpenFloor(BaseContract):
    def make(self, num_robots):
        return open_floor(num_robots)


def started(*poses, boxes=None, **options):
    base = SimulatedBase(len(poses), boxes=0 if boxes is None else len(boxes), **options)
    base.connect()
    signals = {"base_pose": np.array(poses)}
    if boxes is not None:
        signals["obstacle_pose"] = np.tile(np.array(boxes), (len(poses), 1, 1))
    return base, base.reset(np.arange(len(poses)), Initial(signals, np.zeros(len(poses), np.int64)))


def test_it_drives_straight_and_gains_speed_as_the_data_sheet_says():
    base, _ = started((0.0, 0.0, math.pi / 2))
    for speed, way in ((0.2, 0.02), (0.4, 0.06), (0.5, 0.11), (0.5, 0.16)):
        state = base.step(np.array([[0.5, 0.0]]))
        np.testing.assert_allclose(state.signals["base_velocity"], [[speed, 0.0]], atol=1e-12)
        np.testing.assert_allclose(state.signals["base_pose"], [[0.0, way, math.pi / 2]], atol=1e-12)
    np.testing.assert_allclose(state.stamp, [0.4])


def test_limits():
    base, _ = started((0.0, 0.0, 0.0), room=None)
    speeds = [base.step(np.array([[-9.0, 9.0]])).signals["base_velocity"][0] for _ in range(7)]
    forwards = [-0.2, -0.4, -0.6, -0.8, -1.0, -1.0, -1.0]
    np.testing.assert_allclose(speeds, np.transpose([forwards, [0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.5]]), atol=1e-12)


def test_it_drives_sideways_as_its_drive_can():
    """Along the arc of its three speeds: a base that drives to the left and turns goes round the point to its left."""
    base, _ = started((0.0, 0.0, 0.0), room=None, robot_model=CART)
    assert base.spec.command.labels == ("linear_velocity", "lateral_velocity", "angular_velocity")
    speeds = [base.step(np.array([[0.0, 0.9, 0.0]])).signals["base_velocity"][0].tolist() for _ in range(4)]
    np.testing.assert_allclose(speeds, [[0, 0.1, 0], [0, 0.2, 0], [0, 0.3, 0], [0, 0.3, 0]], atol=1e-12)
    np.testing.assert_allclose(base.pose, [[0.0, 0.09, 0.0]], atol=1e-12)
    base, _ = started((0.0, 0.0, 0.0), room=None, robot_model=CART)
    for _ in range(10):
        state = base.step(np.array([[0.0, 0.1, 0.2]]))  # radius 0.5 m, reached at once
    pose = [0.5 * (math.cos(0.2) - 1.0), 0.5 * math.sin(0.2), 0.2]
    np.testing.assert_allclose(state.signals["base_pose"], [pose], atol=1e-12)


def test_it_goes_round_a_circle():
    base, _ = started((0.0, 0.0, 0.0))
    command = np.array([[0.2, 0.2]])  # radius 1 m, reached at once
    for _ in range(round(10 * math.pi / 0.2)):
        state = base.step(command)
    angle = 0.2 * float(state.stamp[0])
    x, y, yaw = state.signals["base_pose"][0]
    np.testing.assert_allclose(
        [x, y, yaw], [math.sin(angle), 1 - math.cos(angle), angle - 2 * math.pi * (angle > math.pi)]
    )


def test_a_wall_stops_it_and_the_collision_stays_until_reset():
    base, _ = started((1.5, 0.0, 0.0))
    for _ in range(40):
        state = base.step(np.array([[0.5, 0.0]]))
    np.testing.assert_array_equal(state.signals["base_velocity"], [[0.0, 0.0]])
    assert 2.823 - 0.4876 - 0.05 < state.signals["base_pose"][0, 0] <= 2.823 - 0.4876
    assert state.truth["collision"].tolist() == [True]
    state = base.step(np.array([[-0.2, 0.0]]))
    assert state.signals["base_velocity"][0, 0] == pytest.approx(-0.2)  # away from the wall it may go
    assert state.truth["collision"].tolist() == [True]
    state = base.reset(np.arange(1), Initial({}, np.zeros(1, np.int64)))
    assert state.truth["collision"].tolist() == [False]


def test_a_box_stops_it():
    base, state = started((0.0, 0.0, 0.0), (0.0, 0.0, math.pi), boxes=[(1.0, 0.0, 0.0)])
    np.testing.assert_array_equal(state.truth["obstacle_pose"], np.full((2, 1, 3), [1.0, 0.0, 0.0]))
    for _ in range(10):
        state = base.step(np.array([[0.5, 0.0], [0.5, 0.0]]))
    assert state.truth["collision"].tolist() == [True, False]
    assert state.signals["base_pose"][0, 0] <= 1.0 - 0.25 - 0.4876


def test_scans_are_noisy_and_follow_the_seed():
    base = lab(3)
    base.connect()
    seeds = np.array([4, 4, 5])
    first = base.reset(np.arange(3), Initial({}, seeds)).signals["f_scan"]
    np.testing.assert_array_equal(first[0], first[1])
    assert (first[0] != first[2]).mean() > 0.99
    second = base.step(np.zeros((3, 2))).signals["f_scan"]
    assert (first[0] - second[0]).std() == pytest.approx(0.01 * math.sqrt(2), rel=0.15)
    again = base.reset(np.arange(3), Initial({}, seeds)).signals["f_scan"]
    np.testing.assert_array_equal(again, first)


def test_randomised_drives_differ_a_little_and_follow_the_seed():
    base = open_floor(3, randomize=True)
    base.connect()
    base.reset(np.arange(3), Initial({}, np.array([1, 1, 2])))
    for _ in range(5):
        speed = base.step(np.full((3, 2), 0.5)).signals["base_velocity"]
    np.testing.assert_array_equal(speed[0], speed[1])
    assert (speed[0] != speed[2]).all()
    assert (np.abs(speed / 0.5 - 1) <= 0.05).all()
    assert (speed != 0.5).all()


@pytest.mark.parametrize("pose", [(2.6, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_a_start_where_something_is(pose):
    with pytest.raises(InvalidValue) as caught:
        started(pose, boxes=[(0.5, 0.0, 0.0)])
    assert str(caught.value) == (
        f"The base cannot start at {list(pose)} (x, y [m], yaw [rad]): it touches a wall or a box there. "
        "The walls are at x -2.877 and 2.823 m, y -3.836 and 3.864 m."
    )


def test_the_parts_of_a_period_are_the_period():
    whole, _ = started((0.0, 0.0, 0.3))
    parted, _ = started((0.0, 0.0, 0.3))
    command = np.array([[0.15, 0.2]])
    expected = whole.step(command)
    states = list(parted.slices(command, 5))
    np.testing.assert_allclose([state.stamp[0] for state in states], [0.02, 0.04, 0.06, 0.08, 0.1])
    np.testing.assert_allclose(states[-1].signals["base_pose"], expected.signals["base_pose"], atol=1e-12)
    parts = parted.slices(command, 5)
    before = next(parts)
    parted.halt()  # holds for the rest of the period
    np.testing.assert_array_equal(next(parts).signals["base_pose"], before.signals["base_pose"])
