"""The base without physics: arcs, walls, scans."""

import math

import numpy as np
import pytest

from bam_envs.errors import ResetNeeded
from bam_envs.robots.fake_base import FakeBase
from bam_envs.robots.mir100 import BACK_RAYS, FRONT_RAYS
from bam_envs.robots.robot import Initial
from bam_envs.testing import RobotContract


class BaseContract(RobotContract):
    def measured(self, state):
        return state.signals["base_velocity"]

    def stay(self, state):
        return np.zeros_like(state.command)


class TestFakeBase(BaseContract):
    def make(self, num_robots):
        return FakeBase(num_robots)


class TestFakeBaseWithoutScans(BaseContract):
    def make(self, num_robots):
        return FakeBase(num_robots, with_scans=False)


def started(*poses):
    base = FakeBase(len(poses))
    base.connect()
    return base, base.reset(np.arange(len(poses)), Initial({"base_pose": np.array(poses)}, np.zeros(len(poses), int)))


def test_it_drives_straight_and_gains_speed_as_the_data_sheet_says():
    base, _ = started((0.0, 0.0, math.pi / 2))
    for speed, way in ((0.2, 0.02), (0.4, 0.06), (0.5, 0.11), (0.5, 0.16)):
        state = base.step(np.array([[0.5, 0.0]]))
        np.testing.assert_allclose(state.signals["base_velocity"], [[speed, 0.0]], atol=1e-12)
        np.testing.assert_allclose(state.signals["base_pose"], [[0.0, way, math.pi / 2]], atol=1e-12)
    np.testing.assert_allclose(state.stamp, [0.4])


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


def test_a_wall_stops_it():
    base, _ = started((4.0, 0.0, 0.0))
    for _ in range(40):
        state = base.step(np.array([[0.5, 0.0]]))
    np.testing.assert_array_equal(state.signals["base_velocity"], [[0.0, 0.0]])
    assert 4.3 < state.signals["base_pose"][0, 0] <= 5.0 - math.hypot(0.9, 0.58) / 2


def test_scanners_see_the_walls():
    _, state = started((0.0, 0.0, 0.0), (2.0, 1.0, math.pi / 2))
    front, back = state.signals["f_scan"], state.signals["b_scan"]
    assert front.shape == (2, FRONT_RAYS)
    assert back.shape == (2, BACK_RAYS)
    ahead = 150  # -135 + (30 + 150) / 2 = -45 degrees in a scanner that looks to +45
    np.testing.assert_allclose(front[:, ahead], [5.0 - 0.4288, 4.0 - 1.0 - 0.4288], atol=1e-9)
    behind = 170  # -135 + (10 + 170) / 2 = -45 degrees in a scanner that looks to -135
    np.testing.assert_allclose(back[:, behind], [5.0 - 0.3548, 4.0 + 1.0 - 0.3548], atol=1e-9)


def test_the_parts_of_a_period_are_the_period():
    whole, _ = started((0.0, 0.0, 0.3))
    parted, _ = started((0.0, 0.0, 0.3))
    command = np.array([[0.15, 0.2]])
    expected = whole.step(command)
    states = list(parted.slices(command, 5))
    np.testing.assert_allclose([state.stamp[0] for state in states], [0.02, 0.04, 0.06, 0.08, 0.1])
    np.testing.assert_allclose(states[-1].signals["base_pose"], expected.signals["base_pose"], atol=1e-12)


def test_a_halt_between_two_parts_holds():
    base, _ = started((0.0, 0.0, 0.0))
    parts = base.slices(np.array([[0.2, 0.0]]), 5)
    before = next(parts)
    base.halt()
    after = next(parts)
    np.testing.assert_array_equal(after.signals["base_pose"], before.signals["base_pose"])
    assert base.halts == 1


def test_not_connected():
    with pytest.raises(ResetNeeded) as caught:
        FakeBase().step(np.zeros((1, 2)))
    assert str(caught.value) == "The fake base is not connected. Call connect() first."


def test_saved_and_restored():
    base, _ = started((0.0, 0.0, 0.3))
    base.step(np.array([[0.2, 0.2]]))
    other = FakeBase()
    here = other.load_state_dict(base.state_dict())
    there = base.load_state_dict(base.state_dict())
    for name, array in there.signals.items():
        np.testing.assert_array_equal(here.signals[name], array)
    np.testing.assert_array_equal(here.stamp, there.stamp)
