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
MAKE = """
import gymnasium, bam_envs
env = gymnasium.make('bam/pick-v0', disable_env_checker=True)
try: env.reset()
except Exception as error: print(f"{type(error).__name__}: {error}")
"""


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


def test_environments_at_rest_stay_as_they_are_and_the_others_do_not_know():
    all_of_them, some = started(3), started(3)
    some.resting = np.array([False, True, False])
    before = some.state.copy()
    for physics in (all_of_them, some):
        physics.step(control(3))
    np.testing.assert_array_equal(some.state[1], before[1])
    np.testing.assert_array_equal(some.state[[0, 2]], all_of_them.state[[0, 2]])
    for physics in (all_of_them, some):
        physics.close()


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


def test_without_mujoco_the_extra_is_named(python):
    code = "import sys; sys.modules['mujoco'] = None" + MAKE
    expected = (
        'A simulated robot or its picture needs mujoco, which is not installed. Run: pip install "bam-train[sim]"'
    )
    assert python(code) == f"MissingExtra: {expected}"
    assert issubclass(MissingExtra, ImportError)


def test_a_backend_that_mujoco_does_not_know(python):
    said = python(MAKE, MUJOCO_GL="dx")
    assert said.startswith("InvalidValue: MuJoCo cannot be imported: ")
    assert said.endswith(" Unset MUJOCO_GL, or set it to egl or osmesa.")
