"""Batched physics: rows do not know of each other, and what goes wrong is noticed."""

import os

import numpy as np
import pytest

from bam_envs.core.errors import MissingExtra, PhysicsDiverged
from bam_envs.core.robot import Initial
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.robots.physics.mujoco_batch import Physics
from bam_envs.testing import ARM_HOME

SCENE = "ur5e_cube.xml"


def control(rows, steps=10):
    return np.tile(np.concatenate([ARM_HOME, [0.085]]), (rows, steps, 1))


def started(rows, **options):
    physics = Physics(SCENE, rows, **options)
    physics.qpos[:, :6] = ARM_HOME
    physics.qpos[:, 6:8] = 0.0425
    physics.qpos[:, 8:10] = np.random.default_rng(0).uniform([0.4, -0.2], [0.6, 0.2], (rows, 2))
    return physics


def test_state_is_time_positions_velocities():
    physics = Physics(SCENE, 3)
    assert physics.state.shape == (3, 1 + 15 + 14)
    assert physics.qpos.shape == (3, 15)
    assert physics.qvel.shape == (3, 14)
    physics.step(control(3))
    np.testing.assert_allclose(physics.time, 0.05, atol=1e-12)
    physics.close()


def test_rows_do_not_know_of_each_other():
    many = started(7)
    rows = [started(1) for _ in range(7)]
    for row, one in enumerate(rows):
        one.state = many.state[row : row + 1].copy()
    for k in range(20):
        command = control(7) + 0.002 * k * np.arange(7)[:, None, None]
        many.step(command)
        for row, one in enumerate(rows):
            one.step(np.ascontiguousarray(command[row : row + 1]))
            np.testing.assert_array_equal(one.state[0], many.state[row])
    for physics in (many, *rows):
        physics.close()


def test_a_saved_state_goes_on_exactly():
    physics, other = started(3), started(3)
    for _ in range(5):
        physics.step(control(3))
    other.state = physics.state.copy()
    for _ in range(5):
        physics.step(control(3))
        other.step(control(3))
    np.testing.assert_array_equal(physics.state, other.state)


@pytest.mark.parametrize("bad", [np.nan, 1e11])
def test_a_row_that_diverges_is_noticed(bad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log there
    arm = SimulatedArm(3)
    arm.connect()
    command = control(3, 1)[:, 0]
    arm.physics.qpos[:, :6] = ARM_HOME
    arm.physics.qvel[1] = bad
    with pytest.raises(PhysicsDiverged) as caught:
        arm.step(command)
    assert str(caught.value) == "The simulated state of environments [1] is not finite. Reset them."
    with pytest.raises(PhysicsDiverged):
        arm.step(command)
    initial = Initial({"joint_position": ARM_HOME[None], "object_pose": np.zeros((1, 3)) + 0.4}, np.zeros(1, np.int64))
    arm.reset(np.array([1]), initial)
    arm.step(command)
    arm.close()


def test_without_affinity_every_core_is_used(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    physics = Physics(SCENE, 2)
    physics.step(control(2))
    physics.close()


def test_varied_rows_have_models_of_their_own():
    physics = started(2, varied=True)
    model = physics.model_of(1)
    model.actuator_gainprm[:, 0] *= 0.5
    assert physics.model_of(0).actuator_gainprm[0, 0] == physics.model.actuator_gainprm[0, 0]
    physics.close()


def test_the_cube_rests_where_it_is_put():
    physics = started(4)
    physics.qpos[:, 10] = 0.02
    before = physics.qpos[:, 8:11].copy()
    for _ in range(40):
        physics.step(control(4))
    assert np.abs(physics.qpos[:, 8:11] - before).max() < 1e-3
    physics.close()


def test_without_mujoco_the_extra_is_named(python):
    result = python(
        "import sys; sys.modules['mujoco'] = None\n"
        "import gymnasium, bam_envs\n"
        "from bam_envs.core.errors import MissingExtra\n"
        "env = gymnasium.make('bam/pick-v0', disable_env_checker=True)\n"
        "try: env.reset()\n"
        "except MissingExtra as error: print(error)\n"
    )
    expected = 'A simulated robot needs mujoco, which is not installed. Run: pip install "bam-train[sim]"'
    assert result == expected
    assert issubclass(MissingExtra, ImportError)
