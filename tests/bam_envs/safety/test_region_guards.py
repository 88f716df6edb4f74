"""The guards of forbidden regions: each acts at its limit, lets the arm leave, and brakes in time."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bam_envs.core.errors import InvalidValue, SafetyStop
from bam_envs.core.kinematics import UR5E_GRIPPER
from bam_envs.core.robot import Initial
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.kinematic_arm import ArmContacts, segment_distance2
from bam_envs.robots.ur import UR_MODELS
from bam_envs.robots.ur5e import arm_spec
from bam_envs.safety.arm_tubes import ArmTubes
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits, Tick
from bam_envs.safety.region_guards import Collision, WorkspaceBox
from bam_envs.safety.singularity import Singularity
from bam_envs.testing import ARM_HOME

ARM, HOME, ROW = arm_spec("ur5e", with_object=False), [*ARM_HOME, 0.085], np.arange(1)
JOINTS = st.lists(st.floats(-3.1, 3.1), min_size=6, max_size=6)


def tick_of(last, goal, **numbers):
    """A tick of an arm at rest at `last` (7,) that is told to go to `goal` (7,)."""
    still = {"last_step": [0.0] * 7, "measured": list(last), "before": list(last), "velocity": [0.0] * 7}
    return Tick(goal=list(goal), command=list(goal), last=list(last), age=0.0, period=ARM.period, **still, **numbers)


def box_of(low, high):
    return WorkspaceBox(ARM, Limits(), low, high, UR5E_GRIPPER.tool_position)


def reset(robot, joints=ARM_HOME):
    robot.connect()
    return robot.reset(ROW, Initial({"joint_position": np.array([joints], dtype=np.float64)}, np.zeros(1, np.int64)))


def tubes_of(geometry=UR5E_GRIPPER, tool=True):
    return ArmTubes(geometry, geometry.outline, tool=tool)


@pytest.mark.parametrize("name", sorted(UR_MODELS))
def test_tubes_are_as_far_apart_as_in_the_simulation_where_wrists_begin_3_cm_earlier(name):
    model, rng = UR_MODELS[name], np.random.default_rng(0)
    poses, contacts = rng.uniform(-3.1, 3.1, (50, 6)), ArmContacts(model)
    arms = contacts.capsules(poses)
    for tube in (5, 6):
        way = arms.end[:, tube] - arms.start[:, tube]
        arms.start[:, tube] -= 0.03 * way / np.linalg.norm(way, axis=1, keepdims=True)
    ends = [side[:, pair] for pair in (contacts._one, contacts._other) for side in (arms.start, arms.end)]
    expected = (np.sqrt(segment_distance2(*ends)) - np.sqrt(contacts._near)).min(axis=1)
    tubes = tubes_of(model.geometry, tool=False)
    np.testing.assert_allclose([tubes.nearest(q) for q in poses.tolist()], expected, atol=1e-12)


@pytest.mark.parametrize(
    "q",
    [
        (-3.03, -2.72, 2.84, 2.99, 1.82, -0.43),
        (0.92, 0.83, -2.84, 0.31, 1.06, 2.01),
        (2.83, -0.96, 2.81, -1.03, 0.88, 1.01),
        (1.35, 2.58, 2.77, -0.81, 0.9, 0.68),
    ],
)
def test_a_housing_of_a_wrist_that_is_in_the_upper_arm_is_found(q):
    """Triangles of the maker's meshes of the UR5e intersect there, by 5 to 14 mm of their convex hulls."""
    assert tubes_of(tool=False).nearest(q) < Limits().clearance


def test_the_lowest_point_is_that_of_the_links():
    lying, upright = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, -math.pi / 2, 0.0, -math.pi / 2, 0.0, 0.0]
    assert tubes_of().lowest(lying) == pytest.approx(0.1625 - 0.0997 - 0.0375)
    assert tubes_of().lowest(upright) == pytest.approx(0.1625 + 0.425 - 0.054)


@settings(max_examples=30, deadline=None)
@given(JOINTS, st.lists(st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6), max_size=20))
def test_pairs_that_cannot_be_near_are_left_out_without_a_mistake(joints, ways):
    tubes = tubes_of()
    for way in [[0.0] * 6, *ways]:
        joints = [joint + turn for joint, turn in zip(joints, way, strict=True)]
        assert tubes.nearer_than(0.01, joints) == (tubes.nearest(joints) < 0.01)


def test_zero_is_a_limit_of_the_box():
    box, below = box_of((-1, -1, 0.0), (1, 1, 1)), box_of((-1, -1, -1.0), (1, 1, 1))
    down = [0.0, -1.0, 2.2, -2.8, -math.pi / 2, 0.0]
    assert UR5E_GRIPPER.tool_point(down)[2] == pytest.approx(-0.092, abs=1e-3)
    assert box.depth(down) == pytest.approx(0.092, abs=1e-3)
    assert below.depth(down) == 0.0


def test_the_tool_stops_at_the_box_and_may_leave_its_edge():
    x, y, _ = UR5E_GRIPPER.tool_point(ARM_HOME)
    turned = math.hypot(x, y) * 0.002  # the tool's way at the limit: where it is after 0.002 rad
    box = box_of((-1, -1, 0), (1, y + turned, 1))
    way = [0.02 if x > 0 else -0.02, 0, 0, 0, 0, 0, 0]
    out = tick_of(HOME, np.add(HOME, way))
    assert box.limit(out)
    assert UR5E_GRIPPER.tool_point(out.command[:6])[1] <= y + turned + 1e-9
    assert box.depth(out.command[:6]) == 0.0
    assert abs(out.command[0] - HOME[0]) > 0.0005, "it may go up to the edge"
    back = tick_of(HOME, np.subtract(HOME, way))
    assert not box.limit(back)
    narrow = box_of((-1, -1, 0), (1, y - 0.1, 1))  # it stands outside
    farther, nearer = tick_of(HOME, np.add(HOME, way)), tick_of(HOME, np.subtract(HOME, way))
    assert (narrow.limit(farther), narrow.limit(nearer)) == (True, False)
    assert farther.command == HOME


def test_a_box_needs_room():
    with pytest.raises(InvalidValue) as caught:
        box_of((0, 0, 1), (1, 1, 1))
    assert str(caught.value) == (
        "A workspace box needs room: low (0.0, 0.0, 1.0) must be below high (1.0, 1.0, 1.0) on every axis. "
        "Change the limits box_* (box_z_min is table_height unless it is given)."
    )
    with pytest.raises(InvalidValue, match=r"box_x_min of 0.5 and box_x_max of 0.4 contradict each other"):
        Limits(box_x_min=0.5, box_x_max=0.4)


def test_a_start_pose_outside_the_box_or_in_the_table_is_refused_before_anything_moves():
    x, y, z = UR5E_GRIPPER.tool_point(ARM_HOME)
    robot = SafeRobot(FakeRobot(), limits=Limits(box_x_max=x - 0.1))
    with pytest.raises(InvalidValue) as caught:
        reset(robot)
    assert str(caught.value) == (
        f"workspace box (G10) does not allow the start pose: the tool would be at {x:.3f}, {y:.3f}, {z:.3f} m, outside "
        f"the box from -2.000, -2.000, 0.000 to {x - 0.1:.3f}, 2.000, 2.000 m: widen the box, or choose another start."
    )
    lying = (0.0, 0.3, 0.0, -1.0, -1.5, 0.0)
    with pytest.raises(InvalidValue, match=r"^collision \(G24\) does not allow the start pose: the arm would be -0"):
        reset(SafeRobot(FakeRobot(), limits=Limits(box_z_min=-2.0)), lying)


def drive(robot, state, goal, ticks):
    """Step towards `goal` (7,); the sent joints, and whether a guard stopped the robot."""
    sent = []
    for _ in range(ticks):
        try:
            state = robot.step(np.array([goal]))
        except SafetyStop as stop:
            return np.array(sent), stop
        sent.append(state.command[0, :6].copy())
    return np.array(sent), None


@pytest.mark.parametrize(
    ("goal", "code", "ticks"),
    [
        ((0.0, -1.0, 2.2, -2.8, -math.pi / 2, 0.0), 10, 90),  # the tool through the table
        ((0.0, -2.4, 2.9, -1.0, -math.pi / 2, 0.0), 24, 92),  # the wrist through the shoulder
    ],
)
def test_an_arm_that_is_told_to_go_through_something_rests_before_it_and_is_stopped(goal, code, ticks):
    robot = SafeRobot(FakeRobot())
    state = reset(robot)
    sent, stop = drive(robot, state, [*goal, 0.085], 400)
    assert str(stop).startswith(
        f"The robot was stopped by changed commands (G18): 21 of the last {ticks} commands were changed to keep the "
        "robot out of a forbidden region, and 20 are allowed: the report names the guards that changed them."
    )
    tubes = tubes_of()
    assert min(UR5E_GRIPPER.tool_point(q)[2] for q in sent.tolist()) >= -1e-9
    assert min(min(tubes.nearest(q), tubes.lowest(q)) for q in sent.tolist()) >= 0.005 - 1e-9
    name = {10: "workspace box", 24: "collision"}[code]
    assert robot.report()[name]["altered"] == 21
    robot.resume()
    _, stop = drive(robot, state, [*ARM_HOME, 0.085], 10)
    assert stop is None


def singularity(limits=None):
    return Singularity(ARM, limits or Limits(), UR5E_GRIPPER)


def jacobian(q, unit):
    """By differences, in the frame of the base."""
    columns, h = [], 1e-6
    here = UR5E_GRIPPER.link_poses(np.array([q]))[1][0, -1]
    for joint in range(6):
        turned = np.array(q) + h * (np.arange(6) == joint)
        point = np.subtract(UR5E_GRIPPER.tool_point(turned), UR5E_GRIPPER.tool_point(q)) / h / unit
        turn = (UR5E_GRIPPER.link_poses(turned[None])[1][0, -1] @ here.T - np.eye(3)) / h
        columns.append([*point, turn[2, 1], turn[0, 2], turn[1, 0]])
    return np.array(columns).T


@settings(max_examples=20, deadline=None)
@given(JOINTS)
def test_the_condition_number_is_that_of_the_jacobian_by_differences(q):
    expected = np.linalg.cond(jacobian(q, (0.425 + 0.3922) / 2))
    if expected < 100:
        assert singularity().condition(q) == pytest.approx(expected, rel=0.01)


def wrist(angle):
    """Home with joint 5 at `angle` [rad] from the wrist's singularity."""
    return [*HOME[:4], angle, *HOME[5:]]


def test_towards_a_singularity_an_arm_slows_down_and_stops_and_away_from_it_it_is_free():
    guard = singularity()
    condition = {angle: guard.condition(wrist(angle)[:6]) for angle in (-0.5, -0.25, -0.2, -0.1)}
    assert condition[-0.5] < 17 < condition[-0.2] < 30 < condition[-0.1]
    far, near = tick_of(wrist(-0.52), wrist(-0.5)), tick_of(wrist(-0.22), wrist(-0.2))
    assert (guard.limit(far), guard.limit(near)) == (False, True)
    share = (30 - condition[-0.2]) / 13
    assert near.command[4] == pytest.approx(-0.22 + share * 0.02)
    stop = tick_of(wrist(-0.12), wrist(-0.1))
    assert guard.limit(stop)
    assert stop.command == wrist(-0.12)
    assert not guard.limit(tick_of(wrist(-0.1), wrist(-0.12)))
    assert not guard.limit(tick_of(wrist(-0.12), wrist(-0.1), approach=True))


def test_a_singularity_that_is_gone_to_step_by_step_is_noticed_in_time():
    guard, place = singularity(), wrist(-1.0)
    for _ in range(200):
        tick = tick_of(place, [*place[:4], place[4] + 0.01, *place[5:]])
        guard.limit(tick)
        place = tick.command
    assert guard.condition(place[:6]) < 30.5


@pytest.mark.parametrize("limits", [{}, {"joint_speed": 3.0, "tool_speed": 1.0}])
def test_an_arm_that_cannot_brake_in_time_stops_before_a_singularity_all_the_same(limits):
    robot = SafeRobot(FakeRobot(), limits=Limits(**limits), straight=True)
    state, conditions = reset(robot, wrist(-1.2)[:6]), []
    for _ in range(120):  # past the ramp-in, which a far goal would begin
        state = robot.step(state.command + 0.04 * (np.arange(7) == 4))
        state = robot.step(state.command + 1.0 * (np.arange(7) == 4))
        conditions.append(singularity().condition(state.command[0, :6].tolist()))
    assert 25 < max(conditions) < 30.5


def test_only_tasks_that_move_the_tool_straight_have_the_guard_of_singularities():
    names = {straight: [*SafeRobot(FakeRobot(), straight=straight).report()] for straight in (False, True)}
    assert [name for name in names[True] if name not in names[False]] == ["singularity"]
    assert not Collision(ARM, Limits(), tubes_of(replace(UR5E_GRIPPER, tool=0.0))).depth(ARM_HOME)
