"""How targets become set points of UR arms, what reset options may be, and robo-gym's names for the state."""

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import RobotState
from bam_envs.robots.ur import UR_MODELS
from bam_envs.tasks.ur_arm import UrEmptyTask, in_frame, joint_option, normalised, spherical, wire_states
from bam_envs.tasks.ur_reach import UrReachTask

JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
UR5 = UR_MODELS["ur5"]
HERE = np.array([[0.0, -2.5, 1.5, 0.0, -1.4, 0.0]])


def at(joints, sent=None, **truth):
    joints = np.array(joints, dtype=float)
    sent = joints if sent is None else np.array(sent, dtype=float)
    return RobotState({"joint_position": joints}, np.zeros(len(joints)), sent, truth)


@pytest.mark.parametrize(
    ("task", "way", "step"),
    [
        (UrReachTask(), [1.0, -0.5, 0.0, 0.25, 0.0, -1.0], 0.1 * np.pi / 10 * np.array([1, -0.5, 0, 0.25, 0, -1])),
        (UrReachTask(), [0.15, 0, 0, 0, 0, 0.01], [0.03, 0, 0, 0, 0, 0.002]),  # within half a second
        (UrEmptyTask(), [0.3, 0, 0, 0, 0, 0.01], [0.03, 0, 0, 0, 0, 0.001]),
        # The slowest joint sets the pace: a UR10's base does 120 degrees/s, its wrists 180.
        (UrReachTask(ur_model="ur10"), [1.0, 0, 0, 1.2, 0, 0], 0.02 * np.pi / 3 * np.array([1, 0, 0, 1.2, 0, 0])),
    ],
)
def test_one_period_on_the_way_to_a_target(task, way, step):
    np.testing.assert_allclose(task.toward(HERE + np.array([way]), at(HERE)) - HERE, [step], atol=1e-15)


def test_set_points_go_on_from_the_last_one_unless_the_arm_is_elsewhere():
    here = np.tile(HERE, (2, 1))
    sent = here + np.array([[0.1, 0, 0, 0, 0, 0], [0.1, 0, 0, 0, 0.21, 0]])
    command = UrReachTask(2).toward(here + 1.0, at(here, sent))
    begin = np.stack([sent[0], here[1]])
    way = here + 1.0 - begin
    duration = np.abs(way).max(axis=1, keepdims=True) / (0.1 * np.pi)
    np.testing.assert_allclose(command, begin + way * 0.1 / duration, atol=1e-14)


def test_commands_stay_inside_the_limits():
    end = np.array([[0.0, 0.0, np.pi - 0.01, 0.0, 0.0, 0.0]])
    assert UrReachTask().toward(end + 2.0, at(end))[0, 2] == np.pi


def test_fixed_joints_are_not_in_the_action():
    task = UrReachTask(2, fix_base=True)
    assert task.free.tolist() == [1, 2, 3, 4]
    action = np.array([[0.1, 0.2, -0.3, 7.0], [0, 0, 0, -7.0]], np.float32)
    held = np.full((2, 6), 0.5)
    expected = np.array([[0.5, 0.1, 0.2, -0.3, 1.0, 0.5], [0.5, 0, 0, 0, -1.0, 0.5]])
    np.testing.assert_allclose(task.full_action(action, held), expected, atol=1e-7)
    assert task.full_action(action)[:, [0, 5]].tolist() == [[0, 0], [0, 0]]
    assert task.full_action(action).dtype == np.float64


def test_not_all_joints_can_be_fixed():
    with pytest.raises(InvalidValue) as caught:
        UrReachTask(**{f"fix_{name}": True for name in JOINTS})
    assert str(caught.value) == (
        "At least one of the six joints must be free to move: set one of the fix_ options False."
    )


def test_joints_as_shares_of_their_limits():
    joints = np.array([[np.pi, -np.pi, np.pi / 2, 7.0, -7.0, 0.0]])
    np.testing.assert_allclose(normalised(UR5, joints), [[0.5, -0.5, 0.5, 1.0, -1.0, 0.0]])


def test_spherical_coordinates():
    points = np.array([[0, 0, 2.0], [0, 0, -2.0], [3.0, 0, 0], [0, -1.0, 0], [1.0, 1.0, np.sqrt(2)], [0, 0, 0]])
    half = np.pi / 2
    expected = [[2, 0, 0], [2, np.pi, 0], [3, half, 0], [1, half, -half], [2, half / 2, half / 2], [0, 0, 0]]
    np.testing.assert_allclose(spherical(points), expected, atol=1e-12)


def test_a_point_as_a_frame_sees_it():
    rng = np.random.default_rng(0)
    position, rotation = UR5.geometry.flange_pose(rng.uniform(-3, 3, (5, 6)))
    local = rng.standard_normal((5, 3))
    point = position + np.einsum("nij,nj->ni", rotation, local)
    np.testing.assert_allclose(in_frame(point, position, rotation), local, atol=1e-12)


@pytest.mark.parametrize("given", [None, [0, -1, 1, 0, 0.5, 6], (0, -1, 1, 0, 0.5, 6), np.array([0, -1, 1, 0, 0.5, 6])])
def test_joint_options(given):
    expected = HERE[0] if given is None else given
    np.testing.assert_array_equal(joint_option({"joint_positions": given}, HERE[0], UR5), expected)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([0, 0, 0], "The reset option joint_positions must be 6 finite numbers, not [0, 0, 0]."),
        (
            [0, 0, 0, 0, 0, np.nan],
            "The reset option joint_positions must be 6 finite numbers, not [0, 0, 0, 0, 0, nan].",
        ),
        ("home", "The reset option joint_positions must be 6 finite numbers, not 'home'."),
        ([[1], [2, 3]], "The reset option joint_positions must be 6 finite numbers, not [[1], [2, 3]]."),
        (
            [0, 0, 3.5, 0, 0, 0],
            "The reset option joint_positions has elbow_joint at 3.5 rad, outside -3.142 to 3.142 rad.",
        ),
    ],
)
def test_joint_options_that_do_not_fit(value, text):
    with pytest.raises(InvalidValue) as caught:
        joint_option({"joint_positions": value}, HERE[0], UR5)
    assert str(caught.value) == text


def a_state(**truth):
    rng = np.random.default_rng(0)
    signals = {"joint_position": rng.uniform(-3, 3, (2, 6)), "joint_velocity": rng.uniform(-3, 3, (2, 6))}
    return RobotState(signals, np.zeros(2), np.zeros((2, 6)), truth)


def rotated(x, y, z, w, vector):
    axis = np.array([x, y, z])
    return vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)


def test_the_arm_alone_has_twenty_numbers():
    state = a_state(collision=np.array([False, True]))
    first, second = wire_states(UR5, state)
    assert len(first) == len(second) == 20
    for place, joint in enumerate(JOINTS):
        assert first[f"{joint}_joint_position"] == state.signals["joint_position"][0, place]
        assert second[f"{joint}_joint_velocity"] == state.signals["joint_velocity"][1, place]
    assert (first["in_collision"], second["in_collision"]) == (0.0, 1.0)
    position, rotation = UR5.geometry.flange_pose(state.signals["joint_position"])
    assert [second[f"ee_to_ref_translation_{axis}"] for axis in "xyz"] == position[1].tolist()
    quaternion = [second[f"ee_to_ref_rotation_{axis}"] for axis in "xyzw"]
    np.testing.assert_allclose(rotated(*quaternion, np.array([0, 0, 1.0])), rotation[1, :, 2], atol=1e-12)


def test_more_with_an_object_and_the_forearm():
    state, place = a_state(), np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    one, two = wire_states(UR5, state, place), wire_states(UR5, state, place, with_forearm=True)
    assert [len(one[0]), len(two[0])] == [27, 34]
    assert set(one[0]) < set(two[0])
    assert [one[1][f"object_0_to_ref_translation_{axis}"] for axis in "xyz"] == [0.4, 0.5, 0.6]
    assert [one[1][f"object_0_to_ref_rotation_{axis}"] for axis in "xyzw"] == [0, 0, 0, 1]
    forearm = UR5.geometry.link_poses(state.signals["joint_position"])[0][:, 2]
    assert [two[0][f"forearm_to_ref_translation_{axis}"] for axis in "xyz"] == forearm[0].tolist()
    assert one[0]["in_collision"] == 0.0
