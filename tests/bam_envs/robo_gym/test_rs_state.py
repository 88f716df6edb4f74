"""Wire states read, and back."""

import gymnasium as gym
import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers the ids
from bam_envs.core.errors import InvalidValue
from bam_envs.robo_gym.rs_state import UR_KEYS, read_mir, read_mir_target, read_object, read_ur

ARMS = {
    "EmptyEnvironmentURSim-v0": "only_robot",
    "EndEffectorPositioningURSim-v0": "1object",
    "AvoidanceRaad2022URSim-v0": "1moving2points",
}


def stepped(name):
    """One of our environments after a step, and its wire state."""
    env = gym.make(name, disable_env_checker=True).unwrapped
    env.reset(seed=1)
    env.step(np.full(env.action_space.shape, 0.5, dtype=np.float32))
    return env, env.get_rs_state()


def assert_same(state, expected, names):
    for name in names:
        np.testing.assert_array_equal(state.signals[name], expected.signals[name])
    assert state.truth["collision"].tolist() == expected.truth["collision"].tolist()


@pytest.mark.parametrize("name", ARMS)
def test_arms_there_and_back(name):
    env, wire = stepped(name)
    state = read_ur(wire)
    assert set(wire) == set(UR_KEYS[ARMS[name]])
    names = [
        one.name
        for one in env.robot.spec.signals
        if one.name in ("joint_position", "joint_velocity", "object_position")
    ]
    assert_same(state, env.last_state, names)
    np.testing.assert_array_equal(env.task.observe(state), env.task.observe(env.last_state))
    assert env.task.rs_state(state)[0] == wire


def test_a_base_there_and_back():
    env, wire = stepped("ObstacleAvoidanceMir100Sim-v0")
    state = read_mir(wire)
    assert_same(state, env.last_state, ["base_pose", "base_velocity", "f_scan", "b_scan"])
    assert [state.signals[name].shape for name in ("f_scan", "b_scan")] == [(1, 501), (1, 511)]
    np.testing.assert_array_equal(env.task.observe(state), env.task.observe(env.last_state))
    np.testing.assert_array_equal(read_mir_target(wire), env.task.target[0])
    assert env.task.rs_state(state)[0][:1021] == wire[:1021]


def test_numbers_of_a_base_are_where_robo_gym_has_them():
    wire = [float(i) for i in range(1030)]
    wire[1020] = 1.0
    state = read_mir(wire)
    assert read_mir_target(wire).tolist() == [0, 1, 2]
    assert state.signals["base_pose"].tolist() == [[3, 4, 5]]
    assert state.signals["base_velocity"].tolist() == [[6, 7]]
    assert state.signals["f_scan"][0, [0, -1]].tolist() == [8, 508]
    assert state.signals["b_scan"][0, [0, -1]].tolist() == [509, 1019]
    assert state.truth["collision"].tolist() == [True]
    wire[0] = wire[3] = wire[7] = wire[509] = float("nan")
    state = read_mir(wire)
    assert read_mir_target(wire).tolist() == [0, 1, 2]
    assert state.signals["base_pose"].tolist() == [[0, 4, 5]]
    assert state.signals["base_velocity"].tolist() == [[6, 0]]
    assert np.flatnonzero(np.isnan(state.signals["b_scan"])).tolist() == [0]  # a range stays as it is


def test_an_object_and_its_quaternion():
    wire = dict.fromkeys(UR_KEYS["1object"], 0.0)
    wire |= {f"object_0_to_ref_rotation_{axis}": value for axis, value in zip("xyzw", (1, 2, 3, 4), strict=True)}
    wire["object_0_to_ref_translation_y"], wire["in_collision"] = 0.5, 1.0
    position, quaternion = read_object(wire)
    assert (position.tolist(), quaternion.tolist()) == ([0, 0.5, 0], [4, 1, 2, 3])
    assert read_ur(wire).truth["collision"].tolist() == [True]


@pytest.mark.parametrize(
    ("wire", "text"),
    [
        ([0.0] * 1029, "The wire state of a MiR100 has 1030 numbers in a row; this has shape (1029,)."),
        (["far"], "The wire state of a MiR100 must be 1030 numbers: could not convert string to float: 'far'."),
        ([], "The wire state of a MiR100 has 1030 numbers in a row; this has shape (0,)."),
        ([0.0] * 8 + [float("inf")] + [0.0] * 1021, "Number 8 of the wire state of a MiR100 must be finite, not inf."),
    ],
)
def test_wrong_bases(wire, text):
    with pytest.raises(InvalidValue) as caught:
        read_mir(wire)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("mode", "change", "text"),
    [
        (
            "only_robot",
            {"wrist_2_joint_velocity": None},
            "The wire state of a UR (only_robot: 20 keys) lacks 'wrist_2_joint_velocity'; it has 19 keys.",
        ),
        (
            "1object",
            {"object_0_to_ref_rotation_w": None},
            "The wire state of a UR (1object: 27 keys) lacks 'object_0_to_ref_rotation_w'; it has 26 keys.",
        ),
        (
            "1moving2points",
            {"in_colision": 0.0},
            "The wire state of a UR (1moving2points: 34 keys) has 'in_colision', which robo-gym's has not; "
            "it has 35 keys.",
        ),
        (
            "only_robot",
            {"elbow_joint_position": float("nan")},
            "elbow_joint_position of the wire state of a UR must be finite, not nan.",
        ),
    ],
)
def test_wrong_arms(mode, change, text):
    wire = {**dict.fromkeys(UR_KEYS[mode], 0.0), **change}
    with pytest.raises(InvalidValue) as caught:
        read_ur({key: value for key, value in wire.items() if value is not None})
    assert str(caught.value) == text


def test_nothing_in_place_of_a_number():
    with pytest.raises(InvalidValue, match=r"^in_collision of the wire state of a UR must be finite, not None"):
        read_ur({**dict.fromkeys(UR_KEYS["only_robot"], 0.0), "in_collision": None})
