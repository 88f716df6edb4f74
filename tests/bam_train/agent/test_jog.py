"""Jogging: where a twist leads, how fast, and when it ends."""

import math
from unittest import mock

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.kinematics import UR10E
from bam_envs.core.robot import RobotSpec, RobotState, SignalSpec
from bam_envs.robots.base_description import base_model
from bam_envs.robots.ur5e import GEOMETRY, GRIPPER_OPEN, arm_spec
from bam_envs.testing import ARM_HOME
from bam_train.agent.front.jog import JOG_LIFETIME, LEASH, Jogger
from tests.bam_envs.making import CART

ARM, BASE, PERIOD = arm_spec("ur5e", with_object=False), base_model("mir100").spec(with_scans=False), 0.05
HOME = np.array([*ARM_HOME, 0.04])


@pytest.fixture
def clock():
    """A clock that is set by hand."""
    clock = mock.Mock(side_effect=lambda: clock.now, now=100.0)
    return clock


@pytest.fixture
def arm(clock):
    return Jogger(ARM, PERIOD, clock=clock)


def arm_state(joints=HOME, measured=None):
    """A state of the arm that was commanded `joints` (7,), and is there if `measured` is not given."""
    here = np.array(joints if measured is None else measured, dtype=np.float64)
    signals = {"joint_position": here[None, :6], "joint_velocity": np.zeros((1, 6)), "gripper_width": here[None, 6:]}
    return RobotState(signals, np.zeros(1), np.array([joints], dtype=np.float64))


def twist(seq, *numbers, **others):
    return {"seq": seq, "twist": [*numbers, *[0.0] * (4 - len(numbers))], **others}


def tool(command):
    return GEOMETRY.tool_position(command[:, :6])[0]


@pytest.mark.parametrize("way", [(0.1, 0, 0), (0, -0.2, 0), (0.1, 0.1, 0.05)])
def test_the_tool_moves_along_the_twist_and_keeps_its_orientation(arm, clock, way):
    state, start = arm_state(), GEOMETRY.flange_pose(HOME[None, :6])
    for step in range(20):
        arm.put(**twist(step, *way))
        command = arm.command(state)
        state, clock.now = arm_state(command[0]), clock.now + PERIOD
    moved = tool(command) - GEOMETRY.tool_position(HOME[None, :6])[0]
    np.testing.assert_allclose(moved, np.array(way) * 20 * PERIOD, atol=2e-3)
    turn = start[1][0].T @ GEOMETRY.flange_pose(command[:, :6])[1][0]
    assert np.abs(turn - np.eye(3)).max() < 2e-3
    assert command[0, 6] == HOME[6]


def test_the_tool_turns_in_its_place(arm, clock):
    state = arm_state()
    for step in range(20):
        arm.put(**twist(step, 0, 0, 0, 0.4))
        command = arm.command(state)
        state, clock.now = arm_state(command[0]), clock.now + PERIOD
    assert np.linalg.norm(tool(command) - GEOMETRY.tool_position(HOME[None, :6])[0]) < 2e-3
    axes = [GEOMETRY.tool_pose(joints[None, :6])[1][0] for joints in (HOME, command[0])]
    yaw = [math.atan2(axis[1], axis[0]) for axis in axes]
    assert (yaw[1] - yaw[0]) % (2 * math.pi) == pytest.approx(0.4 * 20 * PERIOD, abs=1e-3)


def test_nothing_is_faster_than_a_quarter_of_a_metre_in_a_second(arm, clock):
    arm.put(**twist(1, 3.0, 4.0, 0.0, 9.0))
    command = arm.command(arm_state())
    moved = tool(command) - GEOMETRY.tool_position(HOME[None, :6])[0]
    assert 0.0 < np.linalg.norm(moved) <= 0.25 * PERIOD * 1.01
    base = Jogger(BASE, 0.1, clock=clock)
    base.put(**twist(1, -5.0, 0, 0, 9.0))
    np.testing.assert_allclose(base.command(None), [[-0.25, 0.5]])
    cart = Jogger(base_model(CART).spec(with_scans=False), 0.1, clock=clock)
    cart.put(**twist(1, 3.0, 4.0, 0.0, 0.1))
    np.testing.assert_allclose(cart.command(None), [[0.15, 0.2, 0.1]])


def test_near_a_singularity_no_joint_is_fast(arm, clock):
    stretched = np.array([0.0, -0.3, 0.0, -1.2, 0.0, 0.0, 0.04])
    for seq, way in enumerate([(0.25, 0, 0), (0, 0.25, 0), (0, 0, 0.25), (0, 0, 0, 0.5)]):
        arm.put(**twist(seq, *way))
        command = arm.command(arm_state(stretched))
        assert np.abs(command[0] - stretched).max() <= 0.5 * PERIOD + 1e-9
        clock.now += 1.0
        assert arm.command(arm_state(stretched)) is None


def test_a_twist_is_fresh_for_a_fifth_of_a_second(arm, clock):
    assert arm.command(arm_state()) is None
    arm.put(**twist(1, 0.1))
    clock.now += 0.99 * JOG_LIFETIME
    assert arm.command(arm_state()) is not None
    clock.now += 0.02 * JOG_LIFETIME
    assert arm.command(arm_state()) is None


def test_twists_out_of_order_are_dropped(arm, clock):
    assert arm.put(**twist(5, 0.1))
    assert not arm.put(**twist(5, 0.2))
    assert not arm.put(**twist(4, 0.2))
    clock.now += JOG_LIFETIME + 0.01
    assert not arm.put(**twist(3, 0.2))
    assert arm.command(arm_state()) is None
    arm.release()  # another page begins at 0 again
    assert arm.put(**twist(0, 0.1))


def test_a_burst_of_late_twists_moves_nothing(arm, clock):
    """A network that hung delivers what was sent meanwhile: the key may be up by now."""
    for seq in range(3):
        clock.now += 0.05
        assert arm.put(**twist(seq, 0.1, sent=7.0 + 0.05 * seq))
    clock.now += 3.0
    assert [arm.put(**twist(3 + n, 0.1, sent=7.15 + 0.05 * n)) for n in range(5)] == [False] * 5
    assert arm.command(arm_state()) is None
    assert arm.put(**twist(8, 0.1, sent=10.1))
    for seq in range(2000):  # clocks that drift apart do no harm
        clock.now += 0.5
        assert arm.put(**twist(9 + seq, 0.1, sent=10.1 + 0.5 * (seq + 1) * (1 - 1e-4)))


def test_the_gripper_closes_opens_and_otherwise_keeps_its_command(arm):
    widths, state = [], arm_state()
    for seq, grip in enumerate([0, 1, 0, -1, 0]):
        arm.put(**twist(seq, 0.01, gripper=grip))
        widths.append(arm.command(state)[0, 6])
    np.testing.assert_array_equal(state.command, HOME[None])  # a state is not changed
    np.testing.assert_array_equal(state.signals["joint_position"], HOME[None, :6])
    assert widths == [0.04, 0.0, 0.0, GRIPPER_OPEN, GRIPPER_OPEN]


def test_the_command_stays_near_an_arm_that_does_not_follow_and_comes_back_at_once(arm, clock):
    for seq in range(40):
        arm.put(**twist(seq, 0.2))
        command = arm.command(arm_state(HOME))
        clock.now += PERIOD
    ahead = tool(command) - GEOMETRY.tool_position(HOME[None, :6])[0]
    assert 0.5 * LEASH < np.linalg.norm(ahead) <= LEASH
    arm.put(**twist(100, -0.2))
    assert np.linalg.norm(tool(arm.command(arm_state(HOME))) - tool(HOME[None])) < np.linalg.norm(ahead) - 0.009


def test_a_motion_begins_at_the_last_command_or_at_an_arm_that_was_halted(arm, clock):
    for seq, (measured, expected) in enumerate([(HOME - 0.0005, HOME), (HOME - 0.02, HOME - 0.02)]):
        arm.put(**twist(seq, 0.1))
        start = np.append(expected[:6], HOME[6])
        moved = tool(arm.command(arm_state(HOME, measured))) - tool(start[None])
        np.testing.assert_allclose(moved, [0.1 * PERIOD, 0, 0], atol=1e-4)
        clock.now += 1.0
        assert arm.command(arm_state()) is None


def test_a_twist_of_zeros_holds_what_moves_and_wakes_nothing(arm, clock):
    arm.put(**twist(0, 0.0))
    assert arm.command(arm_state(HOME, HOME - 0.01)) is None
    arm.put(**twist(1, 0.1))
    moving = arm.command(arm_state())
    arm.put(**twist(2, 0.0))
    np.testing.assert_array_equal(arm.command(arm_state()), moving)


def test_an_arm_of_another_size_follows_its_own_kinematics_and_one_without_is_not_jogged(clock):
    large = Jogger(ARM, PERIOD, geometry=UR10E, clock=clock)
    large.put(**twist(1, 0.1))
    moved = UR10E.tool_position(large.command(arm_state())[:, :6])[0] - UR10E.tool_position(HOME[None, :6])[0]
    np.testing.assert_allclose(moved, [0.1 * PERIOD, 0, 0], atol=1e-4)
    command = SignalSpec("command", ("a", "b"), ("rad", "rad"), (-1.0, -1.0), (1.0, 1.0), (1.0, 1.0))
    with pytest.raises(InvalidValue) as caught:
        Jogger(RobotSpec("two_joints", (), command, 0.05), 0.05)
    text = "two_joints cannot be jogged: its kinematics are not known. Drive it by a program."
    assert str(caught.value) == text
