"""Closed-form kinematics against MuJoCo and against themselves."""

import mujoco
import numpy as np
import pytest

from bam_envs.kinematics import UR5E, cube_yaw_phase
from bam_envs.robots.simulated.physics import MODELS
from bam_envs.robots.ur5e import GEOMETRY


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_path(str(MODELS / "ur5e_cube.xml"))


def random_joints(n, seed=0):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, 6))


def test_forward_kinematics_are_those_of_the_model(model):
    data, site = mujoco.MjData(model), model.site("tool").id
    joints = random_joints(200)
    position, x_axis = GEOMETRY.tool_pose(joints)
    for row, q in enumerate(joints):
        data.qpos[:6] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(position[row], data.site_xpos[site], atol=2e-6)
        np.testing.assert_allclose(x_axis[row], data.site_xmat[site].reshape(3, 3)[:, 0], atol=2e-6)


def test_tool_position_is_the_position_of_tool_pose():
    joints = random_joints(10)
    np.testing.assert_array_equal(GEOMETRY.tool_position(joints), GEOMETRY.tool_pose(joints)[0])


def test_the_tool_is_farther_out_than_the_flange_by_its_length():
    joints = random_joints(50)
    gap = np.linalg.norm(GEOMETRY.tool_position(joints) - UR5E.tool_position(joints), axis=1)
    np.testing.assert_allclose(gap, 0.15, atol=1e-12)


def test_inverse_kinematics_are_exact():
    rng = np.random.default_rng(1)
    position = rng.uniform([0.30, -0.25, 0.016], [0.70, 0.25, 0.35], (2000, 3))
    yaw = rng.uniform(-1.2, 1.2, 2000)
    joints = GEOMETRY.reach_down(position, yaw)
    found, x_axis = GEOMETRY.tool_pose(joints)
    np.testing.assert_allclose(found, position, atol=1e-12)
    np.testing.assert_allclose(np.arctan2(x_axis[:, 1], x_axis[:, 0]), yaw, atol=1e-12)
    np.testing.assert_allclose(x_axis[:, 2], 0.0, atol=1e-12)
    # Down: the tool's z axis is minus world z, so lengthening the tool lowers it and does nothing else.
    shift = found - UR5E.tool_position(joints)
    np.testing.assert_allclose(shift, np.tile([0.0, 0.0, -0.15], (2000, 1)), atol=1e-12)


def test_inverse_kinematics_do_not_jump():
    way = np.linspace(0, 1, 2000)[:, None]
    position = (1 - way) * [0.30, -0.25, 0.016] + way * [0.70, 0.25, 0.35]
    joints = GEOMETRY.reach_down(position, np.linspace(-1.2, 1.2, 2000))
    assert np.abs(np.diff(joints, axis=0)).max() < 0.01


@pytest.mark.parametrize("position", [[5.0, 0.0, 0.2], [0.5, 0.0, 9.0], [0.0, 0.0, 0.0], [0.0, 0.05, 0.4], [0, 0, -3]])
def test_a_position_out_of_reach_gets_finite_joints(position):
    assert np.isfinite(GEOMETRY.reach_down(np.array([position], dtype=float), np.zeros(1))).all()


def quaternion(axis, angle):
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.asarray(axis, dtype=float)])


def product(a, b):
    (w, *v), (x, *u) = a, b
    return np.concatenate([[w * x - np.dot(v, u)], w * np.array(u) + x * np.array(v) + np.cross(v, u)])


def faces():
    """The 24 ways to put a cube down."""
    half = np.pi / 2
    up = [([1, 0, 0], k * half) for k in range(4)] + [([0, 1, 0], half), ([0, 1, 0], -half)]
    return [product(quaternion(*one), quaternion([0, 0, 1], k * half)) for one in up for k in range(4)]


@pytest.mark.parametrize("yaw", [-2.5, -0.3, 0.0, 0.7, 3.0])
def test_yaw_of_a_cube_does_not_depend_on_the_face_that_is_up(yaw):
    turned = np.array([product(quaternion([0, 0, 1], yaw), face) for face in faces()])
    np.testing.assert_allclose(cube_yaw_phase(turned), np.exp(4j * yaw), atol=1e-12)


def test_yaw_phase_is_bounded_while_the_cube_tumbles():
    turned = np.random.default_rng(2).standard_normal((5000, 4))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    assert np.abs(cube_yaw_phase(turned)).max() <= 1.0 + 1e-12
