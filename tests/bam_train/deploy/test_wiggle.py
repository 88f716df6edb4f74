"""A small motion of each axis shows whether it moves as commanded."""

import math

import numpy as np
import pytest

from bam_envs.core.robot import Initial
from bam_envs.robots.base_description import base_model
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.kinematic_base import open_floor
from bam_envs.robots.ur5e import arm_spec
from bam_envs.safety.gate import SafeRobot
from bam_envs.testing.drivers import DrivenRobot
from bam_train.deploy.wiggle import FAR, motion_checks, recorded_motion, wiggle
from bam_train.recording.recorder import Recorder

HOME = np.array([-0.27, -1.54, 1.89, -1.93, -1.57, -1.84])
SPEC = arm_spec("ur5e", with_object=False)
ARM = SPEC.command


class Wrong(DrivenRobot):
    """Its driver alters commands, relative to where the robot was placed."""

    def __init__(self, robot, alter):
        super().__init__(robot)
        self.alter = alter

    def _driven(self, command):
        start = self._followed if not hasattr(self, "start") else self.start
        self.start = start
        return start + self.alter(command - start)


def wiggled(alter=lambda change: change):
    driven = Wrong(FakeRobot(with_object=False), alter)
    driven.connect()
    driven.place(Initial({"joint_position": HOME[None]}, np.zeros(1, np.int64)))
    robot = SafeRobot(driven, clock=driven.clock)
    robot.connect()
    lines = list(wiggle(robot, HOME))
    state = driven.measure()
    return {one.what: (one.found, one.verdict) for one in lines}, state, driven


def test_a_correct_arm_moves_a_little_and_comes_back():
    found, state, driven = wiggled()
    assert found == {f"motion of {label}": ("1.00 of what was commanded", "ok") for label in ARM.labels}
    np.testing.assert_allclose(state.signals["joint_position"][0], HOME, atol=1e-9)
    np.testing.assert_allclose(state.signals["gripper_width"][0], 0.085, atol=1e-9)
    assert driven.fastest < 0.06


def mirror(change):
    return change * (1, -1, 1, 1, 1, 1, 1)


def swap(change):
    return change[:, [0, 1, 2, 4, 3, 5, 6]]


@pytest.mark.parametrize(
    ("alter", "axis", "found"),
    [
        (mirror, "the joints", "first motion (G25): shoulder_lift_joint was commanded to move"),
        (swap, "the joints", "wrist_2_joint moved"),
        (lambda change: change * (1, 1, 1, 1, 1, 0, 1), "the joints", "wrist_3_joint was commanded to move"),
        (lambda change: change * (1, 1, 1, 1, 1, 1, -1), "gripper_width", "it did not move"),
    ],
)
def test_a_wrong_arm_is_refused_by_its_axis(alter, axis, found):
    """The guards stop the arm on the way where its position would be wrong; then nothing else is moved."""
    lines, state, _ = wiggled(alter)
    refused = {what: text for what, (text, verdict) in lines.items() if verdict != "ok"}
    assert list(refused) == [f"motion of {axis}"]
    assert found in refused[f"motion of {axis}"]
    np.testing.assert_allclose(state.signals["joint_position"][0], HOME, atol=0.04)


def test_a_base_drives_and_turns_a_little():
    floor = open_floor(1, randomize=False)
    driven = DrivenRobot(floor)
    driven.connect()
    driven.place(Initial({"base_pose": np.zeros((1, 3))}, np.zeros(1, np.int64)))
    robot = SafeRobot(driven, clock=driven.clock)
    lines = list(wiggle(robot, None))
    assert [(one.what, one.verdict) for one in lines] == [
        ("motion of linear_velocity", "ok"),
        ("motion of angular_velocity", "ok"),
    ]


# ---- a recording of any motion

PERIOD = 0.05


def motion(rng, lag=2):
    """Commands of 10 s that move every axis, and the positions measured `lag` periods later."""
    t = np.arange(200) * PERIOD
    rates = rng.uniform(0.5, 3.0, 7)
    commanded = np.sin(t[:, None] * rates) * np.array([0.2] * 6 + [0.02]) + np.array([*HOME, 0.05])
    measured = np.concatenate([np.repeat(commanded[:1], lag, axis=0), commanded])[: len(t)]
    return commanded, measured + rng.normal(0.0, 1e-4, measured.shape)


@pytest.mark.parametrize("lag", [0, 1, 4])
def test_a_recording_of_a_correct_arm(lag):
    lines = list(motion_checks(ARM, *motion(np.random.default_rng(lag), lag), PERIOD))
    assert [one.verdict for one in lines] == ["ok"] * 7


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda x: x * (-1, 1, 1, 1, 1, 1, 1), {"shoulder_pan_joint": "it moved the other way"}),
        (
            lambda x: x * (math.degrees(1), 1, 1, 1, 1, 1, 1),
            {"shoulder_pan_joint": "it moved 57 times as far (degrees?)"},
        ),
        (lambda x: x * (1, 1, 1, 1, 1, 1, 1000), {"gripper_width": "it moved 1e+03 times as far (millimetres?)"}),
        (
            lambda x: x[:, [2, 1, 0, 3, 4, 5, 6]],
            {
                "shoulder_pan_joint": "it moved as elbow_joint was commanded",
                "elbow_joint": "it moved as shoulder_pan_joint was commanded",
            },
        ),
    ],
)
def test_a_recording_of_a_wrong_arm(change, found):
    commanded, measured = motion(np.random.default_rng(3))
    lines = motion_checks(ARM, commanded, change(measured), PERIOD)
    assert {one.what.removeprefix("motion of "): one.found for one in lines if one.verdict == "refused"} == found


def test_an_axis_that_did_not_move_or_is_not_measured_is_not_told():
    commanded, measured = motion(np.random.default_rng(0))
    commanded[:, 0], measured[:, 6] = commanded[0, 0], np.nan
    lines = {one.what: one for one in motion_checks(ARM, commanded, measured, PERIOD)}
    assert [(one.what, one.found) for one in lines.values() if one.verdict == "unknown"] == [
        ("motion of shoulder_pan_joint", "it was not commanded to move"),
        ("motion of gripper_width", "it is not measured"),
    ]


def test_two_axes_that_were_commanded_alike_are_not_told_apart():
    commanded, measured = motion(np.random.default_rng(0))
    commanded[:, 1], measured[:, 1] = commanded[:, 0], measured[:, 0]
    lines = {one.what: (one.found, one.verdict) for one in motion_checks(ARM, commanded, measured, PERIOD)}
    assert lines["motion of shoulder_pan_joint"] == ("as shoulder_lift_joint was commanded, too", "unknown")


def test_a_gripper_that_holds_something_closes_no_further():
    commanded, measured = motion(np.random.default_rng(0))
    measured[:, 6] = np.maximum(measured[:, 6], 0.045)
    assert list(motion_checks(ARM, commanded, measured, PERIOD))[6].verdict == "ok"


def test_an_axis_that_goes_elsewhere_does_not_follow():
    commanded, measured = motion(np.random.default_rng(0))
    measured[:, 3] = np.random.default_rng(1).normal(0.0, 0.2, len(measured))
    assert list(motion_checks(ARM, commanded, measured, PERIOD))[3].found == "it did not follow its commands"


def test_every_unit_of_a_command_has_its_distance():
    assert {*ARM.units, *base_model("mir100").spec().command.units} == FAR.keys()


@pytest.mark.parametrize(
    ("told", "found"),
    [
        ({"robot": ""}, "a simulation"),
        ({"address": "ws://10.0.0.6:9090"}, "ws://10.0.0.6:9090"),
        ({"marks": "trial, shadow: nothing is sent"}, "a shadow, which sends nothing"),
    ],
)
def test_a_recording_of_another_robot_or_of_a_shadow_is_refused(tmp_path, told, found):
    recorder = Recorder(tmp_path / "a.mcap", {"robot": "ur5e", "address": "ws://10.0.0.5:9090", "marks": ""} | told)
    recorder.start()
    assert recorder.close() == ""
    [line] = recorded_motion(recorder.path, SPEC, "ws://10.0.0.5:9090/")
    assert (line.what, line.found, line.verdict) == ("recording a.mcap", found, "refused")


def test_robots_are_told_apart_by_their_names_where_both_are_known(tmp_path):
    told = {"robot": "ur5e", "address": "ws://127.0.0.1:9090", "marks": "", "identity": "left arm"}
    recorder = Recorder(tmp_path / "a.mcap", told)
    recorder.start()
    assert recorder.close() == ""
    for address, identity, verdict in [
        ("ws://10.0.0.5:9090", "left arm", "ok"),
        ("ws://127.0.0.1:9090", "right arm", "refused"),
        ("ws://127.0.0.1:9090", "", "ok"),
        ("ws://10.0.0.5:9090", "", "refused"),
    ]:
        assert [line.verdict for line in recorded_motion(recorder.path, SPEC, address, identity)] == [verdict]
