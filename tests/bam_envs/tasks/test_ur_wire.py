"""robo-gym's names for the state of a UR arm."""

import copy
import pickle

import numpy as np

from bam_envs.core.robot import RobotState
from bam_envs.core.task import as_objects
from bam_envs.robots.ur import UR_MODELS
from bam_envs.tasks.ur_arm import wire_states

UR5 = UR_MODELS["ur5"]
JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")


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


def test_it_can_be_pickled_and_copied():
    objects = as_objects(list(wire_states(UR5, a_state())))
    assert objects.shape == (2,)
    assert all(type(value) is float for value in objects[0].values())
    assert pickle.loads(pickle.dumps(objects))[1] == objects[1] == copy.deepcopy(objects[1])
