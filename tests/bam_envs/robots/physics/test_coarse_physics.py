"""Coarse physics, to train on: near the fine one, rows by themselves, and objects that nothing touches left alone."""

import numpy as np
import pytest

from bam_envs.arms.description import robot_model
from bam_envs.core.errors import InvalidValue
from bam_envs.robots.physics.coarse_physics import COARSE, FINE, CoarsePhysics
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.robots.physics.mujoco_batch import Physics
from bam_envs.testing import ARM_HOME

UR5E = robot_model("ur5e")
BESIDE, BETWEEN = (0.4, -0.2, 0.02), (0.5, 0.0, 0.02)
"""Places of the cube: beside the gripper, and between its fingers."""


def control(rows, joints=ARM_HOME, width=0.085):
    return np.tile(np.concatenate([joints, [width]]), (rows, FINE, 1))


def put(physics, joints, *cubes):
    """Put arms at rest at `joints`, the gripper open, and each one's cube at a place."""
    physics.qpos[:, :6], physics.qpos[:, 6:8], physics.qpos[:, 8:11] = joints, 0.0425, cubes
    return physics


def coarse(rows, **options):
    return CoarsePhysics(UR5E, rows, **{"with_object": True, "varied": False, **options})


@pytest.fixture
def low():
    """Joints with the tool 2 cm above the table between the fingers of an open gripper."""
    return UR5E.arm.reach_down(np.array([[*BETWEEN[:2], 0.02]]), np.zeros(1))[0]


@pytest.mark.parametrize("cube", [BESIDE, BETWEEN])
def test_an_arm_moves_as_with_fine_physics(low, cube):
    fine, physics = Physics("ur5e_cube.xml", 1), coarse(1)
    for each in (fine, physics):
        put(each, low, cube)
        for k in range(1, 11):  # at 0.3 rad/s, then at rest
            turned = np.clip((k - 1 + np.arange(1, FINE + 1) / FINE) * 0.015, 0, 0.075)[None, :, None]
            each.step(control(1, low) + turned * (np.arange(7) == 0))
            if k == 4:
                moving = each.qpos[0, 0]
        each.moving = moving
    assert physics.moving == pytest.approx(fine.moving, abs=2e-3)
    np.testing.assert_allclose(physics.qpos[:, :8], fine.qpos[:, :8], atol=1e-3)
    assert physics.time[0] == pytest.approx(0.5)
    for each in (fine, physics):
        each.close()


def test_only_a_cube_that_nothing_can_touch_stays_as_it_is(low):
    """Of four cubes one lies between the fingers, one moves, and one falls; they settle in the table by themselves."""
    physics = put(coarse(4), low, BESIDE, BETWEEN, BESIDE, (*BESIDE[:2], 0.03))
    physics.qvel[2, 8] = 0.1
    before = physics.qpos.copy()
    physics.step(control(4, low))
    moved = (physics.qpos[:, 8:] != before[:, 8:]).any(axis=1)
    assert moved.tolist() == [False, True, True, True]
    physics.close()


def test_a_cube_in_the_way_is_not_passed_through(low):
    """The gripper, closed, comes from 15 cm beside the cube and pushes it along, as with fine physics."""
    fine, physics = Physics("ur5e_cube.xml", 1), coarse(1)
    beside = UR5E.arm.reach_down(np.array([[0.5, -0.15, 0.03]]), np.zeros(1))[0]
    for each in (fine, physics):
        put(each, beside, BETWEEN)
        here = control(1, beside, 0.0)
        for y in np.linspace(-0.14, 0.05, 24):
            goal = UR5E.arm.reach_down(np.array([[0.5, y, 0.03]]), np.zeros(1))
            ramp = np.linspace(1 / FINE, 1, FINE)[None, :, None]
            there = np.concatenate([goal, [[0.0]]], axis=1)[:, None]
            each.step(here[:, -1:] + ramp * (there - here[:, -1:]))
            here = np.tile(there, (1, FINE, 1))
    assert fine.qpos[0, 9] > 0.05
    np.testing.assert_allclose(physics.qpos[0, 8:10], fine.qpos[0, 8:10], atol=5e-3)
    for each in (fine, physics):
        each.close()


@pytest.mark.parametrize("varied", [False, True])
def test_rows_do_not_know_of_each_other(low, varied):
    places = [BESIDE, BETWEEN, BESIDE]
    many, rows = put(coarse(3, varied=varied), low, *places), [coarse(1, varied=varied) for _ in places]
    for one, place in zip(rows, places, strict=True):
        put(one, low, place)
    for k in range(10):
        command = control(3, low, 0.085 - 0.008 * k) + 0.002 * k * np.arange(3)[:, None, None]
        many.step(command)
        for row, one in enumerate(rows):
            one.step(command[row : row + 1].copy())
            np.testing.assert_array_equal(one.state[0], many.state[row])
    for physics in (many, *rows):
        physics.close()


def test_a_period_is_not_divided():
    arm = SimulatedArm(with_object=False)
    arm.coarse = True
    arm.connect()
    assert arm.physics.model.opt.timestep == pytest.approx(0.05 / COARSE)
    with pytest.raises(InvalidValue, match=r"^Coarse physics takes a whole period of 10 set points, not 5\.$"):
        next(arm.slices(arm.setpoint, 2))
    arm.close()
