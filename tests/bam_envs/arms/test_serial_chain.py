"""Kinematics of every shipped arm as a chain: against MuJoCo, the closed form, differences and its own inverse."""

import copy
import dataclasses
import itertools
import pickle

import mujoco
import numpy as np
import pytest

from bam_envs.arms.capsules import Outline
from bam_envs.arms.description import ArmDescription, robot_model
from bam_envs.arms.serial_chain import HAND, Capsule, arm_of, chain_of
from bam_envs.core.kinematics import ArmGeometry
from bam_envs.core.robot_models import known_models
from bam_envs.robots.physics.arm_model import scene_spec

ARMS = ("fr3", "gen3", "so101", "ur10e", "ur16e", "ur3e", "ur5e", "xarm7")
UR = tuple(name for name in ARMS if name.startswith("ur"))
DOWN = [0.0, 0.0, -1.0]


def postures(chain, n, seed=0):
    """Joint positions within the limits. Shape: (n, k) [rad]."""
    return np.random.default_rng(seed).uniform(chain.low, chain.high, (n, chain.num_joints))


def followed(chain, start, path):
    """The joints that follow tool positions and yaws, one small step after another."""
    q = start
    for position, yaw in path:
        q = chain.reach_down(position, yaw, q)
    return q


def line(chain, goals, yaws, steps=150):
    """Straight lines from the tool of the home pose to `goals` (n, 3) and `yaws` (n,), then rest there."""
    start, axis = chain.tool_pose(chain.home[None])
    turned = np.arctan2(axis[:, 1], axis[:, 0])
    for share in [*np.linspace(0, 1, steps + 1)[1:], *[1.0] * 10]:
        yield start + share * (goals - start), turned + share * (yaws - turned)


def test_these_are_the_shipped_arms():
    assert set(ARMS) == set(known_models(ArmDescription))


@pytest.mark.parametrize("name", ARMS)
def test_forward_kinematics_are_those_of_mujoco(name):
    arm = robot_model(name)
    model = scene_spec(arm, with_object=False).compile()
    data, site = mujoco.MjData(model), model.site("tool").id
    q = postures(arm.chain, 1000)
    position, x_axis = arm.chain.tool_pose(q)
    frames = arm.chain.link_frames(q)
    for row, joints in enumerate(q):
        data.qpos[: arm.num_joints] = joints
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(position[row], data.site_xpos[site], rtol=0, atol=1e-9)
        np.testing.assert_allclose(frames[row, -1, :3, :3].ravel(), data.site_xmat[site], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(x_axis, frames[:, -1, :3, 0])


@pytest.mark.parametrize("name", UR)
def test_the_chain_of_an_ur_arm_is_its_closed_form(name):
    arm = robot_model(name)
    assert isinstance(arm.arm, ArmGeometry)
    q = postures(arm.chain, 500)
    for chain, closed in zip(arm.chain.tool_pose(q), arm.arm.tool_pose(q), strict=True):
        np.testing.assert_allclose(chain, closed, rtol=0, atol=1e-9)
    for chain, closed in zip(arm.chain.flange_pose(q[:20]), arm.arm.flange_pose(q[:20]), strict=True):
        assert chain.shape == closed.shape
    other = chain_of(arm.arm)
    np.testing.assert_allclose(other.link_frames(q), arm.chain.link_frames(q), rtol=0, atol=1e-9)
    assert other.capsules == tuple(one for one in arm.capsules if one.link <= arm.num_joints)
    assert chain_of(arm.chain) is arm.chain


@pytest.mark.parametrize("name", ARMS)
def test_the_jacobian_is_that_of_numeric_differences(name):
    chain, step = robot_model(name).chain, 1e-6
    for q in postures(chain, 20):
        moves = q + step * np.concatenate([np.eye(len(q)), -np.eye(len(q))])
        ahead, behind = np.split(chain.link_frames(moves)[:, -1], 2)
        linear = (ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * step)
        turn = ahead[:, :3, :3] @ behind[:, :3, :3].transpose(0, 2, 1)
        turn = (turn - turn.transpose(0, 2, 1)) / (4 * step)
        angular = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
        np.testing.assert_allclose(chain.tool_jacobian(q.tolist()), np.concatenate([linear.T, angular.T]), atol=1e-8)


@pytest.mark.parametrize("name", ARMS)
def test_one_pose_and_many_are_the_same(name):
    chain = robot_model(name).chain
    q = postures(chain, 20)
    np.testing.assert_array_equal(chain.tool_position(q), chain.tool_pose(q)[0])
    one_by_one = [chain.tool_point(pose) for pose in q.tolist()]
    np.testing.assert_allclose(one_by_one, chain.tool_position(q), rtol=0, atol=1e-14)
    poses = np.array([chain.poses(pose) for pose in q.tolist()])
    np.testing.assert_array_equal(poses[:, 0], np.tile(chain.mount[:3].ravel(), (20, 1)))
    np.testing.assert_allclose(poses[:, 1:].reshape(20, -1, 3, 4), chain.link_frames(q)[:, :, :3], rtol=0, atol=1e-14)
    goals, yaws = chain.tool_position(chain.home[None]) + 0.01, np.zeros(1)
    near = np.tile(chain.home, (20, 1)) + 0.01 * q
    many = chain.reach_down(np.tile(goals, (20, 1)), np.tile(yaws, 20), near)
    alone = [chain.joints_down(*goals[0].tolist(), 0.0, pose) for pose in near.tolist()]
    np.testing.assert_allclose(alone, many, rtol=0, atol=1e-12)
    flange, turned = chain.flange_pose(q)
    np.testing.assert_allclose(flange + HAND * turned[:, :, 2], chain.tool_position(q), atol=1e-15)


@pytest.mark.parametrize("name", ARMS)
def test_the_tool_follows_lines_from_home_to_every_corner_of_the_work_area(name):
    arm = robot_model(name)
    chain = arm.chain
    corners = np.array(list(itertools.product(*zip(*arm.workspace, strict=True))))
    yaws = [-1.2, 0.0, 1.2] if chain.turns else [0.0]
    goals, turns = np.repeat(corners, len(yaws), axis=0), np.tile(yaws, len(corners))
    q = followed(chain, np.tile(chain.home, (len(goals), 1)), line(chain, goals, turns))
    position, x_axis = chain.tool_pose(q)
    np.testing.assert_allclose(position, goals, rtol=0, atol=1e-6)
    np.testing.assert_allclose(chain.link_frames(q)[:, -1, :3, 2], np.tile(DOWN, (len(goals), 1)), rtol=0, atol=1e-5)
    if chain.turns:
        np.testing.assert_allclose(np.arctan2(x_axis[:, 1], x_axis[:, 0]), turns, rtol=0, atol=1e-5)
    assert (q > chain.low).all()
    assert (q < chain.high).all()


@pytest.mark.parametrize("name", ARMS)
def test_out_of_reach_the_joints_are_finite_and_within_their_limits(name):
    chain = robot_model(name).chain
    goals = np.array([[5.0, 0.0, 0.3], [-3.0, 3.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 9.0], [1e4, 0.0, 0.0]])
    for near in (None, np.tile(chain.home, (5, 1))):
        q = chain.reach_down(goals, np.full(5, 0.7), near)
        assert np.isfinite(q).all()
        assert (q >= chain.low).all()
        assert (q <= chain.high).all()
    # It comes as near as it can: from a position out of reach, the tool is farther out than in the home pose.
    q = followed(chain, chain.home[None], [(goals[:1], np.zeros(1))] * 300)
    assert np.isfinite(q).all()
    assert chain.tool_position(q)[0, 0] > chain.tool_position(chain.home[None])[0, 0] + 0.02


@pytest.mark.parametrize("name", [name for name in ARMS if robot_model(name).num_joints == 7])
def test_an_elbow_that_is_free_comes_home_with_the_tool(name):
    arm = robot_model(name)
    chain = arm.chain
    start, axis = chain.tool_pose(chain.home[None])
    goal, yaw = np.array([arm.workspace[1]]), np.arctan2(axis[:, 1], axis[:, 0])
    out = list(line(chain, goal, np.ones(1)))
    there = followed(chain, chain.home[None], out)
    assert np.abs(there - chain.home).max() > 0.2
    back = followed(chain, there, [*reversed(out), *[(start, yaw)] * 100])
    np.testing.assert_allclose(back[0], chain.home, rtol=0, atol=2e-3)


def test_which_arm_a_function_belongs_to():
    chain, closed = robot_model("fr3").arm, robot_model("ur5e").arm
    assert arm_of(chain.tool_position) is chain
    assert arm_of(closed.tool_position) is closed
    for other in (chain.tool_pose, len, None, lambda q: chain.tool_position(q)):
        assert arm_of(other) is None


def test_a_chain_whose_code_was_made_can_be_copied_and_sent():
    chain = robot_model("fr3").chain
    place = chain.tool_point(chain.home.tolist())
    assert pickle.loads(pickle.dumps(chain)).tool_point(chain.home.tolist()) == place
    assert copy.deepcopy(chain).tool_point(chain.home.tolist()) == place


def test_an_arm_without_capsules_touches_nothing():
    outline = Outline(dataclasses.replace(robot_model("fr3").chain, capsules=()))
    q = robot_model("fr3").chain.home[None]
    assert (outline.lowest(q).item(), outline.nearest(q).item()) == (np.inf, np.inf)


def test_a_shoulder_that_stands_low_is_not_taken_for_an_arm_in_the_table():
    chain = robot_model("fr3").chain
    low = Capsule(link=2, radius=0.4)  # a shoulder whose outline reaches below the table, where it is mounted
    outline = Outline(dataclasses.replace(chain, capsules=(low, *chain.capsules)))
    assert outline.lowest(chain.home[None]) > 0.1
