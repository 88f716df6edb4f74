"""What leaves a robot where it is, and what a halt sends."""

import numpy as np

from bam_envs.live.rest import hold_command, rest_command
from bam_envs.robots.profiles.profile import load_profile

ARM, BASE = load_profile("ur5e"), load_profile("mir100")
SPEC, SINKS = ARM.spec(), ARM.sinks()
SIGNALS = {
    "joint_position": np.arange(6.0)[None],
    "joint_velocity": np.full((1, 6), 9.0),
    "gripper_width": np.array([[0.04]]),
}
SENT = np.array([5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 0.02])


def test_an_arm_rests_where_it_is():
    np.testing.assert_array_equal(rest_command(SPEC, SINKS, SIGNALS), [0, 1, 2, 3, 4, 5, 0.04])
    np.testing.assert_array_equal(rest_command(SPEC, SINKS, {}), [np.nan] * 7)


def test_a_base_rests_when_it_is_told_zero():
    signals = {"base_velocity": np.array([[0.3, 0.4]])}
    np.testing.assert_array_equal(rest_command(BASE.spec(), BASE.sinks(), signals), [0.0, 0.0])
    np.testing.assert_array_equal(hold_command(BASE.spec(), BASE.sinks(), {}, np.ones(2)), [0.0, 0.0])


def test_a_halted_arm_stays_and_its_gripper_goes_on_holding():
    np.testing.assert_array_equal(hold_command(SPEC, SINKS, SIGNALS, SENT), [0, 1, 2, 3, 4, 5, 0.02])


def test_a_gripper_that_was_told_nothing_is_left_alone():
    np.testing.assert_array_equal(hold_command(SPEC, SINKS, SIGNALS, None), [0, 1, 2, 3, 4, 5, np.nan])


def test_an_arm_that_cannot_be_read_holds_what_it_was_sent():
    np.testing.assert_array_equal(hold_command(SPEC, SINKS, {}, SENT), SENT)
    np.testing.assert_array_equal(hold_command(SPEC, SINKS, {}, None), [np.nan] * 7)
