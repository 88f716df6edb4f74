"""The simulated UR5e: set points, limits, gripper, halt."""

from dataclasses import replace

import numpy as np
import pytest

from bam_envs.arms.description import robot_model
from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.core.robot import Initial, Robot
from bam_envs.robots.physics.mujoco_arm import SimulatedArm, arm_scene, cube_scene
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.testing import ARM_HOME


@pytest.fixture
def arm():
    """One arm with a cube, at its start."""
    robot = SimulatedArm(1)
    robot.connect()
    yield robot
    robot.close()


def begin(robot, object_pose=(0.5, 0.1, 0.3), joints=ARM_HOME):
    n = robot.num_robots
    signals = {"joint_position": np.tile(joints, (n, 1)), "object_pose": np.tile(object_pose, (n, 1))}
    return robot.reset(np.arange(n), Initial(signals, np.arange(n, dtype=np.int64)))


def hold(width=0.085):
    return np.concatenate([ARM_HOME, [width]])[None]


def test_scenes_are_robots_that_differ_in_the_object():
    with_cube, without = cube_scene(2), arm_scene(2)
    assert isinstance(with_cube, Robot)
    assert [signal.name for signal in with_cube.spec.signals] == [
        "joint_position",
        "joint_velocity",
        "gripper_width",
        "object_position",
        "object_quaternion",
    ]
    assert [signal.name for signal in without.spec.signals] == ["joint_position", "joint_velocity", "gripper_width"]
    assert with_cube.spec.period == 0.05


def test_reset_puts_everything_where_it_is_told(arm):
    state = begin(arm)
    np.testing.assert_array_equal(state.signals["joint_position"], [ARM_HOME])
    np.testing.assert_array_equal(state.signals["joint_velocity"], np.zeros((1, 6)))
    np.testing.assert_array_equal(state.signals["gripper_width"], [[0.085]])
    np.testing.assert_allclose(state.signals["object_position"], [[0.5, 0.1, 0.02]])
    np.testing.assert_allclose(state.signals["object_quaternion"], [[np.cos(0.15), 0, 0, np.sin(0.15)]])
    np.testing.assert_array_equal(state.stamp, [0.0])
    np.testing.assert_array_equal(state.command, hold())


def test_a_tool_of_another_length_is_simulated():
    """Also that of a project's own ``ur5e``, which has the name of the one with a model of its own."""
    arm = robot_model("ur5e")
    longer = replace(arm, tool=replace(arm.tool, xyz=(0.0, 0.0, arm.tool.xyz[2] + 0.05)))
    heights = []
    for one in (arm, longer):
        robot = SimulatedArm(robot_model=one, with_object=False)
        robot.connect()
        begin(robot)
        site = robot.physics.data_of(0).site("tool").xpos
        np.testing.assert_allclose(site, robot.tool_position(np.array([ARM_HOME]))[0], atol=1e-9)
        heights.append(site[2])
        robot.close()
    assert heights[1] < heights[0] - 0.04


def test_it_holds_still(arm):
    start = begin(arm)
    for _ in range(40):
        state = arm.step(hold())
    assert np.abs(state.signals["joint_position"] - start.signals["joint_position"]).max() < 1e-3
    assert np.abs(state.signals["object_position"] - start.signals["object_position"]).max() < 1e-3
    np.testing.assert_allclose(state.stamp, [2.0], atol=1e-9)


def test_the_gripper_closes_at_its_speed(arm):
    begin(arm, object_pose=(0.65, 0.2, 0.0))
    widths = [float(arm.step(hold(0.0)).signals["gripper_width"][0, 0]) for _ in range(20)]
    assert widths[0] > 0.085 - 1.5 * 0.15 * 0.05
    assert abs(widths[-1]) < 1e-3
    assert np.diff(widths).min() > -1.6 * 0.15 * 0.05


def test_the_gripper_stops_at_the_cube(arm):
    joints = GEOMETRY.reach_down(np.array([[0.5, 0.0, 0.02]]), np.zeros(1))[0]
    begin(arm, object_pose=(0.5, 0.0, 0.0), joints=joints)
    for _ in range(20):
        state = arm.step(np.concatenate([joints, [0.0]])[None])
    assert 0.035 < state.signals["gripper_width"][0, 0] < 0.041


def test_halt_holds_where_it_is(arm):
    begin(arm)
    moving = arm.step(hold() + 0.04)
    arm.halt()
    state = arm.step(arm.setpoint)
    assert np.abs(state.signals["joint_position"][0] - moving.signals["joint_position"][0]).max() < 0.05


def test_not_connected():
    arm = SimulatedArm(1)
    for act in (lambda: arm.step(hold()), lambda: begin(arm), lambda: arm.render("rgb_array", [])):
        with pytest.raises(ResetNeeded) as caught:
            act()
        assert str(caught.value) == "The simulated robot is not connected. Call reset() first."


def test_a_command_beyond_the_data_sheet_is_followed_as_far_as_the_arm_can():
    arm = cube_scene()
    arm.connect()
    start = begin(arm).command.copy()
    far = start.copy()
    far[0, :6] += 10.0
    sent = arm.step(far).command
    np.testing.assert_allclose(sent[0, :6] - start[0, :6], np.pi * 0.05, rtol=1e-12)
    for _ in range(100):
        sent = arm.step(far).command
    assert (sent <= np.array(arm.spec.command.high)).all()
    assert sent[0, 2] == np.pi


def test_the_parts_of_a_period_have_the_set_points_of_the_period():
    one, two = SimulatedArm(1), SimulatedArm(1)
    for arm in (one, two):
        arm.connect()
        begin(arm)
    for way in (0.03, -0.01, 0.02):
        expected = one.step(hold() + way)
        states = list(two.slices(hold() + way, 5))
    assert len(states) == 5
    np.testing.assert_allclose([state.stamp[0] for state in states], 0.1 + np.array([0.01, 0.02, 0.03, 0.04, 0.05]))
    np.testing.assert_allclose(states[-1].signals["joint_position"], expected.signals["joint_position"], atol=1e-6)
    np.testing.assert_allclose(two.setpoint, one.setpoint, atol=1e-15)
    one.close()
    two.close()


@pytest.mark.parametrize("parts", [0, 3, 20, 2.5, -1])
def test_a_period_is_divided_into_whole_physics_steps(arm, parts):
    begin(arm)
    with pytest.raises(InvalidValue) as caught:
        arm.slices(hold(), parts)
    assert str(caught.value) == f"A period has 10 physics steps; it cannot be divided into {parts!r}."


def test_a_halt_between_two_parts_holds_for_the_rest(arm):
    begin(arm)
    parts = arm.slices(hold() + 0.04, 5)
    next(parts)
    next(parts)
    arm.halt()
    held = arm.setpoint
    states = list(parts)
    assert len(states) == 3
    np.testing.assert_array_equal(arm.setpoint, held)
    np.testing.assert_array_equal(states[-1].command, held)


def test_a_period_that_is_left_in_the_middle_goes_on_from_there(arm):
    begin(arm)
    parts = arm.slices(hold() + 0.04, 5)
    next(parts)
    half = next(parts).command.copy()
    begun = arm.setpoint
    state = next(arm.slices(half, 1))
    np.testing.assert_allclose(begun[0, :6], ARM_HOME + 0.016)
    np.testing.assert_allclose(state.stamp, [0.07])


def test_a_noisy_tracker_looks_once_a_period():
    arm = SimulatedArm(1, randomize=True)
    arm.connect()
    begin(arm)
    for _ in range(3):
        states = list(arm.slices(hold(), 5))
        for state in states[1:4]:
            np.testing.assert_array_equal(state.signals["object_position"], states[0].signals["object_position"])
    arm.close()


def test_the_object_is_placed_elsewhere_while_the_arm_stays(arm):
    begin(arm)
    before = arm.step(hold() + 0.02)
    seen = {name: array.copy() for name, array in before.signals.items()}
    state = arm.place_object(np.array([[0.4, -0.1, 0.6]]), np.zeros(1, np.int64))
    np.testing.assert_allclose(state.signals["object_position"], [[0.4, -0.1, 0.02]])
    np.testing.assert_allclose(state.signals["object_quaternion"], [[np.cos(0.3), 0, 0, np.sin(0.3)]])
    np.testing.assert_array_equal(state.signals["joint_position"], seen["joint_position"])
    assert not state.signals["joint_velocity"].any()
    for name, array in seen.items():
        np.testing.assert_array_equal(before.signals[name], array)
    resting = arm.step(before.command)
    assert np.abs(resting.signals["object_position"] - [[0.4, -0.1, 0.02]]).max() < 1e-3


def test_a_new_scene_draws_anew_what_differs():
    arm = SimulatedArm(1, randomize=True)
    arm.connect()
    first = begin(arm).signals["object_position"].copy()
    pose = np.array([[0.5, 0.1, 0.3]])
    arm.step(hold())
    other = arm.place_object(pose, np.array([7])).signals["object_position"]
    assert (other != first).any()
    np.testing.assert_array_equal(arm.place_object(pose, np.array([0])).signals["object_position"], first)
    arm.close()


def test_an_arm_without_an_object_has_none_to_place():
    arm = arm_scene()
    arm.connect()
    begin(arm)
    with pytest.raises(InvalidValue) as caught:
        arm.place_object(np.zeros((1, 3)), np.zeros(1, np.int64))
    assert str(caught.value) == "The robot 'ur5e' has no object that could be placed."
    arm.place_object(None, np.zeros(1, np.int64))
    arm.close()
