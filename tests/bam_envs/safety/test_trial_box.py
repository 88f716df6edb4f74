"""A robot on trial stays near its start."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.kinematics import UR5E_GRIPPER
from bam_envs.core.robot import Initial
from bam_envs.core.robot_env import RobotEnv
from bam_envs.robots.base_description import base_model
from bam_envs.robots.physics.kinematic_base import SimulatedBase
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits
from bam_envs.safety.guards import default_guards
from bam_envs.tasks.reach import ReachTask

START = np.array([0.5, 0.0, 0.3])


def far_along(axis, sign, half):
    """How far the tool goes from its start along an axis [m], asked to go 0.3 m beyond the box in 200 ticks."""
    robot = SafeRobot(SimulatedArm(with_object=False), limits=Limits(trial_box=half, clamp_stop=1.0))
    joints = UR5E_GRIPPER.reach_down(START[None], np.zeros(1))
    robot.connect()
    robot.reset(np.zeros(1, np.int64), Initial({"joint_position": joints}, np.zeros(1, np.uint64)))
    target = START.copy()
    target[axis] += sign * (half + 0.3) * (0.5 if axis == 2 else 1.0)
    goal = UR5E_GRIPPER.reach_down(target[None], np.zeros(1))[0]
    command = np.concatenate([goal, robot.spec.command.high[6:]])[None]
    farthest = 0.0
    for _ in range(200):
        state = robot.step(command)
        tool = UR5E_GRIPPER.tool_position(state.signals["joint_position"])[0]
        farthest = max(farthest, float(np.abs(tool - START).max()))
    assert robot.report()["trial box"]["altered"] > 0
    return farthest


@pytest.mark.parametrize(("axis", "sign", "half"), [(0, -1, 0.1), (1, 1, 0.1), (1, -1, 0.2), (2, 1, 0.1)])
def test_the_tool_stays_in_the_box(axis, sign, half):
    assert 0.8 * half < far_along(axis, sign, half) < half + 0.01


def test_the_way_to_the_start_pose_is_free_and_the_box_is_around_the_first_one():
    robot = SafeRobot(SimulatedArm(with_object=False), limits=Limits(trial_box=0.05))
    env = RobotEnv(robot, ReachTask())
    for seed in range(3):  # starts are farther from each other than the box is large
        env.reset(seed=seed)
        state = env.state
        command = state.command.copy()
        robot.step(command)
    assert robot.report()["trial box"]["limit"] == 0.05


def test_a_base_brakes_at_the_edge():
    base = SimulatedBase(room=None, with_scans=False)
    robot = SafeRobot(base, limits=Limits(trial_box=1.0, clamp_stop=1.0))
    start = np.array([[2.0, -1.0, math.pi / 2]])
    robot.connect()
    robot.reset(np.zeros(1, np.int64), Initial({"base_pose": start}, np.zeros(1, np.uint64)))
    for _ in range(60):
        state = robot.step(np.array([[0.5, 0.0]]))
    x, y, _ = state.signals["base_pose"][0]
    assert (x, robot.spec.command.units) == (pytest.approx(2.0, abs=0.02), ("m/s", "rad/s"))
    assert -0.2 < y <= 0.02


def test_a_base_whose_place_is_not_measured_has_no_box_and_is_refused():
    spec = replace(base_model("mir100").spec(with_scans=False), signals=base_model("mir100").spec().signals[1:2])
    with pytest.raises(
        InvalidValue, match=r"^The trial box \(G10\) of mir100 needs base_pose, which the task does not"
    ):
        default_guards(spec, Limits(trial_box=1.0))


def test_without_the_limit_there_is_no_such_guard():
    assert "trial box" not in SafeRobot(SimulatedArm(with_object=False)).report()
