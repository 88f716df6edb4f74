"""Closed-form kinematics against MuJoCo and against themselves."""

import mujoco
import numpy as np
import pytest

from bam_envs.core.kinematics import LINKS, UR5E, angle_between, cube_yaw_phase, from_angles, quaternions, turned
from bam_envs.robots.physics.mujoco_batch import MODELS
from bam_envs.robots.ur import UR_MODELS
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
    one_by_one = [GEOMETRY.tool_point(pose) for pose in joints.tolist()]
    np.testing.assert_allclose(one_by_one, GEOMETRY.tool_position(joints), rtol=0, atol=1e-14)


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


def turn(angle, axis):
    """Homogeneous matrix of a turn about x or z."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    one, two = (1, 2) if axis == "x" else (0, 1)
    matrix[one, one], matrix[one, two], matrix[two, one], matrix[two, two] = c, -s, s, c
    return matrix


def shift(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def denavit_hartenberg(geometry, q):
    """Poses behind each joint as Denavit and Hartenberg have them, in base_link."""
    rows = [
        (geometry.d1, 0.0, np.pi / 2),
        (0.0, geometry.a2, 0.0),
        (0.0, geometry.a3, 0.0),
        (geometry.d4, 0.0, np.pi / 2),
        (geometry.d5, 0.0, -np.pi / 2),
        (geometry.d6, 0.0, 0.0),
    ]
    pose, poses = turn(np.pi, "z"), []
    for angle, (d, a, alpha) in zip(q, rows, strict=True):
        pose = pose @ turn(angle, "z") @ shift(0, 0, d) @ shift(a, 0, 0) @ turn(alpha, "x")
        poses.append(pose)
    return poses


def description(geometry, q):
    """Poses of the links as ur_description chains them: where each joint is in the link before, then its turn."""
    joints = [
        shift(0, 0, geometry.d1),
        turn(np.pi / 2, "x"),
        shift(geometry.a2, 0, 0),
        shift(geometry.a3, 0, geometry.d4),
        shift(0, -geometry.d5, 0) @ turn(np.pi / 2, "x"),
        shift(0, geometry.d6, 0) @ turn(-np.pi / 2, "x"),
    ]
    pose, poses = turn(np.pi, "z"), []
    for joint, angle in zip(joints, q, strict=True):
        pose = pose @ joint @ turn(angle, "z")
        poses.append(pose)
    return poses


@pytest.mark.parametrize("name", UR_MODELS)
def test_flange_of_every_model_is_the_product_of_its_matrices(name):
    geometry, joints = UR_MODELS[name].geometry, random_joints(50)
    position, rotation = geometry.flange_pose(joints)
    expected = np.array([denavit_hartenberg(geometry, q)[-1] for q in joints])
    np.testing.assert_allclose(position, expected[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(rotation, expected[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(geometry.tool_position(joints), position, atol=1e-12)


@pytest.mark.parametrize("name", UR_MODELS)
def test_links_of_every_model_are_where_the_description_has_them(name):
    geometry, joints = UR_MODELS[name].geometry, random_joints(50, seed=1)
    positions, rotations = geometry.link_poses(joints)
    expected = np.array([description(geometry, q) for q in joints])
    assert positions.shape == (50, len(LINKS), 3)
    np.testing.assert_allclose(positions, expected[:, :, :3, 3], atol=1e-12)
    np.testing.assert_allclose(rotations, expected[:, :, :3, :3], atol=1e-12)


def test_a_row_of_link_poses_is_the_row_alone():
    joints = random_joints(7)
    positions, rotations = UR5E.link_poses(joints)
    for row, q in enumerate(joints):
        alone = UR5E.link_poses(q[None])
        np.testing.assert_array_equal(positions[row], alone[0][0])
        np.testing.assert_array_equal(rotations[row], alone[1][0])


def test_quaternions_of_rotations():
    expected = np.random.default_rng(3).standard_normal((500, 4))
    expected = np.concatenate([expected, np.eye(4), [[1, 0, 0, 1e-9], [0, 1, 1, 0]]])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    expected[expected[:, 3] < 0] *= -1
    x, y, z, w = expected.T
    rotation = np.empty((len(expected), 3, 3))
    rotation[:, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    rotation[:, 1] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    rotation[:, 2] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    found = quaternions(rotation)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", found, expected)), 1.0, atol=1e-12)
    assert (found[:, 3] >= 0).all()


H = np.sqrt(0.5)


@pytest.mark.parametrize(
    ("angles", "quaternion"),
    [
        ((0, 0, 0), (0, 0, 0, 1)),
        ((np.pi / 2, 0, 0), (H, 0, 0, H)),
        ((0, np.pi / 2, 0), (0, H, 0, H)),
        ((0, 0, np.pi / 2), (0, 0, H, H)),
        ((0, np.pi / 2, np.pi / 2), (-0.5, 0.5, 0.5, 0.5)),  # x points down, then all turned to the left
        ((np.pi / 2, np.pi / 2, 0), (0.5, 0.5, -0.5, 0.5)),
    ],
)
def test_angles_about_fixed_axes(angles, quaternion):
    np.testing.assert_allclose(from_angles(np.array([angles], float)), [quaternion], atol=1e-15)


def test_the_angle_between_two():
    one = from_angles(np.array([[0.0, 0.0, 0.3], [0.0, 1.2, 0.0], [0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]))
    other = from_angles(np.array([[0.0, 0.0, -0.1], [0.0, 1.2, 0.0], [0.1, 0.2, 0.3], [np.pi, 0.0, 0.0]]))
    np.testing.assert_allclose(angle_between(one, other), [0.4, 0.0, 0.0, np.pi], atol=1e-15)
    np.testing.assert_allclose(angle_between(one, -other), [0.4, 0.0, 0.0, np.pi], atol=1e-15)


def test_small_angles_are_exact():
    turned = from_angles(np.array([[0.0, 0.0, 1e-9]]))
    np.testing.assert_allclose(angle_between(turned, np.array([[0.0, 0.0, 0.0, 1.0]])), [1e-9], rtol=1e-9)


@pytest.mark.parametrize("arm", [GEOMETRY, UR_MODELS["ur10"].geometry])
def test_the_jacobian_is_that_by_differences(arm):
    for q in random_joints(20):
        rows = np.array(arm.jacobian(q.tolist())).reshape(1, 6, 2, 3)
        rows = turned(rows, np.cos(q[:1]), np.sin(q[:1]))[0]  # in base_link
        for joint, step in enumerate(1e-6 * np.eye(6)):
            (ahead, axes), (behind, others) = arm.flange_pose((q + step)[None]), arm.flange_pose((q - step)[None])
            points = [end[0] + arm.tool * turn[0, :, 2] for end, turn in ((ahead, axes), (behind, others))]
            turn = (axes[0] - others[0]) @ arm.flange_pose(q[None])[1][0].T / 2e-6
            np.testing.assert_allclose(rows[joint, 0], (points[0] - points[1]) / 2e-6, atol=1e-6)
            np.testing.assert_allclose(rows[joint, 1], [turn[2, 1], turn[0, 2], turn[1, 0]], atol=1e-6)
