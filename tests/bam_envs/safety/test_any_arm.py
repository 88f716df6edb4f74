"""The guards of described arms: what they keep an FR3 and an SO-101 from, and what they let them do."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bam_envs.arms.capsules import Outline
from bam_envs.arms.description import ArmDescription, robot_model
from bam_envs.core.errors import SafetyStop
from bam_envs.core.robot import Initial
from bam_envs.core.robot_env import RobotEnv
from bam_envs.core.robot_models import known_models
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.safety.arm_tubes import ChainTubes, tubes_of
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits, Tick
from bam_envs.safety.region_guards import Collision, WorkspaceBox
from bam_envs.safety.singularity import Singularity
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.scripted import scripted_policy

ROW, CHAINS = np.arange(1), ("fr3", "so101")
CLEARANCE, STEP = 0.005, 0.25 * 0.05  # kept by default [m], and the longest way of the tool in a period [m]


def guarded(name, **options):
    """An arm behind the guards, at its home pose."""
    arm = SimulatedArm(robot_model=name, with_object=False)
    robot = SafeRobot(arm, tool_position=arm.tool_position, **options)
    robot.connect()
    home = np.array([arm.description.home])
    return robot, robot.reset(ROW, Initial({"joint_position": home}, np.zeros(1, np.int64))), arm.description


def drive(robot, goal, ticks):
    """Step towards `goal` (m,); the commands that were sent (k, joints), and why the robot was stopped, if it was."""
    sent = []
    for _ in range(ticks):
        try:
            state = robot.step(np.array([goal]))
        except SafetyStop as stop:
            return np.array(sent), str(stop)
        sent.append(state.command[0, :-1].copy())
    return np.array(sent), ""


def colliding(arm, n):
    """Joint positions (n, k) in which links overlap by 2 cm or more, the tool above the table on the way."""
    chain, tubes = arm.chain, ChainTubes(arm.chain, tool=True)
    rng, found = np.random.default_rng(0), []
    for _ in range(3000):
        if len(found) == n:
            break
        q = rng.uniform(chain.low, chain.high)
        way = chain.home + np.linspace(0, 1, 60)[:, None] * (q - chain.home)
        above = chain.tool_position(way)[:, 2].min() > 0.05 and min(map(tubes.lowest, way.tolist())) > 0.03
        if above and tubes.nearest(q.tolist()) < -0.02:
            found.append(q)
    return found


def test_an_arm_that_is_told_to_go_through_itself_rests_before_it_and_is_stopped():
    name, goals = "fr3", colliding(robot_model("fr3"), 3)
    assert len(goals) == 3
    for goal in goals:
        robot, _, arm = guarded(name)
        sent, stop = drive(robot, [*goal, arm.gripper.open], 600)
        assert stop.startswith("The robot was stopped by changed commands (G18): 21 of the last 100 commands")
        assert robot.report()["collision"]["altered"] == 21
        tubes = ChainTubes(arm.chain, tool=True)
        assert min(map(tubes.nearest, sent.tolist())) >= CLEARANCE - 1e-9
        robot.resume()
        _, stop = drive(robot, [*arm.home, arm.gripper.open], 10)
        assert stop == "", "it may leave"
        robot.close()


@pytest.mark.parametrize("name", CHAINS)
def test_an_arm_that_is_told_to_go_through_the_table_rests_above_it(name):
    robot, _, arm = guarded(name, limits=Limits(box_z_min=-2.0))
    goal = np.array(arm.home)
    lift = {"fr3": 1, "so101": 1}[name]
    goal[lift] = arm.chain.high[lift]
    tubes = ChainTubes(arm.chain, tool=True)
    assert tubes.lowest(goal.tolist()) < -0.02
    sent, stop = drive(robot, [*goal, arm.gripper.open], 600)
    assert stop
    assert min(map(tubes.lowest, sent.tolist())) >= CLEARANCE - 1e-9
    robot.close()


@pytest.mark.parametrize("name", CHAINS)
def test_its_tool_reaches_the_bottom_of_the_box_and_no_farther(name):
    robot, _, arm = guarded(name, limits=Limits(box_z_min=0.03))
    x, y, _ = arm.chain.tool_point(arm.home)
    q = np.array([arm.home])
    for z in np.linspace(arm.chain.tool_point(arm.home)[2], 0.0, 60):
        q = arm.chain.reach_down(np.array([[x, y, z]]), np.zeros(1), q)
    sent, _ = drive(robot, [*q[0], arm.gripper.open], 300)
    heights = arm.chain.tool_position(sent)[:, 2]
    assert 0.03 - 1e-9 <= heights.min() < 0.033
    robot.close()


@pytest.mark.parametrize("name", CHAINS)
def test_its_tool_and_joints_stay_below_their_speeds(name):
    """Goals far away, each kept for a while; a stop by a guard is resumed."""
    robot, state, arm = guarded(name)
    rng, chain, rows = np.random.default_rng(1), arm.chain, [state.command[0, :-1]]
    fastest = np.minimum(1.0, [row.velocity for row in arm.joints]) * 0.05
    for _ in range(8):
        sent, stop = drive(robot, [*rng.uniform(chain.low, chain.high), arm.gripper.open], 40)
        rows += list(sent)
        if stop:
            robot.resume()
    sent = np.array(rows)
    turns = np.abs(np.diff(sent, axis=0))
    assert (turns <= fastest * (1 + 1e-9)).all()
    tool = np.linalg.norm(np.diff(chain.tool_position(sent), axis=0), axis=1)
    assert 0.5 * STEP < tool.max() <= STEP * (1 + 1e-6)
    robot.close()


@pytest.mark.parametrize("name", known_models(ArmDescription))
def test_the_scripted_pick_at_full_speed_is_not_stopped(name):
    arm = SimulatedArm(robot_model=name)
    robot = SafeRobot(arm, tool_position=arm.tool_position, straight=True)
    env, policy = (
        gym.wrappers.TimeLimit(RobotEnv(robot, PickTask(robot_model=name)), 150),
        scripted_policy("bam/pick-v0", name),
    )
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        ended = False
        while not ended:
            observation, _, terminated, truncated, info = env.step(policy.act_batch(observation[None])[0])
            ended = terminated or truncated
        assert info["is_success"]
    assert robot.stopped is None
    report = robot.report()
    assert [row["altered"] for guard, row in report.items() if guard in ("collision", "workspace box")] == [0, 0]
    assert [guard for guard, row in report.items() if row["held"] or row["stopped"]] == []
    env.close()


TURNS = st.lists(st.lists(st.floats(-0.15, 0.15), min_size=7, max_size=7), min_size=1, max_size=15)


def walk(chain, start, turns):
    """Joint positions from a random posture on, one step after another, within the limits."""
    q = np.random.default_rng(start).uniform(chain.low, chain.high)
    for turn in [np.zeros(7), *turns]:
        q = np.clip(q + np.array(turn)[: chain.num_joints], chain.low, chain.high)
        yield q.tolist()


@pytest.mark.parametrize("tool", [True, False])
@pytest.mark.parametrize("name", CHAINS)
@settings(max_examples=25)
@given(st.integers(0, 10_000), TURNS)
def test_no_tube_comes_near_between_two_computations(name, tool, start, turns):
    chain = robot_model(name).chain
    tubes, kept = tubes_of(chain, tool=tool), tuple(one for one in chain.capsules if tool or one.link <= len(chain.low))
    outline = Outline(dataclasses.replace(chain, capsules=kept))  # computes the same in another way
    for q in walk(chain, start, turns):
        nearest, lowest = outline.nearest(np.array([q]))[0], outline.lowest(np.array([q]))[0]
        assert tubes.nearest(q) == pytest.approx(nearest, abs=1e-12)
        assert tubes.lowest(q) == pytest.approx(lowest, abs=1e-12)
        assert tubes.nearer_than(0.01, q, 0.02) == (min(nearest, lowest - 0.02) < 0.01)


@pytest.mark.parametrize("name", CHAINS)
@settings(max_examples=25)
@given(st.integers(0, 10_000), TURNS)
def test_collision_and_box_miss_nothing_between_two_computations(name, start, turns):
    arm = robot_model(name)
    spec = arm.spec(with_object=False)
    box = Limits(), [-0.3, -0.2, 0.05], [0.3, 0.4, 0.5], arm.arm.tool_position
    for kind, arguments in ((Collision, (Limits(), ChainTubes(arm.chain, tool=True))), (WorkspaceBox, box)):
        guard, fresh = kind(spec, *arguments), kind(spec, *arguments)
        for q in walk(arm.chain, start, turns):
            assert guard.is_outside(q) == (fresh.depth(q) <= 1e-9)


@pytest.mark.parametrize("name", CHAINS)
@settings(max_examples=25)
@given(st.integers(0, 10_000), TURNS)
def test_a_singularity_is_not_missed_between_two_computations(name, start, turns):
    arm = robot_model(name)
    spec, limits, open_ = arm.spec(with_object=False), Limits(), arm.gripper.open
    guard, last = Singularity(spec, limits, arm.chain), None
    for q in walk(arm.chain, start, turns):
        if last is not None:
            rest = {"last_step": [0.0] * 8, "measured": last, "before": last, "velocity": [0.0] * 8}
            ticks = [
                Tick(goal=[*q, open_], command=[*q, open_], last=last, age=0.0, period=spec.period, **rest)
                for _ in range(2)
            ]
            changed = guard.limit(ticks[0])
            assert changed == Singularity(spec, limits, arm.chain).limit(ticks[1])
            assert ticks[0].command == ticks[1].command
        last = [*q, open_]
